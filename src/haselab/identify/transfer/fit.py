"""Transfer function in continuous time from one or several records, with intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import Estimate, InputError, JsonObject, ResultError, checked
from haselab.base.chart import Chart
from haselab.identify.charts import records_chart
from haselab.identify.fit import Prediction, RecordFit, several
from haselab.identify.noise import coloured_covariance, fit_percent
from haselab.identify.prediction import fitted_output, note_range, predict
from haselab.identify.record import Record, finite_vector, record_notes
from haselab.identify.residual_tests import input_correlation_p
from haselab.identify.transfer.bode import bode_panels
from haselab.identify.transfer.checks.ambiguity import OtherMinimum, ambiguity, find_other_minima
from haselab.identify.transfer.checks.diagnosis import Diagnosis, diagnose
from haselab.identify.transfer.checks.preconditions import (
    check_size,
    count_outputs,
    runs_away,
    too_few_tones,
)
from haselab.identify.transfer.checks.remarks import remarks_of
from haselab.identify.transfer.feedback import feedback_p
from haselab.identify.transfer.layout import Layout, TransferStructure, layout_of
from haselab.identify.transfer.oversampled import at_lower_rate
from haselab.identify.transfer.parameters import (
    covariance_table,
    follows_input,
    numbers_of,
    poles_of,
    zeros_of,
)
from haselab.identify.transfer.problem import LEAST_GAIN, TransferProblem
from haselab.identify.transfer.profile import profile_std
from haselab.identify.transfer.search import Best, best_fit, has_line
from haselab.identify.transfer.start import delay_margin_s
from haselab.models import Plant, SlowMode
from haselab.models.posterior import PlantPosterior
from haselab.models.rational import RationalModel

__all__ = ["Record", "TransferFit", "TransferStructure", "fit_transfer", "with_record_notes"]

Floats = NDArray[np.float64]
_HELD_OUT = 0.25
_FILTERED = 1e-3  # of the output: noise that is far above the errors of a filtered record
_SWAPPED = 50.0  # per cent of fit with the columns swapped
_RULED_OUT = 4.0  # times the least cost, at a lower rate: no minimum to be listed
_SAME = 1e-3  # relative difference of two solutions that are one
_LITTLE = 30.0  # per cent of fit
_RELATED = 1e-3
_UNEXPLAINED = (
    "no result: the model explains {:.1f} % of the output, and the residuals still follow the "
    "input; check --input and --output, or fit more poles"
)
_FEEDBACK = 1e-6  # probability below which the input follows the residuals
_NO_DISTURBANCE = 99.0  # per cent of fit above which no disturbance matters
_FED_BACK = (
    "The residuals predict the input. In open loop, the actuator is nonlinear: try --choose "
    "nonlinear or a smaller amplitude. In closed loop, a disturbance biases gain and delay, and "
    "the intervals do not include it: record in open loop."
)
_RESTING = (
    "A step at t = 0 is indistinguishable from an initial state; rest before it is assumed. "
    "Record the time before the step too."
)


@dataclass(frozen=True, kw_only=True)
class TransferFit(RecordFit[Record]):
    """A fitted transfer function; see `Fit` for what all fits have.

    Its `parameters` are `gain`, `natural_frequency_rad_s`, `damping_ratio`, `delay_s`,
    `slow_gain`, `slow_time_constant_s`, and so on.

    Args:
        structure: what was fitted.
        poles: poles, in rad/s; the fast ones first.
        zeros: zeros of the fast part, in rad/s.
        fit_percent: NRMSE fit of all samples.
        residual_whiteness_p: Ljung-Box probability; below 0.05 something is unexplained.
        best: solution of the search; None without a result.
        other_minima: other minima found by the search, with their likelihoods.
        ambiguous: two models explain the records: the fit is good, but its parameters may be wrong.
    """

    structure: TransferStructure
    poles: tuple[complex, ...] = ()
    zeros: tuple[complex, ...] = ()
    fit_percent: float = math.nan
    residual_whiteness_p: float = math.nan
    best: Best | None = field(default=None, repr=False)
    other_minima: tuple[OtherMinimum, ...] = ()
    ambiguous: bool = False

    @property
    def records(self) -> tuple[Record, ...]:
        """The experiments, an unknown input before them replaced by the more likely guess."""
        return () if self.best is None else tuple(self.best.records)

    @property
    def fitted_outputs(self) -> tuple[Floats, ...]:
        """See `RecordFit`."""
        return tuple(record.y for record in self.records)

    @property
    def parameter_count(self) -> int:
        """Count of all fitted parameters, the state and offset of each record included."""
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
        """Probability of such residuals if they are uncorrelated with the input.

        Below 0.05 part of the dynamics is missing from the model.
        """
        if self.best is None:
            return math.nan
        return input_correlation_p(self.records, self.residuals)

    @property
    def slow_modes(self) -> tuple[tuple[Estimate, Estimate], ...]:
        """Gain and time constant of each slow branch."""
        gains = [e for name, e in self.parameters.items() if name.startswith("slow_gain")]
        taus = [e for name, e in self.parameters.items() if name.startswith("slow_time_constant")]
        return tuple(zip(gains, taus, strict=True))

    @property
    def plant(self) -> Plant:
        """The plant with the fitted parameters; a delay estimated below zero becomes zero.

        Raises:
            ResultError: the fit has no result, a parameter is not identifiable, or the fit is not
                one resonance without zeros.
        """
        self._require()
        if self.structure.poles != 2 or self.structure.zeros:
            raise ResultError(
                f"The fit has {self.structure.poles} poles and {self.structure.zeros} zeros; a "
                "Plant needs 2 and 0. Fit again with poles = 2, zeros = 0 and slow modes."
            )
        number = {name: estimate.value for name, estimate in self.parameters.items()}
        blind = [name for name, value in number.items() if math.isnan(value)]
        if blind:
            raise ResultError(
                f"{', '.join(blind)} not identifiable from these records; a Plant needs a value "
                "for each. Add a record that excites them, or fit a simpler structure."
            )
        return Plant(
            number["gain"],
            number["natural_frequency_rad_s"],
            number["damping_ratio"],
            max(number["delay_s"], 0.0),
            tuple(SlowMode(gain.value, tau.value) for gain, tau in self.slow_modes),
        )

    @property
    def rational(self) -> RationalModel:
        """The fit as a rational model, for `margins`, `design_pid` and export.

        Raises:
            ResultError: the fit has no result, or a gain, pole or zero is not identifiable.
        """
        self._require()
        gain, delay_s = (self.parameters[name].value for name in ("gain", "delay_s"))
        if not np.isfinite([gain, delay_s, *self.poles, *self.zeros]).all():
            raise ResultError(
                "A gain, pole, zero or delay is not identifiable from these records; a "
                "model needs values. Add a record that excites them, or fit a simpler structure."
            )
        fast = self.poles[: self.structure.poles]
        model = RationalModel.from_poles(fast, self.zeros, gain, max(delay_s, 0.0))
        return model.beside([SlowMode(g.value, tau.value) for g, tau in self.slow_modes])

    @property
    def posterior(self) -> PlantPosterior:
        """The parameters with their covariance, from which `design_controller` draws plants.

        Raises:
            InputError: a parameter is not identifiable.
            ResultError: the fit has no result.
        """
        self._require()
        return PlantPosterior.from_dict(covariance_table(self.parameters, self.covariance))

    @property
    def input_range(self) -> tuple[float, float] | None:
        """Lowest and highest input of the records; None without records."""
        inputs = [record.u for record in self.records]
        if not inputs:
            return None
        return min(float(u.min()) for u in inputs), max(float(u.max()) for u in inputs)

    @property
    def _spread(self) -> PlantPosterior | None:
        """The posterior; None if a parameter is not identifiable."""
        return None if np.isinf(self.covariance).any() else self.posterior

    @property
    def _linear_records(self) -> tuple[Record, ...]:
        """Records of input and output of the linear model, for its frequency response."""
        return self.records

    @checked
    def simulate(self, u: ArrayLike, rate_hz: float | None = None) -> Floats:
        """See `RecordFit`."""
        inputs = finite_vector("u", u, 1)
        rate = self._rate_hz(rate_hz)
        return self.rational.simulate(inputs, rate, np.arange(inputs.size) / rate)

    @checked
    def compare(self, records: Record | Sequence[Record]) -> Prediction:
        """See `RecordFit`; the band is that of the covariance and of the residuals."""
        found = predict(
            self.rational,
            several(records),
            posterior=self._spread,
            noise_std=float(np.std(np.concatenate(self.residuals))),
            training_output=self.training_output,
            rng=np.random.default_rng(1),
        )
        return note_range(found, records, self.input_range)

    def _modelled(self, record: Record) -> tuple[Floats, Floats]:
        return record.y, fitted_output(self.rational, record)

    def _rate_hz(self, rate_hz: float | None) -> float:
        """The rate given, else that of the first record."""
        if rate_hz is None and not self.records:
            raise InputError("The fit has no record, so its rate is not known. Give rate_hz.")
        return self.records[0].input_rate_hz if rate_hz is None else rate_hz

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """See `Fit`."""
        self._present(self.records or None)
        title = f"Transfer function, fit {self.fit_percent:.1f} %"
        chart = records_chart(title, self.records, self.residuals, names)
        try:
            model = self.rational
        except ResultError:  # a parameter is not identifiable
            return chart
        bode = bode_panels(model, self._spread, self._linear_records, names)
        return Chart(title, (*chart.panels, *bode), shared_x=False)

    def answer(self) -> JsonObject:
        """The result under its public JSON keys."""
        keys = ("natural_frequency_rad_s", "damping_ratio", "gain", "delay_s")
        known = self.training_output
        residuals = np.concatenate(self.residuals) if self.residuals else np.zeros(0)
        return {
            **{key: self.parameters.get(key) for key in keys},
            "poles": list(self.poles),
            "zeros": list(self.zeros),
            "slow_modes": [{"gain": gain, "time_constant_s": tau} for gain, tau in self.slow_modes],
            "fit_percent": self.fit_percent,
            "validation_fit_percent": self.validation_fit_percent,
            "residual_whiteness_p": self.residual_whiteness_p,
            "input_correlation_p": self.input_correlation_p,
            "status": self.status,
            "notes": list(self.notes),
            "covariance": covariance_table(self.parameters, self.covariance),
            "residual_std": float(np.sqrt(np.mean(residuals**2))) if residuals.size else None,
            "training_output": None if known is None else known.to_dict(),
            "input_range": self.input_range,
            "other_minima": [
                {"numbers": r.numbers, "log_likelihood_below": r.log_likelihood_below}
                for r in self.other_minima
            ],
        }


@checked
def fit_transfer(
    records: Record | Sequence[Record],
    structure: TransferStructure | None = None,
    *,
    applied: bool = False,
    near: TransferFit | None = None,
) -> TransferFit:
    r"""Fit one transfer function to all records, each with its own initial state and offset.

    $\min_{\theta, c} \sum_r \lVert y_r - \Phi_r(\theta)\, c \rVert^2$: the poles and the delay are
    searched, gains, states and offsets are solved for. The input is interpolated by its actual
    hold; the output is predicted exactly at its own times. No initial guess is needed.

    Args:
        records: experiments, or one; a chirp and a step together identify the fast and the slow
            part.
        structure: model structure. Default: one resonance with a delay.
        applied: whether the inputs are known to have been applied as recorded, by the same clock:
            a clipped or slew-limited input and a drifting clock are then not considered as causes.
        near: fit of the same structure to almost the same records: the search starts there alone,
            ends nearer to the minimum, and looks for no other. If `near` excludes no output and
            `applied` is true, spikes and clipped outputs are not searched for. None, or a fit
            without a result: the search starts anew.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: no record, or fewer samples than parameters to fit.
    Source: variable projection, Golub and Pereyra (1973) and Kaufman (1975); intervals from the
        covariance for the noise model of the residuals.
    Example:
        >>> from haselab.models import Plant
        >>> rng = np.random.default_rng(7)
        >>> u, time_s = rng.normal(size=1000), np.arange(4000) / 400.0
        >>> y = Plant(0.5, 5.11, 0.09, 0.012).simulate(u, 100.0, time_s)
        >>> y = y + 0.01 * rng.normal(size=4000)
        >>> fit = fit_transfer(Record(u, 100.0, y, time_s))
        >>> low, high = fit.parameters["natural_frequency_rad_s"].ci95
        >>> fit.status, low < 5.11 < high
        ('ok', True)
    """
    records, structure = several(records), structure or TransferStructure()
    return with_record_notes(_fitted(records, structure, applied=applied, near=near), records)


def with_record_notes(fit: TransferFit, records: Sequence[Record]) -> TransferFit:
    """Add the notes of the records to a fit.

    Args:
        fit: with or without a result.
        records: that were fitted.
    Returns:
        The same fit with further `notes`; unchanged without a result.
    """
    notes = record_notes(records, fit.parameters.get("delay_s")) if fit.succeeded else ()
    return replace(fit, notes=(*fit.notes, *notes))


def _fitted(
    records: Sequence[Record],
    structure: TransferStructure,
    *,
    applied: bool,
    near: TransferFit | None,
) -> TransferFit:
    """Fit the records; if the result is in doubt, test other explanations of them."""
    slower = at_lower_rate(records, structure.poles)
    tones = too_few_tones(layout_of(structure), slower or records)
    if tones is not None:
        return _no_result(layout_of(structure), tones)
    fit = _fit(layout_of(structure), records, slower, applied=applied, near=near)
    if _doubtful(fit):
        why = _why(structure, records)
        fit = fit if why is None else replace(fit, status=why, ambiguous=False)
    if fit.succeeded and fit.fit_percent < _LITTLE and fit.input_correlation_p < _RELATED:
        fit = replace(fit, status=_UNEXPLAINED.format(fit.fit_percent))
    if fit.succeeded and _is_fed_back(fit):
        fit = replace(fit, notes=(*fit.notes, _FED_BACK))
    alone = all(np.ptp(record.u) == 0.0 for record in records)
    if fit.succeeded or not (structure.initial_state and alone):
        return fit
    # One step at t = 0 looks like a free decay from another state, so rest has to be assumed.
    at_rest = layout_of(replace(structure, initial_state=False))
    fit = _fit(at_rest, records, slower, applied=applied)
    return replace(fit, notes=(*fit.notes, _RESTING))


def _fit(
    layout: Layout,
    records: Sequence[Record],
    slower: Sequence[Record] | None,
    *,
    applied: bool,
    near: TransferFit | None = None,
) -> TransferFit:
    """Search the parameters, from a near fit if there is one, then describe the result.

    `slower` are the records at a lower rate, if they can be filtered.
    """
    check_size(layout, records)
    known = [] if near is None or near.best is None else [near.best.found.search]
    slower = None if known else slower
    best = _search(layout, records if slower is None else slower, known)
    if best is None:
        return _no_result(layout, "no stable model found; record longer, or fit fewer poles")
    if slower is not None:
        return _describe_all(layout, records, best, applied=applied)
    whole = (
        near is not None
        and near.succeeded
        and count_outputs(near.records) == count_outputs(records)
    )
    if applied and whole:  # the fit nearby had no output to exclude
        return _describe(layout, best)
    found = diagnose(layout, best, applied=applied)
    fit = _describe(layout, found.best)
    if found.fault is not None:
        fit = replace(fit, status=found.fault, ambiguous=False)
    return replace(fit, notes=(*fit.notes, *found.notes))


def _search(layout: Layout, records: Sequence[Record], known: Sequence[Floats]) -> Best | None:
    """The best solution over the guesses of inputs before the records."""
    tried: list[Best] = []
    for variant in _variants(records):
        found_before = [one.search for best in tried for one in (best.found, *best.others[:2])]
        starts = [*known, *found_before]
        search = best_fit(layout, variant, starts, 0.0 if known else LEAST_GAIN)
        tried += [] if search is None else [search]
    return min(tried, key=lambda entry: entry.found.cost, default=None)


def _describe_all(
    layout: Layout, records: Sequence[Record], best: Best, *, applied: bool
) -> TransferFit:
    """Describe a fit to all outputs, which starts at the solution for a lower rate.

    Spikes, clipping and wrong times are searched for at the lower rate; what is found there, in all
    outputs, too.
    """
    found = diagnose(layout, best, applied=applied)
    whole = _search(layout, records, _worth_a_search(best))
    if whole is None:
        return _no_result(layout, "no stable model found; record longer, or fit fewer poles")
    if found.cause is not None or found.notes:
        found = _confirmed(layout, whole, found.cause, applied=applied)
        whole = found.best
    noise = math.sqrt(best.found.cost / count_outputs(best.records))
    if noise > _FILTERED * max(float(np.std(record.y)) for record in best.records):
        # At the lower rate, the test sees slow residuals that are small beside the noise.
        whole = replace(whole, whiteness_p=min(whole.whiteness_p, best.whiteness_p))
    fit = _describe(layout, whole)
    if found.fault is not None:
        fit = replace(fit, status=found.fault, ambiguous=False)
    return replace(fit, notes=(*fit.notes, *found.notes))


def _confirmed(layout: Layout, best: Best, cause: str | None, *, applied: bool) -> Diagnosis:
    """What explains the residuals of all outputs: first what was found at a lower rate."""
    if cause is None:  # spikes alone
        return diagnose(layout, best, applied=applied, causes=())
    found = diagnose(layout, best, applied=applied, causes=[cause])
    return diagnose(layout, best, applied=applied) if found.cause is None else found


def _worth_a_search(best: Best) -> list[Floats]:
    """The solution and others that differ from it and may be nearly as likely."""
    kept: list[Floats] = []
    for one in (best.found, *best.others):
        new = not any(np.allclose(one.search, other, _SAME, 1e-6) for other in kept)
        if new and one.cost <= _RULED_OUT * best.found.cost:
            kept.append(one.search)
    return kept


def _is_fed_back(fit: TransferFit) -> bool:
    """Whether disturbances came back through the input; white ones do not bias the fit."""
    if fit.residual_whiteness_p >= _RELATED or fit.fit_percent > _NO_DISTURBANCE:
        return False
    return feedback_p(fit.records, fit.residuals) < _FEEDBACK


def _doubtful(fit: TransferFit) -> bool:
    """Whether the columns may be swapped: the fit explains little or has no result."""
    if fit.succeeded or fit.ambiguous:
        return fit.fit_percent < _SWAPPED and fit.residual_whiteness_p < _RELATED
    return not math.isfinite(fit.fit_percent)


def _why(structure: TransferStructure, records: Sequence[Record]) -> str | None:
    """Cause of a fit without a result, if it can be detected."""
    if any(runs_away(record) for record in records):
        return (
            "no result: the output grows to the end of the record, so the plant is not stable "
            "there; cut the record, or close a loop around it"
        )
    if all(record.u.size == record.y.size and np.ptp(record.u) > 0.0 for record in records):
        turned = [Record.sampled(r.y, r.u, r.input_rate_hz) for r in records]
        backwards_layout = layout_of(replace(structure, delay=0.0, fixed={}))
        slower = at_lower_rate(turned, structure.poles)
        backwards = _fit(backwards_layout, turned, slower, applied=True)
        if backwards.succeeded and backwards.fit_percent > _SWAPPED:
            return "no result: the input responds to the output; the columns are swapped"
    return None


def _variants(records: Sequence[Record]) -> list[list[Record]]:
    """The records with each guess of an unknown input before the record."""
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
    return TransferFit(status=f"no result: {reason}", structure=layout.structure)


def _describe(layout: Layout, best: Best, rounds: int = 3) -> TransferFit:
    """Parameters with intervals, status and notes."""
    records, found = best.records, best.found
    residuals = best.columns.residuals
    own = sum(factors.size for factors in found.own)
    parameters = found.search.size + found.shared.size + own
    inner = coloured_covariance(best.columns.sensitivities, residuals, parameters, best.columns.own)
    if not found.settled:
        return _no_result(layout, "the search did not converge; record longer or fit fewer poles")
    if found.shared.size and not np.isfinite(np.diag(inner)[-found.shared.size :]).any():
        return _no_result(
            layout, "no gain is identifiable; fit fewer poles or zeros, or give the delay"
        )
    if not follows_input(best):
        return _no_result(
            layout, "the output does not respond to the input; check the columns and the sensor"
        )
    size = found.search.size
    factors, better = profile_std(layout, best, np.sqrt(np.maximum(np.diag(inner)[:size], 0.0)))
    if better is not None and rounds and not has_line(layout, better.found.search):
        return _describe(layout, better, rounds - 1)
    if better is not None:  # a nearly undamped pair fits noise as well as a resonance does
        best = replace(best, others=(better.found, *best.others))
    inner[:size] *= factors[:, np.newaxis]
    inner[:, :size] *= factors
    modelled = tuple(r.y - e for r, e in zip(records, residuals, strict=True))
    numbers = layout.full(found.search)
    estimates, covariance, notes = numbers_of(layout, best, inner)
    problem = TransferProblem(layout, records, delay_margin_s(records))
    other_minima: tuple[OtherMinimum, ...] = ()
    if best.others:
        other_minima = find_other_minima(layout, problem, residuals, best.others, estimates)
    doubt = ambiguity(other_minima, estimates)
    return TransferFit(
        status=doubt or "ok",
        structure=layout.structure,
        parameters=estimates,
        covariance=covariance,
        poles=poles_of(layout, numbers, estimates),
        zeros=zeros_of(layout, numbers, found),
        fit_percent=fit_percent([r.y for r in records], modelled),
        residual_whiteness_p=best.whiteness_p,
        residuals=tuple(residuals),
        notes=(*notes, *remarks_of(layout.structure, best, estimates)),
        best=best,
        other_minima=other_minima,
        ambiguous=bool(doubt),
    )


def _validation(layout: Layout, best: Best) -> float:
    """NRMSE fit of the last quarter, simulated with a fit to the first three."""
    records, share = best.records, 1.0 - _HELD_OUT
    cuts = [int(record.y.size * share) for record in records]
    if any(cut < 8 or np.ptp(r.y[:cut]) == 0.0 for r, cut in zip(records, cuts, strict=True)):
        return math.nan
    margin_s = delay_margin_s(records)
    training = TransferProblem(layout, records, margin_s, share)
    fit = training.minimise(best.found.search, best.bounds, gain=1e-7)
    predicted = TransferProblem(layout, records, margin_s).predict(fit)
    return fit_percent(
        [record.y[cut:] for record, cut in zip(records, cuts, strict=True)],
        [output[cut:] for output, cut in zip(predicted, cuts, strict=True)],
    )
