"""Ratio of current to voltage from the phasors of a block's segments, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.sensing.block.segments import Segments

__all__ = ["Ratio", "ratio_of_segments"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_RARE = 1e-4  # chance that noise alone leaves a block unexplained
_MOST_OUTLIERS = 3  # segments of a block that are left out for a transient
_COMMON = 12.0  # scatter of the voltage over that of the ratio when the carrier itself changes
_POOLED = 8  # blocks needed to estimate the record's noise
_WILD = 4.0  # variance ratio to the record that noise does not reach in one block alone
_LINES = (2, 3, 4)  # of a block's spectrum; the parabola includes the lower one
_EVEN = 0.3  # share of the phasors' scatter left after removing a constant frequency offset
_ALIKE = 2.0  # quartile ratio of the scatter; by chance 1.4 with 20 segments
_COLOURED = 0.2  # logarithm of a ratio of noise densities that counts as coloured
_SMALL = 1e-6  # of the carrier: less is rounding
_NO_CARRIER = 1e-120  # replaces a phasor of 0, as of a carrier smaller than one converter step


@dataclass(frozen=True)
class Ratio:
    """Estimates of each block; arrays of shape `(blocks,)` unless stated.

    Args:
        voltage: mean phasor.
        current: the same, so that the ratio is the estimate.
        relative_std: standard deviation of either part of the ratio, relative to its magnitude.
        turn: frequency offset of the carrier, in rad per sample.
        modulated: whether the carrier changes within the block, equally on both monitors.
        left_out: number of segments affected by a transient.
        unexplained: whether the residuals are not noise.
        scatter: relative scatter of a segment.
        middle_samples: mean time of the counted samples, from the block's first sample.
        coloured: whether the noise near the carrier differs from that of the readings.
        turns: whether a constant frequency offset `turn` explains the phase.
        strongest: distance of the strongest residual line from the carrier, in cycles per sample.
    """

    voltage: Complexes
    current: Complexes
    relative_std: Floats
    turn: Floats
    modulated: NDArray[np.bool_]
    left_out: NDArray[np.intp]
    unexplained: NDArray[np.bool_]
    scatter: Floats
    middle_samples: Floats
    strongest: Floats
    coloured: NDArray[np.bool_]
    turns: NDArray[np.bool_]


def _beyond(freedom: Floats, deviations: float = 3.3) -> Floats:
    """Limit of chi-square over its degrees of freedom for noise (Wilson and Hilferty)."""
    middle, width = 1.0 - 2.0 / (9.0 * freedom), deviations * np.sqrt(2.0 / (9.0 * freedom))
    return np.asarray(np.maximum(middle + width, 0.0) ** 3)


def _mean(values: Complexes, weight: Floats) -> Complexes:
    return np.asarray((values * weight).sum(axis=-1) / weight.sum(axis=-1))


@dataclass(frozen=True)
class _Fit:
    """The ratio for one choice of segments."""

    y: Complexes  # relative change of the ratio of the means
    rest: Complexes
    scatter: Floats  # variance of one part of a segment's relative error
    freedom: Floats
    gain: Floats  # variance of y over `scatter`
    modulated: NDArray[np.bool_]
    voltage: Complexes
    current: Complexes
    turn: Floats
    middle: Floats  # mean time of the counted samples, from -1 at the block's start to 1 at its end
    turns: NDArray[np.bool_]


def _fit(v: Complexes, i: Complexes, used: NDArray[np.bool_], segments: Segments) -> _Fit:
    weight = used.astype(np.float64)
    count = weight.sum(axis=1)
    pairs = v[:, 1:] * np.conj(v[:, :-1]) * (used[:, 1:] & used[:, :-1])
    turn = np.angle(pairs.sum(axis=1)) / segments.length
    voltage, current = (
        np.where(np.abs(mean) > _NO_CARRIER, mean, _NO_CARRIER)
        for mean in (_mean(v, weight), _mean(i, weight))
    )
    m, e = v / voltage[:, np.newaxis], i / current[:, np.newaxis]
    e = e - m
    basis = np.asarray(np.polynomial.legendre.legvander(segments.middles, 2), dtype=np.float64)
    about_v = weight * np.abs(m - 1.0) ** 2
    plain = _trend(e, weight, basis)
    modulated = about_v.sum(axis=1) > _COMMON * (weight * np.abs(plain) ** 2).sum(axis=1)
    modulated &= np.abs(voltage) > _NO_CARRIER
    own = np.where(modulated[:, np.newaxis], weight * np.abs(m) ** 2, weight)
    shape = np.where(modulated[:, np.newaxis], m, 1.0)
    rest = _trend(e / np.where(shape == 0.0, 1.0, shape), own, basis)
    rest = rest * shape * weight
    freedom = np.maximum(2.0 * (count - 3.0), 1.0)
    scatter = (np.abs(rest) ** 2).sum(axis=1) / freedom
    y = np.where(modulated, _mean(e / np.where(shape == 0.0, 1.0, shape), own), 0.0)
    gain = 1.0 / own.sum(axis=1)
    middle = (own * segments.middles).sum(axis=1) / own.sum(axis=1)
    still = v * np.exp(-1j * np.outer(turn * segments.length, np.arange(segments.count)))
    about = (weight * np.abs(still - _mean(still, weight)[:, np.newaxis]) ** 2).sum(axis=1)
    turns = about < _EVEN * np.abs(voltage) ** 2 * about_v.sum(axis=1)
    return _Fit(y, rest, scatter, freedom, gain, modulated, voltage, current, turn, middle, turns)


def _trend(values: Complexes, weight: Floats, basis: Floats) -> Complexes:
    """Residuals of weighted least squares over a few columns."""
    normal = np.einsum("bp,pj,pk->bjk", weight, basis, basis)
    normal += 1e-12 * np.eye(basis.shape[1]) * weight.sum(axis=1)[:, np.newaxis, np.newaxis]
    right = np.einsum("bp,pj,bp->bj", weight, basis, values)
    coefficients = np.linalg.solve(normal.astype(np.complex128), right[:, :, np.newaxis])[:, :, 0]
    return np.asarray(values - coefficients @ basis.T)


def _not_white(rest: Complexes, used: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], Floats]:
    """Whether the residuals have a significant line or correlated neighbours, and the line."""
    count = used.sum(axis=1).astype(np.float64)
    total = (np.abs(rest) ** 2).sum(axis=1)
    power = np.abs(np.fft.fft(rest, axis=1)) ** 2
    strongest = power.argmax(axis=1)
    share = power.max(axis=1) / np.maximum(count * total, 1e-300)
    limit = 1.0 - (_RARE / count) ** (1.0 / (count - 1.0))  # Fisher's g
    next_ = np.abs((rest[:, 1:] * np.conj(rest[:, :-1])).sum(axis=1)) / np.maximum(total, 1e-300)
    cycles = np.fft.fftfreq(rest.shape[1])[strongest]
    return (share > limit) | (next_ > 3.0 / np.sqrt(count)), cycles


def ratio_of_segments(
    phasors: Complexes,
    used: NDArray[np.bool_],
    extra: Floats,
    variance: Floats,
    segments: Segments,
    refused: NDArray[np.bool_] | None = None,
) -> Ratio:
    """Ratio of the means, or mean of the segments' ratios where the carrier itself changes.

    The residuals of each segment's ratio about a parabola give the noise near the carrier,
    independent of other noise. Where they do not clearly exceed the white noise of the readings,
    scaled by the median of the record, that noise is used: its own error is smaller.

    Args:
        phasors: `(blocks, 2, segments)`, voltage and current.
        used: segments that count, `(blocks, segments)`.
        extra: variance of a quadrature added by the drive's parameters, for readings of variance
            1, `(blocks,)`.
        variance: of the readings, `(blocks, 2)`.
        segments: segments of the blocks.
        refused: blocks that are known to be wrong, `(blocks,)`; they are not used for the record's
            noise.
    Returns:
        See `Ratio`.
    """
    v, i = phasors[:, 0], phasors[:, 1]
    used = used.copy()
    start = used.sum(axis=1)
    fit = _fit(v, i, used, segments)
    white = _white(fit, variance)
    for _ in range(_MOST_OUTLIERS):
        share = np.abs(fit.rest) ** 2
        total = share.sum(axis=1)
        worst = share.argmax(axis=1)
        count = used.sum(axis=1).astype(np.float64)
        limit = 1.0 - (_RARE / count) ** (1.0 / (count - 1.0))
        high = _beyond(fit.freedom) * white * segments.quadrature
        hit = (share.max(axis=1) > limit * total) & (fit.scatter > high)
        hit &= count > max(5, segments.count // 2)
        if not hit.any():
            break
        used[hit, worst[hit]] = False
        fit = _fit(v, i, used, segments)
    high = _beyond(fit.freedom)
    expected = white * segments.quadrature
    over = fit.scatter / np.maximum(expected, 1e-300)
    coloured, cycles = _not_white(fit.rest, used)
    taken = np.ones(len(over), dtype=bool) if refused is None else ~refused
    taken &= ~(coloured & (over > high))
    prior, near = expected, 1.0
    low, common, most = np.quantile(over[taken], (0.25, 0.5, 0.75)) if taken.any() else (0, 1, 1)
    # Only if the noise is uniform, not for disturbances of varying size.
    if taken.sum() >= max(_POOLED, len(over) // 2) and most < _ALIKE * low:
        clear = 5.0 / np.sqrt(taken.sum() * float(fit.freedom.mean()))
        prior = expected * common if abs(np.log(max(common, 1e-12))) > clear else expected
        near = _near_carrier(fit.rest, taken & used.all(axis=1), segments)
    own = (fit.scatter >= high * prior) | (fit.scatter < _beyond(fit.freedom, -4.5) * prior)
    scatter = np.where(own, fit.scatter, prior)
    unexplained = coloured & (fit.scatter > high * expected)
    unexplained |= fit.scatter > _WILD * np.maximum(prior, expected)
    unexplained &= fit.scatter > _SMALL**2
    relative = np.sqrt(near * scatter * fit.gain + white * extra)
    return Ratio(
        fit.voltage,
        fit.current * (1.0 + fit.y),
        relative,
        fit.turn,
        fit.modulated,
        start - used.sum(axis=1),
        unexplained,
        np.sqrt(fit.scatter),
        0.5 * (fit.middle + 1.0) * segments.samples - 0.5,
        cycles / segments.length,
        np.abs(np.log(np.maximum(near * scatter / np.maximum(expected, 1e-300), 1e-12)))
        > _COLOURED,
        fit.turns,
    )


def _near_carrier(rest: Complexes, blocks: NDArray[np.bool_], segments: Segments) -> float:
    """Noise density close to the carrier relative to its mean in the band of a segment."""
    count, many = rest.shape[1], int(blocks.sum())
    if many < max(_POOLED, len(rest) // 2) or count < 2 * _LINES[-1] + 4:
        return 1.0
    lines = [*_LINES, *(-k for k in _LINES)]
    power = (np.abs(np.fft.fft(rest[blocks], axis=1)[:, lines]) ** 2).mean(axis=1)
    total = (np.abs(rest[blocks]) ** 2).sum(axis=1)
    # White noise with a parabola subtracted.
    basis = np.polynomial.legendre.legvander(segments.middles, 2)
    waves = np.exp(2j * np.pi * np.outer(lines, np.arange(count)) / count)
    white = (np.abs(waves - waves @ basis @ np.linalg.pinv(basis)) ** 2).sum(axis=1).mean()
    near = float(np.median(power / np.maximum(total, 1e-300))) * (count - 3.0) / float(white)
    near /= 1.0 - 1.0 / (3.0 * len(lines))  # the median of such a mean is below its mean
    clear = max(_COLOURED, 6.0 / np.sqrt(many * len(lines)))
    return near if abs(np.log(max(near, 1e-12))) > clear else 1.0


def _white(fit: _Fit, variance: Floats) -> Floats:
    """Relative variance of the ratio for white noise, for a quadrature of variance 1."""
    sizes = np.abs(np.stack([fit.voltage, fit.current], axis=1))
    return np.asarray((variance / sizes**2).sum(axis=1))
