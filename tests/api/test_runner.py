"""A Runner after another one on the same bench: zero strain, and a start in motion."""

import numpy as np
import pytest

import haselab as hl
from haselab.base import InputError, ResultError
from haselab.runtime.camera_recorder import CameraRecorder

SHAKEN_V = 1.0 + 0.6 * hl.signals.linear_chirp(5.0, 5.2, 2.0, rate_hz=100.0)  # at the resonance


def test_a_runner_that_starts_in_motion_still_measures_the_strain() -> None:
    rig = hl.twin(frequency_unit="hz", seed=1)
    with hl.Runner(rig, baseline_v=1.0) as runner:
        shaken = runner.play(SHAKEN_V)
    assert np.ptp(shaken["strain"][-50:]) > 0.05  # leaving takes the output to 0 V from there
    with hl.Runner(rig, baseline_v=1.0, zero_length_m=shaken.zero_length_m) as runner:
        held = runner.play(np.full(50, 1.0))
    assert held.length_m.size == 25  # 0.5 s at 50 frames/s
    assert held.zero_length_m == shaken.zero_length_m
    # The first stretch has softened the actuator, so it is longer now; creep moves it by less.
    assert held.strain.mean() > 0.01


def test_a_length_that_is_none_is_refused() -> None:
    with pytest.raises(InputError, match=r"zero_length_m is -0\.05; it must be a number above 0 m"):
        hl.Runner(hl.twin(), zero_length_m=-0.05)


def test_a_camera_that_sees_nothing_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    look = CameraRecorder._track

    def lost(self: CameraRecorder, frames: object) -> object:
        session = self._session
        append = session.append_frames

        def invalid(name: str, time_s: np.ndarray, tracks: np.ndarray, mass_kg: float) -> None:
            tracks["valid"] = False
            append(name, time_s, tracks, mass_kg)

        monkeypatch.setattr(session, "append_frames", invalid)
        seen = look(self, frames)  # type: ignore[arg-type]
        monkeypatch.setattr(session, "append_frames", append)
        return seen

    monkeypatch.setattr(CameraRecorder, "_track", lost)
    with (
        pytest.raises(ResultError, match="not find all six fiducials in any of 200 frames"),
        hl.Runner(hl.twin(seed=1)),
    ):
        pass
