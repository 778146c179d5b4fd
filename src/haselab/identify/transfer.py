"""Transfer function in continuous time from one or several records, with intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from haselab.base import Estimate, InputError, ResultError
from haselab.identify.noise import coloured_covariance, fit_percent, whiteness_p
from haselab.identify.projection import Solution, minimise, project
from haselab.identify.record import Record
from haselab.identify.transfer_basis import Layout, TransferStructure, layout_of
from haselab.identify.transfer_start import (
    coarse_grid,
    search_bounds,
    starting_points,
    thinned,
)
from haselab.models import Plant, SlowMode

__all__ = ["Record", "TransferFit", "TransferStructure", "fit_transfer"]

Floats = NDArray[np.float64]
_HELD_OUT = 0.25
_THIN = 400
_CANDIDATES = 2  # for the three numbers of one resonance; 2 more for each further number
_APART = 0.15
_UNRELATED_P = 1e-6
_RESTING = (
    "A step at t = 0 cannot be told from an initial state: rest before the step is assumed. "
    "Record the time before the step too."
)


@dataclass(frozen=True)
class TransferFit:
    """A fitted transfer function.

    Args:
        status: "ok", or why there is no result.
        structure: what was fitted.
        estimates: every number by name: `gain`, `natural_frequency_rad_s`, `damping_ratio`,
            `delay_s`, `slow_gain`, `slow_time_constant_s`, and so on.
        covariance: of `estimates`, in their order. Shape `(P, P)`.
        poles: poles, in rad/s; the fast ones first.
        zeros: zeros of the fast part, in rad/s.
        fit_percent: NRMSE fit of all samples.
        validation_fit_percent: NRMSE fit of the last quarter of each record, simulated with the
            numbers, the initial state and the offset of a fit to the rest. NaN when too short.
        residual_whiteness_p: Ljung-Box probability; below 0.05 something is unexplained.
        modelled: fitted output of each record. Shape `(M_r,)` each.
        residuals: measured minus fitted. Shape `(M_r,)` each.
        notes: what the reader of the numbers should know, a sentence each.
    """

    status: str
    structure: TransferStructure
    estimates: dict[str, Estimate]
    covariance: Floats
    poles: tuple[complex, ...]
    zeros: tuple[complex, ...]
    fit_percent: float
    validation_fit_percent: float
    residual_whiteness_p: float
    modelled: tuple[Floats, ...]
    residuals: tuple[Floats, ...]
    notes: tuple[str, ...]

    @property
    def succeeded(self) -> bool:
        """Whether the numbers may be used."""
        return self.status == "ok"

    @property
    def slow_modes(self) -> tuple[tuple[Estimate, Estimate], ...]:
        """Gain and time constant of each slow branch."""
        gains = [e for name, e in self.estimates.items() if name.startswith("slow_gain")]
        taus = [e for name, e in self.estimates.items() if name.startswith("slow_time_constant")]
        return tuple(zip(gains, taus, strict=True))

    @property
    def plant(self) -> Plant:
        """The plant of the fitted numbers; a delay estimated below zero becomes zero.

        Raises:
            ResultError: the fit has no result, or is not one resonance without zeros.
        """
        if not self.succeeded:
            raise ResultError(f"The fit has no result: {self.status}")
        if self.structure.poles != 2 or self.structure.zeros:
            raise ResultError(
                f"The fit has {self.structure.poles} poles and {self.structure.zeros} zeros; a "
                "plant takes 2 and 0. Fit again with poles = 2, zeros = 0 and slow modes."
            )
        number = {name: estimate.value for name, estimate in self.estimates.items()}
        return Plant(
            number["gain"],
            number["natural_frequency_rad_s"],
            number["damping_ratio"],
            max(number["delay_s"], 0.0),
            tuple(SlowMode(gain.value, tau.value) for gain, tau in self.slow_modes),
        )

    def answer(self) -> dict[str, Any]:
        """The keys of the public contract."""
        keys = ("natural_frequency_rad_s", "damping_ratio", "gain", "delay_s")
        return {
            **{key: self.estimates.get(key) for key in keys},
            "poles": list(self.poles),
            "zeros": list(self.zeros),
            "slow_modes": [{"gain": gain, "time_constant_s": tau} for gain, tau in self.slow_modes],
            "fit_percent": self.fit_percent,
            "validation_fit_percent": self.validation_fit_percent,
            "residual_whiteness_p": self.residual_whiteness_p,
            "status": self.status,
            "notes": list(self.notes),
        }


def fit_transfer(
    records: Sequence[Record], structure: TransferStructure | None = None
) -> TransferFit:
    r"""Fit one transfer function to all records; each has its own initial state and offset.

    $\min_{\theta, c} \sum_r \lVert y_r - \Phi_r(\theta)\, c \rVert^2$: the poles and the delay are
    searched, gains, states and offsets are solved for. The input is held as it really was; the
    output is predicted exactly at its own times. No first guess is needed.

    Args:
        records: experiments; a chirp and a step together tell fast and slow parts.
        structure: what is fitted. One resonance with a delay when not given.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: no record, or fewer samples than numbers to fit.
    Source: variable projection, Golub and Pereyra (1973) and Kaufman (1975); intervals from the
        covariance for the noise model of the residuals.
    Example:
        >>> from haselab.models import Plant
        >>> rng = np.random.default_rng(7)
        >>> u, time_s = rng.normal(size=1000), np.arange(4000) / 400.0
        >>> y = Plant(0.5, 5.11, 0.09, 0.012).simulate(u, 100.0, time_s)
        >>> y = y + 0.01 * rng.normal(size=4000)
        >>> fit = fit_transfer([Record(u, 100.0, y, time_s)])
        >>> low, high = fit.estimates["natural_frequency_rad_s"].ci95
        >>> fit.status, low < 5.11 < high
        ('ok', True)
    """
    structure = structure or TransferStructure()
    fit = _fit(layout_of(structure), records)
    alone = all(np.ptp(record.u) == 0.0 for record in records)
    if fit.succeeded or not (structure.initial_state and alone):
        return fit
    # One step at t = 0 looks like a free decay from another state, so only rest can be assumed.
    fit = _fit(layout_of(replace(structure, initial_state=False)), records)
    return replace(fit, notes=(*fit.notes, _RESTING))


def _fit(layout: Layout, records: Sequence[Record]) -> TransferFit:
    """Search, then describe."""
    _check_size(layout, records)
    searches = (_search(layout, variant) for variant in _variants(records))
    tried = [search for search in searches if search is not None]
    if not tried:
        return _no_result(layout, "no start led to a stable model; record longer, or fewer poles")
    solution, settled, used = min(tried, key=lambda entry: entry[0].cost)
    return _describe(layout, used, solution, settled)


def _check_size(layout: Layout, records: Sequence[Record]) -> None:
    if not records:
        raise InputError("records is empty; allowed is one record or more. Give a record.")
    count = sum(record.y.size for record in records)
    own = layout.structure.offset + sum(s.order for s in layout.sections)
    wanted = layout.free.size + len(layout.factor_names) + own * len(records)
    if count < 2 * wanted:
        raise InputError(
            f"The records hold {count} outputs; {wanted} numbers need {2 * wanted} or more. "
            "Record longer, or fit fewer poles."
        )


def _variants(records: Sequence[Record]) -> list[list[Record]]:
    """The records with each guess for an input before the record that is not known."""
    choices = []
    for record in records:
        if record.input_before is not None:
            choices.append([record])
            continue
        first = float(record.u[0])
        options = [0.0] if first == 0.0 or len(records) > 3 else [0.0, first]
        if np.ptp(record.u) == 0.0:
            options = [0.0]
        choices.append([replace(record, input_before=value) for value in options])
    return [list(variant) for variant in product(*choices)]


def _search(layout: Layout, records: list[Record]) -> tuple[Solution, bool, list[Record]] | None:
    """Best solution of several starts: ranked and polished on fewer samples, then on all."""
    few, bounds = thinned(records, _THIN), search_bounds(layout, records)

    def on(chosen: Sequence[Record], search: Floats) -> list[Any]:
        return [layout.basis(search, record) for record in chosen]

    def ranked(starts: Any) -> list[Solution]:
        clipped = (np.clip(start, *bounds) for start in starts)
        solutions = [project(start, on(few, start)) for start in clipped]
        finite = [solution for solution in solutions if math.isfinite(solution.cost)]
        return sorted(finite, key=lambda solution: solution.cost)

    first = ranked(starting_points(layout, records))
    spread = sum(float(((r.y - r.y.mean()) ** 2).sum()) for r in few)
    if not first or first[0].cost > 0.5 * spread:
        first = sorted([*first, *ranked(coarse_grid(layout, records))], key=lambda s: s.cost)
    polished = [
        minimise(lambda search: on(few, search), start.search, bounds, gain=1e-3)[0]
        for start in _distinct(first, _CANDIDATES * (layout.free.size - 2))
    ]
    if not polished:
        return None
    best = min(polished, key=lambda solution: solution.cost)
    solution, settled = minimise(lambda search: on(records, search), best.search, bounds)
    return solution, settled, records


def _distinct(solutions: Sequence[Solution], most: int) -> list[Solution]:
    """The first solutions that differ by 15 % or more in some searched number."""
    kept: list[Solution] = []
    for solution in solutions:
        gaps = (np.abs(solution.search - other.search).max(initial=0.0) for other in kept)
        if all(gap > _APART for gap in gaps):
            kept.append(solution)
        if len(kept) >= max(most, 1):
            break
    return kept


def _no_result(layout: Layout, reason: str) -> TransferFit:
    nan = math.nan
    return TransferFit(
        f"no result: {reason}", layout.structure, {}, np.zeros((0, 0)), (), (), nan, nan, nan,
        (), (), (),
    )  # fmt: skip


def _describe(
    layout: Layout, records: list[Record], solution: Solution, settled: bool
) -> TransferFit:
    """Numbers with intervals, judged."""
    own = sum(factors.size for factors in solution.own)
    parameters = solution.search.size + solution.shared.size + own
    inner = coloured_covariance(solution.columns, solution.residuals, parameters)
    modelled = tuple(r.y - e for r, e in zip(records, solution.residuals, strict=True))
    estimates, covariance = _estimates(layout, solution, inner)
    if not settled:
        return _no_result(layout, "the search did not come to rest; record longer or fewer poles")
    if solution.shared.size and not np.isfinite(np.diag(inner)[-solution.shared.size :]).any():
        return _no_result(
            layout, "no gain is identifiable; fit fewer poles or zeros, or give the delay"
        )
    if not _related(solution, inner):
        return _no_result(
            layout, "the output does not follow the input; check the columns and the sensor"
        )
    numbers = layout.full(solution.search)
    poles = [p for section in layout.sections for p in section.poles(numbers)[0]]
    return TransferFit(
        "ok",
        layout.structure,
        estimates,
        covariance,
        tuple(complex(p) for p in poles),
        _zeros(layout, numbers, estimates),
        fit_percent([r.y for r in records], modelled),
        _validation(layout, records, solution.search),
        whiteness_p(solution.residuals),
        modelled,
        solution.residuals,
        _notes(layout, records, solution, estimates),
    )


def _estimates(
    layout: Layout, solution: Solution, inner: Floats
) -> tuple[dict[str, Estimate], Floats]:
    """All numbers by name with their covariance; the fixed ones have no spread."""
    numbers = layout.full(solution.search)
    factors = layout.factor_template.copy()
    factors[np.isnan(factors)] = solution.shared
    logarithmic = np.array([name != "delay_s" for name in layout.names])
    values = np.where(logarithmic, np.exp(np.where(logarithmic, numbers, 0.0)), numbers)
    free = np.concatenate([np.isnan(layout.template), np.isnan(layout.factor_template)])
    slope = np.concatenate([np.where(logarithmic, values, 1.0), np.ones(factors.size)])
    covariance = np.zeros((free.size, free.size))
    covariance[np.ix_(free, free)] = inner
    covariance[np.ix_(free, free)] *= np.outer(slope[free], slope[free])
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    estimates: dict[str, Estimate] = {}
    for i, name in enumerate((*layout.names, *layout.factor_names)):
        unit = "rad/s" if name.endswith("_rad_s") else "s" if name.endswith("_s") else ""
        if i < numbers.size and logarithmic[i]:
            estimates[name] = Estimate.lognormal(values[i], std[i] / values[i], unit)
        else:
            value = values[i] if i < numbers.size else factors[i - numbers.size]
            estimates[name] = Estimate.normal(value, std[i], unit)
    return estimates, covariance


def _related(solution: Solution, inner: Floats) -> bool:
    """Whether the gains differ from zero beyond doubt (Wald's test on those that are told)."""
    count = solution.shared.size
    block = inner[inner.shape[0] - count :, inner.shape[0] - count :]
    told = np.isfinite(np.diag(block))
    scale = np.sqrt(np.diag(block)[told])
    if count == 0 or not (scale > 0.0).all():
        return True
    scaled = solution.shared[told] / scale
    correlation = block[np.ix_(told, told)] / np.outer(scale, scale)
    wald = float(scaled @ np.linalg.lstsq(correlation, scaled, rcond=1e-10)[0])
    return float(chi2.sf(wald, scale.size)) < _UNRELATED_P


def _zeros(layout: Layout, numbers: Floats, estimates: dict[str, Estimate]) -> tuple[complex, ...]:
    """Zeros of the fast part, in rad/s."""
    if layout.structure.zeros == 0:
        return ()
    poles = layout.sections[0].poles(numbers)[0]
    scale = float(np.prod(-poles).real) ** (1.0 / poles.size)
    names = ["gain"] + [f"numerator_{i}" for i in range(1, layout.structure.zeros + 1)]
    roots = np.roots([estimates[name].value for name in reversed(names)]) * scale
    return tuple(complex(root) for root in roots)


def _validation(layout: Layout, records: list[Record], search: Floats) -> float:
    """NRMSE fit of the last quarter, simulated with a fit to the first three."""
    cuts = [int(record.y.size * (1.0 - _HELD_OUT)) for record in records]
    early = [(r.y[:cut], r.output_time_s[:cut]) for r, cut in zip(records, cuts, strict=True)]
    if any(y.size < 8 or np.ptp(y) == 0.0 for y, _ in early):
        return math.nan
    training = [replace(r, y=y, output_time_s=t) for r, (y, t) in zip(records, early, strict=True)]
    bounds = search_bounds(layout, records)
    fit, _ = minimise(
        lambda numbers: [layout.basis(numbers, record) for record in training],
        search,
        bounds,
        gain=1e-7,
    )
    measured, predicted = [], []
    for record, own, cut in zip(records, fit.own, cuts, strict=True):
        basis = layout.basis(fit.search, record)
        output = basis.known + basis.shared @ fit.shared + basis.own @ own
        measured.append(record.y[cut:])
        predicted.append(output[cut:])
    return fit_percent(measured, predicted)


def _notes(
    layout: Layout, records: list[Record], solution: Solution, estimates: dict[str, Estimate]
) -> tuple[str, ...]:
    notes = []
    low, high = search_bounds(layout, records)
    for at, value, lowest, highest in zip(layout.free, solution.search, low, high, strict=True):
        if not lowest < value < highest:
            notes.append(f"{layout.names[at]} ran to the end of its range: not identifiable here.")
    for name, estimate in estimates.items():
        if name != "delay_s" and not estimate.std < 0.5 * abs(estimate.value):
            remedy = " Add a step record." if name.startswith("slow") else ""
            notes.append(f"{name} is not identifiable from these records.{remedy}")
    delay = estimates["delay_s"]
    if not delay.std < 0.1 * max(record.duration_s for record in records):
        notes.append("delay_s is not identifiable from these records. Give it, or drop the zeros.")
    if delay.value < 0.0:
        shown = "no different from zero" if delay.ci95[1] >= 0.0 else "below zero: check the clocks"
        notes.append(f"The delay is {shown}; the plant takes 0 s.")
    if whiteness_p(solution.residuals) < 0.05:
        notes.append("The residuals are not white: the model leaves something unexplained.")
    return tuple(notes)
