"""The camera recorder: which fiducial is which after a jump."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from haselab.rig import Frames
from haselab.runtime.camera_recorder import PARTICLES, CameraRecorder
from haselab.store.session.writer import ExperimentPlan, SessionWriter

SIGMA_PX, DEPTH, NOISE = 3.0, 120.0, 1.0
SPACING_PX = 40.0  # of the dots of a clamp
RATE_HZ = 50.0
ROWS = np.array([[x, y] for y in (50.0, 170.0) for x in (80.0, 120.0, 160.0)])
# The Cramer-Rao bound of a Gaussian dot's place along x is sqrt(2 / pi) NOISE / DEPTH = 0.0066 px;
# rounding to grey levels and a reference of ten frames make it 0.0072 px. Seven times that.
CLOSE_PX = 0.05


class Jumps:
    """A camera that shows some frames at rest, then the lower clamp at each of the shifts."""

    def __init__(
        self,
        shifts: list[tuple[float, float]],
        hidden: frozenset[int],
        at_rest: int = 10,
        *,
        particles: bool = False,
    ) -> None:
        self._with_particles = particles
        self._shifts, self._hidden = [(0.0, 0.0)] * at_rest + shifts, hidden
        self._given = 0

    def start(self, rate_hz: float) -> None:
        self._given = 0

    def stop(self) -> None:
        pass

    def take(self) -> Frames | None:
        if self._given:
            return None
        self._given = len(self._shifts)
        rng = np.random.default_rng(3)
        images = np.stack([self._image(k, rng) for k in range(self._given)])
        return Frames(images, np.arange(self._given) / RATE_HZ)

    def places(self, k: int) -> NDArray[np.float64]:
        return ROWS + np.repeat([[0.0, 0.0], self._shifts[k]], 3, axis=0)

    def particles(self, k: int) -> NDArray[np.float64]:
        """Two dots in the middle of the sheet, which move half as far as the lower clamp."""
        middle = np.array([[100.0, 110.0], [140.0, 110.0]]) if self._with_particles else ROWS[:0]
        return middle + 0.5 * np.array(self._shifts[k])

    def _image(self, k: int, rng: np.random.Generator) -> NDArray[np.uint8]:
        y, x = np.mgrid[:260, :240]
        grey = 190.0 + NOISE * rng.standard_normal(x.shape)
        dots = self.places(k)[: 5 if k in self._hidden else 6]
        small = self.particles(k)
        sizes = [SIGMA_PX] * len(dots) + [0.5 * SIGMA_PX] * len(small)
        for (cx, cy), sigma_px in zip([*dots, *small], sizes, strict=True):
            grey -= DEPTH * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2.0 * sigma_px**2))
        return np.rint(grey).astype(np.uint8)


def followed(folder: Path, camera: Jumps) -> NDArray[np.void]:
    session = SessionWriter(folder / "session.h5", [ExperimentPlan("x", "test", 6, {})], 100, {})
    camera_recorder = CameraRecorder(camera, session, folder, "none")
    with camera_recorder:
        camera_recorder.start("x", RATE_HZ, 0.0)
        camera_recorder.finish()
    tracks = session.experiment("x").tracks
    session.close()
    return tracks


@pytest.mark.parametrize("jump", [(0.0, 25.0), (25.0, 0.0), (SPACING_PX, 0.0), (0.0, -30.0)])
def test_fiducials_that_jump_keep_their_names(tmp_path: Path, jump: tuple[float, float]) -> None:
    camera = Jumps([jump, jump, (0.0, 0.0), (0.0, 0.0), jump], frozenset())
    tracks = followed(tmp_path, camera)
    assert tracks["valid"].all()
    truth = np.stack([camera.places(k) for k in range(15)])
    np.testing.assert_allclose(tracks["x_px"], truth[..., 0], rtol=0, atol=CLOSE_PX)
    np.testing.assert_allclose(tracks["y_px"], truth[..., 1], rtol=0, atol=CLOSE_PX)


@pytest.mark.parametrize("at_rest", [1, 3, 9])
def test_motion_in_the_first_frames_does_not_blur_the_reference(
    tmp_path: Path, at_rest: int
) -> None:
    """A trial may begin with a step of the drive; the mean of ten frames then shows no dots."""
    camera = Jumps([(0.0, 6.0 * k) for k in range(1, 12)], frozenset(), at_rest)
    tracks = followed(tmp_path, camera)
    assert tracks["valid"].all()
    truth = np.stack([camera.places(k) for k in range(at_rest + 11)])
    # The reference has `at_rest` frames instead of ten.
    close_px = CLOSE_PX * np.sqrt((1.0 + 1.0 / at_rest) / (1.0 + 1.0 / 10.0))
    np.testing.assert_allclose(tracks["y_px"], truth[..., 1], rtol=0, atol=close_px)


def test_motion_in_the_first_frames_does_not_blur_the_particles(tmp_path: Path) -> None:
    """Particles have a reference in each experiment, not only in the first one of a session."""
    camera = Jumps([(0.0, 12.0 * k) for k in range(1, 10)], frozenset(), 2, particles=True)
    plans = [
        ExperimentPlan(name, "test", points, {})
        for name, points in (("x", 6), ("x-particles", PARTICLES))
    ]
    session = SessionWriter(tmp_path / "session.h5", plans, 100, {})
    with CameraRecorder(camera, session, tmp_path, "none") as recorder:
        for first in (True, False):
            recorder.start("x", RATE_HZ, 0.0, particles="" if first else "x-particles")
            recorder.finish()
    tracks = session.experiment("x-particles").tracks[:, :2]
    noted = [what for _, what in session.events()]
    session.close()
    shown = range(0, 11, 2)  # 20 Hz of the camera's 50 Hz
    truth = np.stack([camera.particles(k) for k in shown])
    assert tracks["valid"].all() and "motion after 2 frames" in " ".join(noted)
    order = np.argsort(tracks["x_px"][0])
    close_px = CLOSE_PX * np.sqrt((1.0 + 1.0 / 2.0) / (1.0 + 1.0 / 10.0))
    for field, axis in (("x_px", 0), ("y_px", 1)):
        found = tracks[field][:, order]
        np.testing.assert_allclose(found, truth[..., axis], rtol=0, atol=close_px)


def test_fiducials_whose_names_are_in_doubt_are_not_valid(tmp_path: Path) -> None:
    camera = Jumps([(25.0, 0.0), (25.0, 0.0)], frozenset({10}))
    tracks = followed(tmp_path, camera)
    assert not tracks["valid"][10, 3:].any()  # one is hidden: the rows do not tell the others
    assert tracks["valid"][:10].all() and tracks["valid"][11].all()
