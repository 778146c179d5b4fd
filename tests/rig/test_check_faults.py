"""`rig check` over the wire: every planted fault is named, no healthy bench is accused."""

from __future__ import annotations

import contextlib
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from haselab.base import HaselabError
from haselab.rig import Rig
from haselab.rig.bench_config import BenchConfig
from haselab.rig.checks import (
    CheckResult,
    DryPlan,
    LivePlan,
    dry_checks,
    edge_check,
    live_checks,
)
from haselab.rig.instruments.nidaq.section import NidaqConfig
from haselab.rig.instruments.registry import daq_of
from haselab.rig.real_bench import RealBench
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.serve.faults import FAULTS, BenchFaults
from haselab.rig.twin.serve.generator.state import GeneratorFaults
from haselab.rig.twin.serve.ni.bus import BoardFaults
from haselab.rig.twin.serve.server import ServedTwin
from haselab.rig.twin.serve.wiring import Wiring

pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")

Changes = dict[str, dict[str, Any]]


@dataclass(frozen=True)
class Bench:
    """A served bench and the rig file of its user."""

    faults: BenchFaults = field(default_factory=BenchFaults)
    changes: Changes = field(default_factory=dict)
    without: tuple[str, ...] = ()
    board: str = "USB-6212"
    twin: dict[str, dict[str, Any]] = field(default_factory=dict)
    seed: int = 1
    ahead_blocks: int = 1
    plan: LivePlan = field(default_factory=LivePlan)
    meanwhile: Callable[[ServedTwin], object] = lambda _: None
    exposure_line: bool = True  # wired; its check takes more than half of the time

    def config(self, served: ServedTwin) -> BenchConfig:
        text = served.rig_file(ahead_blocks=self.ahead_blocks, exposure_line=self.exposure_line)
        data = tomllib.loads(text)
        data["daq"]["server_patience_s"] = 30.0  # a busy machine is no fault
        for section, values in self.changes.items():
            data[section] |= values
        for section in self.without:
            del data[section]
        return BenchConfig.model_validate(data)


def steps(bench: Bench, served: ServedTwin, gate: type) -> Iterator[CheckResult]:
    """As `haselab rig check --live` goes through them."""
    config = bench.config(served)

    @contextlib.contextmanager
    def opened(changed: BenchConfig) -> Iterator[Rig]:
        with RealBench(changed, gate()) as real:
            yield real.rig

    daq = daq_of(config.daq)
    with contextlib.closing(daq.connect(config.daq)) as link:
        yield from daq.route_checks(config.daq, config.exposure, link)
    yield from edge_check(config, opened)
    with opened(config) as rig:
        yield from dry_checks(rig, DryPlan())
        bench.meanwhile(served)
        yield from live_checks(rig, bench.plan)


def reported(bench: Bench, gate: type) -> tuple[str, int]:
    """What the first check that fails says and advises, empty if none does; how many passed."""
    config = twin_of_reading("hz").model_dump()
    for section, values in bench.twin.items():
        config[section] |= values
    twin = TwinConfig.model_validate(config)
    passed = 0
    with ServedTwin(twin, bench.seed, 0.0, board=bench.board, faults=bench.faults) as served:
        try:
            for each in steps(bench, served, gate):
                if not each.passed:
                    return f"{each.what}: {each.found}. {each.advice}", passed
                passed += 1
        except HaselabError as error:
            assert "\n" not in str(error)
            return str(error), passed
        finally:
            assert served.hub.output_v == pytest.approx(0.0, abs=30.0)  # it runs down
    return "", passed


NAMED = {
    "voltage-monitor-off": "Connect the voltage monitor to daq.v_monitor",
    "current-monitor-off": "Connect the current monitor to daq.i_monitor",
    "monitors-swapped": "Swap the cables of the two monitors",
    "voltage-monitor-reversed": "Swap the two wires of the voltage monitor",
    "current-monitor-reversed": "Swap the two wires of the current monitor",
    "voltage-monitor-scale": "Change amplifier.volt_per_monitor_volt",
    "current-monitor-scale": "Multiply amplifier.ampere_per_monitor_volt by 2",
    "output-off": "Connect daq.output to the summing input",
    "output-reversed": "Use the amplifier's non-inverting input",
    "output-scale": "Change the gain of the summing stage at daq.output",
    "generator-off": "Connect the generator's output",
    "generator-load": "Set generator.load",
    "generator-scale": "Set generator.volt_per_volt",
    "amplifier-off": "switch it and its high voltage on",
    "input-floats": "the input floats: connect its negative side to ground",
    "mains-hum": "Connect the shields at one end only",
    "actuator-off": "and the actuator to the amplifier",
    "actuator-shorted": "the actuator is shorted, or its capacitance is too large",
    "route-refused": "board: block clock: NI board Dev1: the device cannot route a required signal",
    "tasks-orphaned": "haselab rig safe RIG.toml",
    "usb-slow": "outputs came after their block. Raise daq.ahead_blocks",
    "second-program": "close other programs that are connected to it",
    "supply-on-at-boot": "would put out up to 2000 V at power-on",
    "supply-jack-out": "its power jack is unplugged",
    "supply-stays-on": "its meter shows 80",
    "supply-firmware": "Load firmware 8",
    "supply-switchboard": "this port is a switchboard",
    "network-lossy": "5 lost",
    "camera-slow": "31 Hz found, 0 lost, times to 0.05 us. The camera does not reach this rate",
    "camera-ticks": "Set camera.tick_hz",
    "exposure-line-off": "Check the wire of the exposure signal",
    "exposure-line-inverted": "Set exposure.edge to the other edge",
}


# Faults that an exposure line, its counter and the frames may show: it is wired there.
OF_THE_BOARD = {
    "route-refused", "tasks-orphaned", "usb-slow", "second-program", "network-lossy",
    "camera-slow", "camera-ticks", "exposure-line-off", "exposure-line-inverted",
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_every_fault_that_a_served_twin_can_have_is_named(name, permitted):
    known = LivePlan(500e-12) if name == "current-monitor-scale" else LivePlan()
    bench = Bench(FAULTS[name], plan=known, exposure_line=name in OF_THE_BOARD)
    assert NAMED[name] in reported(bench, permitted)[0]


RIG_FILE_FAULTS = {
    "gain": (Bench(changes={"amplifier": {"gain": 1000.0}}), "amplifier.gain"),
    "skew": (Bench(changes={"daq": {"skew_s": 40e-6}}), r"Set daq.skew_s = 2.5e-06"),
    "serial": (Bench(changes={"generator": {"serial_number": "MY9"}}), "Connect that one"),
    "channel": (Bench(changes={"daq": {"i_monitor": "ai99"}}), "Change the channels"),
    "counter": (Bench(changes={"daq": {"counter": "ctr3"}}), "Change the channels"),
    "rate": (Bench(changes={"daq": {"rate_hz": 250e3}}), "Lower it to 200000 or less"),
    "load": (Bench(changes={"generator": {"load": "50"}}), "Set generator.load"),
    "monitor": (Bench(changes={"amplifier": {"volt_per_monitor_volt": 1e4}}), "volt_per_monitor"),
}


@pytest.mark.parametrize("name", RIG_FILE_FAULTS)
def test_a_rig_file_that_is_not_that_of_the_bench_is_named(name, permitted):
    bench, advice = RIG_FILE_FAULTS[name]
    assert advice in reported(replace(bench, exposure_line=False), permitted)[0]


def test_somebody_who_sets_the_generator_to_burst_meanwhile_is_noticed(permitted):
    found = reported(Bench(meanwhile=lambda s: s.generator.answer("BURS:STAT ON")), permitted)[0]
    assert "burst mode is on" in found


def test_a_supply_whose_main_switch_is_off_is_named(permitted):
    def switch_off(served: ServedTwin) -> None:
        served.supply.firmware.enabled = False

    assert "switch its main switch on" in reported(Bench(meanwhile=switch_off), permitted)[0]


W = Wiring
HARDER = {
    "monitor 0.85": (Bench(BenchFaults(W(v_monitor_gain=0.85))), "amplifier.volt_per_monitor_volt"),
    "monitor 1.15": (Bench(BenchFaults(W(v_monitor_gain=1.15))), "amplifier.volt_per_monitor_volt"),
    "output 0.95": (Bench(BenchFaults(W(output_gain=0.95))), "gain of the summing stage"),
    "hum of 100 Hz": (Bench(BenchFaults(W(hum_v=0.04, hum_hz=100.0))), "0.04 V at 100 Hz"),
    "hum and a fault": (
        Bench(BenchFaults(W(hum_v=0.015, carrier_gain=0.5))), "Set generator.load"
    ),
    "swapped in a small range": (
        Bench(BenchFaults(W(swapped_monitors=True)), {"daq": {"drive_high_v": 0.2}}),
        "Swap the cables of the two monitors",
    ),
    "swapped with a sensitive current monitor": (
        Bench(BenchFaults(W(swapped_monitors=True)), twin={"amplifier": {
            "ampere_per_monitor_volt": 2e-4}}),
        "Swap the cables of the two monitors",
    ),
    "nothing connected": (
        Bench(BenchFaults(W(v_monitor_gain=0.0, i_monitor_gain=0.0))), "switch the amplifier off"
    ),
    "a capacitor read too small": (
        Bench(BenchFaults(W(i_monitor_gain=0.9), at_amplifier_f=1e-9), plan=LivePlan(1e-9)),
        "amplifier.ampere_per_monitor_volt",
    ),
    "the actuator in place of the capacitor": (Bench(plan=LivePlan(500e-12)), "ratio 0.9"),
    "a range that clips": (Bench(twin={"acquisition": {"range_v": 0.2}}), "daq.range_v"),
    "a range too small": (Bench(changes={"daq": {"drive_high_v": 0.01}}), "daq.range_v"),
    "the amplifier in the loop": (
        Bench(plan=LivePlan(loop_back=True, daq=NidaqConfig())), "Disconnect the amplifier"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", HARDER)
def test_what_an_adversary_planted_is_named(name, permitted):
    bench, advice = HARDER[name]
    assert advice in reported(replace(bench, exposure_line=False), permitted)[0]


def test_the_starts_of_the_output_are_seen_over_a_loop_back_wire(permitted):
    plan = LivePlan(loop_back=True, daq=NidaqConfig())
    wired = Bench(BenchFaults(Wiring(loop_back=True)), plan=plan, exposure_line=False)
    assert reported(wired, permitted)[0] == ""
    below = {"daq": {"drive_low_v": -2.0, "drive_high_v": 0.0}}
    assert reported(replace(wired, changes=below), permitted)[0] == ""
    late = BenchFaults(Wiring(loop_back=True), board=BoardFaults(usb_lag_samples=3000))
    assert "0 of 50 steps seen" in reported(replace(wired, faults=late), permitted)[0]


KNOWN = BenchFaults(at_amplifier_f=500e-12)
ANALOGUE = {
    "a known capacitor": Bench(KNOWN, plan=LivePlan(500e-12)),
    "a small actuator": Bench(BenchFaults(at_amplifier_f=25e-12)),
    "a large actuator": Bench(BenchFaults(at_amplifier_f=3e-9)),
    "a lossy actuator": Bench(twin={"dielectric": {"series_ohm": 3e4}}),
    "a leaking actuator": Bench(twin={"dielectric": {"leakage_ohm": 2e8}}),
    "noisy inputs": Bench(twin={"acquisition": {"v_noise_v": 3e-3, "i_noise_v": 3e-3}}),
    "offsets": Bench(twin={"amplifier": {"v_monitor_offset_v": 8e-3, "i_monitor_offset_v": -0.02}}),
    "gain errors": Bench(twin={"amplifier": {"gain_error": 0.008, "v_monitor_gain_error": -0.005}}),
    "another amplifier": Bench(twin={"amplifier": {"gain": 1000.0, "volt_per_monitor_volt": 1000.0,
                                                   "ampere_per_monitor_volt": 1e-3}}),
    "a quiet hum": Bench(BenchFaults(W(hum_v=0.012))),
    "hum of 60 Hz in a small range": Bench(BenchFaults(W(hum_v=1.5e-3, hum_hz=60.0)),
                                           {"daq": {"drive_high_v": 0.5}}),
    "a range of both signs": Bench(changes={"daq": {"drive_low_v": -2.0}}),
    "what the generator's last user left": Bench(
        BenchFaults(generator=GeneratorFaults(panel=("BURS:STAT ON",)))
    ),
}  # fmt: skip
HEALTHY = {
    **{f"board {name}": Bench(board=name) for name in
       ("USB-6212", "USB-6361", "PCIe-6321", "PXIe-6363", "USB-6366")},
    "seed 2": Bench(seed=2),
    **{f"seed {seed}": Bench(seed=seed, exposure_line=False) for seed in (3, 4)},
    "no queue": Bench(ahead_blocks=0),
    "three outputs queued": Bench(ahead_blocks=3),
    "no supply": Bench(without=("supply",)),
    "no camera": Bench(without=("camera", "exposure")),
    "no exposure line": Bench(without=("exposure",)),
    **{name: replace(bench, exposure_line=False) for name, bench in ANALOGUE.items()},
}  # fmt: skip


@pytest.mark.parametrize("name", HEALTHY)
def test_a_healthy_bench_is_not_accused(name, permitted):
    found, passed = reported(HEALTHY[name], permitted)
    assert not found
    assert passed >= 15
