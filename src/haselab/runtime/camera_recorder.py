"""Record the camera independently of the monitors: fiducials on the acquisition's clock."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from haselab.base import HaselabError, InputError, ResultError
from haselab.rig import Camera, Frames
from haselab.rig.cameras.source import KnownCamera
from haselab.runtime.helper_process import HelperProcess
from haselab.runtime.observer import FIDUCIALS, PARTICLES, Seen
from haselab.store.session.writer import SessionWriter
from haselab.store.video.raw import RawVideoWriter, transcode
from haselab.store.video.writer import VideoWriter, write_png
from haselab.tracking import PointTracker, TrackOptions, detect_fiducials, detect_particles
from haselab.tracking.tracks import FrameTracks, LossReason, TrackState

__all__ = ["CameraRecorder", "FrameRecorder", "KeepVideo"]

KeepVideo = Literal["none", "sample", "all"]
_REST_FRAMES = 10
_SAMPLE_S = 1.0
_STILL_PX = 0.3  # a fiducial that moves farther between the first frames is in motion
_SURE = 0.9  # correlation above which a fiducial found near its last position needs no search
_PARTICLE_RATE_HZ = 20.0
_CLAMP_PX = 28.0  # half height of the clamp's bar around its row of fiducials
_OPTIONS = TrackOptions(subset_px=21, search_px=40, sloped_light=True)


def _fiducials_of(images: NDArray[np.uint8]) -> NDArray[np.float64]:
    return detect_fiducials(images.mean(axis=0), FIDUCIALS)


def _particles_of(images: NDArray[np.uint8]) -> NDArray[np.float64]:
    return detect_particles(images.mean(axis=0))


def _in_doubt(found: FrameTracks) -> bool:
    return found.reason is not None and bool((found.reason & LossReason.AMBIGUOUS).any())


def _time_s(shown: tuple[Frames, int]) -> float:
    frames, k = shown
    return float(frames.time_s[k])


_Search = Callable[[NDArray[np.uint8]], NDArray[np.float64]]
_Call = Callable[[_Search, NDArray[np.uint8]], NDArray[np.float64]]


def _here(search: _Search, images: NDArray[np.uint8]) -> NDArray[np.float64]:
    return search(images)


class FrameRecorder(Protocol):
    """Where tracks of frames and events go: a session, or memory."""

    def append_frames(
        self,
        name: str,
        time_s: NDArray[np.float64],
        tracks: NDArray[np.void],
        mass_kg: float,
    ) -> None:
        """Add the tracks of frames."""

    def event(self, time_s: float, what: str) -> None:
        """Note that something happened."""


class _Particles:
    """Row S11: the sheet's particles, tracked at a lower rate than the camera's."""

    def __init__(self, session: FrameRecorder, name: str, rate_hz: float, call: _Call) -> None:
        self._session = session
        self._name = name
        self._call = call
        self._stride = max(1, round(rate_hz / _PARTICLE_RATE_HZ))
        self._seen = 0
        self._count = 0
        self._tracker: PointTracker | None = None
        self._state: TrackState | None = None

    def refer(self, images: NDArray[np.uint8], fiducials: NDArray[np.float64]) -> None:
        """Find the particles between the two rows of fiducials."""
        found = self._call(_particles_of, images)
        low, high = fiducials[:3, 1].max() + _CLAMP_PX, fiducials[3:, 1].min() - _CLAMP_PX
        found = found[(found[:, 1] > low) & (found[:, 1] < high)][:PARTICLES]
        self._count = len(found)
        if self._count:
            by_itself = TrackOptions(subset_px=15, model="affine")
            try:
                self._tracker = PointTracker(found, replace(by_itself, model="neighbours"))
            except InputError:  # fewer than six particles, or all on one line
                self._tracker = PointTracker(found, by_itself)
            self._state = self._tracker.init(list(images))

    def follow(self, frames: Frames, mass_kg: float) -> None:
        """Track the particles in every n-th frame and record them; lost points are not valid."""
        first, count = -self._seen % self._stride, len(frames.time_s)
        self._seen += count
        chosen = range(first, count, self._stride)
        if self._tracker is None or self._state is None or not chosen:
            return
        rows = np.zeros((len(chosen), PARTICLES), dtype=SessionWriter.track_dtype())
        for row, k in zip(rows, chosen, strict=True):
            self._state, found = self._tracker.step(self._state, frames.image(k))
            for field in ("x_px", "y_px", "std_x_px", "std_y_px", "valid"):
                row[field][: self._count] = getattr(found, field)
        self._session.append_frames(self._name, frames.time_s[list(chosen)], rows, mass_kg)


def _count_at_rest(images: NDArray[np.uint8], points: NDArray[np.float64]) -> int:
    """Number of frames before the points first move; later frames would blur the mean."""
    tracker = PointTracker(points, _OPTIONS)
    state = tracker.init([images[0]])
    for count, image in enumerate(images[1:], start=1):
        state, found = tracker.step(state, image)
        moved_px = np.hypot(found.x_px - points[:, 0], found.y_px - points[:, 1])
        if not found.valid.all() or moved_px.max() > _STILL_PX:
            return count
    return len(images)


class CameraRecorder:
    """Tracks the fiducials of both clamps through all experiments of a session.

    Use as a context: after a run in real time, leaving it makes videos of the raw frames. The first
    ten frames of the session, or those before the first motion, are the reference of all
    experiments, so that a length has the same error in each.

    Args:
        camera: of the rig.
        session: to which the tracks are written.
        folder: to which videos are written.
        keep: which frames are kept: none, the first and last second, or all.
        real_time: a loop runs at the same time, so points are searched for in a helper process,
            and videos are made from raw frames at the end.
    """

    def __init__(
        self,
        camera: Camera,
        session: FrameRecorder,
        folder: Path,
        keep: KeepVideo,
        *,
        real_time: bool = False,
    ) -> None:
        self._camera = camera
        self._session = session
        self._folder = folder
        self._keep = keep
        self._name = ""
        self._rate_hz = 0.0
        self._mass_kg = 0.0
        self._tracker: PointTracker | None = None
        self._state: TrackState | None = None
        self._placed = False
        self._points = np.empty((FIDUCIALS, 2))
        self._waiting: list[Frames] = []
        self._video: RawVideoWriter | VideoWriter | None = None
        self._raws: list[Path] = []
        self._helper = HelperProcess([__name__], yields=True) if real_time else None
        self._call: _Call = _here if self._helper is None else self._helper.call
        self._first_s: float | None = None
        self._last_s = 0.0
        self._particles: _Particles | None = None
        self._tail: deque[tuple[Frames, int]] = deque()

    def start(
        self, name: str, rate_hz: float, mass_kg: float, part: str = "", particles: str = ""
    ) -> None:
        """Begin an experiment, or a part of it; the actuator must not move."""
        self._particles = (
            _Particles(self._session, particles, rate_hz, self._call) if particles else None
        )
        self._name, self._rate_hz, self._mass_kg = name, rate_hz, mass_kg
        self._placed, self._first_s = False, None
        self._waiting = []
        self._tail.clear()
        if self._keep != "none":
            path = self._folder / f"{name}{part}"
            if self._helper is None:
                self._video = VideoWriter(path.with_name(f"{path.name}.avi"), rate_hz, hashed=True)
            else:
                self._video = RawVideoWriter(path.with_name(f"{path.name}.mkv"), rate_hz)
        self._camera.start(rate_hz)

    def look(self) -> Seen | None:
        """Track and record the frames that have arrived; return what the last one shows."""
        frames = self._camera.take()
        if frames is None:
            return None
        self._last_s = float(frames.time_s[-1])
        self._store(frames)
        if not self._placed:
            self._waiting.append(frames)
            images = np.concatenate([f.images for f in self._waiting])
            if self._state is None and len(images) < _REST_FRAMES:
                return None
            self._place(images)
            times_s = np.concatenate([f.time_s for f in self._waiting])
            frames, self._waiting = Frames(images, times_s), []
        return self._track(frames)

    def _place(self, images: NDArray[np.uint8]) -> None:
        """Find the fiducials; in the session's first frames, also make them the reference."""
        first = images[:_REST_FRAMES]
        if self._tracker is None:
            rest = self._at_rest(first)
            points = self._call(_fiducials_of, rest)
            self._tracker = PointTracker(points, _OPTIONS)
            self._state = self._tracker.init(list(rest))
        else:
            points, rest = self._find(images[0]), None
        assert self._state is not None
        self._state = self._tracker.placed(self._state, points)
        self._points = points
        self._placed = True
        if self._particles is not None:
            still = self._before_motion(first, points) if rest is None else rest
            self._particles.refer(still, points)
            write_png(self._folder / f"{self._name}.png", images[0])

    def _at_rest(self, images: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The frames before the first motion; an event in the session says if motion left fewer."""
        try:
            points = self._call(_fiducials_of, images[:1])
        except ResultError:  # too noisy; the mean of all frames may be good enough
            return images
        return self._before_motion(images, points)

    def _before_motion(
        self, images: NDArray[np.uint8], points: NDArray[np.float64]
    ) -> NDArray[np.uint8]:
        count = _count_at_rest(images, points)
        if count < len(images):
            self._session.event(
                self._last_s, f"camera: motion after {count} frames, which are the reference"
            )
        return images[:count]

    def _find(self, image: NDArray[np.uint8]) -> NDArray[np.float64]:
        """Find the fiducials, near their last positions first, then in the whole image."""
        assert self._tracker is not None and self._state is not None
        state, found = self._tracker.step(self._tracker.placed(self._state, self._points), image)
        points = np.stack([found.x_px, found.y_px], axis=1)
        row = points[3:, 1]
        if found.valid.all() and np.ptp(row) < 1.0 and found.quality.min() > _SURE:
            self._state = state
            return points
        return self._call(_fiducials_of, image[np.newaxis])

    def _track(self, frames: Frames) -> Seen:
        assert self._tracker is not None and self._state is not None
        rows = np.empty((len(frames.time_s), FIDUCIALS), dtype=SessionWriter.track_dtype())
        searches = len(rows) if self._helper is None else 1  # a loop must not wait longer
        for k, row in enumerate(rows):
            before = self._state
            self._state, found = self._tracker.step(before, frames.view(k))
            if searches and _in_doubt(found):
                searches -= 1
                self._state, found = self._named(before, self._state, found, frames.image(k))
            for field in ("x_px", "y_px", "std_x_px", "std_y_px", "valid"):
                row[field] = getattr(found, field)
        if found.valid.all():
            self._points = np.stack([found.x_px, found.y_px], axis=1)
        self._session.append_frames(self._name, frames.time_s, rows, self._mass_kg)
        if self._particles is not None:
            self._particles.follow(frames, self._mass_kg)
        half = FIDUCIALS // 2
        length_px = float(found.y_px[half:].mean() - found.y_px[:half].mean())
        return Seen(float(frames.time_s[-1]), length_px if found.valid.all() else float("nan"))

    def _named(
        self, before: TrackState, after: TrackState, found: FrameTracks, image: NDArray[np.uint8]
    ) -> tuple[TrackState, FrameTracks]:
        """Identify the fiducials after a jump by their places in the two rows.

        A single fiducial that jumped cannot be distinguished from its neighbour.
        """
        assert self._tracker is not None
        try:
            points = self._call(_fiducials_of, image[np.newaxis])
        except ResultError:  # not all of them are in view
            return after, found
        state, found = self._tracker.step(self._tracker.placed(before, points), image)
        motion = state.poses["centre_px"] - before.poses["centre_px"]
        return replace(state, velocity_px=motion), found

    def _store(self, frames: Frames) -> None:
        if self._video is None:
            return
        if self._first_s is None:
            self._first_s = float(frames.time_s[0])
        early = frames.time_s < self._first_s + _SAMPLE_S
        if self._keep == "all":
            early[:] = True
        if early.any():
            self._video.append(frames.images[early], frames.time_s[early])
        self._tail.extend((frames, k) for k in np.flatnonzero(~early).tolist())
        while self._tail and frames.time_s[-1] - _time_s(self._tail[0]) > _SAMPLE_S:
            self._tail.popleft()

    def _end_video(self) -> None:
        video, self._video = self._video, None
        if video is None:
            return
        try:
            if self._tail:
                images = [frames.image(k) for frames, k in self._tail]
                video.append(np.stack(images), np.array([_time_s(shown) for shown in self._tail]))
        finally:
            try:
                video.close()
            finally:
                if isinstance(video, RawVideoWriter) and video.recorded is not None:
                    self._raws.append(video.recorded)

    def finish(self) -> None:
        """Record the remaining frames of this experiment and stop the camera."""
        self.look()
        self._note_camera()
        self._camera.stop()
        self._end_video()
        if not self._placed:
            raise ResultError(
                f"Fewer than {_REST_FRAMES} frames arrived in {self._name!r}. Record for longer, "
                "or raise the frame rate."
            )

    def _note_camera(self) -> None:
        """Record how many frames a camera with its own clock lost, and its timing uncertainty."""
        if not isinstance(self._camera, KnownCamera) or not self._camera.uncertainty_s:
            return
        timing = f"times to {1e3 * self._camera.uncertainty_s:.2g} ms"
        self._session.event(self._last_s, f"camera: {self._camera.dropped} frames lost, {timing}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._helper is not None:
            self._helper.close()
        try:
            for raw in self._raws:
                transcode(raw)
        except HaselabError:
            if kind is None:  # after an error the raw frames stay, and the error is reported first
                raise
