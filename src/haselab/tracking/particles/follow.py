"""Tracking of independently moving particles while their identity is certain."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from haselab.tracking.camera.noise import NoiseLaw
from haselab.tracking.options import Floats, Frame, TrackOptions
from haselab.tracking.particles.detect import DotProfile, find_profile, locate_particles
from haselab.tracking.particles.link import nearest_pairs
from haselab.tracking.points import PointTracker
from haselab.tracking.tracks import FrameTracks, LossReason, TrackState

__all__ = ["ParticleState", "ParticleTracker", "lone_subset_px"]

_MOST_DOUBT = 1e-3  # probability that a particle was confused with another
_REACH_STEPS = 6.0  # of the root mean square step: largest step of a particle
_LEAST_REACH_PX = 3.0
_CANDIDATES = 4  # nearest particles that a point may be confused with
_MEMORY = 3  # frames that a particle may be missing
_LEAST_STEP_PX = 0.1
_SAME_PX = 2.0  # distance within which a point is on a particle
_STEADY = 0.5  # of the steps' size; with smaller changes of step, velocities are assumed constant
_OVERLAP_SIGMAS = 3.5  # standard deviations of a dot within which another one shifts its image
_PULL = 0.4  # shift by a neighbour at that distance; a subset sees 0.6 of it; rms along an axis
_FAR_SIGMAS = 10.0
_LONE_SIGMAS = 4.5  # of a dot: side of a subset that excludes others
_SMALLEST_SUBSET_PX = 7
_REFINED_PX = 1.5  # a match farther from the detection is something else


@dataclass(frozen=True)
class ParticleState:
    """State of the tracker between frames.

    Args:
        inner: state of the subset matching of the points.
        others_px: particles that are not tracked but could be confused with a tracked one. Shape
            `(Q, 2)`.
        place_px: last known positions of the points. Shape `(P, 2)`.
        unseen: frames since the last detection. Shape `(P,)`.
        certain: whether a point's identity is certain. Shape `(P,)`.
        step_px: root mean square step of a particle along one axis; 0 before it is known.
        drift_px: the same for a step's change since the previous frame.
        moved_px: last step of the points, then of the others. Shape `(P + Q, 2)`.
    """

    inner: TrackState
    others_px: Floats
    place_px: Floats
    unseen: NDArray[np.intp]
    certain: NDArray[np.bool_]
    step_px: float
    drift_px: float
    moved_px: Floats

    @property
    def noise(self) -> NoiseLaw | None:
        """The camera's noise law, if the rest frames determined it."""
        return self.inner.noise


class ParticleTracker:
    """Tracks particles that have no common motion.

    All particles of each frame are detected and paired with those of the previous frame so that the
    sum of squared steps is minimal. A point's identity is certain as long as the probability that
    two particles were exchanged, given the typical steps, is below one in a thousand.

    Args:
        points_px: points `[x, y]` in the first frame, in px. Shape `(P, 2)`.
        options: tracker options.

    Raises:
        InputError: as for `PointTracker`.

    Source: Crocker and Grier 1996 (the likelihood of an exchange under diffusion).
    """

    def __init__(self, points_px: Floats, options: TrackOptions | None = None) -> None:
        chosen = replace(options or TrackOptions(), model="translation", search_px=0)
        self._points = np.array(points_px, float)
        self._tracker = PointTracker(points_px, chosen)
        self._half = chosen.subset_px // 2
        self._profile = DotProfile(2.0, "dark")

    def init(self, rest_frames: Sequence[Frame]) -> ParticleState:
        """Create the state at rest; see `PointTracker.init`."""
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
            drift_px=np.inf,
            moved_px=np.zeros((count + int((away > _SAME_PX).sum()), 2)),
        )

    def _seen(self, frame: Frame | Floats) -> Floats:
        return locate_particles(frame, self._profile, margin_px=4).points_px

    def step(self, state: ParticleState, frame: Frame) -> tuple[ParticleState, FrameTracks]:
        """Find all points in the next frame; see `PointTracker.step`."""
        seen = self._seen(state.inner.cleaned(frame))
        last = np.concatenate([state.place_px, state.others_px])
        count = len(self._points)
        step_px = state.step_px or self._first_step(last, seen)
        steady = state.drift_px < _STEADY * step_px
        before = last + state.moved_px if steady else last
        change_px = max(state.drift_px, _LEAST_STEP_PX) if steady else step_px
        reach = max(_REACH_STEPS * change_px, _LEAST_REACH_PX)
        partner = nearest_pairs(before, seen, reach)
        paired = partner >= 0
        moved = np.where(steady, state.moved_px, 0.0)
        moved[paired] = seen[partner[paired]] - last[paired]
        away = np.full(len(before), reach)  # lower bound where none was found
        away[paired] = np.linalg.norm(seen[partner[paired]] - before[paired], axis=1)
        doubt = _doubt(before, seen, partner, _smoothed(change_px, away))[:count]
        went = np.where(paired, np.linalg.norm(moved, axis=1), reach)
        turned = np.where(paired, np.linalg.norm(moved - state.moved_px, axis=1), reach)
        step_px = _smoothed(step_px, went)
        drift_px = _smoothed(min(state.drift_px, step_px), turned)
        found = paired[:count]
        unseen = np.where(found, 0, state.unseen + 1)
        certain = state.certain & (unseen <= _MEMORY) & (doubt <= _MOST_DOUBT)
        place = before[:count].copy()
        place[found] = seen[partner[:count][found]]
        if steady:  # two that merge are assumed to keep their velocities
            through = self._nearest_px(before[:count], before[count:]) <= self._overlap_px
            place[through], unseen[through] = before[:count][through], state.unseen[through]
            moved[:count][through] = state.moved_px[:count][through]
            certain[through] = state.certain[through]
        used = np.zeros(len(seen), bool)
        used[partner[:count][found]] = True
        others_px = np.concatenate([seen[~used], before[count:][~paired[count:]]])
        near_px = self._nearest_px(place, others_px)
        if not steady:  # two that merge may have been exchanged
            known_px = self._nearest_px(place, before[count:])  # a new particle may be the point
            merged = ~found & (known_px <= self._overlap_px)
            near = cKDTree(place).query_ball_point(place[merged], self._overlap_px)
            certain[sorted({index for group in near for index in group})] = False
        inner, tracks = self._matched(state, frame, place, found & certain, certain, near_px)
        others = np.full(len(seen), -1)
        others[partner[count:][paired[count:]]] = count + np.flatnonzero(paired[count:])
        owner = others[~used]
        others_moved = np.where((owner >= 0)[:, None], moved[owner], 0.0)
        after = ParticleState(
            inner,
            seen[~used],
            place,
            unseen,
            certain,
            step_px,
            drift_px,
            np.concatenate([moved[:count], others_moved]),
        )
        return after, tracks

    @property
    def _overlap_px(self) -> float:
        return _OVERLAP_SIGMAS * self._profile.sigma_px

    def _nearest_px(self, place: Floats, others: Floats) -> Floats:
        """Distance from each point to the nearest other particle. Shape `(P,)`."""
        every = np.concatenate([place, others])
        if len(every) < 2:
            return np.full(len(place), np.inf)
        return np.asarray(cKDTree(every).query(place, 2)[0][:, 1])

    def _pulled_px(self, near_px: Floats) -> Floats:
        """Largest shift of a point by a particle at that distance, along one axis."""
        far = np.minimum(near_px / self._profile.sigma_px, _FAR_SIGMAS)
        return np.asarray(_PULL * self._profile.sigma_px * far * np.exp(-0.25 * far**2))

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
        near_px: Floats,
    ) -> tuple[TrackState, FrameTracks]:
        """Refine the points by subset matching, starting from the detected particles."""
        start = self._tracker.placed(state.inner, place)
        inner, made = self._tracker.step(start, frame)
        away = np.hypot(made.x_px - place[:, 0], made.y_px - place[:, 1])
        reason = np.zeros(len(place), np.uint16) if made.reason is None else made.reason.copy()
        reason[(reason == 0) & ~(found & (away < _REFINED_PX))] = LossReason.STRAYED
        reason[near_px <= self._overlap_px] |= np.uint16(LossReason.COVERED)
        reason[~certain] = LossReason.AMBIGUOUS
        keep = reason == 0
        columns = (made.x_px, made.y_px, made.std_x_px, made.std_y_px)
        x, y, std_x, std_y = (np.where(keep, column, np.nan) for column in columns)
        pulled = self._pulled_px(near_px)
        std_x, std_y = np.hypot(std_x, pulled), np.hypot(std_y, pulled)
        return inner, FrameTracks(x, y, std_x, std_y, made.quality, keep, reason)


def lone_subset_px(frame: Frame, most_px: int) -> int:
    """Side of a subset, in px, that contains a dot of this frame and little of others.

    Subsets of independently moving dots must not contain other dots: 4.5 standard deviations
    of a dot contain 95 % of the information in its gradients.
    """
    wide = int(_LONE_SIGMAS * find_profile(frame).sigma_px) | 1
    return min(max(wide, _SMALLEST_SUBSET_PX), most_px)


def _smoothed(step_px: float, away: Floats) -> float:
    """Standard deviation of steps along one axis, updated with those of this frame."""
    # from the median, so that wrong pairs have little effect
    now = float(np.median(away) / np.sqrt(2.0 * np.log(2.0)))
    return max(0.8 * step_px + 0.2 * now, now, _LEAST_STEP_PX)


def _doubt(before: Floats, seen: Floats, partner: NDArray[np.intp], step_px: float) -> Floats:
    """Probability that each particle was confused with another one. Shape `(N,)`.

    If the partners of two particles are exchanged, the squared steps grow by an amount D; under
    diffusion the exchange is exp(-D / 2 step²) times as likely. The same holds for a partner that
    belongs to no particle.
    """
    doubt = np.zeros(len(before))
    if len(seen) < 2:
        return doubt
    owner = np.full(len(seen), -1)
    owner[partner[partner >= 0]] = np.flatnonzero(partner >= 0)
    near = cKDTree(seen).query(before, min(_CANDIDATES, len(seen)))[1]
    for other in near.T:
        i = np.flatnonzero((partner >= 0) & (other != partner))
        mine, theirs = seen[partner[i]], seen[other[i]]
        growth = ((theirs - before[i]) ** 2 - (mine - before[i]) ** 2).sum(axis=1)
        other_owner = owner[other[i]]
        held = other_owner >= 0
        back = before[other_owner[held]]
        growth[held] += ((mine[held] - back) ** 2 - (theirs[held] - back) ** 2).sum(axis=1)
        doubt[i] = np.maximum(doubt[i], np.exp(-np.maximum(growth, 0.0) / (2.0 * step_px**2)))
    return doubt
