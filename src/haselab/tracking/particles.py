"""Particles that move each for itself, followed by name as long as their names are certain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from haselab.tracking.detect import DotProfile, find_profile, locate_particles
from haselab.tracking.link import nearest_pairs
from haselab.tracking.noise import NoiseLaw
from haselab.tracking.options import Floats, Frame, TrackOptions
from haselab.tracking.points import PointTracker
from haselab.tracking.tracks import FrameTracks, Reason, TrackState

__all__ = ["ParticleState", "ParticleTracker"]

_MOST_DOUBT = 1e-3  # probability that a particle was taken for another
_REACH_STEPS = 6.0  # of the root mean square step, how far a particle may go
_LEAST_REACH_PX = 3.0
_RIVALS = 4  # nearest particles that a point may be taken for
_MEMORY = 3  # frames that a particle may stay unseen
_LEAST_STEP_PX = 0.1
_SAME_PX = 2.0  # a point lies on a particle
_REFINED_PX = 1.5  # farther from the detection, a match shows something else


@dataclass(frozen=True)
class ParticleState:
    """What is carried from frame to frame.

    Args:
        inner: of the matching of the points.
        others_px: particles that are not followed but could be taken for one. Shape `(Q, 2)`.
        place_px: where the points were seen last. Shape `(P, 2)`.
        unseen: frames since then. Shape `(P,)`.
        certain: whether a point's name is. Shape `(P,)`.
        step_px: root mean square step of a particle along one axis; 0 before it is known.
    """

    inner: TrackState
    others_px: Floats
    place_px: Floats
    unseen: NDArray[np.intp]
    certain: NDArray[np.bool_]
    step_px: float

    @property
    def noise(self) -> NoiseLaw | None:
        """The camera's noise law, where the rest frames told it."""
        return self.inner.noise


class ParticleTracker:
    """Follows particles that have no common motion.

    All particles of each frame are found and paired with those of the frame before, so that the
    sum of squared steps is least. A point's name is certain as long as the probability that two
    particles were exchanged, by the steps that all make, stays below one in a thousand.

    Args:
        points_px: points `[x, y]` in the first frame, in px. Shape `(P, 2)`.
        options: how to track.

    Raises:
        InputError: as `PointTracker`.

    Source: Crocker and Grier 1996 (the likelihood of an exchange under diffusion).
    """

    def __init__(self, points_px: Floats, options: TrackOptions | None = None) -> None:
        chosen = replace(options or TrackOptions(), model="translation", search_px=0)
        self._points = np.array(points_px, float)
        self._tracker = PointTracker(points_px, chosen)
        self._half = chosen.subset_px // 2
        self._profile = DotProfile(2.0, "dark")

    def init(self, rest_frames: Sequence[Frame]) -> ParticleState:
        """The state at rest; see `PointTracker.init`."""
        inner = self._tracker.init(rest_frames)
        self._profile = find_profile(inner.reference.picture)
        seen = self._seen(inner.reference.picture)
        away = cKDTree(self._points).query(seen)[0] if len(seen) else np.zeros(0)
        count = len(self._points)
        return ParticleState(
            inner,
            others_px=seen[away > _SAME_PX],
            place_px=self._points,
            unseen=np.zeros(count, np.intp),
            certain=np.ones(count, bool),
            step_px=0.0,
        )

    def _seen(self, frame: Frame | Floats) -> Floats:
        return locate_particles(frame, self._profile, margin_px=4).points_px

    def step(self, state: ParticleState, frame: Frame) -> tuple[ParticleState, FrameTracks]:
        """Finds all points in the next frame; see `PointTracker.step`."""
        seen = self._seen(state.inner.cleaned(frame))
        before = np.concatenate([state.place_px, state.others_px])
        count = len(self._points)
        step_px = state.step_px or self._first_step(before, seen)
        reach = max(_REACH_STEPS * step_px, _LEAST_REACH_PX)
        partner = nearest_pairs(before, seen, reach)
        paired = partner >= 0
        away = np.full(len(before), reach)  # at least, where none was found
        away[paired] = np.linalg.norm(seen[partner[paired]] - before[paired], axis=1)
        # over the median, so that pairs of the wrong particles count little
        now = float(np.median(away)) / np.sqrt(2.0 * np.log(2.0))
        step_px = max(0.8 * step_px + 0.2 * now, now, _LEAST_STEP_PX)
        doubt = _doubt(before, seen, partner, step_px)[:count]
        found = paired[:count]
        unseen = np.where(found, 0, state.unseen + 1)
        certain = state.certain & (unseen <= _MEMORY) & (doubt <= _MOST_DOUBT)
        place = state.place_px.copy()
        place[found] = seen[partner[:count][found]]
        inner, tracks = self._matched(state, frame, place, found & certain, certain)
        used = np.zeros(len(seen), bool)
        used[partner[:count][found]] = True
        after = ParticleState(inner, seen[~used], place, unseen, certain, step_px)
        return after, tracks

    @staticmethod
    def _first_step(before: Floats, seen: Floats) -> float:
        if not len(seen):
            return _LEAST_STEP_PX
        return max(float(np.median(cKDTree(seen).query(before)[0])), _LEAST_STEP_PX)

    def _matched(
        self,
        state: ParticleState,
        frame: Frame,
        place: Floats,
        found: NDArray[np.bool_],
        certain: NDArray[np.bool_],
    ) -> tuple[TrackState, FrameTracks]:
        """The points refined by their subsets from where the particles were found."""
        start = self._tracker.placed(state.inner, place)
        inner, made = self._tracker.step(start, frame)
        away = np.hypot(made.x_px - place[:, 0], made.y_px - place[:, 1])
        reason = np.zeros(len(place), np.uint8) if made.reason is None else made.reason.copy()
        reason[(reason == 0) & ~(found & (away < _REFINED_PX))] = Reason.STRAYED
        reason[~certain] = Reason.AMBIGUOUS
        keep = reason == 0
        columns = (made.x_px, made.y_px, made.std_x_px, made.std_y_px)
        x, y, std_x, std_y = (np.where(keep, column, np.nan) for column in columns)
        return inner, FrameTracks(x, y, std_x, std_y, made.quality, keep, reason)


def _doubt(before: Floats, seen: Floats, partner: NDArray[np.intp], step_px: float) -> Floats:
    """Probability that each particle was taken for another one. Shape `(N,)`.

    Of two particles whose partners change places, the squared steps grow by some amount D; under
    diffusion the exchange is exp(-D / 2 step²) times as likely. The same for a partner that belongs
    to none.
    """
    doubt = np.zeros(len(before))
    if len(seen) < 2:
        return doubt
    owner = np.full(len(seen), -1)
    owner[partner[partner >= 0]] = np.flatnonzero(partner >= 0)
    near = cKDTree(seen).query(before, min(_RIVALS, len(seen)))[1]
    for other in near.T:
        i = np.flatnonzero((partner >= 0) & (other != partner))
        mine, theirs = seen[partner[i]], seen[other[i]]
        growth = ((theirs - before[i]) ** 2 - (mine - before[i]) ** 2).sum(axis=1)
        rival = owner[other[i]]
        held = rival >= 0
        back = before[rival[held]]
        growth[held] += ((mine[held] - back) ** 2 - (theirs[held] - back) ** 2).sum(axis=1)
        doubt[i] = np.maximum(doubt[i], np.exp(-np.maximum(growth, 0.0) / (2.0 * step_px**2)))
    return doubt
