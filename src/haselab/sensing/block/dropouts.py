"""Blocks in which a monitor drops out, sticks or changes its gain for part of the time."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.sensing.block.segments import Segments

__all__ = ["Breaks", "find_breaks"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_LOUD = 8.0  # ratio of the quotient's variance to that of the noise from which a block is examined
_EXPLAINED = 0.25  # of the parabola's residuals: two levels must leave less
_NOISE = 10.0  # of the noise variance: largest residual variance
_CLEAR = 8.0  # standard deviations of a change
_LEAST = 0.03  # smallest relative change of the quotient
_SHORT = 3  # segments that are left out as a transient
_GONE = 0.2  # of the amplitude elsewhere: less counts as lost
_MONITORS = ("voltage", "current")


@dataclass(frozen=True)
class Breaks:
    """Result of the search for dropouts.

    Args:
        used: segments that count, without those in which a monitor is stuck, `(blocks, segments)`.
        refused: blocks with too few segments left, or with no way to decide which part is right.
        texts: descriptions; empty where nothing was found.
    """

    used: NDArray[np.bool_]
    refused: NDArray[np.bool_]
    texts: list[str]

    def with_blocks(self, blocks: NDArray[np.intp], other: Breaks) -> Breaks:
        """The result with the refusals of another search for some blocks added."""
        refused, texts = self.refused.copy(), list(self.texts)
        for k in np.flatnonzero(other.refused).tolist():
            refused[blocks[k]], texts[blocks[k]] = True, other.texts[k]
        return Breaks(self.used, refused, texts)


def find_breaks(
    phasors: Complexes,
    used: NDArray[np.bool_],
    stuck: NDArray[np.bool_],
    variance: Floats,
    segments: Segments,
    *,
    smallest: float = _LEAST,
) -> Breaks:
    """Find readings that do not change, and blocks with two levels of the current-voltage ratio.

    A capacitance changes smoothly within a block. Where one run of segments has a different ratio
    than the rest, and two constants fit where a parabola does not, a monitor has changed.

    Args:
        phasors: of the carrier in the segments, `(blocks, 2, segments)`.
        used: segments that count, `(blocks, segments)`.
        stuck: segments in which a channel has no noise, `(blocks, 2, segments)`.
        variance: of the readings, `(blocks, 2)`.
        segments: segments of the blocks.
        smallest: smallest change of the ratio that is searched for.
    Returns:
        See `Breaks`.
    """
    refused = np.zeros(len(used), dtype=bool)
    texts = [""] * len(used)
    still = np.flatnonzero(stuck.any(axis=(1, 2)))
    if still.size:
        used = used.copy()
        any_ = np.asarray(stuck[still].any(axis=1), dtype=np.bool_)
        wide = any_.copy()
        wide[:, 1:] |= any_[:, :-1]
        wide[:, :-1] |= any_[:, 1:]
        used[still] &= ~wide
        for k, block in enumerate(still.tolist()):
            monitor = _MONITORS[int(stuck[block].sum(axis=1).argmax())]
            texts[block] = f"{monitor} monitor stuck for {_ms(any_[k].sum(), segments):.2g} ms"
        few = used[still].sum(axis=1) < max(4, segments.count // 2)
        used[still[few]] = True  # the block is refused, so its results do not matter
        refused[still[few]] = True
    amplitude = _mean(phasors, used)
    relative = phasors / np.where(amplitude == 0.0, 1e-300, amplitude)[..., np.newaxis]
    noise = segments.quadrature * (variance / np.maximum(np.abs(amplitude), 1e-150) ** 2).sum(
        axis=1
    )
    change = (relative[:, 1] - relative[:, 0]) * used
    basis = np.polynomial.legendre.legvander(segments.middles, 2)
    left = change - change @ np.linalg.pinv(basis).T @ basis.T
    total = (np.abs(left) ** 2 * used).sum(axis=1)
    freedom = np.maximum(2.0 * (used.sum(axis=1) - 3.0), 1.0)
    loud = np.flatnonzero((total > _LOUD * freedom * noise) & ~refused)
    if not loud.size:
        return Breaks(used, refused, texts)
    levels = _two_levels(change[loud], used[loud], total[loud], noise[loud], smallest)
    for block, first, end in levels:
        block = int(loud[block])
        inside = np.zeros(segments.count, dtype=bool)
        inside[first:end] = True
        refused[block] = True
        texts[block] = _words(np.abs(phasors[block]), used[block], inside, segments)
    return Breaks(used, refused, texts)


def _mean(phasors: Complexes, used: NDArray[np.bool_]) -> Complexes:
    used = used[:, np.newaxis]
    return np.asarray((phasors * used).sum(axis=2) / np.maximum(used.sum(axis=2), 1))


def _ms(count: float, segments: Segments) -> float:
    return 1e3 * count * segments.length / segments.rate_hz


def _two_levels(
    change: Complexes, used: NDArray[np.bool_], total: Floats, noise: Floats, smallest: float
) -> list[tuple[int, int, int]]:
    """Block, first segment and end of the run that differs; the segments at its edges are free."""
    count = used.shape[1]
    weight = used.astype(np.float64)
    sums = [
        np.concatenate([np.zeros((len(used), 1)), np.cumsum(x, axis=1)], axis=1)
        for x in (weight, change * weight, np.abs(change) ** 2 * weight)
    ]
    best = np.full(len(used), np.inf)
    place = np.zeros((len(used), 2), dtype=np.intp)
    for long in range(1, count - 1):
        first = np.arange(count - long + 1)
        low, high = np.maximum(first - 1, 0), np.minimum(first + long + 1, count)
        w, s, q = (x[:, first + long] - x[:, first] for x in sums)
        edge = [x[:, -1:] - (x[:, high] - x[:, low]) for x in sums]
        rest = q - np.abs(s) ** 2 / np.maximum(w, 1.0)
        rest += edge[2] - np.abs(edge[1]) ** 2 / np.maximum(edge[0], 1.0)
        rest += 4.0 * noise[:, np.newaxis] * (high - low - long)  # for each edge that is left out
        jump = np.abs(s / np.maximum(w, 1.0) - edge[1] / np.maximum(edge[0], 1.0))
        error = np.sqrt(2.0 * noise)[:, np.newaxis] * np.sqrt(
            1.0 / np.maximum(w, 1.0) + 1.0 / np.maximum(edge[0], 1.0)
        )
        ok = (w > 0.0) & (edge[0] > 0.0) & (jump > np.maximum(_CLEAR * error, smallest))
        # A run, or a remainder, that is this short is left out as a transient.
        ok &= np.minimum(w, edge[0]) + (high - low - long) > _SHORT
        rest = np.where(ok, rest, np.inf)
        at = rest.argmin(axis=1)
        value = rest[np.arange(len(used)), at]
        better = value < best
        best[better] = value[better]
        place[better] = np.stack([first[at], first[at] + long], axis=1)[better]
    found = np.flatnonzero(best < np.minimum(_EXPLAINED * total, _NOISE * noise * 2.0 * count))
    return [(k, *place[k].tolist()) for k in found.tolist()]


def _words(
    size: Floats, used: NDArray[np.bool_], inside: NDArray[np.bool_], segments: Segments
) -> str:
    near = inside.copy()  # including the edges, which belong to both parts
    near[1:] |= inside[:-1]
    near[:-1] |= inside[1:]
    means = np.array([size[:, used & part].mean(axis=1) for part in (inside, ~near)])
    share = means.min(axis=0) / np.maximum(means.max(axis=0), 1e-300)
    channel = int(share.argmin())
    small = inside if means[0, channel] < means[1, channel] else ~inside
    at = np.flatnonzero(small)
    begin, end = _ms(at[0], segments), _ms(at[-1] + 1, segments)
    where = f"from {begin:.2g} to {end:.2g} ms"
    if at.size <= at[-1] - at[0]:  # on both sides of the other part
        at = np.flatnonzero(~small)
        where = f"except for {_ms(at[0], segments):.2g} to {_ms(at[-1] + 1, segments):.2g} ms"
    if share[channel] < _GONE:
        return f"{_MONITORS[channel]} monitor lost {where}"
    return f"{_MONITORS[channel]} monitor at {100.0 * share[channel]:.0f} % {where}"
