"""What a loop takes its strain from: the camera follows a reference as the capacitance does."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from haselab.base import SafetyError, SilentProgress
from haselab.control import Saturation
from haselab.controllers import pid_controller
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench, rig_of
from haselab.runtime.camera_recorder import CameraRecorder
from haselab.runtime.lockin import lockin_of
from haselab.runtime.loop import LoopSettings
from haselab.runtime.observer import Seen
from haselab.runtime.runner import Runner
from haselab.runtime.sensors import PATIENCE_BLOCKS, VideoSensor
from haselab.store.session.writer import ExperimentPlan, SessionWriter

EQ4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
CODES = np.zeros((2000, 2), dtype=np.int16)


class Eyes:
    """An observer that returns the given lengths."""

    def __init__(self, seen: Iterable[Seen | None]) -> None:
        self._seen = iter(seen)

    def start(self, *_: object, **__: object) -> None: ...

    def look(self) -> Seen | None:
        return next(self._seen)

    def finish(self) -> None: ...


def test_a_strain_holds_until_the_next_frame_and_is_lost_after_too_long():
    frames = [Seen(0.0, 210.0), None, None, Seen(0.03, 220.0), *[None] * PATIENCE_BLOCKS]
    sensor = VideoSensor(Eyes(frames), zero_px=200.0)
    strains = [sensor.strain(CODES) for _ in frames]
    np.testing.assert_allclose(strains[:4], [0.05, 0.05, 0.05, 0.1])
    np.testing.assert_allclose(strains[4:-1], 0.1)
    assert np.isnan(strains[-1])
    assert "No frame in 5 blocks" in sensor.lost()


def test_a_fiducial_that_is_not_seen_gives_no_strain():
    sensor = VideoSensor(Eyes([Seen(0.0, float("nan"))]), zero_px=200.0)
    assert np.isnan(sensor.strain(CODES))
    assert "fiducial" in sensor.lost()


class Bench:
    """A twin that a camera watches, with a session."""

    def __init__(self, folder: Path) -> None:
        config = twin_of_reading("hz")
        self.twin = TwinBench(config, 3)
        self.rig = rig_of(self.twin, config)
        plans = [ExperimentPlan(name, "test", 6, {}) for name in ("rest", "loop")]
        self.session = SessionWriter(folder / "s.h5", plans, 2000, {})
        camera_recorder = CameraRecorder(self.rig.camera, self.session, folder / "video", "none")
        self.runner = Runner(
            self.rig, self.session, camera_recorder, 2000.0, 0.02, SilentProgress()
        )

    def length_px(self, name: str) -> np.ndarray:
        """Of the recorded tracks, frame by frame."""
        tracks = self.session.experiment(name).tracks
        return tracks["y_px"][:, 3:].mean(axis=1) - tracks["y_px"][:, :3].mean(axis=1)


@pytest.mark.parametrize("frame_rate_hz", [200.0, 50.0])
def test_the_loop_closes_on_the_camera(tmp_path, frame_rate_hz):
    bench = Bench(tmp_path)
    reference = np.concatenate([np.full(20, np.nan), np.zeros(200), np.full(900, 0.02)])
    with bench.runner as runner:
        runner.play("rest", np.full(200, float(EQ4.voltage_v(0.0))), 100.0, 0.25)
        zero_px = float(bench.length_px("rest")[-20:].mean())
        loop = LoopSettings(
            pid_controller(0.3, 1.5), Saturation(-0.05, 0.06), EQ4, StrainMap(1.0, 0.0), zero_px
        )
        runner.close_loop("loop", reference, loop, frame_rate_hz, 0.25)
    strain = bench.length_px("loop") / zero_px - 1.0
    # The strain map above is nonsense: only the camera can bring it there. The integral has
    # 9 s at 1.5 per s; what is left is the creep that goes on meanwhile.
    assert strain[-round(frame_rate_hz) :].mean() == pytest.approx(0.02, abs=1e-3)


def test_a_covered_lens_trips_the_loop(tmp_path):
    bench = Bench(tmp_path)
    with bench.runner as runner:
        runner.play("rest", np.full(30, 1.0), 100.0, 0.25)
        zero_px = float(bench.length_px("rest")[-10:].mean())
        take, count = bench.twin.take, iter(range(1000))

        def covered():
            frames = take()
            if frames is not None and next(count) > 20:
                frames.images[:] = 0
            return frames

        bench.twin.take = covered  # type: ignore[method-assign]
        loop = LoopSettings(
            pid_controller(0.3, 1.5), Saturation(-0.05, 0.06), EQ4, StrainMap(1.0, 0.0), zero_px
        )
        with pytest.raises(SafetyError, match="A fiducial is not visible"):
            runner.close_loop("loop", np.zeros(200), loop, 100.0, 0.25)
    assert bench.twin.output_v == 0.0


def closed_on_capacitance(folder: Path, below_f: float, above_f: float) -> tuple[Bench, list[str]]:
    """A loop on a map that was fitted from below to above the capacitance of zero strain."""
    bench = Bench(folder)
    zero_v = float(EQ4.voltage_v(0.0))
    with bench.runner as runner:
        runner.play("rest", np.full(200, zero_v), 100.0, 0.25)
        rest = bench.session.experiment("rest")
        sensed = lockin_of(bench.rig.description, 2000.0).sense(rest.codes[-20:])
        zero_f = float(sensed.capacitance_f.mean())
        to_strain = StrainMap(
            SLOPE_PER_F, -SLOPE_PER_F * zero_f, range_f=(zero_f - below_f, zero_f + above_f)
        )
        loop = LoopSettings(pid_controller(0.1, 1.5), Saturation(-0.05, 0.06), EQ4, to_strain)
        reference = np.concatenate([np.full(20, np.nan), np.zeros(100), np.full(300, 0.02)])
        try:
            runner.close_loop("loop", reference, loop, 100.0, 0.25)
        finally:
            bench.session.flush("loop")
    return bench, [what for _, what in bench.session.events()]


SLOPE_PER_F = 4.9e8  # about that of the twin: a step of 0.02 is 41 pF


def test_a_loop_that_leaves_the_range_of_its_map_a_little_is_flagged_and_goes_on(tmp_path):
    """20 pF above, of a range of 200 pF: the strain is extrapolated and still controlled."""
    _, events = closed_on_capacitance(tmp_path, 180e-12, 20e-12)
    said = " ".join(events)
    assert "blocks the capacitance was outside" in said and "strain is extrapolated" in said
    assert any(each == "end loop" for each in events)


def test_a_loop_that_leaves_the_range_of_its_map_far_behind_trips_with_that_reason(tmp_path):
    """40 pF above, of a range of 21 pF: nobody knows the strain there."""
    with pytest.raises(SafetyError, match=r"too far from .* F, where the strain map was fitted"):
        closed_on_capacitance(tmp_path, 20e-12, 1e-12)


def test_a_loop_within_the_range_of_its_map_says_nothing(tmp_path):
    _, events = closed_on_capacitance(tmp_path, 200e-12, 200e-12)
    assert not [each for each in events if "strain map" in each]
