"""The shipped drivers against the served twin: what goes wrong on a wire, reported in one line."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab.base import DeviceError, InputError, LimitError
from haselab.rig import RigDescription
from haselab.rig.bench_config import BenchConfig
from haselab.rig.drivers import load_driver
from haselab.rig.instruments.keysight33500.generator import KeysightGenerator
from haselab.rig.instruments.nidaq.link import NidaqLink
from haselab.rig.instruments.nidaq.section import NidaqConfig
from haselab.rig.instruments.petapicovoltron.supply import PetaPicoVoltron
from haselab.rig.real_bench import RealBench
from haselab.rig.twin.client import TwinClient
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.hub import TwinHub
from haselab.rig.twin.serve.lines import LineServer
from haselab.rig.twin.serve.server import ServedTwin
from haselab.safety.gate import Gate
from haselab.safety.guardian.make_safe import make_safe
from haselab.safety.rig_limits import safety_of

pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")

METER_V = 5000.0 / 1023.0  # a step of the supply's ten-bit meter


def changed(served: ServedTwin, **sections: dict[str, Any]) -> BenchConfig:
    """The served rig file, with some keys replaced."""
    data = tomllib.loads(served.rig_file(ahead_blocks=1))
    data["daq"]["server_patience_s"] = 30.0  # on a busy machine too
    for section, values in sections.items():
        data[section] |= values
    return BenchConfig.model_validate(data)


@pytest.fixture
def served() -> Iterator[ServedTwin]:
    before = set(threading.enumerate())
    with ServedTwin(twin_of_reading("hz"), 1, pace=0.0) as twin:
        yield twin
    ours = [t for t in set(threading.enumerate()) - before if "twin" in t.name]
    assert not ours, "the served twin leaves no thread behind"


@pytest.fixture
def bench(served: ServedTwin, permitted) -> Iterator[RealBench]:
    with RealBench(changed(served), permitted()) as opened:
        yield opened


# ---- opening ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("section", "key", "value", "reported"),
    [
        (
            "daq",
            "serial_number",
            "DEADBEEF",
            r"Dev1 has the serial number [0-9A-F]{8}, but the rig file names DEADBEEF",
        ),
        ("generator", "serial_number", "MY99", r"generator has the serial number MY00"),
        ("supply", "serial_number", "other", r"supply's name is 'haselab-twin'"),
        (
            "supply",
            "highest_v",
            6000.0,
            r"highest_v is 6000 V, but this supply reaches only 5000 V",
        ),
    ],
)
def test_another_instrument_than_the_rig_file_names_is_refused(
    served, section, key, value, reported
):
    with (
        pytest.raises(InputError, match=reported),
        RealBench(changed(served, **{section: {key: value}}), Gate()),
    ):
        pass
    assert served.hub.output_v == pytest.approx(0.0, abs=1e-6)


def closed_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return listener.getsockname()[1]


@pytest.mark.parametrize(
    ("section", "key", "value", "reported"),
    [
        ("daq", "server", "127.0.0.1:{port}", r"NI board Dev1 does not reply .*daq\.server"),
        (
            "daq",
            "device",
            "Dev7",
            r"Dev7: the device does not exist \(status -200220\)\. Set",
        ),
        ("daq", "v_monitor", "ai99", r"has no such channel \(status -200170\)"),
        ("daq", "v_monitor", "ai9", r"outside the device's limits \(status -200077\)"),
        ("daq", "rate_hz", 250e3, r"limit of 200000 Hz for two .* Lower it to 200000"),
        ("generator", "address", "TCPIP::127.0.0.1::{port}::SOCKET", r"generator does not reply"),
        ("generator", "address", "nowhere", r"generator does not reply .*nowhere"),
        ("supply", "port", "/dev/none", r"supply does not reply correctly .*/dev/none"),
        ("stand", "address", "127.0.0.1:{port}", r"The served twin does not reply"),
    ],
)
def test_an_instrument_that_is_not_there_is_one_line(served, section, key, value, reported):
    if isinstance(value, str):
        value = value.format(port=closed_port())
    with pytest.raises(DeviceError, match=reported) as caught:
        RealBench(changed(served, **{section: {key: value}}), Gate())
    assert "\n" not in str(caught.value)


def test_a_missing_driver_says_what_to_install():
    with pytest.raises(
        DeviceError, match=r"needs the Python package 'nidaqmy', which is not .*pip"
    ):
        load_driver("nidaqmy.task", "The NI board")


def test_no_local_driver_is_one_line():
    config = NidaqConfig()
    with contextlib.suppress(DeviceError):
        NidaqLink(config).close()
        pytest.skip("this computer has the NI-DAQmx driver")
    with pytest.raises(DeviceError, match=r"NI-DAQmx driver is not installed .*daq\.server"):
        NidaqLink(config)


# ---- the board ----------------------------------------------------------------------------------


def switched_at(codes: np.ndarray, d: RigDescription, low_v: float, high_v: float) -> int:
    """Sample at which the voltage monitor goes through the middle of a step."""
    volt = codes[:, 0] * d.volt_per_code
    return int(np.argmax(np.abs(volt - low_v) > 0.5 * abs(high_v - low_v)))


@pytest.mark.parametrize("stalled", [3, 7])
def test_outputs_that_come_too_late_are_left_out_counted_and_no_block_is_lost(
    served, bench, stalled
):
    d = bench.rig.description
    bench.rig.camera.start(50.0)
    start_s = bench.rig.acquisition.time_s
    bench.rig.source.write(0.1)
    blocks = [bench.rig.acquisition.read() for _ in range(3)]
    served.hub.readings(served.hub.acquired, stalled * 2000, 1.0)  # time passes, no output comes
    values = 0.1 + 0.02 * np.arange(1, 16)
    missed = []
    for value in values:
        bench.rig.source.write(float(value))
        blocks.append(bench.rig.acquisition.read())
        missed.append(bench.rig.source.missed_outputs)
    assert bench.rig.acquisition.time_s - start_s == pytest.approx(18 * d.block_s, abs=1e-9)
    # One value was queued ahead of the stall: so the outputs of all later blocks until the queue
    # runs again are left out, and then each comes in its own block. Over USB a stream starts with
    # three values of the standing output, of which one is the queue.
    assert missed[-1] == missed[-3] and 0 < missed[-1] <= stalled + 2 + 3
    first = int(np.argmax(np.array(missed) == missed[-1])) + 1  # the first that was put out
    codes = np.concatenate(blocks)
    at = (3 + first) * d.block_samples + d.switch_sample
    stood_v = 0.1
    for k in range(first, 14):
        here = (3 + k) * d.block_samples + d.switch_sample
        part = codes[here - 200 : here + 1000]
        assert switched_at(part, d, stood_v if k == first else values[k - 1], values[k]) - 200 in (
            range(4, 14)
        )
        stood_v = values[k]
    before = codes[3 * d.block_samples : at, 0] * d.volt_per_code
    np.testing.assert_allclose(before, 0.1, atol=5e-3)  # the output stood meanwhile


def test_an_output_that_comes_too_late_passes_blocks_over_where_they_may_be(served, bench):
    d = bench.rig.description
    bench.rig.source.write(0.1)
    for _ in range(3):
        bench.rig.acquisition.read()
    served.hub._streaming, served.hub.output_status = False, -200290
    before_s = bench.rig.acquisition.time_s
    bench.rig.source.write(0.2)
    codes = np.concatenate([bench.rig.acquisition.read() for _ in range(3)])
    assert bench.rig.acquisition.time_s - before_s > 3.5 * d.block_s
    assert switched_at(codes, d, 0.1, 0.2) - d.switch_sample in range(4, 14)
    assert bench.rig.source.missed_outputs == 0
    served.hub._streaming, served.hub.output_status = False, -200290
    bench.rig.safe()
    assert served.hub.output_v == pytest.approx(0.0, abs=1e-6)


def test_queued_outputs_are_each_put_out_in_their_own_block(served, bench):
    """As long as the computer is not later than the values that wait."""
    d = bench.rig.description
    values = np.r_[np.tile([0.0, 0.1], 60), np.zeros(60)]
    assert bench.rig.source.preload(values) == 0  # blocks may be passed over
    bench.rig.camera.start(50.0)
    ahead = bench.rig.source.preload(values)
    assert ahead >= 20
    blocks = []
    for k, value in enumerate(values):
        if k in (5, 71):
            served.hub.readings(served.hub.acquired, (ahead - 1) * 2000, 1.0)
        bench.rig.source.write(float(value))
        blocks.append(bench.rig.acquisition.read())
    assert bench.rig.source.missed_outputs == 0
    codes = np.concatenate(blocks)
    for k in range(1, 119):
        here = k * d.block_samples + d.switch_sample
        part = codes[here - 200 : here + 1000]
        assert switched_at(part, d, values[k - 1], values[k]) - 200 in range(4, 14)


def test_a_queued_drive_that_runs_out_is_held_and_then_continues_in_its_own_blocks(served, bench):
    d = bench.rig.description
    values = 0.002 * np.arange(200)
    bench.rig.camera.start(50.0)
    ahead = bench.rig.source.preload(values)
    stalled, at = ahead + 30, 20
    blocks, left_out = [], []
    for k, value in enumerate(values):
        if k == at:
            served.hub.readings(served.hub.acquired, stalled * 2000, 1.0)
        before = bench.rig.source.missed_outputs
        bench.rig.source.write(float(value))
        blocks.append(bench.rig.acquisition.read())
        if bench.rig.source.missed_outputs != before:
            left_out.append(k)
    # What waited in the device came in time; from there on until the queue ran again, nothing did.
    assert np.all(np.diff(left_out) == 1)
    assert at + ahead - 2 <= left_out[0] <= at + ahead + 12
    assert left_out[-1] - at <= stalled + 4
    assert bench.rig.source.missed_outputs == len(left_out)
    put_out = values.copy()
    put_out[left_out] = values[left_out[0] - 1]
    codes = np.concatenate(blocks)
    # Between two switches the monitor shows the value of its block.
    for k in range(1, 198):
        start = k * d.block_samples + d.switch_sample + 400
        seen_v = codes[start : start + d.block_samples - 800, 0].mean() * d.volt_per_code
        assert seen_v == pytest.approx(put_out[k], abs=5e-4), k


def test_a_task_that_holds_the_output_does_not_keep_it_from_zero(served, bench):
    """Writing commits a task: stopped alone it would still hold the output."""
    bench.rig.camera.start(50.0)
    for _ in range(3):
        bench.rig.source.write(1.0)
        bench.rig.acquisition.read()
    other = bench.board._link.task()
    other.ao_channels.add_ao_voltage_chan("Dev1/ao0", min_val=-10.0, max_val=10.0)
    bench.board._end_stream()
    bench.board._link.writer(other, auto_start=True).write_one_sample(1.0)
    served.hub.readings(served.hub.acquired, 4000, 1.0)
    assert served.hub.output_v > 4500.0
    bench.rig.source.zero()
    served.hub.readings(served.hub.acquired, 4000, 1.0)
    assert served.hub.output_v == pytest.approx(0.0, abs=1.0)


def test_queued_outputs_are_discarded_at_zero_and_another_output_is_refused(served, bench):
    bench.rig.camera.start(50.0)
    bench.rig.source.preload(np.full(100, 0.1))
    for _ in range(3):
        bench.rig.source.write(0.1)
        bench.rig.acquisition.read()
    bench.rig.source.write(0.05)
    with pytest.raises(DeviceError, match=r"queued output differs from the requested one, 0\.05 V"):
        bench.rig.acquisition.read()
    bench.rig.source.zero()
    served.hub.readings(served.hub.acquired, 30 * 2000, 1.0)
    assert served.hub.output_v == pytest.approx(0.0, abs=1e-6)
    with pytest.raises(LimitError, match="3 V"):
        bench.rig.source.preload(np.array([0.1, 3.0]))


def test_blocks_that_come_too_late_are_an_overrun(served, bench):
    bench.rig.camera.start(50.0)
    bench.rig.acquisition.read()
    served.hub.queue_output([0.0] * 1200)  # so that the output does not run dry first
    served.hub.readings(served.hub.acquired + 11 * 200_000, 2000, 1.0)
    with pytest.raises(DeviceError, match=r"overwritten before they were read.*status -200279"):
        bench.rig.acquisition.read()


def test_idle_time_is_no_fault_between_experiments(served, bench):
    bench.rig.acquisition.read()
    start_s = bench.rig.acquisition.time_s
    served.hub.readings(served.hub.acquired + 15 * 200_000, 2000, 1.0)
    bench.rig.source.write(0.5)
    bench.rig.acquisition.read()
    assert bench.rig.acquisition.time_s - start_s > 15.0
    blocks = [bench.rig.acquisition.read() for _ in range(2)]
    assert blocks[-1][:, 0].mean() * bench.rig.description.volt_per_code == pytest.approx(0.5, 0.01)


def test_a_lost_server_is_one_line_and_zero_does_not_raise(served, bench):
    bench.rig.source.write(1.0)
    bench.rig.acquisition.read()
    served.daq.close()
    with pytest.raises(DeviceError, match=r"NI board Dev1 does not reply"):
        bench.rig.acquisition.read()
    bench.rig.safe()


def test_a_server_that_falls_silent_is_one_line(served, monkeypatch):
    with RealBench(changed(served, daq={"server_patience_s": 0.2}), Gate()) as bench:
        bench.rig.acquisition.read()
        silence, answered = threading.Event(), threading.Event()

        def readings(*given: object) -> None:
            silence.wait(300.0)
            answered.set()

        monkeypatch.setattr(served.hub, "readings", readings)
        with pytest.raises(DeviceError, match=r"Dev1 does not reply \(.*Deadline Exceeded"):
            bench.rig.acquisition.read()
        assert not answered.is_set()  # the board gave up while the server was still silent
        silence.set()


def test_a_bench_is_made_safe_from_outside(served, bench):
    bench.rig.generator.sine(2000.0, 0.02)
    bench.rig.supply.set_voltage(500.0)
    bench.rig.source.write(1.0)
    for _ in range(4):
        bench.rig.acquisition.read()
    assert served.hub.output_v > 4000.0
    # A pseudo-terminal has one reader: the supply's own connection goes first, as at its death.
    bench.supply._line.close()
    assert make_safe(bench.config) == [("daq", ""), ("supply", ""), ("generator", "")]
    served.hub.set_output(0.0)  # a block of time passes
    assert served.hub.output_v == pytest.approx(0.0, abs=1e-6)
    assert served.hub.rail_v == 0.0


# ---- the generator ------------------------------------------------------------------------------


def generator_config(served: ServedTwin, **values: Any):
    return changed(served, generator=values).generator


@pytest.mark.parametrize(("load", "part"), [("INF", 1.0), ("50", 0.5)])
def test_amplitudes_are_volts_at_the_load_that_is_set(served, load, part):
    generator = KeysightGenerator(generator_config(served, load=load))
    generator.sine(2000.0, 0.1)
    # The amplifier is an open circuit: with a load of 50 ohm set, twice what was asked arrives.
    assert served.hub.bench._native.carrier_v == pytest.approx(0.1 / part, rel=1e-6)
    generator.close()
    assert served.hub.bench._native.carrier_v == 0.0


def test_pymeasures_own_shutdown_leaves_the_output_on_and_off_does_not(served):
    generator = KeysightGenerator(generator_config(served))
    generator.sine(2000.0, 0.02)
    generator._link.driver.shutdown()
    assert not generator.is_off()
    generator.off()
    assert generator.is_off()
    generator.close()


@pytest.mark.parametrize("amplitude_v", [1e-3, 1.5])
def test_amplitudes_beyond_the_instrument_or_the_file_are_refused(served, amplitude_v):
    generator = KeysightGenerator(generator_config(served))
    with pytest.raises(LimitError, match=r"Sine of 2000 Hz, .* V is outside .* \[0\.005, 1\] V"):
        generator.sine(2000.0, amplitude_v)
    generator.close()


class Liar:
    """Answers as the twin's generator does, but for some lines."""

    def __init__(self, served: ServedTwin, lies: dict[str, bytes]) -> None:
        self._served, self.lies = served, lies
        self._server = LineServer(self, name="liar")
        self.address = f"TCPIP::127.0.0.1::{self._server.port}::SOCKET"

    def answer(self, line: str) -> bytes:
        return self.lies.get(line, self._served.generator.answer(line))

    def refuse_line(self, longest: int) -> bytes:
        return self._served.generator.refuse_line(longest)

    def fail(self) -> bytes:
        return self._served.generator.fail()

    def close(self) -> None:
        self._server.close()


@pytest.mark.parametrize(
    ("question", "answer", "reported"),
    [
        ("SOUR1:VOLT?", b"+5.0E-01\n", r"amplitude in Vpp was set to 0.04 but reads back as 0.5"),
        ("SOUR1:FREQ?", b"+1.0E+03\n", r"frequency in Hz was set to 2000 but reads back as 1000"),
        ("SOUR1:VOLT?", b"\xff\x00garbage\n", r"does not reply"),
        ("OUTP1?", b"0\n", r"output was switched on but is off"),
        ("SOUR1:FREQ?", b"", r"does not reply"),
    ],
)
def test_a_wrong_read_back_of_the_generator_switches_it_off(served, question, answer, reported):
    with contextlib.closing(Liar(served, {})) as liar:
        patience_s = 0.3 if "does not reply" in reported else 30.0
        config = generator_config(served, address=liar.address, timeout_s=patience_s)
        generator = KeysightGenerator(config)
        liar.lies[question] = answer
        with pytest.raises(DeviceError, match=reported):
            generator.sine(2000.0, 0.02)
        assert served.hub.bench._native.carrier_v == 0.0
        generator.close()


def test_the_servers_settings_follow_the_manual(served):
    ask = served.generator.answer
    for line in (b"FREQUENCY 2e3", b"VOLT:UNIT VPP", b"OUTP1:LOAD INF", b"VOLT 0.04"):
        assert ask(line.decode()) == b""
    assert float(ask("SOURCE1:FREQ?")) == 2000.0
    ask("VOLT:UNIT VRMS")
    assert float(ask("VOLTAGE?")) == pytest.approx(0.04 / np.sqrt(8.0), rel=1e-12)
    ask("OUTP:LOAD 50")
    assert float(ask("VOLT?")) == pytest.approx(0.02 / np.sqrt(8.0), rel=1e-12)
    ask("VOLT:UNIT DBM")  # 20 mVpp into 50 ohm is 1 uW
    assert float(ask("VOLT?")) == pytest.approx(-30.0, abs=1e-9)
    ask("NONSENSE 1;FREQ 1e12")
    assert ask("SYST:ERR?") == b'-113,"Undefined header"\n'
    assert ask("SYSTEM:ERROR:NEXT?") == b'-222,"Data out of range"\n'
    assert ask("SYST:ERR?") == b'+0,"No error"\n'


# ---- the supply ---------------------------------------------------------------------------------


def test_the_supplys_rail_is_seen_by_the_voltage_monitor(served, bench):
    bench.rig.supply.set_voltage(1500.0)
    assert bench.rig.supply.read_voltage() == pytest.approx(1500.0, abs=METER_V)
    codes = [bench.rig.acquisition.read() for _ in range(3)][-1]
    d = bench.rig.description
    volt = codes[:, 0].mean() * d.volt_per_code / d.v_monitor_v_per_v
    assert volt == pytest.approx(1500.0, rel=1e-3)
    assert not bench.supply.is_off()
    bench.rig.supply.off()
    assert bench.supply.is_off()


@pytest.mark.parametrize("voltage_v", [-1.0, 5001.0, float("nan")])
def test_a_supply_voltage_outside_the_file_is_refused(bench, voltage_v):
    bench.rig.supply.set_voltage(100.0)
    with pytest.raises(LimitError, match=r"supply voltage is .* must be within \[0, 5000\] V"):
        bench.rig.supply.set_voltage(voltage_v)
    assert bench.rig.supply.read_voltage() == pytest.approx(100.0, abs=METER_V)


@pytest.mark.parametrize(
    ("command", "answer", "reported"),
    [
        ("SVset 700", "70", r"SVset 700 is echoed as 70"),
        ("SVset 700", "Err", r"SVset 700: Err"),
        ("SSwMode 1", "\x00??", r"SSwMode 1: "),
        ("SVset 700", "7" * 200, r"without an end of line"),
    ],
)
def test_a_wrong_echo_of_the_supply_switches_it_off(served, command, answer, reported, monkeypatch):
    patience_s = 0.3 if reported == "without an end of line" else 30.0
    supply = PetaPicoVoltron(changed(served).supply.model_copy(update={"timeout_s": patience_s}))
    real = served.supply.answer

    def lying(line: str) -> str:
        told_truly = real(line)
        return answer if line == command else told_truly

    monkeypatch.setattr(served.supply, "answer", lying)
    with pytest.raises(DeviceError, match=reported):
        supply.set_voltage(700.0)
    assert served.hub.rail_v == 0.0
    supply.close()


# ---- client --------------------------------------------------------------------------------------


def test_a_line_that_is_not_a_request_is_reported(served):
    assert b"Not a request" in served.client.answer("jump")
    assert b"Not a request" in served.client.answer('{"do": "jump"}')
    assert b"Not a request" in served.client.answer('{"do": "hang"}')


def test_meters_see_the_bench(served, bench):
    client = TwinClient(served.client.address)
    bench.rig.source.write(1.0)
    for _ in range(4):
        bench.rig.acquisition.read()
    assert client.meters()["output_v"] == pytest.approx(5000.0, rel=0.01)
    client.close()


# ---- breakdown ----------------------------------------------------------------------------------


def test_after_a_breakdown_both_monitors_read_zero_and_the_reason_is_reported(permitted):
    config = twin_of_reading("hz")
    weak = config.model_copy(
        update={"dielectric": config.dielectric.model_copy(update={"breakdown_v_per_m": 3e6})}
    )
    with (
        ServedTwin(weak, 1, pace=0.0) as served,
        RealBench(changed(served), permitted()) as bench,
    ):
        bench.rig.source.write(2.0)
        blocks = [bench.rig.acquisition.read() for _ in range(5)]
        assert not blocks[-1].any()
        assert "Dielectric breakdown" in served.hub.protected
        assert abs(served.hub.output_v) < 50.0


# ---- the wall clock -----------------------------------------------------------------------------


def answer_late(hub: TwinHub, late_s: float) -> None:
    """The answer to the start of the output comes late; the output runs meanwhile."""
    start = hub.stream

    def start_and_wait(on: bool, *repeated: tuple[float, ...]) -> None:
        start(on, *repeated)
        time.sleep(late_s if on else 0.0)

    hub.stream = start_and_wait


PACE = 0.1  # of the wall clock: eight queued outputs last 0.8 s, so that a busy machine is not late


@pytest.mark.parametrize("late_s", [0.0, 0.25, 1.0])
def test_with_a_pace_the_blocks_come_by_the_wall_clock_and_outputs_at_their_sample(
    late_s, permitted
):
    """The bench never runs ahead of the wall clock; how far it falls behind is not asserted."""
    config = twin_of_reading("hz")
    with ServedTwin(config, 1, pace=PACE) as served:
        file = BenchConfig.model_validate(tomllib.loads(served.rig_file(ahead_blocks=8)))
        with RealBench(file, permitted()) as bench:
            rig = bench.rig
            answer_late(served.hub, late_s)
            rig.camera.start(50.0)
            start_s, wall_s = rig.acquisition.time_s, time.monotonic()
            there_s = served.hub.acquired / rig.description.rate_hz
            rig.source.write(0.1)  # so small that the amplifier's current limit plays no part
            codes = np.concatenate([rig.acquisition.read() for _ in range(12)])
            end_s, wall_s = rig.acquisition.time_s, time.monotonic() - wall_s
            rig.camera.stop()
    d = rig.description
    assert end_s - start_s == pytest.approx(12 * d.block_s, abs=1e-9)
    assert end_s - there_s < PACE * wall_s + d.block_s
    volt = codes[:, 0] * d.volt_per_code
    # The amplifier of 6 kHz and damping 0.6 crosses one half 1.3 / w after its input's step.
    assert int(np.argmax(volt > 0.05)) - d.switch_sample in range(4, 13)
    assert abs(served.hub.output_v) < 50.0


def test_a_request_that_was_interrupted_does_not_spoil_the_next_one(served):
    """Ctrl-C while the camera is asked: its answer comes later and is nobody's."""
    client = TwinClient(served.addresses["client"])

    class Interrupted:
        def __init__(self, stream):
            self._stream = stream

        def readline(self):
            raise KeyboardInterrupt

        def __getattr__(self, name):
            return getattr(self._stream, name)

    client.start(50.0)
    client._stream = Interrupted(client._stream)
    with pytest.raises(KeyboardInterrupt):
        client.meters()
    assert client.take() is None
    assert set(client.meters()) >= {"output_v", "length_m"}
    client.close()


def test_a_program_that_vanished_leaves_no_board_reserved(served):
    gate = Gate()
    vanished = RealBench(changed(served), gate)
    vanished.rig.camera.start(50.0)
    vanished.rig.acquisition.read()  # its tasks run
    gate.interlock._owns = False  # as the system leaves it: locks free, nobody has said good-bye
    gate.interlock.close()
    with RealBench(changed(served), Gate()) as bench:
        assert bench.rig.acquisition.read().shape == (2000, 2)
    vanished.close()


def test_on_a_twin_in_lock_step_nothing_is_late(served):
    file = changed(served)
    assert file.stand.lock_step
    assert not safety_of(file, {}, Path("rig.toml")).real_time
    paced = file.model_copy(update={"stand": file.stand.model_copy(update={"lock_step": False})})
    assert safety_of(paced, {}, Path("rig.toml")).real_time
