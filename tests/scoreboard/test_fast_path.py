"""The fast path against the full twin, and against its own definitions."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from haselab.controllers import (
    CONTROLLERS,
    ChosenController,
    ControllerKind,
    Measurement,
    OpenLoop,
)
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench, describe
from haselab.runtime.lockin import counted_s, lockin_of
from haselab.runtime.loop import RunningController
from haselab.scoreboard.devices import ZERO_LENGTH_M, find_device
from haselab.scoreboard.knowledge import true_actuator
from haselab.scoreboard.loop_class import (
    CARRIER_HZ,
    CARRIER_V,
    CLASSES,
    STEP_S,
    LoopClass,
    noise_of,
)
from haselab.scoreboard.plant import FastPlant
from haselab.scoreboard.play import Scenario, play, setting_for
from haselab.scoreboard.tasks.task import sensed_noise

HOST = CLASSES["host-100hz"]
HZ = find_device("hz")
DRIVES_V = np.concatenate([
    np.full(20, 1.04), np.full(20, 1.3), np.full(20, 0.8),
    1.04 + 0.3 * np.sin(2.0 * np.pi * 2.0 * 0.01 * np.arange(60)),
])  # fmt: skip


@pytest.fixture(scope="module")
def full_twin():
    """Capacitances of the lock-in from raw samples, and true lengths after each block."""
    bench = TwinBench(HZ.config, 3)
    bench.sine(CARRIER_HZ, CARRIER_V)
    bench.write(1.04)
    bench.wait(20.0)
    lockin = lockin_of(describe(HZ.config), CARRIER_HZ)
    farad, length_m = [], []
    for drive_v in DRIVES_V.tolist():
        bench.write(drive_v)
        farad.append(lockin.step(bench.read())[0])
        length_m.append(bench.length_m)
    return np.array(farad), np.array(length_m)


@pytest.fixture(scope="module")
def fast():
    """The same of the fast path, without noise."""
    silent = LoopClass("silent", HOST.steps, HOST.switch_at, HOST.first, HOST.last, 0.0)
    plant = FastPlant(HZ, silent, np.random.default_rng(0), DRIVES_V.size)
    plant.hold(0.0, 120.0)
    plant.hold(1.04, 20.0)
    farad = [plant.update(drive_v) for drive_v in DRIVES_V.tolist()]
    return np.array(farad), plant.true_lengths_m[HOST.steps - 1 :: HOST.steps]


def test_the_window_is_that_of_the_lock_in_and_the_switch_that_of_the_bench():
    about = describe(HZ.config)
    assert HOST.window_s == pytest.approx(counted_s(about, CARRIER_HZ), abs=STEP_S)
    assert HOST.switch_at * STEP_S == pytest.approx(about.switch_sample / about.rate_hz)
    assert HOST.steps * STEP_S == pytest.approx(about.block_s)
    # the middle of the window to the block's end, and the output's delay
    assert HOST.delay_s == pytest.approx(0.5 * HOST.window_s + 0.002, abs=0.5 * STEP_S)
    assert CLASSES["chip-1khz"].delay_s == pytest.approx(1.8125e-3, abs=0.5 * STEP_S)


def test_the_fast_path_moves_as_the_full_twin_does(full_twin, fast):
    """Within the slew of 12 mA, which the fast path leaves out: 0.6 ms over 10 kV.

    The largest jump here is 0.5 V or 2.5 kV: it takes 0.12 ms, half of it late, at speeds up to
    0.06 m/s (0.1 strain in 0.1 s), so 4 um.
    """
    np.testing.assert_allclose(fast[1], full_twin[1], rtol=0.0, atol=4e-6)


def test_the_capacitance_is_that_of_the_lock_in_within_its_noise(full_twin, fast):
    noise_f = noise_of(HOST, HZ.config, float(fast[0].mean()))
    error = (full_twin[0] - fast[0]) / noise_f
    # a chi-squared of 120 values: its standard deviation over its mean is sqrt(2 / 120) = 0.13
    assert np.mean(error**2) == pytest.approx(1.0, abs=4.0 * 0.13)
    assert abs(error.mean()) < 4.0 / math.sqrt(error.size)


def scenario(duration_s: float = 0.5, device: str = "hz", **more) -> Scenario:
    public = find_device(device)
    zero_m = true_actuator(public).zero_length_m
    return Scenario(public, zero_m, duration_s, lambda t: 0.02 * (t >= 0.0), lead_s=0.2, **more)


class Echo(OpenLoop):
    """Keeps what it gets."""

    def __init__(self) -> None:
        self.seen = []

    def step(self, reference, measurement):
        self.seen.append((reference, measurement))
        return reference


def test_a_controller_gets_the_reference_the_preview_and_the_drive_in_force():
    echo = Echo()
    kind = ControllerKind("echo", lambda: echo, preview_s=0.02)
    known = true_actuator(HZ)
    trace = play(scenario(), kind.choose(), HOST, known, np.random.default_rng(1))
    assert trace.failure == "" and len(echo.seen) == 70
    references = [reference for reference, _ in echo.seen]
    assert references == [0.0] * 20 + [0.02] * 50
    assert echo.seen[18][1].preview == (0.0, 0.02)
    assert [measured.voltage_v for _, measured in echo.seen] == trace.drive_v.tolist()
    # the loop's own static map: the drive of update k + 1 is that of the strain of update k
    step_v = HOST.drive_step_v
    assert trace.drive_v[30] == pytest.approx(known.static_drive_v(0.02), abs=step_v)
    # after 0.5 s the fast motion has ended, and the truth is what the sensor tells within 5 sigma
    sensed = np.mean([measured.strain for _, measured in echo.seen[-10:]])
    assert sensed == pytest.approx(trace.strain[-100:].mean(), abs=5.0 * 2e-4 / math.sqrt(10.0))


class Clocks:
    """Wall time and processor time of steps that take what they are told to."""

    wall_s = processor_s = 0.0

    def perf_counter(self):
        return self.wall_s

    def thread_time(self):
        return self.processor_s


@pytest.mark.parametrize(
    ("wall_s", "processor_s", "late"),
    [
        (0.051, 0.051, True),  # computes for more than five periods of 10 ms
        (0.049, 0.049, False),
        (0.4, 0.049, False),  # seven other programs on the same processor
        (0.051, 0.0005, True),  # sleeps
        (0.049, 0.0, False),
    ],
)
def test_a_step_is_late_by_its_own_time_not_by_that_of_other_programs(
    monkeypatch, wall_s, processor_s, late
):
    clocks = Clocks()

    class Takes(OpenLoop):
        def step(self, reference, measurement):
            clocks.wall_s += wall_s
            clocks.processor_s += processor_s
            return reference

    monkeypatch.setattr("haselab.scoreboard.play.time", clocks)
    kind = ControllerKind("takes", Takes)
    trace = play(scenario(), kind.choose(), HOST, true_actuator(HZ), np.random.default_rng(1))
    assert trace.failure == ("5 steps in a row took longer than 5 periods" if late else "")
    assert trace.step_s == pytest.approx(processor_s)


def test_a_late_device_gets_each_drive_later():
    shifted = {}
    for late_s in (0.0, 0.004, 0.012):
        device = replace(HZ, late_s=late_s)
        silent = replace(HOST, relative_noise=0.0)
        plant = FastPlant(device, silent, np.random.default_rng(0), 12)
        plant.hold(0.0, 30.0)
        for drive_v in [0.0] * 4 + [1.5] * 8:
            plant.update(drive_v)
        moved = plant.true_lengths_m - plant.true_lengths_m[0]
        shifted[late_s] = np.interp(1e-4, moved, STEP_S * np.arange(moved.size))
    assert shifted[0.004] - shifted[0.0] == pytest.approx(0.004, abs=STEP_S)
    assert shifted[0.012] - shifted[0.0] == pytest.approx(0.012, abs=STEP_S)


def test_a_breakdown_ends_the_task_with_the_reason():
    class Full(OpenLoop):
        def step(self, reference, measurement):
            return 2.0

    kind = ControllerKind("full", Full, output="voltage")
    heavy = scenario(3.0, loads=((0.0, 0.5),))
    trace = play(heavy, kind.choose(), HOST, true_actuator(HZ), np.random.default_rng(1))
    assert trace.failure == "dielectric breakdown"
    assert trace.time_s[-1] < 3.0 and trace.peak_field_v_per_m > 30e6


def test_the_slew_of_the_chip_limits_the_drive():
    chip = CLASSES["chip-1khz"]
    kind = ControllerKind("echo", Echo)
    trace = play(scenario(0.3), kind.choose(), chip, true_actuator(HZ), np.random.default_rng(1))
    steps_v = np.diff(trace.drive_v)
    assert np.abs(steps_v).max() == pytest.approx(20.0 * 1e-3)


def test_the_reading_of_the_frequency_axis_is_a_device():
    assert find_device("rad").config == twin_of_reading("rad")


def test_a_closed_loop_on_the_full_twin_has_the_trace_of_the_fast_path():
    """The same controller and step on raw samples, the lock-in and the amplifier.

    Both have noise of their own. It moves the length by at most 1.2 times the noise of one update
    (a demand of the design), so two traces differ by sqrt(2) * 1.2 * 2e-4; 5 standard deviations.
    """
    known = replace(true_actuator(HZ), capacitance_noise_f=noise_of(HOST, HZ.config, 5.6e-10))
    kind = CONTROLLERS.find("force")
    chosen = kind.choose(kind.design(setting_for(ChosenController(kind, ()), HOST, known, 1.04)))
    step = Scenario(HZ, known.zero_length_m, 0.6, lambda t: 0.04 * (t >= 0.0), lead_s=0.6)
    fast = play(step, chosen, HOST, known, np.random.default_rng(1))
    assert fast.failure == ""
    bench = TwinBench(HZ.config, 3)
    bench.sine(CARRIER_HZ, CARRIER_V)
    bench.hang(2.4 * 0.25)
    bench.wait(20.0)
    bench.hang(0.25)
    bench.wait(60.0)
    drive_v = known.static_drive_v(0.0)
    bench.write(drive_v)
    bench.wait(20.0)
    lockin = lockin_of(describe(HZ.config), CARRIER_HZ)
    running = RunningController(chosen, setting_for(chosen, HOST, known, drive_v))
    strains = []
    for k in range(120):
        bench.write(drive_v)
        farad = lockin.step(bench.read())[0]
        strains.append(known.strain(bench.length_m))
        seen = known.strain(known.sensed_length_m(farad, drive_v))
        measured = Measurement(seen, farad, drive_v, 0.01 * (k + 1))
        drive_v = running.step(0.04 if k >= 60 else 0.0, measured)
        drive_v = round(drive_v / HOST.drive_step_v) * HOST.drive_step_v
    np.testing.assert_allclose(fast.strain[9::10], strains, rtol=0.0, atol=5.0 * 1.2 * 2.83e-4)
    assert strains[-1] == pytest.approx(0.04, abs=2e-3)


@pytest.mark.parametrize("strain", [-0.03, 0.21])
def test_the_limits_by_noise_assume_the_noise_that_is_played(strain):
    """The length creeps by far less than the noise; 2,000 differences know it to 2 %."""
    known, scenario = true_actuator(HZ), Scenario(HZ, ZERO_LENGTH_M, 1.0, np.zeros_like)
    plant = FastPlant(HZ, HOST, np.random.default_rng(1), 2000)
    plant.train()
    drive_v = known.static_drive_v(strain)
    plant.hold(drive_v, 60.0)
    sensed = [known.strain(known.sensed_length_m(plant.update(drive_v))) for _ in range(2000)]
    played = float(np.diff(sensed).std()) / math.sqrt(2.0)
    assert played == pytest.approx(sensed_noise(known, scenario, HOST, strain), rel=0.06)
