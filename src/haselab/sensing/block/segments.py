"""A block in pieces of a carrier period: what is left of it for everything that is slow in it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.sensing.sensed import LockinConfig

__all__ = ["HARMONICS", "Pieces", "Projected"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

HARMONICS = (2, 3, 4, 5)
_MOST, _FEWEST, _SHORTEST = 32, 4, 40
_STUCK, _ALIVE = 1e-6, 0.8  # variance of a piece over that of the others, at this quantile


@dataclass(frozen=True)
class Projected:
    """Readings in the coordinates of their pieces.

    Args:
        carrier: over cosine and sine, shape `(blocks, 2, pieces, 2)`: channel, piece, coordinate.
        slow: over level, slope, and the part of the slope that no harmonic of the carrier reaches,
            `(blocks, 2, pieces, 3)`.
        harmonic: phasors of the carrier's harmonics in the unit of the readings, turned back to the
            block's start, shape `(blocks, 2, pieces, harmonics)`; 0 for those beyond the band.
        rest: variance of a reading by what all of these leave of it, `(blocks, 2, pieces)`.
    """

    carrier: Floats
    slow: Floats
    harmonic: Complexes
    rest: Floats

    def variance(self, used: NDArray[np.bool_]) -> Floats:
        """Of the readings in the pieces that count, `(blocks, pieces)`; shape `(blocks, 2)`."""
        share = used / used.sum(axis=1)[:, np.newaxis]
        return np.asarray(np.einsum("bcp,bp->bc", self.rest, share))

    def harmonics(self, used: NDArray[np.bool_]) -> tuple[Complexes, Floats]:
        """Mean phasors of the harmonics over the pieces that count, and their deviations.

        Args:
            used: `(blocks, pieces)`.
        Returns:
            Two arrays `(blocks, 2, harmonics)`; the deviation is that of one quadrature, from the
            scatter over the pieces.
        """
        weight = used.astype(np.float64)
        count = weight.sum(axis=1)[:, np.newaxis, np.newaxis]
        mean = np.einsum("bcph,bp->bch", self.harmonic, weight) / count
        square = np.einsum("bcph,bp->bch", np.abs(self.harmonic) ** 2, weight) / count
        variance = np.maximum(square - np.abs(mean) ** 2, 0.0)
        std = np.sqrt(variance / (2.0 * np.maximum(count - 1.0, 1.0)))
        return mean, np.where(square > 0.0, std, np.inf)

    def with_pieces(self, places: tuple[NDArray[np.intp], ...], other: Projected) -> Projected:
        """Some pieces, by block, channel and piece, taken from another projection of theirs."""
        changed = {}
        for one in fields(self):
            values = getattr(self, one.name).copy()
            values[places] = getattr(other, one.name)
            changed[one.name] = values
        return Projected(**changed)

    def calm_variance(self, counts: NDArray[np.bool_]) -> tuple[Floats, NDArray[np.bool_]]:
        """The same, as the median of the pieces has it: a transient does not raise it.

        Args:
            counts: pieces that count, `(pieces,)`.
        Returns:
            The variance, `(blocks, 2)`, and the pieces in which a channel has no noise at all while
            it has some in others, `(blocks, 2, pieces)`.
        """
        ordered = np.sort(self.rest[:, :, counts], axis=2)
        many = ordered.shape[2]
        median = 0.5 * (ordered[..., (many - 1) // 2] + ordered[..., many // 2])
        least = _STUCK * ordered[..., int(_ALIVE * (many - 1))]
        stuck = (self.rest < least[..., np.newaxis]) & counts
        low = median < least
        if low.any():  # most of a block is stuck: the others tell
            moving = np.where(ordered < least[..., np.newaxis], np.nan, ordered)
            median[low] = np.nanmedian(moving[low], axis=1)
        return median, stuck


def _bridged(phasors: Complexes, used: NDArray[np.bool_]) -> Complexes:
    """A straight line between the neighbours of pieces that do not count."""
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


class Pieces:
    """Orthonormal coordinates of each piece: carrier, level and slope, harmonics of the carrier.

    White noise of the readings is white noise of the same variance in each coordinate. A signal
    that is slow against a piece lies in level and slope but for a small rest; the carrier lies in
    its own two coordinates altogether, whatever its amplitude does from piece to piece.

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
        # Harmonics where the drive's slope is known: what the drive puts in is taken off later.
        flat = np.delete(self._upper, 3, axis=1)
        self._to_harmonics = np.linalg.pinv(flat)[3:].T
        # Direction of the slope's column that is orthogonal to the harmonics' ones.
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
        )  # of a carrier that grows from piece to piece
        # Variance of a quadrature of one piece's phasor for readings of variance 1.
        self.quadrature = 0.5 * float((self._to_phasor**2).sum())

    @property
    def middles(self) -> Floats:
        """Of the pieces, from -1 at the block's start to 1 at its end, shape `(pieces,)`."""
        return (2.0 * np.arange(self.count) + 1.0) / self.count - 1.0

    def cut(self, readings: NDArray[Any]) -> Floats:
        """Blocks `(blocks, block_samples, 2)` to `(blocks, 2, pieces, length)`, in one piece."""
        cut = np.empty((len(readings), 2, self.samples))
        for channel in (0, 1):  # one by one: numpy would go through a transposed array by pairs
            cut[:, channel] = readings[:, : self.samples, channel]
        return cut.reshape(len(readings), 2, self.count, self.length)

    def project(self, cut: Floats, piece: NDArray[np.intp] | None = None) -> Projected:
        """Coordinates of blocks that `cut` gave, or of single pieces `(many, length)` of blocks."""
        y = cut @ self._basis
        square = np.einsum("...k,...k", cut, cut) - np.einsum("...k,...k", y, y)
        rest = np.maximum(square, 0.0) / (self.length - self._basis.shape[1])
        return Projected(y[..., :2], self._slow(y), self._harmonics(y, piece), rest)

    def rest(self, cut: Floats) -> tuple[Floats, Floats]:
        """What the coordinates leave of each reading, as if the reading were not fitted itself.

        Returns:
            The leave-one-out residual, shape as `cut`, and the leverage, shape `(length,)`.
        """
        leverage = (self._basis**2).sum(axis=1)
        return (cut - (cut @ self._basis) @ self._basis.T) / (1.0 - leverage), leverage

    def phasors(self, carrier: Floats) -> Complexes:
        """The carrier's phasor of each piece, turned back to the block's first sample."""
        a, b = np.moveaxis(carrier @ self._to_phasor.T, -1, 0)
        return np.asarray((a - 1j * b) * np.exp(-1j * self.start_turn[: a.shape[-1]]))

    def phasors_alone(self, projected: Projected) -> Complexes:
        """Phasors of pieces whose own level and slope are taken off, whatever the drive."""
        own = np.linalg.inv(self._upper[:4, :4])[:2]
        both = np.concatenate([projected.carrier, projected.slow[..., :2]], axis=-1)
        a, b = np.moveaxis(both @ own.T, -1, 0)
        return np.asarray((a - 1j * b) * np.exp(-1j * self.start_turn))

    def growth(
        self, phasors: Complexes, used: NDArray[np.bool_]
    ) -> tuple[Floats, Floats, Complexes]:
        """What a carrier that changes from piece to piece puts into their coordinates.

        Args:
            phasors: of the pieces, turned back to the block's start, `(blocks, 2, pieces)`.
            used: pieces that count, `(blocks, pieces)`; a straight line goes over the others.
        Returns:
            Over the carrier, over level and slope, and into the harmonics, as in `Projected`.
        """
        local = np.gradient(_bridged(phasors, used), axis=2) * np.exp(1j * self.start_turn)
        put = np.stack([local.real, -local.imag], axis=-1) @ self._ramped.T
        return put[..., :2], self._slow(put), self._harmonics(put)

    def columns(self, signals: Floats, *, apart: bool) -> tuple[Floats, Floats, Complexes]:
        """Coordinates of signals of a block's length, shape `(samples, count)`.

        Args:
            signals: as they are.
            apart: take the part of the slope that no harmonic reaches.
        Returns:
            Over the carrier and over level and slope, shapes `(2 pieces, count)`, and the phasors
            of each piece that would be taken for harmonics, `(pieces, harmonics, count)`.
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

    def _harmonics(self, y: Floats, piece: NDArray[np.intp] | None = None) -> Complexes:
        parts = y @ self._to_harmonics
        found = np.zeros((*parts.shape[:-1], len(HARMONICS)), dtype=np.complex128)
        start = self.start_turn if piece is None else self.start_turn[piece]
        for k, order in enumerate(self.orders):
            turned = parts[..., 2 * k] - 1j * parts[..., 2 * k + 1]
            found[..., k] = turned * np.exp(-1j * order * start)
        return found
