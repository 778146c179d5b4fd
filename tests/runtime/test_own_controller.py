"""A controller of one's own in the runner: what it gets, its limits, its failures."""

from __future__ import annotations

import asyncio
import math
import sys

import numpy as np
import pytest

from haselab.base import InputError, SafetyError, SilentProgress
from haselab.control import Saturation
from haselab.controllers import (
    ControllerKind,
    ControllerSetting,
    KnownActuator,
    Measurement,
    Parameter,
)
from haselab.controllers.protocol import waiting_drives
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench, describe, rig_of
from haselab.runtime.camera_recorder import CameraRecorder
from haselab.runtime.lockin import counted_s, lockin_of
from haselab.runtime.loop import LoopSettings, RunningController
from haselab.runtime.runner import Runner
from haselab.store.session.writer import ExperimentPlan, SessionWriter

EQ4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
TO_STRAIN = StrainMap(4.9e8, -0.27)


class Spy:
    """Puts out what it is given, and keeps what it got."""

    def __init__(self, drive: float) -> None:
        self.drive = drive
        self.seen: list[tuple[float, Measurement]] = []

    def start(self, setting: ControllerSetting) -> None:
        self.setting = setting

    def step(self, reference: float, measurement: Measurement) -> float:
        self.seen.append((reference, measurement))
        return self.drive


class Scene:
    """A twin with a session and a runner."""

    def __init__(self, folder, config=None) -> None:
        config = config or twin_of_reading("hz")
        self.twin = TwinBench(config, 5)
        self.rig = rig_of(self.twin, config)
        self.session = SessionWriter(
            folder / "session.h5", [ExperimentPlan("x", "test", 6, {})],
            self.rig.description.block_samples, {},
        )  # fmt: skip
        witness = CameraRecorder(self.rig.camera, self.session, folder / "video", "none")
        self.runner = Runner(self.rig, self.session, witness, 2000.0, 0.02, SilentProgress())

    def play_kind(self, kind, reference, actuator=None) -> None:
        loop = LoopSettings(
            kind.choose(), Saturation(-0.04, 0.1), EQ4, TO_STRAIN, actuator=actuator
        )
        with self.runner as runner:
            runner.close_loop("x", np.asarray(reference), loop, 50.0, 0.25)

    def play(self, make, reference, **values: float) -> None:
        parameters = tuple(Parameter(name, "1/s") for name in values)
        loop = LoopSettings(
            ControllerKind("spy", make, parameters).choose(values),
            Saturation(-0.04, 0.1), EQ4, TO_STRAIN,
        )  # fmt: skip
        with self.runner as runner:
            runner.close_loop("x", np.asarray(reference), loop, 50.0, 0.25)


@pytest.fixture
def scene(tmp_path) -> Scene:
    return Scene(tmp_path)


def test_a_controller_gets_period_limits_and_each_block_s_measurement(scene):
    spy = Spy(0.01)
    scene.play(lambda: spy, [math.nan] * 3 + [0.02] * 20)
    about = scene.rig.description
    window_s = counted_s(about, 2000.0)  # of which the capacitance is the mean
    assert spy.setting == ControllerSetting(
        about.block_s, -0.04, 0.1, delay_s=0.5 * window_s + about.switch_sample / about.rate_hz,
        sensed_before_s=0.5 * window_s,
    )  # fmt: skip
    record = scene.session.experiment("x")
    lockin = lockin_of(scene.rig.description, 2000.0)
    farad = [lockin.step(codes)[0] for codes in record.codes]
    assert [reference for reference, _ in spy.seen] == [0.02] * 20  # none before the reference
    got = [measured for _, measured in spy.seen]
    assert [m.capacitance_f for m in got] == farad[3:]
    assert [m.voltage_v for m in got] == record.drive_v[3:].tolist()
    np.testing.assert_allclose([m.strain for m in got], 4.9e8 * np.array(farad[3:]) - 0.27,
                               rtol=0, atol=1e-6)  # fmt: skip
    assert all(m.valid for m in got)
    steps_s = np.diff([m.time_s for m in got])
    np.testing.assert_allclose(steps_s, scene.rig.description.block_s, rtol=1e-9)


@pytest.mark.parametrize("queued", [0, 1])
def test_a_controller_gets_the_drive_that_acts_while_outputs_wait_in_the_device(tmp_path, queued):
    config = twin_of_reading("hz")
    plain, about = config.acquisition, describe(config)
    late = plain.model_copy(
        update={"output_delay_s": plain.output_delay_s + queued * about.block_s}
    )
    scene = Scene(tmp_path, config.model_copy(update={"acquisition": late}))
    spy = Spy(0.0)
    spy.step = lambda reference, measured: spy.seen.append((0, measured)) or 0.002 * len(spy.seen)
    scene.play(lambda: spy, [0.0] * 20)
    drive_v = scene.session.experiment("x").drive_v
    got = [measured.voltage_v for _, measured in spy.seen]
    assert got[queued:] == drive_v[: drive_v.size - queued].tolist()
    assert len(set(got)) == 20  # each output differs
    assert waiting_drives(spy.setting) == queued


def test_a_preview_beyond_the_closed_part_of_a_reference_stays(scene):
    """Where the reference is NaN, the loop is open: the last desired strain goes on."""
    spy = Spy(0.0)
    kind = ControllerKind("spy", lambda: spy, preview_s=0.03)
    scene.play_kind(kind, [0.0] * 40 + [0.01] + [math.nan] * 3)
    got = [measured.preview for _, measured in spy.seen][36:]
    assert got == [(0.0, 0.0, 0.0), (0.0, 0.0, 0.01), (0.0, 0.01, 0.01), *[(0.01,) * 3] * 2]


def test_the_drive_of_a_step_is_the_voltage_of_the_next_block(scene):
    scene.play(lambda: Spy(0.015), [0.0] * 40)
    drive_v = scene.session.experiment("x").drive_v
    np.testing.assert_allclose(drive_v[0], EQ4.voltage_v(0.0), rtol=1e-6)
    np.testing.assert_allclose(drive_v[1:], EQ4.voltage_v(0.015), rtol=1e-6)


@pytest.mark.parametrize(("asked", "put_out"), [(0.3, 0.1), (-0.3, -0.04)])
def test_the_loop_s_saturation_limits_every_controller(asked, put_out):
    loop = LoopSettings(
        ControllerKind("spy", lambda: Spy(asked)).choose(), Saturation(-0.04, 0.1), EQ4, TO_STRAIN
    )
    running = RunningController(loop.controller, loop.setting(0.01, None, (0.0, 2.0)))
    assert running.step(0.0, Measurement(0.0, 6e-10, 1.0, 0.0)) == put_out


LAW = KnownActuator(twin_of_reading("hz").law, 0.25, 0.051, 0.0, 1.8, 5000.0)


class Volts(Spy):
    """Puts out a voltage near that of zero strain."""

    def __init__(self) -> None:
        super().__init__(1.1)


def test_a_kind_with_voltage_output_puts_out_its_voltage_and_gets_the_actuator(scene):
    spy = Volts()
    kind = ControllerKind("volts", lambda: spy, output="voltage", preview_s=0.03)
    reference = [*np.linspace(0.0, 0.01, 20)]
    scene.play_kind(kind, reference, actuator=LAW)
    drive_v = scene.session.experiment("x").drive_v
    np.testing.assert_allclose(drive_v[0], EQ4.voltage_v(0.0), rtol=1e-6)
    assert drive_v[1:].tolist() == [1.1] * 19
    assert spy.setting.actuator is LAW
    assert (spy.setting.drive_low, spy.setting.drive_high) == (0.0, 1.8)  # of the actuator's file
    padded = [*reference, *[reference[-1]] * 3]
    assert [seen.preview for _, seen in spy.seen] == [
        tuple(padded[k + 1 : k + 4]) for k in range(20)
    ]


def test_a_voltage_outside_the_limits_stops_the_run(scene):
    kind = ControllerKind("volts", lambda: Spy(1.85), output="voltage")
    with pytest.raises(SafetyError, match=r"returned 1\.85 V, outside its limits of 0 to 1\.8 V"):
        scene.play_kind(kind, [0.0] * 5, actuator=LAW)
    assert scene.twin.output_v == 0.0


def test_a_kind_with_voltage_output_is_refused_without_a_physical_model(scene):
    kind = ControllerKind("volts", Volts, output="voltage")
    with pytest.raises(InputError, match=r"haselab identify actuator RUN --actuator A\.toml"):
        scene.play_kind(kind, [0.0] * 5)


def test_the_output_holds_while_the_measurement_is_not_valid():
    loop = LoopSettings(
        ControllerKind("spy", lambda: Spy(math.nan)).choose(), Saturation(), EQ4, TO_STRAIN
    )
    lost = Measurement(math.nan, math.nan, 1.0, 0.0, valid=False)
    running = RunningController(loop.controller, loop.setting(0.01, None, (0.0, 2.0)))
    assert running.step(0.0, lost) is None


def test_kind_parameters_and_drive_are_in_the_session(scene):
    scene.play(lambda gain_per_s: Spy(gain_per_s), [0.0] * 40, gain_per_s=0.02)
    events = [what for _, what in scene.session.events()]
    assert "controller x: spy, gain_per_s = 0.02 1/s" in events


class Raises(Spy):
    """Fails in its third step."""

    def step(self, reference: float, measurement: Measurement) -> float:
        if len(self.seen) == 2:
            raise ZeroDivisionError("float division by zero")
        return super().step(reference, measurement)


class Leaves(Spy):
    """Exits in its third step."""

    def step(self, reference: float, measurement: Measurement) -> float:
        if len(self.seen) == 2:
            raise SystemExit(0)
        return super().step(reference, measurement)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Leaves(0.0), r"Controller 'spy' failed: RuntimeError: it called sys\.exit\(0\)"),
        (lambda: Raises(0.0), "Controller 'spy' failed: ZeroDivisionError: float division"),
        (lambda: Spy(math.nan), "Controller 'spy' returned nan for a strain of"),
        (lambda: Spy(math.inf), "Controller 'spy' returned inf for a strain of"),
        (lambda: Spy("much"), "Controller 'spy' returned 'much' for a strain of"),
    ],
)
def test_a_controller_that_fails_ends_at_0_v_with_its_name(scene, make, said):
    with pytest.raises(SafetyError, match=said):
        scene.play(make, [0.0] * 20)
    assert scene.twin.output_v == 0.0
    assert any(said[:24] in what for _, what in scene.session.events())


def test_a_controller_that_does_not_start_is_refused_before_anything_moves(scene):
    def make() -> Spy:
        raise OSError("no solver")

    with pytest.raises(InputError, match="Controller 'spy' does not start: OSError: no solver"):
        scene.play(make, [0.0] * 5)
    assert len(scene.session.experiment("x").codes) == 0


def test_a_controller_that_exits_at_its_start_is_refused(scene):
    with pytest.raises(InputError, match=r"'spy' does not start: .*it called sys\.exit\(3\)"):
        scene.play(lambda: sys.exit(3), [0.0] * 5)


def test_an_exception_that_is_no_exception_stops_the_run_at_zero(scene):
    """Such as that of a task of asyncio that was cancelled, or a panic in Rust."""

    class Cancelled(Spy):
        def step(self, reference: float, measurement: Measurement) -> float:
            raise asyncio.CancelledError

    with pytest.raises(SafetyError, match=r"'spy' failed: .*it raised CancelledError"):
        scene.play(lambda: Cancelled(0.0), [0.0] * 5)
    assert scene.twin.output_v == 0.0


def test_a_wild_controller_is_stopped_by_the_watchdog_as_a_pid_is(scene):
    class Wild(Spy):
        def step(self, reference: float, measurement: Measurement) -> float:
            self.drive = -0.04 if self.drive > 0.0 else 0.1
            return self.drive

    with pytest.raises(SafetyError, match="Output charges the actuator too often"):
        scene.play(lambda: Wild(0.1), [0.0] * 300)
    assert scene.twin.output_v == 0.0


class MuteError(Exception):
    """An exception of which no text can be made."""

    def __str__(self) -> str:
        raise KeyError("text")

    __repr__ = __str__


class Unprintable:
    """An object that is no number and cannot be printed."""

    def __repr__(self) -> str:
        raise KeyError("text")


class Fails(Spy):
    """Raises an exception without a text."""

    def step(self, reference: float, measurement: Measurement) -> float:
        raise MuteError


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Fails(0.0), "'spy' failed: MuteError: no text: its __str__ raised KeyError"),
        (lambda: Spy("0.1"), "returned '0.1' for a strain of"),
        (lambda: Spy(True), "returned True for"),
        (lambda: Spy(np.bool_(True)), "returned (np.)?True"),
        (lambda: Spy(None), "returned None"),
        (lambda: Spy(np.zeros(1)), "returned an array of shape .1,. and type float64"),
        (lambda: Spy([0.1]), r"returned \[0\.1\]"),
        (lambda: Spy(0.1 + 0j), r"returned \(0\.1\+0j\)"),
        (lambda: Spy(Unprintable()), "returned an object of type Unprintable"),
        (lambda: Spy(10**400), "returned 1000"),
    ],
)  # fmt: skip
def test_a_step_that_is_no_finite_number_ends_at_0_v_in_one_line(scene, make, said):
    with pytest.raises(SafetyError, match=said) as raised:
        scene.play(make, [0.0] * 20)
    assert "\n" not in str(raised.value)
    assert scene.twin.output_v == 0.0


@pytest.mark.parametrize("drive", [np.float32(0.015), np.int64(0), 0])
def test_any_real_number_is_a_drive(drive):
    loop = LoopSettings(
        ControllerKind("spy", lambda: Spy(drive)).choose(), Saturation(), EQ4, TO_STRAIN
    )
    running = RunningController(loop.controller, loop.setting(0.01, None, (0.0, 2.0)))
    found = running.step(0.0, Measurement(0.0, 6e-10, 1.0, 0.0))
    assert type(found) is float and found == pytest.approx(float(drive))
