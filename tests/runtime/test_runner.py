"""The runner's order of acts, the closed loop against a second computation, and its clean-up."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab import _core
from haselab.base import DeviceError, LimitError, ResultError, SilentProgress
from haselab.control import PidGains, Saturation
from haselab.controllers import pid_controller
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.rig import Rig
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench, rig_of
from haselab.runtime.camera_recorder import CameraRecorder
from haselab.runtime.lockin import lockin_of, printed_chain_of
from haselab.runtime.loop import LoopSettings
from haselab.runtime.runner import Runner
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.safety.watchdog.settings import WatchdogSettings
from haselab.signals import linear_chirp, triangle
from haselab.store.session.writer import ExperimentPlan, ExperimentRecord, SessionWriter
from haselab.store.video.opening import open_video

EQ4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
CARRIER_HZ, CARRIER_V = 2000.0, 0.02
FRAME_RATE_HZ, MASS_KG = 50.0, 0.25


Faults = dict[str, tuple[int, BaseException]]  # method: the call from which on it raises


class Watched:
    """Wraps a part of the rig or its observers, keeps a log, and fails on request."""

    def __init__(self, part: Any, log: list[str], faults: Faults) -> None:
        self._part, self._log, self._faults = part, log, faults

    def __getattr__(self, name: str) -> Any:
        value = getattr(self._part, name)
        if not callable(value):
            return value

        def call(*args: Any, **kwargs: Any) -> Any:
            self._log.append(name)
            at, error = self._faults.get(name, (0, None))
            if error is not None and self._log.count(name) >= at:
                raise error
            return value(*args, **kwargs)

        return call


class Scene:
    """A twin, a session and a runner, all watched."""

    def __init__(
        self,
        folder: Path,
        faults: Faults | None = None,
        keep: Any = "none",
        limits: SafetySettings | None = None,
    ) -> None:
        config = twin_of_reading("hz")
        self.twin = TwinBench(config, 5)
        self.folder = folder
        self.acts: list[str] = []
        faults = {} if faults is None else faults
        plain = rig_of(self.twin, config)
        self.rig: Rig = dataclasses.replace(
            plain,
            source=Watched(self.twin, self.acts, faults),
            acquisition=Watched(self.twin, self.acts, faults),
            generator=Watched(self.twin, self.acts, faults),
        )
        self.session = SessionWriter(
            folder / "session.h5",
            [ExperimentPlan(name, "test", 6, {}) for name in ("x", "y")],
            plain.description.block_samples,
            {},
        )
        self.camera_recorder = CameraRecorder(plain.camera, self.session, folder / "video", keep)
        if limits is not None:
            self.rig = guard(self.rig, Safety(limits))
            self.rig.safety.arm(self.rig.safety.request())
        self.runner = Runner(
            self.rig,
            Watched(self.session, [], faults),
            Watched(self.camera_recorder, [], faults),
            CARRIER_HZ,
            CARRIER_V,
            Watched(SilentProgress(), [], faults),
        )

    def record(self, name: str) -> ExperimentRecord:
        return self.session.experiment(name)

    def events(self) -> list[str]:
        return [what for _, what in self.session.events()]

    def assert_safe(self) -> None:
        assert self.twin.output_v == 0.0
        assert self.twin._native.carrier_v == 0.0
        assert self.twin.take() is None
        outputs = [act for act in self.acts if act in ("write", "zero")]
        assert outputs[-1] == "zero"


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return Scene(tmp_path)


def play(runner: Runner) -> None:
    runner.play("x", np.full(90, 1.4), FRAME_RATE_HZ, MASS_KG)


def release(runner: Runner) -> None:
    runner.release("x", 1.0, 0.5, 0.6, FRAME_RATE_HZ, MASS_KG)


def hang(runner: Runner) -> None:
    runner.hang("x", [0.1, 0.3, 0.2, 0.25], 0.2, FRAME_RATE_HZ)


def close_loop(runner: Runner) -> None:
    pi, to_strain = pid_controller(0.4, 0.7), StrainMap(4.9e8, -0.27)
    loop = LoopSettings(pi, Saturation(-0.04, 0.1), EQ4, to_strain)
    runner.close_loop("x", np.zeros(90), loop, FRAME_RATE_HZ, MASS_KG)


# ---- every way out --------------------------------------------------------------------------

FAULTS = {
    "disk full under a block": ("append_block", DeviceError("disk full")),
    "disk full under an event": ("event", DeviceError("disk full")),
    "acquisition gone": ("read", DeviceError("no block")),
    "drive output gone": ("write", DeviceError("no answer")),
    "camera or tracking": ("look", ResultError("lost the fiducials")),
    "a programming error": ("append_block", ZeroDivisionError("slip")),
    "Ctrl-C between blocks": ("read", KeyboardInterrupt()),
    "Ctrl-C while drawing the progress bar": ("advance", KeyboardInterrupt()),
}


@pytest.mark.parametrize("act", [play, release, close_loop])
@pytest.mark.parametrize(("method", "error"), FAULTS.values(), ids=list(FAULTS))
def test_any_fault_in_any_experiment_ends_at_zero_and_is_reported(
    tmp_path: Path, act: Callable[[Runner], None], method: str, error: BaseException
) -> None:
    scene = Scene(tmp_path, {method: (3, error)})
    with (
        pytest.raises(type(error), match=re.escape(str(error)) or None) as caught,
        scene.runner as runner,
    ):
        act(runner)
        act(runner)
    assert caught.value is error
    scene.assert_safe()


def test_a_fault_while_masses_are_hung_ends_at_zero(tmp_path: Path) -> None:
    error = ResultError("lost the fiducials")
    scene = Scene(tmp_path, {"finish": (3, error)})
    with pytest.raises(ResultError, match="lost the fiducials"), scene.runner as runner:
        runner.settle(1.5, 0.1)
        hang(runner)
    scene.assert_safe()


def test_a_refused_sensing_signal_ends_at_zero_before_anything_begins(tmp_path: Path) -> None:
    scene = Scene(tmp_path)
    runner = Runner(
        scene.rig, scene.session, CameraRecorder(scene.twin, scene.session, tmp_path, "none"),
        CARRIER_HZ, 5.0, SilentProgress(),
    )  # fmt: skip
    with pytest.raises(LimitError, match="carrier amplitude = 5 V"), runner:
        raise AssertionError("the context must not be entered")
    scene.assert_safe()


@pytest.mark.parametrize("method", ["event", "finish", "off"])
def test_an_interrupt_of_the_clean_up_itself_finds_the_output_at_zero(
    tmp_path: Path, method: str
) -> None:
    faults: Faults = {}
    scene = Scene(tmp_path, faults)
    interrupt = KeyboardInterrupt()
    with pytest.raises(KeyboardInterrupt) as caught, scene.runner as runner:
        play(runner)
        faults[method] = (0, interrupt)
        runner.settle(1.0, 0.1)
        raise DeviceError("first")
    assert caught.value is interrupt
    if method == "off":  # a generator that cannot be switched off is found by the read-back
        assert any("Output not at 0 V" in what for what in scene.events())
        assert scene.twin._native.carrier_v == CARRIER_V
    else:
        assert scene.twin.output_v == 0.0
    assert [act for act in scene.acts if act in ("write", "zero")][-1] == "zero"


def test_a_disk_that_is_full_in_the_clean_up_does_not_hide_the_first_error(tmp_path: Path) -> None:
    faults: Faults = {}
    scene = Scene(tmp_path, faults)
    with pytest.raises(ZeroDivisionError, match="zero"), scene.runner as runner:
        play(runner)
        faults |= {name: (0, DeviceError("disk full")) for name in ("event", "finish")}
        raise ZeroDivisionError("by zero")
    scene.assert_safe()


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda r: r.play("x", np.append(np.full(5, 1.0), 2.01), 50.0, 0.25), r"2\.01 V"),
        (lambda r: r.play("x", np.array([1.0, np.nan]), 50.0, 0.25), "nan V"),
        (lambda r: r.release("x", -0.1, 1.0, 1.0, 50.0, 0.25), r"-0\.1 V"),
        (lambda r: r.settle(5.0, 1.0), "5 V"),
    ],
)
def test_a_voltage_beyond_the_limits_is_refused_before_anything_moves(scene, act, words):
    with scene.runner as runner:
        before = (scene.twin.time_s, scene.twin._native.length_m)
        with pytest.raises(LimitError, match=rf"drive voltage = {words} is outside \[0, 2\] V"):
            act(runner)
        assert (scene.twin.time_s, scene.twin._native.length_m) == before
        assert scene.events() == []
    scene.assert_safe()


def test_a_loop_is_refused_when_its_map_bulges_beyond_the_limits_between_the_ends(scene):
    # 0 V and 1.4 V at the ends of the saturation, 3 V in between.
    bulge = VoltageMap(12.0, -20.0, -12.0, -40.0)
    ends = bulge.voltage_v([0.0, 0.1])
    assert ends.min() >= 0.0 and ends.max() <= 2.0 < bulge.voltage_v(0.035)
    pi, to_strain = pid_controller(0.4, 0.7), StrainMap(4.9e8, -0.27)
    loop = LoopSettings(pi, Saturation(0.0, 0.1), bulge, to_strain)
    with scene.runner as runner, pytest.raises(LimitError, match=r"is outside \[0, 2\] V"):
        runner.close_loop("x", np.zeros(5), loop, FRAME_RATE_HZ, MASS_KG)
    assert scene.record("x").codes.shape[0] == 0
    scene.assert_safe()


# ---- what is recorded -----------------------------------------------------------------------


@pytest.mark.parametrize("act", [play, release, hang, close_loop])
def test_a_whole_experiment_has_a_start_and_an_end_and_a_broken_one_has_no_end(tmp_path, act):
    scene = Scene(tmp_path / "whole")
    with scene.runner as runner:
        act(runner)
    assert scene.events()[0] == "start x"
    assert scene.events()[-1] == "end x"
    broken = Scene(
        tmp_path / "broken", {name: (3, KeyboardInterrupt()) for name in ("look", "finish")}
    )
    with pytest.raises(KeyboardInterrupt), broken.runner as runner:
        act(runner)
    assert "end x" not in broken.events()
    assert broken.events()[-1] == "ended by KeyboardInterrupt; output at 0 V"


def test_the_session_says_what_the_output_was_in_each_block(scene):
    drive_v = np.round(np.linspace(0.0, 2.0, 41), 3)
    with scene.runner as runner:
        runner.play("x", drive_v, FRAME_RATE_HZ, MASS_KG)
    record = scene.record("x")
    d = scene.rig.description
    np.testing.assert_array_equal(record.drive_v, drive_v)
    np.testing.assert_allclose(np.diff(record.block_start_s), d.block_s, atol=1e-9)
    assert np.isnan(record.reference).all()
    monitor_v = record.codes[:, -100:, 0].mean(axis=1) * d.volt_per_code
    # The mean of 100 samples is one carrier period: 3 sigma of its noise, the amplifier settled.
    np.testing.assert_allclose(monitor_v, drive_v, atol=3 * 0.3e-3 / 10 + 1e-4)


def test_a_run_begins_without_the_carrier_before_which_the_mass_hung_for_long(scene):
    start_s = scene.twin.time_s
    with scene.runner:
        pass
    rows = scene.session.conditions()
    np.testing.assert_array_equal(rows["time_s"][:2], start_s)
    np.testing.assert_array_equal(rows["carrier_v"][:2], [0.0, CARRIER_V])


def test_a_release_lifts_waits_lets_go_and_notes_when(scene):
    with scene.runner as runner:
        release(runner)
    record = scene.record("x")
    drop_s = next(time for time, what in scene.session.events() if what == "drop x")
    assert drop_s == pytest.approx(record.block_start_s[10], abs=1e-9)  # 0.1 s at rest
    assert len(record.codes) == 70
    rows = record.tracks["y_px"][:, 3:].mean(axis=1) - record.tracks["y_px"][:, :3].mean(axis=1)
    early = rows[record.frame_time_s < drop_s]
    assert rows.max() > early.max() + 5.0  # the weight stretches the sheet by many pixels


@pytest.mark.parametrize("keep", ["none", "sample", "all"])
def test_an_interrupted_run_leaves_a_video_that_can_be_read(tmp_path, keep):
    # At the third look: 60 blocks, 0.6 s.
    scene = Scene(tmp_path, {"advance": (3, KeyboardInterrupt())}, keep)
    with pytest.raises(KeyboardInterrupt), scene.camera_recorder, scene.runner as runner:
        play(runner)
    path = tmp_path / "video" / "x.avi"
    assert path.exists() == (keep != "none")
    if keep != "none":
        frames = scene.record("x").frame_time_s
        with open_video(path) as video:
            time_s = [time for time, _ in video.timed()]
        np.testing.assert_allclose(time_s, frames - frames[0], atol=1e-9)


# ---- the closed loop against a second computation -------------------------------------------


def closed_trial(
    scene: Scene, gains: PidGains, **further: Any
) -> tuple[ExperimentRecord, LoopSettings]:
    """A step of 2 % strain on the loop, its strain map taken from the plate law at rest."""
    with scene.runner as runner:
        runner.play("x", np.full(60, float(EQ4.voltage_v(0.0))), FRAME_RATE_HZ, MASS_KG)
        rest = lockin_of(scene.rig.description, CARRIER_HZ).sense(scene.record("x").codes[-20:])
        slope_per_f = 1.0 / (3.33 * rest.capacitance_f.mean())
        to_strain = StrainMap(slope_per_f, -1 / 3.33)
        loop = LoopSettings(gains.controller(), Saturation(-0.02, 0.06), EQ4, to_strain, **further)
        reference = np.concatenate([np.full(10, np.nan), np.zeros(60), np.full(150, 0.02)])
        runner.close_loop("y", reference, loop, FRAME_RATE_HZ, MASS_KG)
    return scene.record("y"), loop


# The last one saturates by swinging from end to end: the watchdog would trip, as it should.
WILD = WatchdogSettings(swings_per_s=1e3, slow_swings_per_s=1e3, charges_per_s=1e3)
GAINS = [PidGains(0.4, 0.7), PidGains(0.5, 1.5, 0.02, 0.03), PidGains(3.0, 20.0)]


@pytest.mark.parametrize("gains", GAINS, ids=["PI", "PID", "saturating PI"])
def test_each_output_is_the_core_s_answer_to_the_block_before_bit_for_bit(tmp_path, gains):
    scene = Scene(tmp_path, limits=SafetySettings(loop=WILD))
    record, loop = closed_trial(scene, gains)
    lockin = lockin_of(scene.rig.description, CARRIER_HZ)
    pid = _core.Pid(
        gains.kp, gains.ki, gains.kd, scene.rig.description.block_s, gains.derivative_filter_s,
        loop.saturation.low, loop.saturation.high,
    )  # fmt: skip
    v, s = loop.voltage_map, loop.strain_map
    output_v = _core.voltage_from_strain(v.a1_v, v.b1, v.a2_v, v.b2, 0.0)
    for k, desired in enumerate(record.reference):
        assert record.drive_v[k] == output_v, f"block {k}"
        capacitance_f, _, valid = lockin.step(record.codes[k])
        assert valid
        if desired == desired:
            strain = _core.strain_from_capacitance(*s.coefficients, capacitance_f)
            output_v = _core.voltage_from_strain(
                v.a1_v, v.b1, v.a2_v, v.b2, pid.step(desired, strain)
            )


@pytest.mark.long
def test_a_loop_may_close_while_the_actuator_still_rings_from_a_sweep(tmp_path):
    """The watchdog must not take the last drive of the sweep for that of an equilibrium."""
    scene = Scene(tmp_path, limits=SafetySettings())
    to_strain = StrainMap(1.038e9, -0.3998, -5.266e17, 1.166e26)  # of this twin, softened
    to_volt = VoltageMap(15.13, -2.406, -14.648, -3.581)
    loop = LoopSettings(
        PidGains(0.0, 6.88).controller(), Saturation(-0.02, 0.06), to_volt, to_strain
    )
    sweep = 0.015 * linear_chirp(0.2, 8.0, 8.0, 100.0)
    with scene.runner as runner:
        softened_v = triangle(0.0, 1.8, 0.3, 2, 100.0)
        drive_v = np.append(softened_v, to_volt.voltage_v(sweep))
        runner.play("x", drive_v, FRAME_RATE_HZ, MASS_KG)
        assert not scene.rig.bench.is_settled
        runner.close_loop("y", np.zeros(120), loop, FRAME_RATE_HZ, MASS_KG)
        assert len(scene.record("y").drive_v) == 120
        runner.settle(0.5, 6.0)
        assert scene.rig.bench.is_settled


def test_late_outputs_are_those_of_a_loop_some_blocks_before(tmp_path):
    """What the controller asks for in a block is put out two blocks later than it would be."""
    scene = Scene(tmp_path)
    record, loop = closed_trial(scene, PidGains(0.1, 0.5), extra_delay_blocks=2)
    lockin = lockin_of(scene.rig.description, CARRIER_HZ)
    pid = _core.Pid(
        0.1, 0.5, 0.0, scene.rig.description.block_s, 0.0,
        loop.saturation.low, loop.saturation.high,
    )  # fmt: skip
    v, s = loop.voltage_map, loop.strain_map
    asked = [_core.voltage_from_strain(v.a1_v, v.b1, v.a2_v, v.b2, 0.0)]
    for codes, desired in zip(record.codes, record.reference, strict=True):
        if desired == desired:
            strain = _core.strain_from_capacitance(*s.coefficients, lockin.step(codes)[0])
            u = pid.step(desired, strain)
            asked.append(_core.voltage_from_strain(v.a1_v, v.b1, v.a2_v, v.b2, u))
        else:
            asked.append(asked[-1])
    np.testing.assert_array_equal(record.drive_v[:2], asked[0])
    np.testing.assert_array_equal(record.drive_v[2:], asked[: record.drive_v.size - 2])


def test_the_printed_chain_closes_the_loop_with_a_carrier_of_its_own(tmp_path):
    """The outputs are the core's answer to the printed chain, whose low-pass runs on."""
    scene = Scene(tmp_path)
    gains = PidGains(0.1, 0.5)
    record, loop = closed_trial(scene, gains, printed_chain=True, carrier_v=0.2)
    chain = printed_chain_of(scene.rig.description, CARRIER_HZ)
    pid = _core.Pid(
        gains.kp, gains.ki, 0.0, scene.rig.description.block_s, 0.0,
        loop.saturation.low, loop.saturation.high,
    )  # fmt: skip
    v = loop.voltage_map
    output_v = _core.voltage_from_strain(v.a1_v, v.b1, v.a2_v, v.b2, 0.0)
    for k, desired in enumerate(record.reference):
        assert record.drive_v[k] == pytest.approx(output_v, abs=1e-6), f"block {k}"
        sensed = chain.sense(record.codes[k][np.newaxis])
        if desired == desired:
            strain = float(loop.strain_map.strain(sensed.capacitance_f)[0])
            output_v = _core.voltage_from_strain(
                v.a1_v, v.b1, v.a2_v, v.b2, pid.step(desired, strain)
            )
    # 0.2 V at the input are ten times the carrier of the run, less the amplifier's roll-off.
    volt = scene.rig.description.volt_per_code
    plain = lockin_of(scene.rig.description, CARRIER_HZ).sense(scene.record("x").codes[-5:])
    assert np.median(sensed.v_pp) * volt > 6.5 * np.median(plain.v_pp) * volt


@pytest.mark.parametrize("gains", GAINS, ids=["PI", "PID", "saturating PI"])
def test_each_output_agrees_with_a_computation_in_double_precision(tmp_path, gains):
    scene = Scene(tmp_path, limits=SafetySettings(loop=WILD))
    record, loop = closed_trial(scene, gains)
    d = scene.rig.description
    first = 560  # the pieces of 112 that the blanking of 500 samples reaches
    time_s = np.arange(d.block_samples)[first:] / d.rate_hz
    angle = 2.0 * np.pi * CARRIER_HZ * time_s
    basis = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle), time_s], axis=1)
    solve = np.linalg.pinv(basis)
    integral, filtered, wanted = 0.0, None, [float(EQ4.voltage_v(0.0))]
    share = d.block_s / (d.block_s + gains.derivative_filter_s)
    for codes, desired in zip(record.codes, record.reference, strict=True):
        (v_re, v_im), (i_re, i_im) = (solve @ codes[first:].astype(float))[:2].T
        voltage, current = complex(v_re, -v_im), complex(i_re, -i_im)
        current *= np.exp(-2j * np.pi * CARRIER_HZ * d.skew_s)  # back to the voltage's instant
        ohm = voltage / d.v_monitor_v_per_v / (current / d.i_monitor_v_per_a)
        capacitance_f = 1.0 / (2.0 * np.pi * CARRIER_HZ * abs(ohm.imag))
        if desired != desired:
            wanted.append(wanted[-1])
            continue
        strain = float(loop.strain_map.strain(np.float64(capacitance_f)))
        error = desired - strain
        previous = strain if filtered is None else filtered
        filtered = previous + share * (strain - previous)
        damping = gains.kd * (filtered - previous) / d.block_s
        free = gains.kp * error + integral - damping
        low, high = loop.saturation.low, loop.saturation.high
        if not (free > high and error > 0.0) and not (free < low and error < 0.0):
            integral += gains.ki * error * d.block_s
        u = min(max(gains.kp * error + integral - damping, low), high)
        wanted.append(float(EQ4.voltage_v(u)))
    # Single precision: the phasors carry 1e-6 of themselves, so strain, which is the small
    # difference of two numbers of 0.3, carries 4e-7; gain 3.5 (P, D) and the map's 11.7 V.
    gain = gains.kp + 2.0 * gains.kd / d.block_s * share
    tolerance_v = 11.7 * (gain * 4e-7 + len(wanted) * np.finfo(np.float32).eps * 0.06) + 5e-7
    np.testing.assert_allclose(record.drive_v, wanted[:-1], rtol=0, atol=tolerance_v)
    assert np.ptp(record.drive_v) > 0.1  # the loop did act
    if gains.kp == 3.0:
        top = float(EQ4.voltage_v(loop.saturation.high))
        assert record.drive_v.max() == pytest.approx(top, abs=1e-6)  # and it did saturate
