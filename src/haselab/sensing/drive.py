"""Models of the drive below the carrier, and the choice between them by evidence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from haselab.sensing.piecewise import HARMONICS, Pieces

__all__ = ["DriveChoice", "DriveLibrary"]

Floats = NDArray[np.float64]

_MOST_DEGREE = 20
_TAUS_A_BLOCK = (0.005, 0.4)  # of a block's length: beyond, a step is sharp, or a drive
_TAU_RATIO = 1.35
_UNEXPECTED = 40.0  # of chi-square, that steps must explain more where there should be none
_LEARNED = 12  # blocks that tell the time constant
_ROUNDED_TAU = 0.03  # in the logarithm: the second column of a tail takes such an error
_UNEXPLAINED = 4.5  # standard deviations of chi-square
_MOST_MISFIT = 1e4  # of a coordinate, in variances
_KEPT = 1e-8  # of a column's square: below, it is a combination of the others


@dataclass(frozen=True)
class DriveChoice:
    """The drive of each block.

    Args:
        carrier: its part in the coordinates of the carrier, `(blocks, 2, 2 pieces)`.
        used: pieces that count, `(blocks, pieces)`.
        score: penalised chi-square of the model, `(blocks,)`.
        harmonic: what the drive puts into the carrier's harmonics, mean over the pieces that count,
            `(blocks, 2, harmonics)`.
        extra: variance that the model's parameters add to one quadrature of the carrier, for
            readings of variance 1, `(blocks,)`.
        names: of the models, `(blocks,)` indices into `texts`.
        texts: of all models.
    """

    carrier: Floats
    used: NDArray[np.bool_]
    score: Floats
    harmonic: NDArray[np.complex128]
    extra: Floats
    names: NDArray[np.intp]
    texts: list[str]


@dataclass(frozen=True)
class _Family:
    """Models of one size: orthonormal columns, and what they put into the carrier.

    Args:
        columns: over level and slope of the pieces, `(models, 2 pieces, size)`.
        leak: into the carrier, the same shape.
        harmonic: of the drive alone into the carrier's harmonics, `(models, harmonics, size)`.
        used: pieces, `(models, pieces)`.
        cost: of each model.
        rank: parameters of each that the pieces determine, on one channel.
        texts: of each.
    """

    columns: Floats
    leak: Floats
    harmonic: NDArray[np.complex128]
    used: NDArray[np.bool_]
    cost: Floats
    rank: NDArray[np.intp]
    texts: list[str]


_Columns = tuple[Floats, Floats, NDArray[np.complex128]]


class DriveLibrary:
    """Everything that may be under the carrier: polynomials, tones, one step or two, with tails.

    The drive is fitted to level and slope of the pieces, which the carrier does not reach; what
    it puts into the carrier's coordinates follows from the fit. Models are compared by
    chi-square plus the logarithm of the number of coordinates for each parameter (Schwarz), twice
    the logarithm of the number of places for each step, and one for each coordinate left out.

    Args:
        pieces: of the blocks.
        expected: steps are; else they need more evidence.
    """

    def __init__(self, pieces: Pieces, *, expected: bool) -> None:
        self._handicap = 0.0 if expected else _UNEXPECTED
        self.pieces = pieces
        self._at = 2.0 * (np.arange(pieces.samples) + 0.5) / pieces.samples - 1.0
        self._fit_rows = np.repeat(pieces.counts, 2)
        self._coordinates = 2.0 * float(self._fit_rows.sum())
        self._steps = bool(pieces.counts.all())  # beside blanked samples there is no room for one
        self._signals: dict[tuple[object, ...], _Columns] = {}
        self._cache: dict[tuple[object, ...], _Family] = {}
        self._nested: dict[tuple[str, bool], Floats] = {}
        self._with_harmonics = False

    # ---- columns ----

    def _of(self, kind: str, *place: float) -> _Columns:
        """Coordinates of the signals of one kind, made once."""
        key = (kind, *place)
        if key not in self._signals:
            self._signals[key] = self.pieces.columns(_SIGNALS[kind](self, *place))
        return self._signals[key]

    def _polynomials(self, degree: float) -> Floats:
        columns = np.polynomial.legendre.legvander(self._at, int(degree))
        return np.asarray(columns, dtype=np.float64)

    def _tail(self, piece: float, tau: float) -> Floats:
        """exp(-t / tau) and t exp(-t / tau) from a piece on; tau in samples."""
        after = np.arange(self.pieces.samples) - piece * self.pieces.length
        decay = np.where(after >= 0, np.exp(-np.maximum(after, 0) / tau), 0.0)
        return np.stack([decay, after / tau * decay], axis=1)

    def _step(self, piece: float) -> Floats:
        """A level and a slope more from a piece on."""
        first = piece * self.pieces.length
        after = (np.arange(self.pieces.samples) >= first).astype(np.float64)
        ramp = after * (np.arange(self.pieces.samples) - first) / self.pieces.samples
        return np.stack([after, ramp], axis=1)

    # ---- families ----

    def _family(
        self, models: list[tuple[list[_Columns], NDArray[np.bool_], float, str]]
    ) -> _Family:
        """Orthonormalise models of one size: columns of signals, pieces used, cost beside the
        price of the parameters, text."""
        used = np.stack([used for _, used, _, _ in models])
        beside = self._of("harmonics") if self._with_harmonics else None
        carrier, slow, harmonic = [], [], []
        for parts, *_ in models:
            own = [*parts, beside] if beside is not None else parts
            carrier.append(np.concatenate([part[0] for part in own], axis=1))
            slow.append(np.concatenate([part[1] for part in own], axis=1))
            drives = [part[2] for part in parts]
            if beside is not None:
                drives.append(0.0 * beside[2])
            harmonic.append(np.concatenate(drives, axis=2))
        rows = np.stack(slow) * np.repeat(used, 2, axis=1)[:, :, np.newaxis]
        scale = np.linalg.norm(rows, axis=1, keepdims=True)
        scale[scale < 1e-9 * scale.max()] = np.inf
        rows = rows / scale
        # By the eigenvalues: columns that are combinations of others fall out.
        size, turn = np.linalg.eigh(rows.transpose(0, 2, 1) @ rows)
        keep = size > _KEPT * size[:, -1:]
        root = np.where(keep, 1.0 / np.sqrt(np.where(keep, size, 1.0)), 0.0)
        back = turn * root[:, np.newaxis, :]
        beside_count = beside[1].shape[1] if beside is not None else 0
        free = keep.sum(axis=1) - beside_count
        own_scale = 1.0 / scale.transpose(0, 2, 1)
        return _Family(
            rows @ back,
            np.stack(carrier) @ (back * own_scale),
            np.einsum("mp,mphs->mhs", used / used.sum(axis=1, keepdims=True), np.stack(harmonic))
            @ (back * own_scale),
            used,
            np.array([cost for _, _, cost, _ in models]) + self._price(free.astype(np.float64)),
            free + beside_count,
            [text for *_, text in models],
        )

    def _smooth(self, degree: int) -> _Family:
        key = ("smooth", degree, self._with_harmonics)
        if key not in self._cache:
            text = f"drive of degree {degree}" if degree > 1 else ""
            columns = [self._of("polynomials", degree)]
            model = (columns, self.pieces.counts, 0.0, text)
            self._cache[key] = self._family([model])
        return self._cache[key]

    def _price(self, parameters: Floats | float) -> Floats:
        return np.asarray(2.0 * parameters * np.log(self._coordinates))  # on both channels

    def _stepped(self, count: int, tau: float, degree: int) -> _Family:
        """Steps in all places; tau in samples, 0: sharp."""
        key = ("steps", count, tau, degree, self._with_harmonics)
        if key in self._cache:
            return self._cache[key]
        pieces, models = self.pieces.count, []
        for places in combinations(range(pieces), count):
            for parts, used in self._segments(places, tau, degree):
                if used.sum() < max(4, pieces // 2):
                    continue
                cost = self._handicap + 2.0 * count * float(np.log(pieces))
                cost += 4.0 * float((~used).sum())
                models.append((parts, used, cost, self._words(places, tau, degree)))
        self._cache[key] = self._family(models)
        return self._cache[key]

    def _segments(
        self, places: tuple[int, ...], tau: float, degree: int
    ) -> list[tuple[list[_Columns], NDArray[np.bool_]]]:
        """Columns and pieces that count, for steps in these places.

        A segment whose own parameters leave nothing to test them by does not count.
        """
        pieces, least = self.pieces.count, 4 if tau else 3
        used = np.ones(pieces, dtype=bool)
        parts: list[_Columns] = []
        for place, until in zip(places, (*places, pieces)[1:], strict=True):
            begin = place + 2
            if until - begin < least:
                used[place:until] = False
                begin = pieces
            used[place : place + 2] = False
            parts.append(self._of("step", begin))
            if tau:
                parts.append(self._of("tail", begin, tau))
        first = places[0] if places else pieces
        base, tail = self._of("polynomials", degree), self._of("tail", 0, tau) if tau else None
        if tail is None:
            used[: first if first < 2 else 0] = False
            return [([base, *parts], used)]
        if first >= least:
            return [([base, tail, *parts], used)]
        without = used.copy()
        without[:first] = False
        found = [([base, tail, *parts], without)]
        if first >= 2:  # level and slope alone: no earlier step
            found.append(([base, self._of("tail", pieces, tau), *parts], used))
        return found

    def _words(self, places: tuple[int, ...], tau: float, degree: int) -> str:
        where = " and ".join(
            f"{1e3 * (place + 1) * self.pieces.length / self.pieces.rate_hz:.2g} ms"
            for place in places
        )
        text = ("", "step at ", "steps at ")[len(places)] + where
        if tau:
            text += ", " if places else "earlier step, "
            text += f"tail of {1e3 * tau / self.pieces.rate_hz:.2g} ms"
        return text if degree <= 1 else f"{text}, drive of degree {degree}"

    # ---- choice ----

    def choose(self, slow: Floats, variance: Floats, *, harmonics: bool) -> DriveChoice:
        """The model of each block that the evidence is for.

        Args:
            slow: level and slope of the pieces, `(blocks, 2, pieces, 2)`.
            variance: of one coordinate, `(blocks, 2)`.
            harmonics: the carrier has some, which slopes of the pieces see as well.
        Returns:
            The choice.
        """
        self._with_harmonics = harmonics
        y = slow.reshape(len(slow), 2, -1) * self._fit_rows
        self._y = y / np.sqrt(np.maximum(variance, 1e-300))[:, :, np.newaxis]
        self._found: list[tuple[_Family, NDArray[np.intp]]] = []
        self._score = np.full(len(y), np.inf)
        self._over = np.full(len(y), np.inf)
        self._family_of = np.zeros(len(y), dtype=np.intp)
        self._model_of = np.zeros(len(y), dtype=np.intp)
        degree = self._try_degrees()
        if self._steps:
            self._try_steps(degree)
        return self._taken(y)

    def _try_degrees(self) -> int:
        """The best polynomial of each block; the degree that most blocks need."""
        key = ("nested", self._with_harmonics)
        if key not in self._nested:
            most = min(_MOST_DEGREE, self.pieces.count, int(self._coordinates / 4) - 2)
            slow = [self._of("polynomials", max(most, 1))[1]]
            if self._with_harmonics:
                slow.insert(0, self._of("harmonics")[1])
            columns = np.concatenate(slow, axis=1) * self._fit_rows[:, np.newaxis]
            self._nested[key] = np.linalg.qr(columns)[0]
        nested = self._nested[key]
        first = nested.shape[1] - self._polynomial_count(nested)
        taken = ((self._y.reshape(-1, nested.shape[0]) @ nested) ** 2).reshape(len(self._y), 2, -1)
        total = (self._y**2).sum(axis=(1, 2))
        left = total[:, np.newaxis] - np.cumsum(taken.sum(axis=1), axis=1)[:, first + 1 :]
        degrees = np.arange(1, left.shape[1] + 1)
        best = 1 + (left + self._price(1.0) * (degrees + 1)).argmin(axis=1)
        for degree in np.unique(best):
            self._try(self._smooth(int(degree)), np.flatnonzero(best == degree))
        return int(np.percentile(best, 90))

    def _polynomial_count(self, nested: Floats) -> int:
        beside = 2 * len(self.pieces.orders) if self._with_harmonics else 0
        return int(nested.shape[1] - beside)

    def _try_steps(self, degree: int) -> None:
        left = self._left(np.arange(len(self._y)))
        if not left.size or self.pieces.count < 8:
            return
        self._try(self._stepped(1, 0.0, 1), left)
        for more in sorted({4, max(4, min(degree, 8))}):
            left = self._left(left)
            self._try(self._stepped(1, 0.0, more), left)
        for steps in (1, 2):
            left = self._left(left)
            if steps == 2:
                self._try(self._stepped(2, 0.0, 1), left)
                left = self._left(left)
            self._try_tails(self._left(left), steps)

    def _try_tails(self, blocks: NDArray[np.intp], steps: int) -> None:
        """Steps with a tail whose time constant these blocks tell."""
        tau = self._learn_tau(blocks, steps) if blocks.size else 0.0
        for count in range(steps + 1) if tau else ():
            self._try(self._stepped(count, tau, 1), blocks)

    def _left(self, blocks: NDArray[np.intp]) -> NDArray[np.intp]:
        """Those of the blocks that their model so far leaves unexplained."""
        return blocks[self._over[blocks] > _UNEXPLAINED]

    def _learn_tau(self, blocks: NDArray[np.intp], steps: int) -> float:
        """The time constant under which a few of the blocks are explained best; 0: none is."""
        some = blocks[:: max(1, blocks.size // _LEARNED)]
        low, high = (share * self.pieces.samples for share in _TAUS_A_BLOCK)
        ratio = _TAU_RATIO**steps  # the second column of a tail reaches as far for two
        grid = low * ratio ** np.arange(int(np.log(high / low) / np.log(ratio)) + 1)
        totals = np.array([self._total(some, float(tau), steps) for tau in grid])
        k = int(np.argmin(totals))
        best = float(np.log(grid[k]))
        if 0 < k < grid.size - 1:
            a, b, c = totals[k - 1 : k + 2]
            best += 0.5 * np.log(ratio) * (a - c) / max(a - 2.0 * b + c, 1e-30)
        best = round(best / _ROUNDED_TAU) * _ROUNDED_TAU
        return float(np.exp(best))

    def _total(self, blocks: NDArray[np.intp], tau: float, steps: int) -> float:
        best = self._scores(self._stepped(steps, tau, 1), blocks).min(axis=1)
        # A block with more steps than that counts as much as it may, whatever the time constant.
        return float(np.minimum(best, _MOST_MISFIT * self._coordinates).sum())

    def _scores(self, family: _Family, blocks: NDArray[np.intp]) -> Floats:
        """Penalised chi-square of each model of a family, `(blocks, models)`."""
        y = self._y[blocks]
        models, rows, size = family.columns.shape
        wide = family.columns.transpose(1, 0, 2).reshape(rows, models * size)
        taken = (y.reshape(-1, rows) @ wide).reshape(-1, 2, models, size)
        square = (y**2).reshape(-1, 2, self.pieces.count, 2).sum(axis=3)
        present = square.sum(axis=1) @ family.used.T.astype(np.float64)
        return np.asarray(present - (taken**2).sum(axis=(1, 3)) + family.cost)

    def _try(self, family: _Family, blocks: NDArray[np.intp]) -> None:
        if not blocks.size:
            return
        scores = self._scores(family, blocks)
        best = scores.argmin(axis=1)
        value = scores[np.arange(blocks.size), best]
        better = value < self._score[blocks]
        self._found.append((family, best))
        chosen, best = blocks[better], best[better]
        self._score[chosen] = value[better]
        self._family_of[chosen] = len(self._found) - 1
        self._model_of[chosen] = best
        freedom = 4.0 * family.used[best].sum(axis=1) - 2.0 * family.rank[best]
        freedom = np.maximum(freedom, 1.0)
        misfit = value[better] - family.cost[best] - freedom
        self._over[chosen] = misfit / np.sqrt(2.0 * freedom)

    def _taken(self, y: Floats) -> DriveChoice:
        carrier = np.zeros_like(y)
        harmonic = np.zeros((len(y), 2, len(HARMONICS)), dtype=np.complex128)
        used = np.zeros((len(y), self.pieces.count), dtype=bool)
        names = np.zeros(len(y), dtype=np.intp)
        extra = np.zeros(len(y))
        texts: list[str] = []
        keys = self._family_of * 100_000 + self._model_of
        for key in np.unique(keys):
            family, _ = self._found[int(key) // 100_000]
            model = int(key) % 100_000
            mine = np.flatnonzero(keys == key)
            part = y[mine] @ family.columns[model]
            carrier[mine] = part @ family.leak[model].T
            harmonic[mine] = part @ family.harmonic[model].T
            used[mine] = family.used[model]
            names[mine] = len(texts)
            extra[mine] = self._extra(family.leak[model], family.used[model])
            texts.append(family.texts[model])
        return DriveChoice(carrier, used, self._score, harmonic, extra, names, texts)

    def _extra(self, leak: Floats, used: NDArray[np.bool_]) -> float:
        """Variance of one quadrature of the mean phasor by the drive's parameters."""
        into = self.pieces.phasors(leak.T.reshape(-1, self.pieces.count, 2))
        return 0.5 * float((np.abs(into[:, used].mean(axis=1)) ** 2).sum())


_SIGNALS: dict[str, Callable[..., Floats]] = {
    "polynomials": DriveLibrary._polynomials,
    "tail": DriveLibrary._tail,
    "step": DriveLibrary._step,
    "harmonics": lambda library: library.pieces.harmonic_signals(),
}
