"""Clipped outputs and inputs as causes of the residuals of a transfer function."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from haselab.base import InputError
from haselab.identify.noise import autoregression
from haselab.identify.record import Record
from haselab.identify.transfer.checks.ambiguity import whitened_energy
from haselab.identify.transfer.layout import Layout, TransferStructure, layout_of
from haselab.identify.transfer.problem import TransferProblem
from haselab.identify.transfer.search import Best, best_fit
from haselab.identify.transfer.start import delay_margin_s, richer_start

__all__ = ["clipped_input", "keep_outputs", "richer_fits", "without_clipped"]

Floats = NDArray[np.float64]
_BETTER = 50.0  # twice the gain of logarithmic likelihood that names a cause
_SHARE = 0.7  # of the residuals' energy that may remain at most
_LEVELS = (0.999, 0.99, 0.97, 0.93, 0.88, 0.8, 0.7)  # quantiles at which clipping is looked for
_INPUT_LEVELS = (0.95, 0.9, 0.85, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3)
_CLEAR = 4.0  # standard deviations below a rail where an output counts as free of it
_MOSTLY = 0.7  # of the inputs beyond a limit: noise on the input looks the same
_FOLLOWS = 0.2  # slope of the outputs beyond a rail over the model; 0 where they are clipped
_SLOPES = (0.25, 0.5)  # of an input beyond its limit that still gets through
_CURVES = (-0.45, -0.3, -0.15, 0.15, 0.3, 0.45)  # of the square, for an input from -1 to 1
_CUBES = (-0.3, -0.2, -0.1, 0.1, 0.2, 0.3)  # all of them monotone
_MOST_POLES = 6
_MOST_SLOW = 3
_TAUS = 4
_ROUNDS = 2
_AROUND = 0.1
_LEAST_VISITS = 2
_STEPS = 16  # steps of the search for one limit


def without_clipped(layout: Layout, best: Best) -> tuple[Best | None, list[str]]:
    """The fit to the unclipped outputs; None where clipping does not explain the records.

    A limit is reported where the outputs beyond it no longer follow the model, and where neither
    another pole nor a slow branch explains the records equally well.
    """
    records = best.records
    count = sum(r.y.size for r in records)
    whole = TransferProblem(layout, records, delay_margin_s(records))
    y = np.concatenate([r.y for r in records])
    chosen: tuple[float, Best, float, float] | None = None
    for low, high in _rails(y):
        found = _fit_between(layout, best, (y > low) & (y < high))
        if found is None:
            continue
        modelled = np.concatenate(whole.predict(found.found))
        bounds = _settled_rails(y, modelled, low, high)
        if _visits(modelled, bounds) < _LEAST_VISITS:
            continue
        cost = float(((y - np.clip(modelled, *bounds)) ** 2).sum())
        if chosen is None or cost < chosen[0]:
            chosen = (cost, found, *bounds)
    if chosen is None:
        return None, []
    cost, found, low, high = chosen
    gain = count * math.log(best.found.cost / max(cost, 1e-300))
    if gain < _BETTER or cost > _SHARE * best.found.cost:
        return None, []
    modelled_parts = whole.predict(found.found)
    residuals = [r.y - np.clip(m, low, high) for r, m in zip(records, modelled_parts, strict=True)]
    if not _beats(residuals, _richer(layout, best)):
        return None, []
    for _ in range(2):  # by the modelled output, not by the noisy one
        modelled = np.concatenate(whole.predict(found.found))
        std = math.sqrt(found.found.cost / sum(r.y.size for r in found.records))
        lowest, highest = low + _CLEAR * std, high - _CLEAR * std
        again = _fit_between(layout, best, (modelled > lowest) & (modelled < highest))
        if again is None:
            return None, []
        found = again
    left_out = count - sum(r.y.size for r in found.records)
    return found, [
        f"The output is clipped at {_shown(low, high)}: {left_out} of {count} outputs near this "
        "limit are excluded."
    ]


def keep_outputs(record: Record, keep: NDArray[np.bool_]) -> Record:
    """The record with the marked outputs only.

    Raises:
        InputError: too few are left for a record.
    """
    return replace(record, y=record.y[keep], output_time_s=record.output_time_s[keep])


def _refit(layout: Layout, records: Sequence[Record], start: Best) -> Best | None:
    return best_fit(layout, records, [start.found.search])


def _follows(y: Floats, modelled: Floats, beyond: NDArray[np.bool_]) -> bool:
    """Whether outputs beyond a limit still rise with the model, as unclipped outputs do."""
    if beyond.sum() < 3:
        return False
    along = modelled[beyond] - modelled[beyond].mean()
    energy = float(along @ along)
    return energy > 0.0 and float(along @ y[beyond]) > _FOLLOWS * energy


def _visits(modelled: Floats, bounds: tuple[float, float]) -> int:
    """How often the model goes beyond a rail. Once is no evidence: an output that creeps towards
    a limit after its only step looks the same."""
    beyond = (modelled > bounds[1]) | (modelled < bounds[0])
    return int(np.count_nonzero(np.diff(beyond.astype(np.int8), prepend=0) == 1))


def _shown(low: float, high: float) -> str:
    rails = [f"{rail:.4g}" for rail in (low, high) if math.isfinite(rail)]
    return " and ".join(rails)


def _rails(y: Floats) -> Iterator[tuple[float, float]]:
    """Candidate ranges of the output between clipping limits."""
    for share in _LEVELS:
        high, low = float(np.quantile(y, share)), float(np.quantile(y, 1.0 - share))
        yield -math.inf, high
        yield low, math.inf
        yield low, high


def _settled_rails(y: Floats, modelled: Floats, low: float, high: float) -> tuple[float, float]:
    """Rails at the median of the outputs beyond the range that do not follow the model."""
    above, below = y[modelled > high], y[modelled < low]
    low_free = below.size < 3 or _follows(y, modelled, modelled < low)
    high_free = above.size < 3 or _follows(y, modelled, modelled > high)
    return (
        -math.inf if low_free else float(np.median(below)),
        math.inf if high_free else float(np.median(above)),
    )


def _fit_between(layout: Layout, best: Best, keep: NDArray[np.bool_]) -> Best | None:
    """The fit to the outputs that are kept; None where too few are left for a record."""
    ends = np.cumsum([r.y.size for r in best.records])[:-1]
    try:
        records = [
            keep_outputs(r, part)
            for r, part in zip(best.records, np.split(keep, ends), strict=True)
        ]
    except InputError:
        return None
    return _refit(layout, records, best)


def clipped_input(layout: Layout, best: Best) -> tuple[str, Best] | None:
    """Status and fit where an unrecorded limit of the input explains the records.

    A limit is reported where it explains them better than each of these: another pole, a slow
    branch, an input that passes its limit with a smaller slope, and a smooth curve of the input.
    A limit also compensates part of a drift or of a nonlinearity.
    """
    inputs = _Inputs(layout, best)
    chosen = min(
        (
            (fit.found.cost, limits, fit)
            for limits in inputs.limits()
            if (fit := inputs.clipped(limits)) is not None
        ),
        key=lambda entry: entry[0],
        default=None,
    )
    if chosen is None:
        return None
    _, limits, fit = chosen
    count = sum(r.y.size for r in best.records)
    gain = count * math.log(best.found.cost / max(fit.found.cost, 1e-300))
    if gain < _BETTER or fit.found.cost > _SHARE * best.found.cost:
        return None
    limits, fit = inputs.settled(limits, fit)
    if not _beats(fit.columns.residuals, inputs.curved()):
        return None
    if not _beats(fit.columns.residuals, _richer(layout, best)):
        return None
    low, high = inputs.outer(limits)
    beyond = np.concatenate([(r.u < low) | (r.u > high) for r in best.records])
    noisy = " or is noisy" if beyond.mean() > _MOSTLY else ""
    return (
        f"no result: the applied input seems to have been clipped at {_shown(low, high)}, but the "
        f"recorded input goes beyond{noisy}; record the applied input, or stay within the limit"
    ), fit


@dataclass(frozen=True)
class _Inputs:
    """Fits to a memoryless curve of the input, which is scaled to -1 to 1."""

    layout: Layout
    best: Best

    @property
    def _scale(self) -> tuple[float, float]:
        u = np.concatenate([r.u for r in self.best.records])
        return 0.5 * float(u.max() + u.min()), 0.5 * float(np.ptp(u))

    def limits(self) -> Iterator[tuple[float, float]]:
        """Candidate limits that the input crosses."""
        for level in _INPUT_LEVELS:
            yield -level, level
            yield -math.inf, level
            yield -level, math.inf

    def outer(self, limits: tuple[float, float]) -> tuple[float, float]:
        """Limits in units of the input."""
        middle, half = self._scale
        return middle + half * limits[0], middle + half * limits[1]

    def fitted(self, curve: Callable[[Floats], Floats]) -> Best | None:
        """The fit to a curve of the input; None where an input becomes constant."""
        middle, half = self._scale
        if not half > 0.0:
            return None

        def curved(values: Floats) -> Floats:
            return middle + half * curve((values - middle) / half)

        records = []
        for r in self.best.records:
            u = curved(r.u)
            before = r.input_before
            if before is not None:
                before = float(curved(np.array([before]))[0])
            if np.ptp(u) == 0.0 and (before is None or before == u[0] or np.ptp(r.u) > 0.0):
                return None
            records.append(replace(r, u=u, input_before=before))
        return _refit(self.layout, records, self.best)

    def settled(self, limits: tuple[float, float], fit: Best) -> tuple[tuple[float, float], Best]:
        """Limits and fit, each limit refined between grid points."""
        for side in (0, 1) * _ROUNDS:
            if not math.isfinite(limits[side]):
                continue

            def moved(limit: float, side: int = side, at: tuple[float, float] = limits) -> Floats:
                return np.array([limit, at[1]] if side == 0 else [at[0], limit])

            def cost(limit: float, moved: Callable[[float], Floats] = moved) -> float:
                found = self.clipped(moved(limit))
                return math.inf if found is None else found.found.cost

            around = (limits[side] - _AROUND, limits[side] + _AROUND)
            searched = minimize_scalar(
                cost, bounds=around, method="bounded", options={"maxiter": _STEPS}
            )
            low, high = moved(float(searched.x))
            found = self.clipped((low, high))
            if found is not None and found.found.cost < fit.found.cost:
                limits, fit = (float(low), float(high)), found
        return limits, fit

    def clipped(self, limits: Sequence[float] | Floats) -> Best | None:
        """The fit to the input within limits."""
        return self.fitted(lambda x: np.clip(x, limits[0], limits[1]))

    def curved(self) -> Iterator[Best]:
        """Fits to a smooth curve of the input."""
        curves: list[Callable[[Floats], Floats]] = []
        for q in _CURVES:
            curves.append(partial(_squared, part=q))
        for q in _CUBES:
            curves.append(partial(_cubed, part=q))
        for limits in self.limits():
            for slope in _SLOPES:
                curves.append(partial(_soft, limits=limits, slope=slope))
        for curve in curves:
            fit = self.fitted(curve)
            if fit is not None:
                yield fit


def _squared(x: Floats, part: float) -> Floats:
    return x + part * x * x


def _cubed(x: Floats, part: float) -> Floats:
    return x + part * x**3


def _soft(x: Floats, limits: tuple[float, float], slope: float) -> Floats:
    return np.asarray((1.0 - slope) * np.clip(x, *limits) + slope * x)


def _beats(residuals: Sequence[Floats], others: Iterator[Best]) -> bool:
    """Whether residuals are clearly more likely than those of all other fits."""
    polynomial = autoregression(residuals)[0]
    count = sum(e.size for e in residuals)
    least = max(whitened_energy(residuals, polynomial), 1e-300)
    for other in others:
        energy = whitened_energy(other.columns.residuals, polynomial)
        if count * math.log(max(energy, 1e-300) / least) < _BETTER:
            return False
    return True


def _richer(layout: Layout, best: Best) -> Iterator[Best]:
    return (found for _, found in richer_fits(layout, best))


def richer_fits(layout: Layout, best: Best) -> Iterator[tuple[TransferStructure, Best]]:
    """Fits of linear models with one more branch or pole, each at least as good as the fit."""
    structure, records = layout.structure, best.records
    if structure.slow_modes < _MOST_SLOW:
        richer = layout_of(replace(structure, slow_modes=structure.slow_modes + 1))
        numbers = dict(zip(layout.names, layout.full(best.found.search), strict=True))
        span_s = max(r.duration_s for r in records)
        step_s = min(r.output_step_s for r in records)
        starts = [
            np.array([numbers.get(name, math.log(tau)) for name in richer.names])[richer.free]
            for tau in np.geomspace(10.0 * step_s, span_s, _TAUS)
        ]
        found = best_fit(richer, records, starts)
        if found is not None:
            yield richer.structure, found
    if structure.poles < _MOST_POLES and not structure.fixed:
        zeros = structure.zeros + (structure.zeros == structure.poles)
        richer = layout_of(replace(structure, poles=structure.poles + 1, zeros=zeros))
        starts = list(richer_start(richer, layout, best.found.search, records))
        found = best_fit(richer, records, starts) if starts else None
        if found is not None:
            yield richer.structure, found
