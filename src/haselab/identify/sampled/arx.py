"""Difference equation from a sampled record by least squares (ARX)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import Estimate, InputError, JsonObject, ResultError, checked
from haselab.base.chart import Chart
from haselab.base.estimate import Z95
from haselab.identify.clipped import clipping_of
from haselab.identify.fit import RecordFit
from haselab.identify.noise import fit_percent, whiteness_p
from haselab.identify.record import Record, finite_vector
from haselab.identify.sampled.arx_bias import instrumental_coefficients
from haselab.identify.sampled.arx_equation import (
    SEARCH_DELAY,
    ArxOrders,
    Solved,
    chosen_orders,
    criteria_of,
    has_constant,
    solve,
)
from haselab.identify.sampled.record import (
    check_same_rate,
    sampled_chart,
    single_driven_record,
    single_record,
)
from haselab.identify.sampled.responds import responds
from haselab.models import ArxModel
from haselab.models.filters import lfilter

__all__ = ["ArxFit", "fit_arx"]

Floats = NDArray[np.float64]
_CRITERIA = ("bic", "aic")
_WHITE = 0.05
_COLOURED = 1e-3  # whiteness below which a difference from unbiased coefficients counts
_BIASED = 1.5  # times the error of a simulation with unbiased coefficients: no result
_UNKNOWN = (-math.inf, math.inf)


@dataclass(frozen=True, kw_only=True)
class ArxFit(RecordFit[Record]):
    """A fitted difference equation; see `Fit` for what all fits have.

    Its `parameters` are `a_1`, `a_2`, ..., `b_1`, `b_2`, ...; its `residuals` are the prediction
    errors from sample `orders.memory` on.

    Args:
        orders: its size.
        model: the equation about the operating point; None without a result.
        record: what was fitted.
        operating_point: input and output that were subtracted.
        fit_percent: of the simulated output, initial state fitted.
        prediction_fit_percent: of the output predicted one sample ahead.
        validation_fit_percent: simulation of the last quarter with a fit to the first three.
        residual_whiteness_p: of the prediction errors.
        aic: Akaike's criterion.
        bic: Schwarz's criterion.
    """

    orders: ArxOrders
    model: ArxModel | None
    record: Record = field(repr=False)
    operating_point: tuple[float, float]
    fit_percent: float
    prediction_fit_percent: float
    validation_fit_percent: float
    residual_whiteness_p: float
    aic: float
    bic: float

    @property
    def fitted_outputs(self) -> tuple[Floats, ...]:
        """See `RecordFit`."""
        return (self.record.y,)

    def _fitted(self) -> ArxModel:
        return self._present(self.model)

    @property
    def a(self) -> tuple[Estimate, ...]:
        """Coefficients of the earlier outputs."""
        return tuple(self.parameters.values())[: self._fitted().a.size]

    @property
    def b(self) -> tuple[Estimate, ...]:
        """Coefficients of the inputs."""
        return tuple(self.parameters.values())[self._fitted().a.size :]

    @property
    def static_gain(self) -> Estimate:
        """Static gain: output per input in steady state, with Fieller's interval.

        Not identifiable if the poles may as well be those of an integrator.
        """
        model = self._fitted()
        above, below = float(model.b.sum()), float(model.denominator.sum())
        sums = np.zeros((2, self.orders.na + self.orders.nb))
        sums[0, self.orders.na :], sums[1, : self.orders.na] = 1.0, 1.0
        (by_b, both), (_, by_a) = sums @ self.covariance @ sums.T
        # All gains g for which above - g below is within 1.96 of its standard deviations of 0.
        square = below**2 - Z95**2 * by_a
        middle = above * below - Z95**2 * both
        root = middle**2 - square * (above**2 - Z95**2 * by_b)
        if not square > 0.0 or not root >= 0.0:
            return Estimate(math.nan, math.inf, _UNKNOWN, "")
        gain = above / below
        spread = max(float(by_b - 2.0 * gain * both + gain**2 * by_a), 0.0)
        ends = (middle - math.sqrt(root)) / square, (middle + math.sqrt(root)) / square
        return Estimate(gain, math.sqrt(spread) / abs(below), (float(ends[0]), float(ends[1])), "")

    @property
    def modes(self) -> tuple[JsonObject, ...]:
        """Poles in continuous time, the slowest first, with frequency and damping or time constant.

        A pole at z <= 0 has no counterpart and is left out.
        """
        model, found = self._fitted(), []
        for z in sorted(model.poles, key=lambda pole: -abs(pole)):
            real = abs(z.imag) < 1e-12
            if z.imag < -1e-12 or abs(z) < 1e-300 or (real and z.real <= 0.0):
                continue
            s = np.log(z) * model.rate_hz
            slope = self._pole_slope(z) * model.rate_hz / z
            mode: dict[str, Any] = {
                "z": [float(z.real), float(z.imag)],
                "pole_rad_s": [float(s.real), float(s.imag)],
            }
            if real:
                mode["time_constant_s"] = self._time_constant(float(z.real), self._pole_slope(z))
            else:
                size, turned = abs(s), slope * np.conj(s)
                mode["natural_frequency_rad_s"] = self._mode_estimate(
                    size, turned.real / size, "rad/s"
                )
                damping = -s.real / size
                by = -slope.real / size - damping * turned.real / size**2
                mode["damping_ratio"] = self._mode_estimate(damping, by, "")
            found.append(mode)
        return tuple(found)

    def _pole_slope(self, z: complex) -> NDArray[np.complex128]:
        """Derivatives of a pole with respect to `a`."""
        na = self.orders.na
        by_z = np.polyval(np.polyder(self._fitted().denominator), z)
        return np.asarray([-(z ** (na - j)) / by_z for j in range(1, na + 1)])

    def _time_constant(self, z: float, slope: NDArray[np.complex128]) -> Estimate:
        """Time constant of a real pole: the ends of the pole's interval, converted."""
        pole = self._mode_estimate(z, slope.real, "")
        if pole.ci95[1] >= 1.0:
            return Estimate(math.nan, math.inf, _UNKNOWN, "s")
        step_s = 1.0 / self.record.input_rate_hz
        low, high = (-step_s / math.log(end) if end > 0.0 else 0.0 for end in pole.ci95)
        return Estimate(
            -step_s / math.log(z), pole.std * step_s / (z * math.log(z) ** 2), (low, high), "s"
        )

    def _mode_estimate(self, value: float, slope: Floats, unit: str) -> Estimate:
        part = self.covariance[: self.orders.na, : self.orders.na]
        return Estimate.normal(value, math.sqrt(max(float(slope @ part @ slope), 0.0)), unit)

    @checked
    def simulate(self, u: ArrayLike, rate_hz: float | None = None) -> Floats:
        """See `RecordFit`; rest is the operating point, and the rate that of the record."""
        model = self._fitted()
        check_same_rate(rate_hz, model.rate_hz)
        inputs = finite_vector("u", u, 1)
        return model.simulate(inputs - self.operating_point[0]) + self.operating_point[1]

    def _modelled(self, record: Record) -> tuple[Floats, Floats]:
        model, new = self._fitted(), single_record(record)
        check_same_rate(new.input_rate_hz, model.rate_hz)
        if not model.is_stable:
            raise ResultError(f"The equation is unstable and cannot be simulated: {self.notes[0]}")
        free = np.column_stack([_free(model, new.y.size), np.ones(new.y.size)])
        forced = model.simulate(new.u - self.operating_point[0])
        own = np.linalg.lstsq(free, new.y - forced, rcond=None)[0]
        return new.y, forced + free @ own

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """See `Fit`; the model predicts one sample ahead."""
        return sampled_chart("ARX model", self.record, self.residuals[0], names)

    def answer(self) -> JsonObject:
        """The result as a dictionary for JSON."""
        usable = self.succeeded
        return {
            "orders": {"na": self.orders.na, "nb": self.orders.nb, "nk": self.orders.nk},
            "a": list(self.a) if usable else None,
            "b": list(self.b) if usable else None,
            "static_gain": self.static_gain if usable else None,
            "modes": list(self.modes) if usable else None,
            "continuous": self._continuous() if usable else None,
            "operating_point": list(self.operating_point),
            "fit_percent": self.fit_percent,
            "prediction_fit_percent": self.prediction_fit_percent,
            "validation_fit_percent": self.validation_fit_percent,
            "residual_whiteness_p": self.residual_whiteness_p,
            "aic": self.aic,
            "bic": self.bic,
            "status": self.status,
            "notes": list(self.notes),
        }

    def _continuous(self) -> dict[str, Any] | None:
        if self.record.hold != "zero":
            return None
        try:
            top, bottom, delay_s = self._fitted().continuous()
        except ResultError:
            return None
        return {"numerator": top, "denominator": bottom, "delay_s": delay_s}


@checked
def fit_arx(
    records: Record | Sequence[Record],
    orders: ArxOrders | None = None,
    *,
    criterion: str = "bic",
    remove_means: bool = True,
) -> ArxFit:
    r"""Least squares of the prediction error of a difference equation.

    $\min \sum_k (y_k + \sum_i a_i y_{k-i} - \sum_j b_j u_{k-n_k-j+1})^2$

    This is optimal if the disturbance passes through the poles of the plant. If noise is added by
    the sensor, the fit is biased, the more the faster the sampling; use `fit_transfer` then.

    Args:
        records: one record whose input and output were sampled together (`Record.sampled`).
        orders: size of the equation. None: na and nb up to 4 and nk from 1 to 12 are tried.
        criterion: "bic" or "aic", by which the orders are chosen.
        remove_means: subtract the means first; otherwise zero is the operating point.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: several records, times that are not those of the input, too few samples, an
            input without change, an unknown name.
    Source: Ljung, System Identification (1999), section 10.1; criteria over the same samples for
        all orders, section 16.4.
    Example:
        >>> rng = np.random.default_rng(1)
        >>> u, e = rng.normal(size=(2, 600))
        >>> y = lfilter([0, 0, 0.5], [1, -1.2, 0.5], u) + lfilter([0.05], [1, -1.2, 0.5], e)
        >>> fit = fit_arx(Record.sampled(u, y, 100.0))
        >>> fit.orders
        ArxOrders(na=2, nb=1, nk=2)
        >>> all(low < a < high for (low, high), a in zip([e.ci95 for e in fit.a], [-1.2, 0.5]))
        True
    """
    if criterion not in _CRITERIA:
        raise InputError(f"criterion = {criterion}; it must be one of {', '.join(_CRITERIA)}.")
    record = single_driven_record(records)
    point = (float(record.u.mean()), float(record.y.mean())) if remove_means else (0.0, 0.0)
    inputs, outputs = record.u - point[0], record.y - point[1]
    trials = 1 if orders is not None else SEARCH_DELAY
    if orders is None:
        least_delay = 1 if record.hold == "zero" else 0
        orders = chosen_orders(
            inputs, outputs, criterion, constant=remove_means, least_delay=least_delay
        )
    least = orders.memory + 2 * (orders.na + orders.nb)
    if inputs.size <= least:
        raise InputError(
            f"The record has {inputs.size} samples; it must have more than {least} for na = "
            f"{orders.na}, nb = {orders.nb}, nk = {orders.nk}. Record longer, or lower the orders."
        )
    constant = remove_means and has_constant(inputs, outputs, orders)
    return _fit(record, inputs, outputs, orders, point, constant, trials)


def _fit(
    record: Record,
    u: Floats,
    y: Floats,
    orders: ArxOrders,
    point: tuple[float, float],
    constant: bool,
    trials: int,
) -> ArxFit:
    rate_hz = record.input_rate_hz
    solved = solve(u, y, orders, constant=constant)
    coefficients, errors = solved.coefficients, solved.errors
    model = ArxModel(coefficients[: orders.na], coefficients[orders.na :], orders.nk, rate_hz)
    criteria = criteria_of(float(errors @ errors), errors.size, coefficients.size)
    whiteness = whiteness_p([errors])
    status, covariance = "ok", solved.covariance
    if clipped := clipping_of(record.y, "outputs"):
        status = f"no result: {clipped}"
    elif not np.isfinite(np.diag(covariance)).all():
        status = (
            "no result: the data do not support these orders; lower na or nb, or excite "
            "the plant with more frequencies"
        )
    elif whiteness < _WHITE:
        status, covariance = _with_bias(solved, u, y, orders, rate_hz, whiteness)
    if status == "ok" and not _responds(solved, orders, trials, white=whiteness >= _WHITE):
        status = (
            "no result: the output shows no response to the input; check the columns and the "
            "sensor, or record longer"
        )
    names = [f"a_{i + 1}" for i in range(orders.na)] + [f"b_{i + 1}" for i in range(orders.nb)]
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    estimates = {
        name: Estimate.normal(value, spread, "")
        for name, value, spread in zip(names, coefficients, std, strict=True)
    }
    below = float(model.denominator.sum())
    if constant and below > Z95 * math.sqrt(
        max(float(covariance[: orders.na, : orders.na].sum()), 0)
    ):
        point = point[0], point[1] + solved.constant[0] / below
    fit = ArxFit(
        status=status,
        parameters=estimates if status == "ok" else {},
        covariance=covariance,
        residuals=(errors,),
        orders=orders,
        model=model if status == "ok" else None,
        record=record,
        operating_point=point,
        fit_percent=_simulation_percent(model, u, y, constant=constant),
        prediction_fit_percent=fit_percent([y[orders.memory :]], [y[orders.memory :] - errors]),
        validation_fit_percent=_validation_percent(u, y, rate_hz, orders, constant=constant),
        residual_whiteness_p=whiteness,
        aic=criteria["aic"],
        bic=criteria["bic"],
    )
    return replace(fit, notes=_notes(fit, model))


def _responds(solved: Solved, orders: ArxOrders, trials: int, *, white: bool) -> bool:
    """Whether the output depends on the input, with the best of some delays."""
    if not np.abs(solved.errors).max() > 0.0:
        return True
    covariance = solved.covariance if white else solved.coloured_covariance
    part = covariance[orders.na :, orders.na :]
    return responds(solved.coefficients[orders.na :], part, trials)


def _with_bias(
    solved: Solved, u: Floats, y: Floats, orders: ArxOrders, rate_hz: float, whiteness: float
) -> tuple[str, Floats]:
    """Status, and a covariance that includes the bias, where the prediction errors are coloured."""
    size, constant = solved.coefficients.size, solved.columns.shape[1] > solved.coefficients.size
    covariance = solved.coloured_covariance
    unbiased = instrumental_coefficients(u, y, orders.numbers, orders.memory, constant=constant)
    if unbiased is None or not np.isfinite(covariance).all():
        return "ok", solved.covariance if unbiased is None else covariance
    fits = [
        _simulation_percent(
            ArxModel(each[: orders.na], each[orders.na : size], orders.nk, rate_hz), u, y,
            constant=constant,
        )
        for each in (solved.coefficients, unbiased)
    ]  # fmt: skip
    off = solved.coefficients - unbiased[:size]
    covariance = covariance + np.outer(off, off)
    errors = [100.0 - fit for fit in fits]
    if not math.isfinite(errors[0]) and math.isfinite(errors[1]):
        errors[0] = math.inf
    if whiteness < _COLOURED and errors[0] > _BIASED * errors[1]:
        shown = f"{fits[0]:.0f} %" if math.isfinite(fits[0]) else "not possible"
        return (
            f"no result: noise biases the coefficients (simulated fit: {shown}; with instrumental "
            f"variables of the same orders: {fits[1]:.0f} %; prediction errors not white, "
            f"p = {whiteness:.2g}). Use `haselab identify transfer`"
        ), covariance
    return "ok", covariance


def _simulation_percent(model: ArxModel, u: Floats, y: Floats, *, constant: bool) -> float:
    """Fit of the output simulated from the input alone, with the best initial state."""
    if not model.is_stable:
        return math.nan
    free = _free(model, y.size)
    if constant:
        ones = lfilter([1.0], model.denominator, np.ones(y.size))
        free = np.column_stack([free, ones])
    forced = model.simulate(u)
    state = np.linalg.lstsq(free, y - forced, rcond=None)[0]
    return fit_percent([y], [forced + free @ state])


def _free(model: ArxModel, count: int) -> Floats:
    """Output after each initial state, without input. Shape `(count, K)`."""
    length = max(model.a.size, model.b.size + model.nk - 1, 1)
    starts = np.zeros((count, length))
    starts[np.arange(length), np.arange(length)] = 1.0
    return np.asarray(lfilter([1.0], model.denominator, starts, axis=0))


def _validation_percent(
    u: Floats, y: Floats, rate_hz: float, orders: ArxOrders, *, constant: bool
) -> float:
    """Fit to three quarters of the record, validated on the last quarter."""
    cut = (3 * y.size) // 4
    if min(cut, y.size - cut) <= orders.memory + 2 * (orders.na + orders.nb):
        return math.nan
    coefficients = solve(u[:cut], y[:cut], orders, constant=constant).coefficients
    model = ArxModel(coefficients[: orders.na], coefficients[orders.na :], orders.nk, rate_hz)
    return _simulation_percent(model, u[cut:], y[cut:], constant=constant)


def _notes(fit: ArxFit, model: ArxModel) -> tuple[str, ...]:
    notes = []
    if not model.is_stable:
        notes.append("The equation is unstable, so it cannot be simulated; lower the orders.")
    if fit.residual_whiteness_p < _WHITE:
        notes.append(
            f"The prediction errors are not white (p = {fit.residual_whiteness_p:.2g}), so noise "
            "may bias the coefficients. Where possible, the intervals include an estimate of this "
            "bias. Raise the orders, or use `haselab identify transfer`."
        )
    if fit.model is not None and math.isnan(fit.static_gain.value):
        notes.append(
            "The static gain is not identifiable: within the intervals the plant may be an "
            "integrator. Record longer."
        )
    if not model.has_continuous:
        notes.append("A pole at z <= 0 has no continuous counterpart; lower na.")
    if fit.record.hold != "zero":
        notes.append(
            f"The record has hold = {fit.record.hold}, so there is no continuous transfer "
            "function, and the equation is valid for such inputs only. Use `haselab identify "
            "transfer`, which takes any hold."
        )
    return tuple(notes)
