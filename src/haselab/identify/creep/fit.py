"""Creep from a held input: choice between exponential, fractional and other laws; forecast."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import Estimate, InputError, JsonObject, checked
from haselab.base.chart import Chart
from haselab.identify.charts import time_chart
from haselab.identify.clipped import clipping_of
from haselab.identify.creep.columns import are_swapped, is_noisy
from haselab.identify.creep.laws import (
    CreepLaw,
    FractionalLaw,
    LogarithmicLaw,
    PowerLaw,
    PronyLaw,
    Span,
)
from haselab.identify.creep.setting import Fitted, Setting
from haselab.identify.fit import RecordFit, rescaled
from haselab.identify.model_choice import APART, bic, effective_count, is_decisive
from haselab.identify.noise import coloured_covariance, fit_percent, whiteness_p
from haselab.identify.projection import minimise, project
from haselab.identify.record import Record
from haselab.identify.sampled.record import single_record
from haselab.models.creep import Creep

__all__ = ["CreepFit", "fit_creep"]

Floats = NDArray[np.float64]
_KINDS = {
    "auto": ("prony", "fractional", "logarithmic"),
    "prony": ("prony",),
    "fractional": ("fractional",),
    "logarithmic": ("logarithmic",),
}
_LEAST_SAMPLES = 24
_DRIFTS = 5.0  # standard deviations of a significant slope before the input changes
_NONE, _NONE_VISIBLE, _UNSURE = "none", "no creep visible", "cannot tell"
_POLISHED = 3
_MOST_BRANCHES = 4
_COLOURED = 1e-3  # whiteness below which a note says so
_SPIKE = 8.0  # standard deviations, estimated by the median, that normal noise does not reach
_ROUNDING = 1e-9  # of the output's span
_LARGEST_STD = 1.0  # of the logarithm of an identifiable time constant
_BEYOND = 3.0  # record lengths: longer time constants are not identifiable
_STRAIGHT = 0.999  # order at which a power of time counts as a straight line
_WEAK = 2.0  # standard deviations of a gain below which its time constant is not identifiable
_HELD_OUT = 0.25
_LEAST_EFFECTIVE = 8.0  # samples, as for coloured residuals
_UNKNOWN = (-math.inf, math.inf)


@dataclass(frozen=True, kw_only=True)
class CreepFit(RecordFit[Record]):
    """Fitted creep; see `Fit` for what all fits have.

    Its `residuals` are those of the samples that are fitted.

    Args:
        kind: the law that is reported: none, prony, fractional or logarithmic.
        verdict: the law that the data support, "no creep visible", or "cannot tell".
        bic: criterion of each kind's best law relative to the lowest.
        fit_percent: NRMSE fit of the fitted samples.
        validation_fit_percent: fit of the last quarter of them, forecast by the same law fitted
            to the rest, relative to the spread of all samples, since the end of a creep varies
            only by noise. NaN where the rest is too short.
        residual_whiteness_p: Ljung-Box probability; below 0.05 something is unexplained.
        fitted: the creep. None: no result.
        candidates: laws that the data do not distinguish from the reported one, which is the first.
        setting: the record.
    """

    kind: str = ""
    verdict: str = ""
    bic: dict[str, float] = field(default_factory=dict)
    fit_percent: float = math.nan
    validation_fit_percent: float = math.nan
    residual_whiteness_p: float = math.nan
    fitted: Creep | None = None
    candidates: tuple[Fitted, ...] = field(default=(), repr=False)
    setting: Setting = field(repr=False)

    @property
    def model(self) -> Creep:
        """The creep model, relative to the input before the record.

        Raises:
            ResultError: the fit has no result.
        """
        return self._present(self.fitted)

    @property
    def fitted_outputs(self) -> tuple[Floats, ...]:
        """See `RecordFit`."""
        return (self.setting.y,)

    @checked
    def simulate(self, u: ArrayLike, rate_hz: float | None = None) -> Floats:
        """See `RecordFit`."""
        return self.model.simulate(u, rate_hz or self.setting.span.rate_hz)

    def _modelled(self, record: Record) -> tuple[Floats, Floats]:
        new = single_record(record)
        moved = self.model.simulate(new.u - _rest(new), new.input_rate_hz)
        return new.y, moved + (new.y - moved).mean()

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """See `Fit`; the whole record with the model from its first row on."""
        span, y = self.setting.span, self.setting.y
        modelled = self.model.simulate(span.inputs, span.rate_hz)
        modelled = modelled + np.median(y - modelled)
        time_s, output = np.arange(y.size) / span.rate_hz, (names or ("", "Output"))[1]
        return time_chart(f"Creep, {self.kind}", time_s, y, modelled, (output, "model"))

    def forecast(self, after_s: float) -> Estimate:
        """Output `after_s` after the record's end, the input held at its last value.

        Args:
            after_s: time after the last sample, in s.
        Returns:
            Output. Its interval covers the intervals of all laws that the data do not distinguish.
        Raises:
            ResultError: the fit has no result.
            InputError: a time that is not above 0 s.
        """
        self._present(self.candidates or None)
        if not 0.0 < after_s < math.inf:
            raise InputError(f"after_s = {after_s:g} s; it must be above 0 s.")
        entries = [_forecast(self.setting, candidate, after_s) for candidate in self.candidates]
        low = min(entry.ci95[0] for entry in entries)
        high = max(entry.ci95[1] for entry in entries)
        return Estimate(entries[0].value, entries[0].std, (low, high), "")

    def answer(self) -> JsonObject:
        """The result as a dictionary for JSON."""
        return {
            "model": self.kind,
            "verdict": self.verdict,
            "parameters": self.parameters,
            "bic": self.bic,
            "fit_percent": self.fit_percent,
            "validation_fit_percent": self.validation_fit_percent,
            "residual_whiteness_p": self.residual_whiteness_p,
            "status": self.status,
            "notes": list(self.notes),
        }


@checked
def fit_creep(
    records: Record | Sequence[Record], model: str = "auto", *, leave_out_s: float = 0.0
) -> CreepFit:
    r"""Fit creep to the response to an input that is held between its updates.

    $y = c + J_0 u + \sum \Delta u_k\,(J(t - t_k) - J_0)$, with candidates for $J$: one to four
    exponentials, a fractional power, a Mittag-Leffler function, a logarithm, none. BIC chooses; a
    difference below 6 is "cannot tell". A time constant too long for the record is NaN, with a
    note.

    Args:
        records: one record, its outputs read right after the input's updates
            (`Record.sampled`). With an `input_before` of None the output had settled at 0 when the
            input never changes (a step at the first sample), else at the first input.
        model: auto, prony, fractional or logarithmic.
        leave_out_s: time after each update of the input whose outputs are not fitted, in s, to
            exclude ringing and lag.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: fewer than 24 fitted samples, unequal lengths, NaN, a column without
            change, an unknown model.
    Source: variable projection, Golub and Pereyra (1973); laws as in `haselab.models.creep`;
        intervals from the covariance for the noise model of the residuals.
    Example:
        >>> from haselab.models import PronyCreep
        >>> u = np.r_[np.zeros(100), np.ones(1900)]
        >>> y = PronyCreep(1.0, (0.2,), (3.0,)).simulate(u, 100.0)
        >>> y = y + 0.002 * np.random.default_rng(1).normal(size=u.size)
        >>> fit = fit_creep(Record.sampled(u, y, 100.0), model="prony")
        >>> low, high = fit.parameters["time_constant_1_s"].ci95
        >>> fit.verdict, low < 3.0 < high
        ('prony', True)
    """
    record = single_record(records)
    setting, stepped = _setting(record, leave_out_s)
    if model not in _KINDS:
        raise InputError(f"model = {model}; it must be one of {', '.join(_KINDS)}.")
    drift = _drift_before(setting, rest_known=not stepped)
    if drift is not None:
        return _no_result(setting, drift)
    if are_swapped(record.u, setting.y):
        return _no_result(
            setting,
            "the output is held between few updates, and the input changes at every row; the "
            "columns are swapped",
        )
    if is_noisy(record.u):
        return _no_result(
            setting,
            "the input is noisy, which biases every parameter; use the commanded input, or the "
            "mean of each level",
        )
    if clipped := clipping_of(setting.y, "outputs"):
        return _no_result(setting, clipped)
    found = [entry for entry in _tried(_KINDS[model], setting) if _one_sided(entry, setting)]
    if not found:
        return _no_result(setting, "no law converged; record longer")
    scored = _scored(found, setting)
    best = scored[0]
    scores: dict[str, float] = {}
    for entry in scored:
        scores.setdefault(_kind(entry), entry.bic - best.bic)
    verdict = _kind(best) if is_decisive(scores) else _UNSURE
    verdict = _NONE_VISIBLE if verdict == _NONE else verdict
    fit = _describe(setting, scored, scores, verdict, stepped)
    if record.hold == "zero":
        return fit
    half_s = 0.5 / record.input_rate_hz
    moved = (
        f"The record has hold = {record.hold}, but its input is treated as held: the creep may "
        f"begin {half_s:.3g} s earlier or later. If this matters, raise --leave-out-s."
    )
    return replace(fit, notes=(*fit.notes, moved))


def _rest(record: Record) -> float:
    """Input before the record, at which the output had settled."""
    if record.input_before is not None:
        return record.input_before
    return 0.0 if np.ptp(record.u) == 0.0 else float(record.u[0])


def _setting(record: Record, leave_out_s: float) -> tuple[Setting, bool]:
    inputs, outputs, rate_hz = record.u, record.y, record.input_rate_hz
    if not 0.0 <= leave_out_s < math.inf:
        raise InputError(f"leave_out_s is {leave_out_s:g} s, but it must be 0 s or more.")
    stepped = bool(np.ptp(inputs) == 0.0)
    rest = _rest(record)
    moved = inputs - rest
    if not moved.any():
        raise InputError(
            f"The input is {rest:g} throughout and before, so nothing creeps. It "
            "must change. Name the right column, or record a step."
        )
    since = np.full(inputs.size, np.inf)
    for k in np.flatnonzero(np.diff(moved, prepend=0.0)):
        since[k:] = np.arange(inputs.size - k) / rate_hz
    kept = since >= leave_out_s
    after = int((kept & np.isfinite(since)).sum())
    if after < _LEAST_SAMPLES:
        raise InputError(
            f"leave_out_s = {leave_out_s:g} s leaves {after} samples after an update; at least "
            f"{_LEAST_SAMPLES} are required. Leave out less, or hold the input longer."
        )
    # A step at the first sample: the output before it and the instantaneous response are
    # indistinguishable.
    return Setting(Span(moved, rate_hz), outputs, kept, not stepped), stepped


def _drift_before(setting: Setting, *, rest_known: bool) -> str | None:
    """Reason for no fit where the output already drifts before the input changes."""
    still = int(np.argmax(setting.span.inputs != 0.0))
    if not rest_known or still < _LEAST_SAMPLES:
        return None
    t = np.arange(still) / setting.span.rate_hz
    columns = np.column_stack([np.ones(still), t - t.mean()])
    factors = np.linalg.lstsq(columns, setting.y[:still], rcond=None)[0]
    left = setting.y[:still] - columns @ factors
    variance = float(coloured_covariance([columns], [left], 2)[1, 1])
    if not factors[1] ** 2 > _DRIFTS**2 * variance:
        return None
    return (
        f"the output drifts by {factors[1]:.3g} per second before the input changes "
        f"({abs(factors[1]) / math.sqrt(max(variance, 1e-300)):.0f} standard deviations); wait "
        "until it has settled, or record without the drift"
    )


def _tried(kinds: tuple[str, ...], setting: Setting) -> list[Fitted]:
    """Fits of no creep, of a growing number of branches, and of the other laws."""
    wanted: list[CreepLaw] = [PowerLaw(), FractionalLaw()] if "fractional" in kinds else []
    wanted += [LogarithmicLaw()] if "logarithmic" in kinds else []
    found = [entry for law in [PronyLaw(0), *wanted] if (entry := _fit(law, setting)) is not None]
    count = int(setting.kept.sum())
    cost = found[0].solution.cost
    for branches in range(1, _MOST_BRANCHES + 1) if "prony" in kinds else ():
        entry = _fit(PronyLaw(branches), setting)
        if entry is None:
            break
        found.append(entry)
        # An improvement below that of two parameters for white noise is insignificant for any
        # noise.
        if not entry.solution.cost < cost * math.exp(-2.0 * math.log(count) / count):
            break
        cost = entry.solution.cost
    return found


def _kind(entry: Fitted) -> str:
    return entry.law.kind if entry.solution.search.size else _NONE


def _fit(law: CreepLaw, setting: Setting) -> Fitted | None:
    """The best of several starts, refined on all samples."""
    few, bounds = setting.thinned(), law.bounds(setting.span)
    starts = [project(start, few.bases(law, start)) for start in law.starts(setting.span)]
    starts = sorted((s for s in starts if math.isfinite(s.cost)), key=lambda s: s.cost)
    polished = [
        minimise(lambda x: few.bases(law, x), start.search, bounds, gain=1e-4)[0]
        for start in starts[:_POLISHED]
    ]
    if not polished:
        return None
    best = min(polished, key=lambda solution: solution.cost)
    solution, settled = minimise(lambda x: setting.bases(law, x), best.search, bounds, gain=1e-8)
    return Fitted(law, solution) if settled else None


def _one_sided(entry: Fitted, setting: Setting) -> bool:
    """Whether all branches creep in one direction; opposed branches fit noise."""
    gains = entry.gains(setting)
    return bool((gains >= 0.0).all() or (gains <= 0.0).all())


def _scored(found: list[Fitted], setting: Setting) -> list[Fitted]:
    """All laws with their BIC, the best first."""
    richest = min(found, key=lambda entry: entry.solution.cost)
    count = int(setting.kept.sum())
    effective = effective_count(richest.solution.residuals)
    floor = max(_ROUNDING * float(np.ptp(setting.y)), setting.step / math.sqrt(12.0)) ** 2
    if setting.step > 0.0:  # a run of equal outputs has one rounding error
        effective = min(effective, max(setting.runs[-1] + 1.0, _LEAST_EFFECTIVE))
    scored = [
        Fitted(
            entry.law,
            entry.solution,
            bic(entry.solution.cost, count, effective, entry.parameters, floor),
        )
        for entry in found
    ]
    return sorted(scored, key=lambda entry: entry.bic)


def _describe(
    setting: Setting,
    scored: list[Fitted],
    scores: dict[str, float],
    verdict: str,
    stepped: bool,
) -> CreepFit:
    best = scored[0]
    candidates = tuple(entry for entry in scored if entry.bic - best.bic < APART)
    estimates, covariance = _estimates(best, setting)
    if _kind(best) == _NONE:  # the instant response may include a creep that is not excluded
        lows, highs = zip(*(_instant(entry, setting).ci95 for entry in candidates), strict=True)
        estimates["instant"] = replace(estimates["instant"], ci95=(min(lows), max(highs)))
    residuals = best.solution.residuals[0]
    measured = setting.y[setting.kept]
    instant = float(best.solution.shared[0])
    return CreepFit(
        status="ok",
        parameters=estimates,
        covariance=covariance,
        residuals=(residuals,),
        notes=_notes(setting, estimates, stepped, residuals),
        kind=_kind(best),
        verdict=verdict,
        bic=scores,
        fit_percent=fit_percent([measured], [measured - residuals]),
        validation_fit_percent=_validation(setting, best),
        residual_whiteness_p=whiteness_p([residuals]),
        fitted=best.law.model(best.solution.search, instant, best.gains(setting)),
        candidates=candidates,
        setting=setting,
    )


def _instant(entry: Fitted, setting: Setting) -> Estimate:
    at = entry.solution.search.size
    variance = float(entry.covariance(setting)[at, at])
    return Estimate.normal(float(entry.solution.shared[0]), math.sqrt(max(variance, 0.0)), "")


def _estimates(entry: Fitted, setting: Setting) -> tuple[dict[str, Estimate], Floats]:
    """All parameters by name, and their covariance.

    A time constant that the record cannot tell takes its gain with it.
    """
    solution = entry.solution
    count = solution.search.size
    inner = entry.covariance(setting)
    std = np.sqrt(np.maximum(np.diag(inner), 0.0))
    names = [*entry.law.names[:count], "instant", *["offset"] * setting.offset]
    names += entry.law.names[count:]
    values = np.concatenate([solution.search, solution.shared])
    numbers = dict(zip(names, zip(values, std, strict=True), strict=True))
    estimates = {}
    for name, (value, spread) in numbers.items():
        if name.endswith("_s"):
            estimates[name] = Estimate.lognormal(math.exp(value), spread, "s")
        else:
            estimates[name] = Estimate.normal(value, spread, "")
    for name in [name for name in names if name.endswith("_s")]:
        log_tau, spread = numbers[name]
        gain = "gain_" + name.split("_")[2]
        weak = abs(numbers[gain][0]) < _WEAK * numbers[gain][1]
        if spread > _LARGEST_STD or weak or math.exp(log_tau) > _BEYOND * setting.span.duration_s:
            estimates[name] = Estimate(math.nan, math.inf, _UNKNOWN, "s")
            estimates[gain] = Estimate(math.nan, math.inf, _UNKNOWN, "")
    for name, known in estimates.items():
        straight = name == "order" and known.value > _STRAIGHT
        if not math.isfinite(known.std) or straight or (name == "order" and known.std > 0.5):
            estimates[name] = Estimate(math.nan, math.inf, _UNKNOWN, known.unit)
    order = ("instant", "offset")
    ordered = {k: estimates[k] for k in order if k in estimates} | estimates
    at = [names.index(name) for name in ordered]
    spread = np.array([known.std for known in ordered.values()])
    return ordered, rescaled(inner[np.ix_(at, at)], spread)


def _forecast(setting: Setting, entry: Fitted, after_s: float) -> Estimate:
    """One law's output after the record, with the covariance of its parameters."""
    span = setting.span
    more = max(1, round(after_s * span.rate_hz))
    longer = Span(np.concatenate([span.inputs, np.full(more, span.inputs[-1])]), span.rate_hz)
    kept = np.zeros(longer.inputs.size, dtype=bool)
    kept[-1] = True
    ahead = Setting(longer, np.zeros(longer.inputs.size), kept, setting.offset)
    basis = ahead.bases(entry.law, entry.solution.search)[0]
    value = float(basis.shared[0] @ entry.solution.shared)
    row = np.concatenate([basis.by_search[:, 0] @ entry.solution.shared, basis.shared[0]])
    covariance = entry.covariance(setting)
    if not np.isfinite(covariance).all():
        return Estimate(value, math.inf, _UNKNOWN, "")
    return Estimate.normal(value, math.sqrt(max(float(row @ covariance @ row), 0.0)), "")


def _validation(setting: Setting, best: Fitted) -> float:
    """Fit percentage of the last quarter of the samples, forecast by a fit to the rest."""
    rows = np.flatnonzero(setting.kept)
    cut = int(rows[round((1.0 - _HELD_OUT) * rows.size)])
    early = setting.before(cut)
    basis = setting.bases(best.law, best.solution.search)[0]
    if (
        early.kept.sum() < 2 * best.parameters
        or np.linalg.matrix_rank(basis.shared[rows < cut]) < best.solution.shared.size
    ):
        return math.nan
    bounds = best.law.bounds(setting.span)
    found = minimise(lambda x: early.bases(best.law, x), best.solution.search, bounds)[0]
    whole = setting.bases(best.law, found.search)[0]
    late = rows >= cut
    error = setting.y[rows[late]] - whole.shared[late] @ found.shared
    spread = float(np.std(setting.y[setting.kept]))
    return 100.0 * (1.0 - float(np.sqrt(np.mean(error**2))) / spread)


def _notes(
    setting: Setting, estimates: dict[str, Estimate], stepped: bool, residuals: Floats
) -> tuple[str, ...]:
    notes = []
    if whiteness_p([residuals]) < _COLOURED:
        notes.append(
            "The residuals are not white: the law does not explain everything (ringing, a delay, "
            "clipping, drift). Intervals and forecasts assume that the law is right. Leave "
            "ringing out with --leave-out-s."
        )
    if setting.step > 0.0:
        notes.append(
            f"The output is quantised in steps of {setting.step:.3g}, which hide its noise. The "
            "intervals allow for the same rounding error in all samples of a run of equal values. "
            "Record more digits, or a larger step of the input."
        )
    spikes = np.abs(residuals) > _SPIKE * 1.4826 * float(np.median(np.abs(residuals)))
    if spikes.any() and setting.step == 0.0:
        notes.append(
            f"{np.count_nonzero(spikes)} of {residuals.size} outputs are more than {_SPIKE:g} "
            "standard deviations away from the law and are not excluded. Remove spikes first."
        )
    blind = [name for name, entry in estimates.items() if not math.isfinite(entry.std)]
    if any(name.endswith("_s") for name in blind):
        notes.append(
            f"The record of {setting.span.duration_s:.4g} s is too short or too noisy for "
            f"{', '.join(blind)}, which are not identifiable. Hold the input longer."
        )
    elif "order" in blind:
        notes.append(
            "Within this record the creep is a straight line, so neither a law nor a time "
            "constant is identifiable. Hold the input longer."
        )
    elif blind:
        notes.append(f"Not identifiable from this record: {', '.join(blind)}.")
    if stepped:
        notes.append(
            "The input steps at the first sample: the output is assumed to be 0 before it, so "
            "`instant` includes any earlier output. Record the time before the step too."
        )
    return tuple(notes)


def _no_result(setting: Setting, reason: str) -> CreepFit:
    return CreepFit(status=f"no result: {reason}", setting=setting)
