"""Hysteresis from loops: model choice, parameters, and the benefit of the inverse."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import Estimate, InputError, JsonObject, checked
from haselab.base.chart import Chart
from haselab.identify.charts import loop_chart
from haselab.identify.clipped import clipping_of
from haselab.identify.fit import RecordFit, rescaled, several
from haselab.identify.hysteresis.lag import fit_lag
from haselab.identify.hysteresis.loops import (
    LoopRecord,
    LoopWidth,
    band_widths,
    common_curve,
    mean_width,
)
from haselab.identify.hysteresis.parameters import hysteresis_estimates, model_of
from haselab.identify.hysteresis.prandtl_ishlinskii import PlayFamily, simplified
from haselab.identify.hysteresis.problem import Family, HysteresisProblem, Numbers, Scale
from haselab.identify.hysteresis.search import (
    BOUC_WEN,
    CURVE,
    ONE_RATE,
    PLAYS,
    Candidate,
    rate_spread,
    rounding_floor,
    search_hysteresis,
)
from haselab.identify.model_choice import APART, effective_count, is_decisive
from haselab.identify.noise import fit_percent, whiteness_p
from haselab.identify.record import finite_vector
from haselab.models.hysteresis.common import Hysteresis

__all__ = ["HysteresisFit", "LoopRecord", "fit_hysteresis"]

Floats = NDArray[np.float64]
_KINDS = {"auto": (PLAYS, BOUC_WEN), PLAYS: (PLAYS,), BOUC_WEN: (BOUC_WEN,)}
_NONE = "no hysteresis visible"
_UNSURE = "cannot tell"
_ROWS = 20_000
_HELD_OUT = 0.25
_MOST_OPERATORS = 20
_COLOURED = 0.01
_OTHER_FORM = 1e-12  # whiteness p-value below which residuals may be loops of another form
_EXACT = 1e-9  # of the output's span
_AS_ROUNDING = 1.5  # mean square over that of rounding errors, below which residuals are rounding
_TOLD = 3.0  # standard deviations of a significant loop width
LAG = "linear lag"
_LAG = (
    "A linear first-order lag of {0.time_constant_s:.3g} s explains the loops {0.how}. Their width "
    "then depends on the rate, and this model is valid at this rate only. Try `identify transfer`."
)
_BIPOLAR = 0.2  # smallest ratio of the drive's smaller side to its larger side
_SQUARABLE = (1e-150, 1e150)  # inputs whose squares do not overflow
LINEAR, SQUARE = "u", "u squared"
_UNKNOWN = Estimate(math.nan, math.inf, (-math.inf, math.inf), "")
_BUTTERFLY = (
    "The output follows the square of the drive (a butterfly): the model and its thresholds apply "
    "to u squared. Square the drive before the model, and take the square root after its inverse."
)


@dataclass(frozen=True, kw_only=True)
class HysteresisFit(RecordFit[LoopRecord]):
    """A fitted hysteresis model; see `Fit` for what all fits have.

    Args:
        kind: the reported model: the requested one, otherwise the best of curve,
            prandtl-ishlinskii and bouc-wen.
        verdict: the model that the data support, "no hysteresis visible", "linear lag", or
            "cannot tell".
        records: what was fitted.
        bic: criterion of each kind's best model relative to the lowest.
        cycles: width of each cycle's loop.
        width: mean of these, in the unit of the output; positive where the output lags.
        relative_width: the same over the span of the output.
        reduction: mean distance of the branches before over that after compensation by the model:
            the benefit of the inverse on such loops; noise makes it smaller.
        fit_percent: NRMSE fit of the samples whose memory state is known.
        validation_fit_percent: NRMSE fit of the last quarter of each record, by the same model
            fitted to the rest. NaN where the rest is too short.
        residual_whiteness_p: Ljung-Box probability; below 0.05 something is unexplained.
        fitted: the model. None: no result.
        drive: input of the model: "u", or "u squared" for a butterfly under a bipolar drive.
    """

    kind: str = ""
    verdict: str = ""
    records: tuple[LoopRecord, ...] = field(repr=False)
    bic: dict[str, float] = field(default_factory=dict)
    cycles: tuple[LoopWidth, ...] = ()
    width: Estimate = _UNKNOWN
    relative_width: Estimate = _UNKNOWN
    reduction: float = math.nan
    fit_percent: float = math.nan
    validation_fit_percent: float = math.nan
    residual_whiteness_p: float = math.nan
    fitted: Hysteresis | None = None
    drive: str = LINEAR

    @property
    def model(self) -> Hysteresis:
        """The model, to simulate and to invert.

        Raises:
            ResultError: the fit has no result.
        """
        return self._present(self.fitted)

    @property
    def fitted_outputs(self) -> tuple[Floats, ...]:
        """See `RecordFit`."""
        return tuple(record.y for record in self.records)

    @checked
    def simulate(self, u: ArrayLike, rate_hz: float | None = None) -> Floats:
        """See `RecordFit`; the memory is that of rest at the first value of the input."""
        inputs = self._driven(finite_vector("u", u, 1))
        rate = self.records[0].rate_hz if rate_hz is None else rate_hz
        return self.model.simulate(inputs, rate, float(inputs[0]))

    def _driven(self, u: Floats) -> Floats:
        """The input as the model takes it."""
        return u**2 if self.drive == SQUARE else u

    def _modelled(self, record: LoopRecord) -> tuple[Floats, Floats]:
        modelled = self.simulate(record.u, record.rate_hz)
        counted = record.settled()
        left = (record.y - modelled)[counted]
        return record.y[counted], modelled[counted] + left.mean()

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """See `Fit`."""
        loops = [(r.u, r.y, r.y - e) for r, e in zip(self.records, self.residuals, strict=True)]
        title = f"Hysteresis, {self.kind}"
        return loop_chart(title, names or ("Input", "Output"), loops)

    def answer(self) -> JsonObject:
        """The result as a dictionary for JSON."""
        return {
            "model": self.kind,
            "drive": self.drive,
            "verdict": self.verdict,
            "parameters": self.parameters,
            "rate_filter_s": getattr(self.fitted, "rate_filter_s", None),
            "dead_zone_thresholds": list(self.fitted.dead_zones.thresholds) if self.fitted else [],
            "width": self.width,
            "relative_width": self.relative_width,
            "cycles": [cycle.to_dict() for cycle in self.cycles],
            "reduction": self.reduction,
            "bic": self.bic,
            "fit_percent": self.fit_percent,
            "validation_fit_percent": self.validation_fit_percent,
            "residual_whiteness_p": self.residual_whiteness_p,
            "status": self.status,
            "notes": list(self.notes),
        }


@checked
def fit_hysteresis(
    records: LoopRecord | Sequence[LoopRecord],
    model: str = "auto",
    *,
    operators: int | None = None,
) -> HysteresisFit:
    r"""Fit an invertible hysteresis model, and test whether the data support it.

    If the output follows the square of a bipolar drive (strain of a dielectric actuator),
    the models are fitted to the square, if that explains more.

    Candidates are a curve without memory, play operators (rate-dependent if the records have
    several rates) and a Bouc-Wen memory, each followed by dead zones. BIC chooses the dead zones,
    the number of operators and the kind; a difference below 6 is "cannot tell". Samples count after
    the input has covered its range once.

    Args:
        records: loops, or one; several rates tell the rate dependence.
        model: auto, prandtl-ishlinskii or bouc-wen.
        operators: number of play operators, 1 to 20; None: chosen by BIC.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: no record, an unknown model, a number of operators outside its range.
    Source: output-error least squares; Kuhnen (2003) for the operators, Ikhouane and Rodellar
        (2007) for Bouc-Wen; intervals from the covariance for the noise model of the residuals.
    Example:
        >>> from haselab.models import PrandtlIshlinskii
        >>> u = np.tile(np.concatenate([np.linspace(0, 2, 150), np.linspace(2, 0, 150)]), 3)
        >>> y = PrandtlIshlinskii(1.0, (0.2, 0.5), (0.4, 0.3)).simulate(u)
        >>> y = y + 0.005 * np.random.default_rng(1).normal(size=u.size)
        >>> fit = fit_hysteresis([LoopRecord(u, y, 100.0)])
        >>> low, high = fit.parameters["threshold_1"].ci95
        >>> fit.verdict, low < 0.2 < high
        ('prandtl-ishlinskii', True)
    """
    records = several(records)
    _check(model, operators)
    fit = _fitted(records, model, operators)
    if all(_follows_square(record) for record in records):
        squared = [replace(record, u=record.u**2) for record in records]
        other = _fitted(squared, model, operators)
        better = not fit.succeeded or other.fit_percent > fit.fit_percent
        if other.succeeded and better:
            return replace(
                other, drive=SQUARE, records=tuple(records), notes=(*other.notes, _BUTTERFLY)
            )
    return fit


def _follows_square(record: LoopRecord) -> bool:
    """Whether the output follows the square of a bipolar drive rather than the drive."""
    u, peak = record.u, float(np.abs(record.u).max())
    if not u.min() < -_BIPOLAR * u.max() or not u.max() > -_BIPOLAR * u.min():
        return False
    if not _SQUARABLE[0] < peak < _SQUARABLE[1]:
        return False
    y = record.y - record.y.mean()
    straight, square = (column - column.mean() for column in (u / peak, (u / peak) ** 2))
    one, two = (
        abs(float(c @ y)) / (math.sqrt(float(c @ c)) or math.inf) for c in (straight, square)
    )
    return two > one


def _fitted(records: Sequence[LoopRecord], model: str, operators: int | None) -> HysteresisFit:
    """Fit the models to the records' own input."""
    scale = Scale.of(records)
    thinned, found = search_hysteresis(records, scale, _KINDS[model], operators)
    scores = {kind: candidate.bic for kind, candidate in found.items()}
    lowest = min(scores.values())
    scores = {kind: score - lowest for kind, score in scores.items()}
    best = min(scores, key=lambda name: scores[name])
    verdict = best if is_decisive(scores) else _UNSURE
    verdict = _NONE if verdict == CURVE else verdict
    given = best if model == "auto" or model not in found else model
    fit = _describe(records, scale, found[given], rate_spread(thinned))
    if verdict == _NONE and abs(fit.width.value) > _TOLD * fit.width.std:
        verdict = _UNSURE  # there is a loop, but no model describes it
    if verdict in (PLAYS, BOUC_WEN) and fit.reduction < 1.0:
        verdict = _UNSURE  # the model's loop is larger than the recorded one
    if not fit.succeeded:
        return fit
    notes = fit.notes
    if verdict != _NONE and (lag_fit := fit_lag(records, fit.residuals, len(fit.parameters))):
        lead = lag_fit.lead
        verdict = LAG if lead > APART else _UNSURE if lead > -APART else verdict
        notes = (*notes, _LAG.format(lag_fit)) if lead > -APART else notes
    return replace(fit, verdict=verdict, bic=scores, notes=notes)


def _check(model: str, operators: int | None) -> None:
    if model not in _KINDS:
        raise InputError(f"model = {model}; it must be one of {', '.join(_KINDS)}.")
    if operators is not None and not 1 <= operators <= _MOST_OPERATORS:
        raise InputError(f"operators = {operators}; it must be 1 to {_MOST_OPERATORS}.")


def _describe(
    records: Sequence[LoopRecord], scale: Scale, chosen: Candidate, spread: float
) -> HysteresisFit:
    """The chosen model on all rows, with status and notes."""
    masks = [record.settled() for record in records]
    problem = HysteresisProblem(records, scale, masks, _ROWS)
    start, family = chosen.solved.numbers, chosen.family
    numbers = problem.solve(family, start, steps=60, gain=1e-9).numbers
    while isinstance(family, PlayFamily):
        fewer, start = simplified(family, numbers)
        if fewer == family:
            break
        family, numbers = fewer, problem.solve(fewer, start, steps=60, gain=1e-9).numbers
    estimates, covariance = hysteresis_estimates(problem, family, numbers)
    if chosen.kind == PLAYS and spread < ONE_RATE:
        estimates["rate_dependence_s"] = replace(_UNKNOWN, unit="s")
        missing = len(estimates) - covariance.shape[0]
        covariance = np.pad(covariance, (0, missing), constant_values=np.inf)
    fitted = model_of(family, numbers, scale)
    residuals = tuple(r.y - fitted.simulate(r.u, r.rate_hz, float(r.u[0])) for r in records)
    counted = [e[mask] for e, mask in zip(residuals, masks, strict=True)]
    measured = [r.y[mask] for r, mask in zip(records, masks, strict=True)]
    clipped = next(filter(None, (clipping_of(r.y[r.first :], "outputs") for r in records)), "")
    if clipped or not _related(measured, counted):
        reason = clipped or "the output does not follow the input; check the columns"
        reason = f"no result: {reason}"
        return HysteresisFit(status=reason, records=tuple(records))
    modelled = [  # a model with an unknown past may start outside the range of the outputs
        np.clip(r.y - e, r.y.min(), r.y.max())[r.first :]
        for r, e in zip(records, residuals, strict=True)
    ]
    span = float(np.ptp(np.concatenate(modelled))) or 1.0  # raw outputs would include noise
    cycles, white = tuple(band_widths(records, span)), whiteness_p(counted)
    width, relative = _means(cycles, span)
    before, after = mean_width(records, common_curve(records)), mean_width(records, residuals)
    return HysteresisFit(
        status="ok",
        parameters=estimates,
        covariance=rescaled(covariance, np.array([entry.std for entry in estimates.values()])),
        residuals=residuals,
        notes=_notes(records, masks, residuals, chosen, estimates, fitted, spread, white, cycles),
        kind=chosen.kind,
        records=tuple(records),
        cycles=cycles,
        width=width,
        relative_width=relative,
        reduction=before / after if after > 0.0 else math.nan,
        fit_percent=fit_percent(measured, [y - e for y, e in zip(measured, counted, strict=True)]),
        validation_fit_percent=_validation(records, scale, family, numbers),
        residual_whiteness_p=white,
        fitted=fitted,
    )


def _related(measured: Sequence[Floats], residuals: Sequence[Floats]) -> bool:
    """Whether the BIC of the model beats that of a constant by more than 6."""
    worth = effective_count(residuals)
    cost = sum(float(e @ e) for e in residuals)
    spread = sum(float(((y - y.mean()) ** 2).sum()) for y in measured)
    return spread > cost * math.exp((APART + 2.0 * math.log(worth)) / worth)


def _means(cycles: tuple[LoopWidth, ...], span: float) -> tuple[Estimate, Estimate]:
    """Mean width of all cycles, absolute and relative."""
    if not cycles:
        return _UNKNOWN, _UNKNOWN
    std = math.sqrt(sum(cycle.width.std**2 for cycle in cycles)) / len(cycles)
    mean = Estimate.normal(sum(cycle.width.value for cycle in cycles) / len(cycles), std, "")
    return mean, mean.scaled(1.0 / span, "")


def _validation(
    records: Sequence[LoopRecord], scale: Scale, family: Family, numbers: Numbers
) -> float:
    """NRMSE fit of the last quarter, simulated by a fit to the rows before it."""
    masks = [record.settled() for record in records]
    cuts = [round((1.0 - _HELD_OUT) * record.u.size) for record in records]
    early = [mask & (np.arange(mask.size) < cut) for mask, cut in zip(masks, cuts, strict=True)]
    if sum(int(mask.sum()) for mask in early) < 2 * numbers.vector.size:
        return math.nan
    problem = HysteresisProblem(records, scale, early, _ROWS)
    fitted = model_of(family, problem.solve(family, numbers).numbers, scale)
    modelled = [fitted.simulate(r.u, r.rate_hz, float(r.u[0])) for r in records]
    return fit_percent(
        [record.y[cut:] for record, cut in zip(records, cuts, strict=True)],
        [y[cut:] for y, cut in zip(modelled, cuts, strict=True)],
    )


def _is_rounding(
    records: Sequence[LoopRecord],
    residuals: Sequence[Floats],
    masks: Sequence[NDArray[np.bool_]],
) -> bool:
    """Whether the residuals are no larger than the rounding errors of the outputs."""
    outputs = np.concatenate([record.y for record in records])
    square = float(
        np.mean(np.concatenate([e[m] for e, m in zip(residuals, masks, strict=True)]) ** 2)
    )
    exact = square < (_EXACT * float(np.ptp(outputs))) ** 2
    return exact or square < _AS_ROUNDING * rounding_floor(outputs, square)


def _notes(
    records: Sequence[LoopRecord],
    masks: Sequence[NDArray[np.bool_]],
    residuals: Sequence[Floats],
    chosen: Candidate,
    estimates: dict[str, Estimate],
    fitted: Hysteresis,
    spread: float,
    white: float,
    cycles: tuple[LoopWidth, ...],
) -> tuple[str, ...]:
    notes = []
    blind = [name for name, entry in estimates.items() if not math.isfinite(entry.std)]
    if chosen.kind == PLAYS and spread < ONE_RATE:
        notes.append(
            "The records hold one rate of the input, so the rate dependence is not identifiable; "
            "record loops at two rates or more."
        )
        blind = [name for name in blind if name != "rate_dependence_s"]
    if _is_rounding(records, residuals, masks):
        notes.append(
            "The residuals are no larger than the rounding of the output. Smaller effects are not "
            "identifiable: record more digits."
        )
    elif white < _COLOURED:
        notes.append(
            "The residuals are coloured: something other than hysteresis is left, such as creep or "
            "a resonance; the intervals treat it as noise. Record slower loops."
        )
        if chosen.kind != CURVE and white < _OTHER_FORM:
            notes.append(
                "The loops may also have another form than the model. Its operators and dead "
                "zones, their number, thresholds and weights, then only approximate these loops, "
                "and differ for another record or on another computer. Use the model as a whole."
            )
    if blind:
        notes.append(f"Not identifiable from these loops: {', '.join(blind)}.")
    if not cycles:
        notes.append("The input has no whole cycles, so no loop width is reported.")
    if any(mask.all() for mask in masks) and chosen.kind != CURVE:
        notes.append(
            "A record has only about one cycle, so a zero memory state is assumed before it. "
            "Record two cycles or more."
        )
    obstacle = fitted.obstacle(max(record.rate_hz for record in records))
    if obstacle:
        notes.append(f"No inverse: {obstacle}")
    return tuple(notes)
