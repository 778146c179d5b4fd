"""Models of the drive below the carrier, and the choice between them."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab import _sense
from haselab.sensing.block.segments import HARMONICS, Segments

__all__ = ["UNEXPLAINED", "DriveChoice", "DriveLibrary"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_MOST_DEGREE, _MOST_DEGREE_OF_PART = 20, 6
_WIDE = _sense.PART_COLUMNS
_GAP = 1  # fewest segments left out at a step
_SPARE = 2  # fewest degrees of freedom of a part
_LEFT_OUT = 10.0  # cost of a segment that is left out; its chi-square would be 4
_TAUS_A_BLOCK = (0.005, 0.4)  # of a block's length: shorter is a sharp step, longer a drive
_TAU_RATIO = 1.08  # the second column of a tail corrects such an error
_COARSE = 4  # of these steps in the first search
_MOST_TABLES = 500
_LONG = 9  # parameters: a polynomial with more may hide a step
_MOST_OF_STEP = 2  # segments affected by a step; more are called a transient
_MANY = 3  # segments left out: more than a sharp step requires
_UNEXPECTED = 40.0  # gain of chi-square required of steps where none are expected
_LEARNED = 12  # blocks used to estimate the time constant
UNEXPLAINED = 4.5  # standard deviations of chi-square
_MOST_MISFIT = 1e4  # largest misfit of a coordinate that counts, in variances
_KEPT = 1e-6  # of a column's norm: below, it is a combination of earlier columns


@dataclass(frozen=True)
class DriveChoice:
    """The drive of each block.

    Args:
        carrier: contribution in the coordinates of the carrier, `(blocks, 2, 2 segments)`.
        used: segments that count, `(blocks, segments)`.
        score: penalised chi-square of the model, `(blocks,)`.
        over: chi-square minus its mean, in standard deviations, `(blocks,)`.
        harmonic: contribution to the carrier's harmonics, mean over the counted segments,
            `(blocks, 2, harmonics)`.
        extra: variance added by the model's parameters to one quadrature of the carrier, for
            readings of variance 1, `(blocks,)`.
        stepped: whether segments are left out for a step, `(blocks,)`.
        fast: whether a polynomial of high degree is better than any cut, `(blocks,)`.
        texts: descriptions of the models.
    """

    carrier: Floats
    used: NDArray[np.bool_]
    score: Floats
    over: Floats
    harmonic: Complexes
    extra: Floats
    stepped: NDArray[np.bool_]
    fast: NDArray[np.bool_]
    texts: list[str]

    def with_blocks(self, blocks: NDArray[np.intp], other: DriveChoice) -> DriveChoice:
        """The choice with some blocks replaced by those of another choice."""
        texts = list(self.texts)
        for block, text in zip(blocks.tolist(), other.texts, strict=True):
            texts[block] = text
        arrays: dict[str, Any] = {
            f.name: _with(getattr(self, f.name), blocks, getattr(other, f.name))
            for f in fields(self)
            if f.name != "texts"
        }
        return DriveChoice(**arrays, texts=texts)


@dataclass(frozen=True)
class _Table:
    """Nested models of the drive in a run of segments: any number of leading columns.

    Args:
        columns: orthonormal, over level and slope of the segments, `(2 segments, size)`.
        leak: contribution of each to the carrier, the same shape.
        harmonic: contribution to the carrier's harmonics, summed over the segments, with the phase
            at the start of the first one, `(harmonics, size)`.
        extra: variance of the sum of the segments' phasors, for each number of columns, `(size,)`.
    """

    columns: Floats
    leak: Floats
    harmonic: Complexes
    extra: Floats


@dataclass(frozen=True)
class _PartTables:
    """Models of runs of 1, 2 ... segments, and their columns in the form of the C code."""

    tables: list[_Table]
    native: Floats


@dataclass(frozen=True)
class _ByDegree:
    """The best polynomial of each block, and its number of parameters."""

    drive: DriveChoice
    size: NDArray[np.intp]


@dataclass(frozen=True)
class _Cuts:
    """Blocks cut into parts; arrays with one row per block.

    Args:
        score: penalised chi-square, infinite where too few segments count.
        over: chi-square minus its mean, in standard deviations.
        raw: the score without that limit.
        parts: `part` of native/sensing/parts.h; `(blocks, segments)`.
    """

    score: Floats
    over: Floats
    raw: Floats
    parts: NDArray[np.void]

    def with_blocks(self, blocks: NDArray[np.intp], other: _Cuts) -> _Cuts:
        return _Cuts(*(_with(getattr(self, f.name), blocks, getattr(other, f.name))
                       for f in fields(self)))  # fmt: skip


class DriveLibrary:
    """Models of the signal below the carrier: polynomials, any number of steps, and their tails.

    The drive is fitted to level and slope of the segments, which are orthogonal to the carrier; its
    contribution to the carrier's coordinates follows from the fit. A block that no polynomial
    explains is cut into parts, with at least one segment left out between them; each has its own
    polynomial, or a straight line and an exponential tail. The best of all cuts is found by dynamic
    programming. Models are compared by chi-square plus the logarithm of the number of coordinates
    for each parameter (Schwarz), twice the logarithm of the number of places for each cut, and the
    same logarithm for each coordinate left out.

    Args:
        segments: of the blocks.
        expected: whether steps are expected; if not, they need more evidence.
    """

    def __init__(self, segments: Segments, *, expected: bool) -> None:
        self.segments = segments
        self._rows = np.repeat(segments.counts, 2)
        self._coordinates = 2.0 * float(self._rows.sum())
        self._price = 2.0 * float(np.log(max(self._coordinates, 2.0)))  # on both channels
        places = 2.0 * float(np.log(max(segments.count, 1)))
        self._cut_price = places + (0.0 if expected else _UNEXPECTED)
        # Besides blanked samples there is no room for a step.
        self._steps = bool(segments.counts.all()) and segments.count >= 8
        self._tau = 0.0  # of the tails of this record, once estimated
        self._of_whole: dict[bool, _Table] = {}
        self._of_parts: dict[tuple[float, bool], _PartTables] = {}

    # ---- tables ----

    def _table(self, signals: Floats, count: int, counts: NDArray[np.bool_], apart: bool) -> _Table:
        """Orthonormal columns of signals over the first segments."""
        carrier, slow, harmonic = self.segments.columns(signals, apart=apart)
        rows = np.repeat(counts[:count], 2)[:, np.newaxis]
        carrier, slow = carrier[: 2 * count] * rows, slow[: 2 * count] * rows
        q, r = np.linalg.qr(slow)
        pivot = np.abs(np.diagonal(r))
        kept = pivot > _KEPT * np.linalg.norm(slow, axis=0)
        r = np.where(kept, r, 0.0) + np.diag(np.where(kept, 0.0, 1.0))
        back = np.linalg.inv(r) * kept
        leak = carrier @ back
        into = self.segments.phasors(leak.T.reshape(-1, count, 2))
        summed = harmonic[:count][counts[:count]].sum(axis=0) @ back
        return _Table(q * kept, leak, summed, 0.5 * np.cumsum(np.abs(into.sum(axis=1)) ** 2))

    def _whole(self, apart: bool) -> _Table:
        """Polynomials over the block."""
        if apart not in self._of_whole:
            count = self.segments.count
            most = max(min(_MOST_DEGREE, count, int(self._coordinates / 4) - 2), 1)
            signals = _polynomials(self.segments.samples, self.segments.samples, most)
            self._of_whole[apart] = self._table(signals, count, self.segments.counts, apart)
        return self._of_whole[apart]

    def _parts(self, tau: float, apart: bool) -> _PartTables:
        """Models of a run of 1, 2 ... segments; tau in samples, 0: polynomials only."""
        key = (tau, apart)
        if key not in self._of_parts:
            if len(self._of_parts) >= _MOST_TABLES:
                self._of_parts.clear()
            every = np.ones(self.segments.count, dtype=bool)
            tables = [
                self._table(self._signals(count, tau), count, every, apart)
                for count in range(1, self.segments.count + 1)
            ]
            wide = [np.pad(t.columns, ((0, 0), (0, _WIDE - t.columns.shape[1]))) for t in tables]
            self._of_parts[key] = _PartTables(tables, np.ascontiguousarray(np.concatenate(wide)))
        return self._of_parts[key]

    def _signals(self, count: int, tau: float) -> Floats:
        samples, span = self.segments.samples, count * self.segments.length
        if not tau:
            return _polynomials(samples, span, min(_MOST_DEGREE_OF_PART, 2 * count - 1))
        after = np.arange(samples)
        decay = np.exp(-after / tau)
        tail = [decay, after / tau * decay]  # the second corrects tau
        columns = np.concatenate([_polynomials(samples, span, 1), np.stack(tail, axis=1)], axis=1)
        return columns[:, : 2 * count]

    # ---- choice ----

    def choose(self, slow: Floats, variance: Floats, *, harmonics: bool) -> DriveChoice:
        """Choose the model of each block with the lowest penalised chi-square.

        Args:
            slow: `Projected.slow` of the blocks.
            variance: of one coordinate, `(blocks, 2)`.
            harmonics: whether the carrier has some, which also affect the slopes of the segments.
        Returns:
            The choice.
        """
        level_slope = slow[..., [0, 2]] if harmonics else slow[..., :2]
        y = np.ascontiguousarray(level_slope).reshape(len(slow), 2, -1) * self._rows
        chosen = self._by_degree(y, variance, harmonics)
        left = np.flatnonzero((chosen.drive.over > UNEXPLAINED) | (chosen.size > _LONG))
        if not self._steps or not left.size:
            return chosen.drive
        some = y[left] / np.sqrt(np.maximum(variance[left], 1e-300))[:, :, np.newaxis]
        if self._tau:  # already estimated for this record
            cuts = self._cuts(some, self._tau, harmonics)
            better = np.flatnonzero(cuts.score < chosen.drive.score[left])
            return self._put(chosen.drive, y, left, better, cuts, self._tau, harmonics)
        cuts = self._cuts(some, 0.0, harmonics)
        out = self.segments.count - cuts.parts["count"].sum(axis=1)
        worse = np.flatnonzero((cuts.over > UNEXPLAINED) | (out >= _MANY))
        if worse.size:
            self._tau = self._learned(some[worse], harmonics)
            tailed = self._cuts(some[worse], self._tau, harmonics)
            cuts = cuts.with_blocks(worse, tailed)
        better = np.flatnonzero(cuts.score < chosen.drive.score[left])
        return self._put(chosen.drive, y, left, better, cuts, self._tau, harmonics)

    def _by_degree(self, y: Floats, variance: Floats, apart: bool) -> _ByDegree:
        """The best polynomial of each block."""
        table = self._whole(apart)
        part = y @ table.columns
        weight = 1.0 / np.maximum(variance, 1e-300)
        taken = np.einsum("bcs,bc->bs", part**2, weight)
        left = np.einsum("bcs,bc->b", y**2, weight)[:, np.newaxis] - np.cumsum(taken, axis=1)
        sizes = np.arange(1, taken.shape[1] + 1)
        best = 1 + (left + self._price * sizes)[:, 1:].argmin(axis=1)
        size = best + 1
        misfit = np.take_along_axis(left, best[:, np.newaxis], axis=1)[:, 0]
        kept = part * (sizes <= size[:, np.newaxis])[:, np.newaxis]
        counted = float(self.segments.counts.sum())
        names = ["" if degree < 2 else f"drive of degree {degree}" for degree in range(sizes.size)]
        drive = DriveChoice(
            kept @ table.leak.T,
            np.repeat(self.segments.counts[np.newaxis], len(y), axis=0),
            misfit + self._price * size,
            _over(misfit, self._coordinates - 2.0 * size),
            kept @ table.harmonic.T / counted,
            table.extra[best] / counted**2,
            np.zeros(len(y), dtype=bool),
            size > _LONG,
            [names[degree] for degree in best.tolist()],
        )
        return _ByDegree(drive, size)

    def _cuts(self, y: Floats, tau: float, apart: bool) -> _Cuts:
        """The best cut of each block into parts; y in standard deviations."""
        segments = self.segments.count
        parts = np.zeros((len(y), segments), _sense.PART)
        result = np.empty(len(y), _sense.PARTS_RESULT)
        tables = [self._parts(0.0, apart).native]
        limits = [2, min(_MOST_DEGREE_OF_PART + 1, _WIDE)]
        if tau:
            tables.append(self._parts(tau, apart).native)
            limits += [4, 4]
        _sense.parts(
            y, tables, [*limits, _GAP, _SPARE], [self._price, self._cut_price, _LEFT_OUT],
            parts, result,
        )  # fmt: skip
        used = parts["count"].sum(axis=1)
        freedom = 4.0 * used - 2.0 * parts["size"].sum(axis=1)
        enough = used >= max(4, segments // 2)
        return _Cuts(
            np.where(enough, result["score"], np.inf),
            np.where(enough, _over(result["misfit"], freedom), np.inf),
            result["score"],
            parts,
        )

    def _learned(self, y: Floats, apart: bool) -> float:
        """The time constant of tails that explains a few of the blocks best."""
        some = np.ascontiguousarray(y[:: max(1, len(y) // _LEARNED)])
        low, high = (share * self.segments.samples for share in _TAUS_A_BLOCK)
        taus = low * _TAU_RATIO ** np.arange(int(np.log(high / low) / np.log(_TAU_RATIO)) + 1)
        # A block that no model explains has a limited weight for every time constant.
        most = _MOST_MISFIT * self._coordinates
        known: dict[int, float] = {}

        def total(k: int) -> float:
            if k not in known:
                known[k] = float(np.minimum(self._cuts(some, taus[k], apart).raw, most).sum())
            return known[k]

        best = min(range(0, taus.size, _COARSE), key=total)
        for step in (2, 1):
            near = range(max(best - step, 0), min(best + step, taus.size - 1) + 1, step)
            best = min(near, key=total)
        return float(taus[best])

    def _put(
        self, drive: DriveChoice, y: Floats, left: NDArray[np.intp], better: NDArray[np.intp],
        cuts: _Cuts, tau: float, apart: bool,
    ) -> DriveChoice:  # fmt: skip
        """The choice with blocks `left[better]` replaced by their cuts."""
        if not better.size:
            return drive
        blocks, segments = left[better], self.segments.count
        parts = cuts.parts[better]
        at, _ = np.nonzero(parts["count"])
        some = parts[parts["count"] > 0]
        first, count, size, kind = (
            some[name].astype(np.intp) for name in ("first", "count", "size", "kind")
        )
        carrier = np.zeros((blocks.size, 2, segments, 2))
        used = np.zeros((blocks.size, segments), dtype=bool)
        harmonic = np.zeros((blocks.size, 2, len(HARMONICS)), dtype=np.complex128)
        extra = np.zeros(blocks.size)
        values = y[blocks].reshape(blocks.size, 2, segments, 2)
        turn = np.exp(-1j * np.outer(self.segments.start_turn, np.array(HARMONICS)))
        every = (self._parts(0.0, apart), self._parts(tau, apart) if tau else None)
        keys = (kind * (segments + 1) + count) * (_WIDE + 1) + size
        for key in np.unique(keys).tolist():
            mine = np.flatnonzero(keys == key)
            k, long, n = kind[mine[0]], count[mine[0]], size[mine[0]]
            tables = every[k]
            assert tables is not None
            table = tables.tables[long - 1]
            places = first[mine, np.newaxis] + np.arange(long)
            rows = at[mine, np.newaxis]
            part = values[rows, :, places].transpose(0, 2, 1, 3).reshape(mine.size, 2, -1)
            part = part @ table.columns[:, :n]
            into = (part @ table.leak[:, :n].T).reshape(mine.size, 2, long, 2)
            carrier[rows, :, places] = into.transpose(0, 2, 1, 3)
            used[rows, places] = True
            own = part @ table.harmonic[:, :n].T * turn[first[mine], np.newaxis]
            np.add.at(harmonic, at[mine], own)
            np.add.at(extra, at[mine], table.extra[n - 1])
        counted = used.sum(axis=1)
        words: dict[bytes, str] = {}
        texts = []
        for one in parts:
            key = one.tobytes()
            if key not in words:
                words[key] = self._words(one, tau)
            texts.append(words[key])
        put = DriveChoice(
            carrier.reshape(blocks.size, 2, -1),
            used,
            cuts.score[better],
            cuts.over[better],
            harmonic / counted[:, np.newaxis, np.newaxis],
            extra / counted**2,
            counted < segments,
            np.zeros(blocks.size, dtype=bool),
            texts,
        )
        return drive.with_blocks(blocks, put)

    def _words(self, parts: NDArray[np.void], tau: float) -> str:
        """Text: what is left out, and the models of the parts."""
        segment_ms = 1e3 * self.segments.length / self.segments.rate_hz
        short, long, degree, at = [], [], 0, self.segments.count
        for first, count, size, kind in [*parts.tolist(), (0, 0, 0, 0)]:
            gap = at - first - count
            if gap > _MOST_OF_STEP:
                long.append(
                    f"transient from {segment_ms * (at - gap):.2g} to {segment_ms * at:.2g} ms"
                )
            elif gap > 0:
                short.append(f"{segment_ms * (at - 0.5 * gap):.2g} ms")
            degree = max(degree, 0 if kind else size - 1)
            at = first
            if not first:
                break
        words = long[::-1]
        if short:
            steps = "step at " if len(short) == 1 else "steps at "
            words.insert(0, steps + " and ".join(short[::-1]))
        if parts["kind"].any():
            words.append(f"tail of {1e3 * tau / self.segments.rate_hz:.2g} ms")
        if degree > 1:
            words.append(f"drive of degree {degree}")
        return ", ".join(words)


def _polynomials(samples: int, span: int, degree: int) -> Floats:
    """Legendre polynomials over the first `span` samples."""
    at = 2.0 * (np.arange(samples) + 0.5) / span - 1.0
    inside = (at < 1.0)[:, np.newaxis]
    values = np.polynomial.legendre.legvander(np.minimum(at, 1.0), degree)
    return np.asarray(np.where(inside, values, 0.0), dtype=np.float64)


def _over(misfit: Floats, freedom: Floats) -> Floats:
    """Chi-square minus its mean, in standard deviations."""
    freedom = np.maximum(freedom, 1.0)
    return np.asarray((misfit - freedom) / np.sqrt(2.0 * freedom))


def _with(values: NDArray[Any], blocks: NDArray[np.intp], other: NDArray[Any]) -> NDArray[Any]:
    values = values.copy()
    values[blocks] = other
    return values
