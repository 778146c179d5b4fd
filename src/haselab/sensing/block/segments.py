"""A block in segments of a carrier period, as carrier, slow signal, harmonics and rest."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.sensing.sensed import LockinConfig

__all__ = ["HARMONICS", "Projected", "Segments"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

HARMONICS = (2, 3, 4, 5)
_MOST, _FEWEST, _SHORTEST = 32, 4, 40
_STUCK, _ALIVE = 1e-6, 0.8  # variance of a segment relative to that of the others, at this quantile
_ROUNDING = 1e-16  # variance of noise-free readings, relative to the squares of their segment


@dataclass(frozen=True)
class Projected:
    """Readings in the coordinates of their segments.

    Args:
        carrier: over cosine and sine, shape `(blocks, 2, segments, 2)`: channel, segment,
            coordinate.
        slow: over level, slope, and the part of the slope that is orthogonal to all harmonics of
            the carrier, `(blocks, 2, segments, 3)`.
        harmonic: phasors of the carrier's harmonics in the unit of the readings, with the phase at
            the start of the block, shape `(blocks, 2, segments, harmonics)`; 0 for those beyond the
            band.
        rest: variance of a reading from the residuals of all of these, `(blocks, 2, segments)`.
    """

    carrier: Floats
    slow: Floats
    harmonic: Complexes
    rest: Floats

    def variance(self, used: NDArray[np.bool_]) -> Floats:
        """Variance of the readings in the counted segments, shape `(blocks, 2)`."""
        share = used / used.sum(axis=1)[:, np.newaxis]
        return np.asarray(np.einsum("bcp,bp->bc", self.rest, share))

    def harmonics(self, used: NDArray[np.bool_]) -> tuple[Complexes, Floats]:
        """Mean phasors of the harmonics over the counted segments, and their standard deviations.

        Args:
            used: `(blocks, segments)`.
        Returns:
            Two arrays `(blocks, 2, harmonics)`; the standard deviation is that of one quadrature,
            from the scatter over the segments.
        """
        weight = used.astype(np.float64)
        count = weight.sum(axis=1)[:, np.newaxis, np.newaxis]
        mean = np.einsum("bcph,bp->bch", self.harmonic, weight) / count
        square = np.einsum("bcph,bp->bch", np.abs(self.harmonic) ** 2, weight) / count
        variance = np.maximum(square - np.abs(mean) ** 2, 0.0)
        std = np.sqrt(variance / (2.0 * np.maximum(count - 1.0, 1.0)))
        return mean, np.where(square > 0.0, std, np.inf)

    def with_segments(self, places: tuple[NDArray[np.intp], ...], other: Projected) -> Projected:
        """The projection with some segments, by block, channel and segment, replaced."""
        changed = {}
        for one in fields(self):
            values = getattr(self, one.name).copy()
            values[places] = getattr(other, one.name)
            changed[one.name] = values
        return Projected(**changed)

    def calm_variance(self, counts: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.bool_]]:
        """Variance of the readings by the median of the segments, robust against a transient.

        Args:
            counts: segments that count, `(segments,)`.
        Returns:
            The variance, `(blocks, 2)`, and the segments in which a channel has no noise at all
            while it has some in others, `(blocks, 2, segments)`. Rounding errors of simulated
            readings do not count as noise.
        """
        ordered = np.sort(self.rest[:, :, counts], axis=2)
        many = ordered.shape[2]
        median = 0.5 * (ordered[..., (many - 1) // 2] + ordered[..., many // 2])
        least = _STUCK * ordered[..., int(_ALIVE * (many - 1))]
        size = (self.carrier**2).sum(axis=3) + self.slow[..., 0] ** 2
        exact = ordered[..., int(_ALIVE * (many - 1))] < _ROUNDING * size.max(axis=2)
        stuck = (self.rest < least[..., np.newaxis]) & counts & ~exact[..., np.newaxis]
        low = (median < least) & ~exact
        if low.any():  # most of a block is stuck, so use the other blocks
            moving = np.where(ordered < least[..., np.newaxis], np.nan, ordered)
            median[low] = np.nanmedian(moving[low], axis=1)
        return median, stuck


def _bridged(phasors: Complexes, used: NDArray[np.bool_]) -> Complexes:
    """Interpolate linearly over segments that do not count."""
    count = used.shape[1]
    at = np.broadcast_to(np.arange(count), used.shape)
    before = np.maximum.accumulate(np.where(used, at, -1), axis=1)
    behind = np.minimum.accumulate(np.where(used, at, count)[:, ::-1], axis=1)[:, ::-1]
    first = np.where(before < 0, behind, before)
    last = np.where(behind >= count, before, behind)
    share = (at - first) / np.maximum(last - first, 1)
    low = np.take_along_axis(phasors, first[:, np.newaxis], axis=2)
    high = np.take_along_axis(phasors, last[:, np.newaxis], axis=2)
    return np.asarray(low + (high - low) * share[:, np.newaxis])


class Segments:
    """Orthonormal coordinates of each segment: carrier, level and slope, harmonics of the carrier.

    White noise of the readings is white noise of the same variance in each coordinate. A signal
    that is slow compared with a segment is in level and slope except for a small rest; the carrier
    is entirely in its own two coordinates, even if its amplitude changes between segments.

    Args:
        config: of the readings.
    """

    def __init__(self, config: LockinConfig) -> None:
        n, turn = config.block_samples, 2.0 * np.pi * config.carrier_hz / config.rate_hz
        length = max(2.0 * np.pi / turn, _SHORTEST, n / _MOST)
        self.count = int(n / length + 1e-9)
        self.length = n // self.count if self.count else n
        self.samples = self.count * self.length
        self.rate_hz, self.turn = config.rate_hz, turn
        self.enough = self.count >= _FEWEST
        k = np.arange(self.length)
        at = (k - 0.5 * (self.length - 1)) / self.length
        self.orders = tuple(h for h in HARMONICS if h * turn < 0.9 * np.pi)
        columns = [np.cos(turn * k), np.sin(turn * k), np.ones_like(at), at]
        for order in self.orders:
            columns += [np.cos(order * turn * k), np.sin(order * turn * k)]
        self._basis, self._upper = np.linalg.qr(np.stack(columns, axis=1))
        # Harmonics at a known slope of the drive; the drive's contribution is subtracted later.
        flat = np.delete(self._upper, 3, axis=1)
        self._to_harmonics = np.linalg.pinv(flat)[3:].T
        # Part of the slope's column that is orthogonal to those of the harmonics.
        q = np.linalg.qr(np.roll(self._upper[3:, 3:], -1, axis=1))[0]
        self._apart = q[:, -1:]
        self.start_turn = turn * self.length * np.arange(self.count)
        self._to_phasor = np.linalg.inv(self._upper[:2, :2]) if self.enough else np.eye(2)
        low, high = config.blank
        first = self.length * np.arange(self.count)
        blanked = (first < high) & (first + self.length > low) & (high > low)
        self.counts: NDArray[np.bool_] = ~blanked
        ramped = [at * np.cos(turn * k), at * np.sin(turn * k)]
        self._ramped = self._basis.T @ np.stack(
            ramped, axis=1
        )  # of a carrier that grows from segment to segment
        # Variance of a quadrature of one segment's phasor for readings of variance 1.
        self.quadrature = 0.5 * float((self._to_phasor**2).sum())

    @property
    def middles(self) -> Floats:
        """Middles of the segments, -1 at the block's start, 1 at its end; `(segments,)`."""
        return (2.0 * np.arange(self.count) + 1.0) / self.count - 1.0

    def cut(self, readings: NDArray[Any]) -> Floats:
        """Blocks `(blocks, block_samples, 2)` to `(blocks, 2, segments, length)`, contiguous."""
        cut = np.empty((len(readings), 2, self.samples))
        for channel in (0, 1):  # one by one: numpy would traverse a transposed array in pairs
            cut[:, channel] = readings[:, : self.samples, channel]
        return cut.reshape(len(readings), 2, self.count, self.length)

    def project(self, cut: Floats, segment: NDArray[np.intp] | None = None) -> Projected:
        """Coordinates of blocks from `cut`, or of single segments `(many, length)` of blocks."""
        y = cut @ self._basis
        square = np.einsum("...k,...k", cut, cut) - np.einsum("...k,...k", y, y)
        rest = np.maximum(square, 0.0) / (self.length - self._basis.shape[1])
        return Projected(y[..., :2], self._slow(y), self._harmonics(y, segment), rest)

    def rest(self, cut: Floats) -> tuple[Floats, Floats]:
        """Leave-one-out residuals of the readings.

        Returns:
            The leave-one-out residual, shape as `cut`, and the leverage, shape `(length,)`.
        """
        leverage = (self._basis**2).sum(axis=1)
        return (cut - (cut @ self._basis) @ self._basis.T) / (1.0 - leverage), leverage

    def phasors(self, carrier: Floats) -> Complexes:
        """The carrier's phasor of each segment, with the phase at the block's first sample."""
        a, b = np.moveaxis(carrier @ self._to_phasor.T, -1, 0)
        return np.asarray((a - 1j * b) * np.exp(-1j * self.start_turn[: a.shape[-1]]))

    def phasors_alone(self, projected: Projected) -> Complexes:
        """Phasors of segments with their own level and slope removed, for any drive."""
        own = np.linalg.inv(self._upper[:4, :4])[:2]
        both = np.concatenate([projected.carrier, projected.slow[..., :2]], axis=-1)
        a, b = np.moveaxis(both @ own.T, -1, 0)
        return np.asarray((a - 1j * b) * np.exp(-1j * self.start_turn))

    def growth(
        self, phasors: Complexes, used: NDArray[np.bool_]
    ) -> tuple[Floats, Floats, Complexes]:
        """Contribution of a carrier that changes between segments to their coordinates.

        Args:
            phasors: of the segments, with the phase at the block's start, `(blocks, 2, segments)`.
            used: segments that count, `(blocks, segments)`; the others are interpolated linearly.
        Returns:
            Over the carrier, over level and slope, and into the harmonics, as in `Projected`.
        """
        local = np.gradient(_bridged(phasors, used), axis=2) * np.exp(1j * self.start_turn)
        put = np.stack([local.real, -local.imag], axis=-1) @ self._ramped.T
        return put[..., :2], self._slow(put), self._harmonics(put)

    def columns(self, signals: Floats, *, apart: bool) -> tuple[Floats, Floats, Complexes]:
        """Coordinates of signals of a block's length, shape `(samples, count)`.

        Args:
            signals: the signals.
            apart: use the part of the slope that is orthogonal to the harmonics.
        Returns:
            Over the carrier and over level and slope, shapes `(2 segments, count)`, and the phasors
            of each segment that would look like harmonics, `(segments, harmonics, count)`.
        """
        cut = signals[: self.samples].reshape(self.count, self.length, -1)
        y = np.einsum("lk,plc->cpk", self._basis, cut)
        count = signals.shape[1]
        harmonic = self._harmonics(y[:, np.newaxis])[:, 0]
        slow = self._slow(y)[..., [0, 2] if apart else [0, 1]].reshape(count, -1)
        carrier = y[..., :2].reshape(count, -1)
        return carrier.T, slow.T, harmonic.transpose(1, 2, 0)

    def _slow(self, y: Floats) -> Floats:
        return np.concatenate([y[..., 2:4], y[..., 3:] @ self._apart], axis=-1)

    def _harmonics(self, y: Floats, segment: NDArray[np.intp] | None = None) -> Complexes:
        parts = y @ self._to_harmonics
        found = np.zeros((*parts.shape[:-1], len(HARMONICS)), dtype=np.complex128)
        start = self.start_turn if segment is None else self.start_turn[segment]
        for k, order in enumerate(self.orders):
            turned = parts[..., 2 * k] - 1j * parts[..., 2 * k + 1]
            found[..., k] = turned * np.exp(-1j * order * start)
        return found
