"""The other libraries of `points.py`, each as one function: frames and points in, positions out.

`absent` names what a library lacks. Each gets at least what its users would give it;
`pyrLK, our prediction` gets more: our predictor and our template, the mean of ten frames.
"""

from __future__ import annotations

import importlib.util
import logging
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Frames = NDArray[np.uint8]
Answer = tuple[float, Floats, None]

REST = 10  # frames at rest


@dataclass(frozen=True)
class Library:
    """One method of another library.

    Args:
        name: of the method.
        package: what it needs.
        run: frames `(F, H, W)` and points `(P, 2)` to CPU seconds and positions `(F, P, 2)`.
        frames: at most so many of a clip, because it is slow; 0 for all.
        stress, field: whether it takes part in those tables.
    """

    name: str
    package: str
    run: Callable[[Frames, Floats], Answer]
    frames: int = 0
    stress: bool = False
    field: bool = False

    @property
    def absent(self) -> str:
        """The missing package, or nothing."""
        return "" if importlib.util.find_spec(self.package) else self.package


def _optical_flow_predicted(frames: Frames, points: Floats) -> Answer:
    """Fixed template, the mean of the rest frames; one level; constant velocity as first guess."""
    import cv2

    cv2.setNumThreads(1)
    first = points.astype(np.float32)[:, None, :]
    place, velocity = first.copy(), np.zeros_like(first)
    found = np.empty((len(frames), len(points), 2))
    template = np.rint(frames[:REST].mean(axis=0)).astype(np.uint8)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.03)
    start = time.process_time()
    for k, frame in enumerate(frames):
        guess = place + velocity
        now, _, _ = cv2.calcOpticalFlowPyrLK(
            template,
            frame,
            first,
            guess.copy(),
            winSize=(15, 15),
            maxLevel=0,
            criteria=criteria,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        velocity, place = now - place, now
        found[k] = now[:, 0]
    return time.process_time() - start, found, None


def _optical_flow_plain(frames: Frames, points: Floats) -> Answer:
    """As in OpenCV's tutorial: from each frame to the next, default pyramid and window."""
    import cv2

    cv2.setNumThreads(1)
    place = points.astype(np.float32)[:, None, :]
    found = np.empty((len(frames), len(points), 2))
    found[0] = points
    start = time.process_time()
    for k in range(1, len(frames)):
        place, status, _ = cv2.calcOpticalFlowPyrLK(frames[k - 1], frames[k], place, None)
        found[k] = np.where(status == 1, place[:, 0], np.nan)
    return time.process_time() - start, found, None


def _pyidi(frames: Frames, points: Floats) -> Answer:
    import pyidi

    def follow(part: Frames) -> Floats:
        method = pyidi.LucasKanade(pyidi.VideoReader(part, root="."))
        method.set_points(np.rint(points[:, ::-1]).astype(int))
        method.configure(roi_size=(15, 15), verbose=0, show_pbar=False)
        return np.asarray(method.get_displacements(autosave=False))

    follow(frames[:3])  # compiles
    start = time.process_time()
    moved = follow(frames)
    seconds = time.process_time() - start
    return seconds, points + moved.transpose(1, 0, 2)[:, :, ::-1], None


def _trackpy(frames: Frames, points: Floats) -> Answer:
    import trackpy
    from scipy.spatial import cKDTree

    trackpy.quiet()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        trackpy.batch(frames[:2], 11, invert=True, minmass=150, processes=1)
        start = time.process_time()
        seen = trackpy.batch(frames, 11, invert=True, minmass=150, processes=1)
        linked = trackpy.link(seen, 6.0, memory=3)
        seconds = time.process_time() - start
    found = np.full((len(frames), len(points), 2), np.nan)
    first = linked[linked.frame == 0]
    away, index = cKDTree(first[["x", "y"]].to_numpy()).query(points)
    number = np.where(away < 3.0, first.particle.to_numpy()[index], -1)
    of_particle = {int(n): p for p, n in enumerate(number) if n >= 0}
    for frame, particle, x, y in linked[["frame", "particle", "x", "y"]].to_numpy():
        if int(particle) in of_particle:
            found[int(frame), of_particle[int(particle)]] = x, y
    return seconds, found, None


def _mudic(frames: Frames, points: Floats) -> Answer:
    """Global DIC on 20 px elements, read off at the points."""
    import muDIC
    from scipy.interpolate import LinearNDInterpolator

    logging.disable(logging.INFO)
    start = time.process_time()
    stack = muDIC.image_stack_from_list([frame.astype(float) for frame in frames])
    low, high = points.min(axis=0) - 12, points.max(axis=0) + 12
    mesh = muDIC.Mesher().mesh(
        stack,
        Xc1=low[0],
        Xc2=high[0],
        Yc1=low[1],
        Yc2=high[1],
        n_elx=int((high[0] - low[0]) / 20),
        n_ely=int((high[1] - low[1]) / 20),
        GUI=False,
    )
    answer = muDIC.DICAnalysis(muDIC.DICInput(mesh, stack)).run()
    seconds = time.process_time() - start
    logging.disable(logging.NOTSET)
    nodes = np.stack([answer.xnodesT, answer.ynodesT], axis=2)  # (N, F, 2)
    rest = nodes[:, 0]
    found = np.full((len(frames), len(points), 2), np.nan)
    for k in range(min(len(frames), nodes.shape[1])):
        found[k] = points + LinearNDInterpolator(rest, nodes[:, k] - rest)(points)
    return seconds, found, None


LIBRARIES = (
    Library("OpenCV pyrLK, our prediction, 15 px", "cv2", _optical_flow_predicted, stress=True),
    Library("OpenCV pyrLK, frame to frame", "cv2", _optical_flow_plain, stress=True),
    Library("pyidi LucasKanade, 15 px", "pyidi", _pyidi),
    Library("trackpy batch + link, d = 11", "trackpy", _trackpy, frames=40),
    Library("muDIC, Q4 of 20 px", "muDIC", _mudic, frames=20, field=True),
)
