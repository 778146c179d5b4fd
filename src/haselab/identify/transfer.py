"""Transfer function in continuous time from one or several records, with intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtrc

from haselab.base import Estimate, InputError, ResultError
from haselab.identify.noise import coloured_covariance, fit_percent
from haselab.identify.record import Record
from haselab.identify.residual_tests import input_correlation_p
from haselab.identify.transfer_layout import Layout, TransferStructure, layout_of
from haselab.identify.transfer_problem import Found, Problem
from haselab.identify.transfer_search import Best, best_fit
from haselab.identify.transfer_start import delay_margin_s
from haselab.models import Plant, SlowMode

__all__ = ["Record", "TransferFit", "TransferStructure", "fit_transfer"]

Floats = NDArray[np.float64]
_HELD_OUT = 0.25
_UNRELATED_P = 1e-6
_UNTOLD = 1.0  # relative standard deviation of a number that the records do not tell
_UNTOLD_TIME = 0.5
_TOLD_WELL = 0.1
_RUNAWAY = 1.3  # growth in an eighth of a record
_SWAPPED = 50.0  # per cent of fit the wrong way round
_ENDLESS = 10.83  # chi-square with one degree, 0.1 %
_REMEDY = {
    "slow_gain": " Add a step record.",
    "slow_time_constant_s": " Add a step record.",
    "delay_s": " Give it, or drop the zeros.",
}
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
            `delay_s`, `slow_gain`, `slow_time_constant_s`, and so on. One that the records do not
            tell is NaN with an infinite interval, and `notes` says so.
        covariance: of `estimates`, in their order. Shape `(P, P)`.
        poles: poles, in rad/s; the fast ones first.
        zeros: zeros of the fast part, in rad/s.
        fit_percent: NRMSE fit of all samples.
        residual_whiteness_p: Ljung-Box probability; below 0.05 something is unexplained.
        residuals: measured minus fitted. Shape `(M_r,)` each.
        notes: what the reader of the numbers should know, a sentence each.
        best: what the search found; None without a result.
    """

    status: str
    structure: TransferStructure
    estimates: dict[str, Estimate] = field(default_factory=dict)
    covariance: Floats = field(default_factory=lambda: np.zeros((0, 0)))
    poles: tuple[complex, ...] = ()
    zeros: tuple[complex, ...] = ()
    fit_percent: float = math.nan
    residual_whiteness_p: float = math.nan
    residuals: tuple[Floats, ...] = ()
    notes: tuple[str, ...] = ()
    best: Best | None = None

    @property
    def succeeded(self) -> bool:
        """Whether the numbers may be used."""
        return self.status == "ok"

    @property
    def records(self) -> tuple[Record, ...]:
        """The experiments, an unknown input before them replaced by the likelier one."""
        return () if self.best is None else tuple(self.best.records)

    @property
    def parameters(self) -> int:
        """Count of all fitted numbers, the state and offset of each record included."""
        if self.best is None:
            return 0
        found = self.best.found
        return int(found.search.size + found.shared.size + sum(own.size for own in found.own))

    @property
    def modelled(self) -> tuple[Floats, ...]:
        """Fitted output of each record. Shape `(M_r,)` each."""
        return tuple(r.y - e for r, e in zip(self.records, self.residuals, strict=True))

    @cached_property
    def validation_fit_percent(self) -> float:
        """NRMSE fit of the last quarter of each record, simulated by a fit to the rest.

        NaN where the rest is too short.
        """
        if self.best is None:
            return math.nan
        return _validation(layout_of(self.structure), self.best)

    @cached_property
    def input_correlation_p(self) -> float:
        """Probability that the residuals have nothing to do with the input.

        Below 0.05 some of the dynamics is missing.
        """
        if self.best is None:
            return math.nan
        return input_correlation_p(self.records, self.residuals)

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
            ResultError: the fit has no result, a number that the records do not tell, or is not
                one resonance without zeros.
        """
        if not self.succeeded:
            raise ResultError(f"The fit has no result: {self.status}")
        if self.structure.poles != 2 or self.structure.zeros:
            raise ResultError(
                f"The fit has {self.structure.poles} poles and {self.structure.zeros} zeros; a "
                "plant takes 2 and 0. Fit again with poles = 2, zeros = 0 and slow modes."
            )
        number = {name: estimate.value for name, estimate in self.estimates.items()}
        blind = [name for name, value in number.items() if math.isnan(value)]
        if blind:
            raise ResultError(
                f"{', '.join(blind)} not identifiable from these records; a plant takes numbers. "
                "Add a record that tells, or fit a simpler structure."
            )
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
            "input_correlation_p": self.input_correlation_p,
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
    if not fit.succeeded:
        fit = replace(fit, status=_why(structure, records) or fit.status)
    alone = all(np.ptp(record.u) == 0.0 for record in records)
    if fit.succeeded or not (structure.initial_state and alone):
        return fit
    # One step at t = 0 looks like a free decay from another state, so only rest can be assumed.
    fit = _fit(layout_of(replace(structure, initial_state=False)), records)
    return replace(fit, notes=(*fit.notes, _RESTING))


def _fit(layout: Layout, records: Sequence[Record]) -> TransferFit:
    """Search, then describe."""
    _check_size(layout, records)
    searches = (best_fit(layout, variant) for variant in _variants(records))
    tried = [search for search in searches if search is not None]
    if not tried:
        return _no_result(layout, "no start led to a stable model; record longer, or fewer poles")
    return _describe(layout, min(tried, key=lambda entry: entry.found.cost))


def _why(structure: TransferStructure, records: Sequence[Record]) -> str | None:
    """What is wrong with records that have no result, if it shows."""
    if any(_runs_away(record) for record in records):
        return (
            "no result: the output grows to the end of the record, so the plant is not stable "
            "there; cut the record, or close a loop around it"
        )
    if all(record.u.size == record.y.size and np.ptp(record.u) > 0.0 for record in records):
        turned = [Record.sampled(r.y, r.u, r.input_rate_hz) for r in records]
        backwards = _fit(layout_of(replace(structure, delay=0.0, fixed={})), turned)
        if backwards.succeeded and backwards.fit_percent > _SWAPPED:
            return "no result: the input follows the output; the columns are swapped"
    return None


def _runs_away(record: Record) -> bool:
    """Whether the output grows by a third and more in each of the last eighths of the record."""
    parts = np.array_split(record.y - np.median(record.y[: max(1, record.y.size // 8)]), 8)
    size = np.sqrt([float(part @ part) / part.size for part in parts])
    return bool((size[4:] > _RUNAWAY * size[3:-1]).all())


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


def _no_result(layout: Layout, reason: str) -> TransferFit:
    return TransferFit(f"no result: {reason}", layout.structure)


def _describe(layout: Layout, best: Best) -> TransferFit:
    """Numbers with intervals, judged."""
    records, found = best.records, best.found
    residuals = best.columns.residuals
    own = sum(factors.size for factors in found.own)
    parameters = found.search.size + found.shared.size + own
    inner = coloured_covariance(best.columns.sensitivities, residuals, parameters, best.columns.own)
    if not found.settled:
        return _no_result(layout, "the search did not come to rest; record longer or fewer poles")
    if found.shared.size and not np.isfinite(np.diag(inner)[-found.shared.size :]).any():
        return _no_result(
            layout, "no gain is identifiable; fit fewer poles or zeros, or give the delay"
        )
    if not _related(found, inner):
        return _no_result(
            layout, "the output does not follow the input; check the columns and the sensor"
        )
    modelled = tuple(r.y - e for r, e in zip(records, residuals, strict=True))
    numbers = layout.full(found.search)
    estimates, covariance, notes = _estimates(layout, best, inner)
    return TransferFit(
        "ok",
        layout.structure,
        estimates,
        covariance,
        _poles(layout, numbers, estimates),
        _zeros(layout, numbers, found),
        fit_percent([r.y for r in records], modelled),
        best.whiteness_p,
        residuals,
        (*notes, *_notes(best, estimates)),
        best,
    )


def _estimates(
    layout: Layout, best: Best, inner: Floats
) -> tuple[dict[str, Estimate], Floats, list[str]]:
    """All numbers by name with their covariance, and a sentence for each that is not told.

    The fixed ones have no spread.
    """
    numbers = layout.full(best.found.search)
    factors = layout.factor_template.copy()
    factors[np.isnan(factors)] = best.found.shared
    logarithmic = np.array([name != "delay_s" for name in layout.names])
    values = np.where(logarithmic, np.exp(np.where(logarithmic, numbers, 0.0)), numbers)
    values = np.concatenate([values, factors])
    free = np.concatenate([np.isnan(layout.template), np.isnan(layout.factor_template)])
    slope = np.ones(values.size)
    slope[: numbers.size][logarithmic] = values[: numbers.size][logarithmic]
    covariance = np.zeros((free.size, free.size))
    covariance[np.outer(free, free)] = (inner * np.outer(slope[free], slope[free])).ravel()
    names = (*layout.names, *layout.factor_names)
    blind = _blind(layout, best, values, covariance)
    covariance[blind] = covariance[:, blind] = np.inf
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    estimates: dict[str, Estimate] = {}
    notes = []
    for i, name in enumerate(names):
        unit = "rad/s" if name.endswith("_rad_s") else "s" if name.endswith("_s") else ""
        if blind[i]:
            estimates[name] = Estimate(math.nan, math.inf, (-math.inf, math.inf), unit)
            notes.append(f"{name} is not identifiable from these records.{_REMEDY.get(name, '')}")
        elif i < numbers.size and logarithmic[i]:
            estimates[name] = Estimate.lognormal(values[i], std[i] / values[i], unit)
        else:
            estimates[name] = Estimate.normal(values[i], std[i], unit)
    return estimates, covariance, notes


def _blind(layout: Layout, best: Best, values: Floats, covariance: Floats) -> NDArray[np.bool_]:
    """Which numbers the records do not tell.

    A frequency or damping with a relative standard deviation above 1, a time constant above 0.5
    or one that might as well be endless, a delay above a tenth of the record, the gain of a slow
    branch whose time constant is not told or that is uncertain by the gain of all. A number at the
    end of its range is not told either.
    """
    names = (*layout.names, *layout.factor_names)
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    longest_s = max(record.duration_s for record in best.records)
    total = sum(abs(v) for n, v in zip(names, values, strict=True) if n.endswith("gain"))
    low, high = best.bounds
    ends = {layout.names[at]: (low[k], high[k]) for k, at in enumerate(layout.free)}
    blind = np.zeros(len(names), dtype=bool)
    for i, name in enumerate(names):
        if name == "delay_s":
            blind[i] = not std[i] <= 0.1 * longest_s
        elif i < len(layout.names):
            lowest, highest = ends.get(name, (-math.inf, math.inf))
            inside = lowest < math.log(values[i]) < highest
            most = _UNTOLD_TIME if "time_constant" in name else _UNTOLD
            blind[i] = not (inside and std[i] <= most * values[i])
            if not blind[i] and name.startswith("slow") and std[i] > _TOLD_WELL * values[i]:
                blind[i] = _endless(layout, best, i)
        elif name.startswith("slow_gain"):
            constant = names.index(name.replace("gain", "time_constant") + "_s")
            blind[i] = bool(blind[constant]) or not std[i] <= abs(total)
        else:
            blind[i] = not math.isfinite(std[i])
    return blind


def _endless(layout: Layout, best: Best, at: int) -> bool:
    """Whether the data cannot tell the time constant from one ten times the longest record."""
    longest_s = max(record.duration_s for record in best.records)
    fixed = {**layout.structure.fixed, layout.names[at]: 10.0 * longest_s}
    held = layout_of(replace(layout.structure, fixed=fixed))
    others = layout.free != at
    bounds = best.bounds[0][others], best.bounds[1][others]
    rival = Problem(held, best.records, delay_margin_s(best.records)).minimise(
        best.found.search[others], bounds, gain=1e-7
    )
    count = sum(record.y.size for record in best.records)
    return rival.cost - best.found.cost < _ENDLESS * best.found.cost / count


def _related(solution: Found, inner: Floats) -> bool:
    """Whether the gains differ from zero beyond doubt (Wald's test on those that are told)."""
    count = solution.shared.size
    block = inner[inner.shape[0] - count :, inner.shape[0] - count :]
    told = np.isfinite(np.diag(block))
    scale = np.sqrt(np.diag(block)[told])
    if count == 0 or not (scale > 0.0).all():
        return True
    if count == 1:
        return float(chdtrc(1, float(solution.shared[0] / scale[0]) ** 2)) < _UNRELATED_P
    scaled = solution.shared[told] / scale
    correlation = block[np.ix_(told, told)] / np.outer(scale, scale)
    wald = float(scaled @ np.linalg.lstsq(correlation, scaled, rcond=1e-10)[0])
    return float(chdtrc(scale.size, wald)) < _UNRELATED_P


def _poles(
    layout: Layout, numbers: Floats, estimates: dict[str, Estimate]
) -> tuple[complex, ...]:
    """Poles, in rad/s; NaN for a slow branch whose time constant is not told."""
    poles = [pole for section in layout.sections for pole in section.poles(numbers)]
    fast = layout.structure.poles
    told = [e.value for name, e in estimates.items() if name.startswith("slow_time_constant")]
    slow = [complex(-1.0 / tau) if tau == tau else complex(math.nan, math.nan) for tau in told]
    return (*poles[:fast], *slow)


def _zeros(layout: Layout, numbers: Floats, found: Found) -> tuple[complex, ...]:
    """Zeros of the fast part, in rad/s."""
    count = layout.structure.zeros
    if count == 0:
        return ()
    factors = layout.factor_template.copy()
    factors[np.isnan(factors)] = found.shared
    poles = np.array(layout.sections[0].poles(numbers))
    scale = float(np.prod(-poles).real) ** (1.0 / poles.size)
    return tuple(complex(root) for root in np.roots(factors[count::-1]) * scale)


def _validation(layout: Layout, best: Best) -> float:
    """NRMSE fit of the last quarter, simulated with a fit to the first three."""
    records, share = best.records, 1.0 - _HELD_OUT
    cuts = [int(record.y.size * share) for record in records]
    if any(cut < 8 or np.ptp(r.y[:cut]) == 0.0 for r, cut in zip(records, cuts, strict=True)):
        return math.nan
    margin_s = delay_margin_s(records)
    training = Problem(layout, records, margin_s, share)
    fit = training.minimise(best.found.search, best.bounds, gain=1e-7)
    predicted = Problem(layout, records, margin_s).predict(fit)
    return fit_percent(
        [record.y[cut:] for record, cut in zip(records, cuts, strict=True)],
        [output[cut:] for output, cut in zip(predicted, cuts, strict=True)],
    )


def _notes(best: Best, estimates: dict[str, Estimate]) -> list[str]:
    notes = []
    delay = estimates["delay_s"]
    if delay.value < 0.0:
        shown = "no different from zero" if delay.ci95[1] >= 0.0 else "below zero: check the clocks"
        notes.append(f"The delay is {shown}; the plant takes 0 s.")
    if best.whiteness_p < 0.05:
        notes.append("The residuals are not white: the model leaves something unexplained.")
    return notes
