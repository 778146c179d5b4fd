"""State model of any order from a sampled record, without a search (MOESP)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import Estimate, InputError, JsonObject, checked, generator
from haselab.base.chart import Chart
from haselab.identify.clipped import clipping_of
from haselab.identify.fit import RecordFit, rescaled
from haselab.identify.noise import (
    autoregression,
    coloured_covariance,
    fit_percent,
    whiteness_p,
)
from haselab.identify.record import Record, finite_vector
from haselab.identify.sampled.record import (
    check_same_rate,
    sampled_chart,
    single_driven_record,
    single_record,
)
from haselab.identify.sampled.responds import responds
from haselab.models import StateSpaceModel
from haselab.models.filters import lfilter

__all__ = ["SubspaceFit", "fit_subspace"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_MOST_ORDER = 10
_LEAST_GAP = 1e-12
_WHITE = 0.05
_LASTING = 0.1  # share of its amplitude above which an oscillation is still there at the end
_LARGEST = 1e100  # output of a growing model, so that its square does not overflow


@dataclass(frozen=True, kw_only=True)
class SubspaceFit(RecordFit[Record]):
    """A fitted state model; see `Fit` for what all fits have.

    Its `parameters` are `static_gain` and, for each mode, `natural_frequency_1_rad_s` and
    `damping_ratio_1`, or `time_constant_1_s`; its `residuals` are output minus simulation.

    Args:
        record: what was fitted.
        operating_point: input and output that were taken off.
        model: about the operating point; None without a result.
        singular_values: significance of each further state. Shape `(block_rows,)`.
        static_gain: output per input in steady state.
        modes: poles in continuous time, the slowest first, each with its frequency and damping or
            its time constant.
        fit_percent: of the simulated output, initial state fitted.
        residual_whiteness_p: of output minus simulation.
    """

    record: Record = field(repr=False)
    operating_point: tuple[float, float]
    model: StateSpaceModel | None
    singular_values: Floats
    static_gain: Estimate
    modes: tuple[JsonObject, ...]
    fit_percent: float
    residual_whiteness_p: float

    @property
    def plant(self) -> StateSpaceModel:
        """The model.

        Raises:
            ResultError: the fit has no result.
        """
        return self._present(self.model)

    @property
    def fitted_outputs(self) -> tuple[Floats, ...]:
        """See `RecordFit`."""
        return (self.record.y,)

    @checked
    def simulate(self, u: ArrayLike, rate_hz: float | None = None) -> Floats:
        """See `RecordFit`; rest is the operating point, and the rate that of the record."""
        check_same_rate(rate_hz, self.plant.rate_hz)
        inputs = finite_vector("u", u, 1)
        return self.plant.simulate(inputs - self.operating_point[0]) + self.operating_point[1]

    def _modelled(self, record: Record) -> tuple[Floats, Floats]:
        new = single_record(record)
        check_same_rate(new.input_rate_hz, self.plant.rate_hz)
        inputs = new.u - self.operating_point[0]
        free = np.column_stack([self.plant.responses(inputs)[1], np.ones(inputs.size)])
        forced = self.plant.simulate(inputs)
        own = np.linalg.lstsq(free, new.y - forced, rcond=None)[0]
        return new.y, forced + free @ own

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """See `Fit`."""
        self._present(self.residuals or None)
        return sampled_chart("Subspace model", self.record, self.residuals[0], names)

    def answer(self) -> JsonObject:
        """The result as a dictionary for JSON."""
        model = self.model
        return {
            "order": None if model is None else model.b.size,
            "static_gain": self.static_gain,
            "modes": list(self.modes),
            "a": None if model is None else model.a,
            "b": None if model is None else model.b,
            "c": None if model is None else model.c,
            "d": None if model is None else model.d,
            "singular_values": self.singular_values,
            "fit_percent": self.fit_percent,
            "residual_whiteness_p": self.residual_whiteness_p,
            "status": self.status,
            "notes": list(self.notes),
        }


@checked
def fit_subspace(
    records: Record | Sequence[Record],
    order: int | None = None,
    *,
    block_rows: int = 15,
    remove_means: bool = True,
    bootstrap: int = 50,
    seed: int = 1,
) -> SubspaceFit:
    """Fit a state model by projections of the record on its own past (subspace method).

    The space of the states is found from one QR and one singular value decomposition;
    input matrix, feedthrough and first state are least-squares fits to the simulated output. The
    intervals are bootstrapped with noise that has the residuals' spectrum.

    Args:
        records: one record whose input and output were sampled together (`Record.sampled`).
        order: states. None: up to the largest gap of the singular values, by their ratio.
        block_rows: number of past and future samples; above the order.
        remove_means: subtract the means first; a remaining offset counts as a state.
        bootstrap: number of bootstrap replicates for the intervals; 0: no intervals.
        seed: seed of the bootstrap.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: several records, times that are not those of the input, too few samples, an
            input without change, an order that is not below the block rows.
    Source: Verhaegen, Automatica 30 (1994), 61, PO-MOESP; the same as SLICOT's IB01AD with METH=M.
    Example:
        >>> u = np.random.default_rng(1).normal(size=500)
        >>> y = lfilter([0.0, 0.3, 0.1], [1.0, -1.2, 0.5], u)
        >>> record = Record.sampled(u, y, 10.0)
        >>> fit = fit_subspace(record, remove_means=False, bootstrap=0)
        >>> np.round(np.poly(fit.plant.a), 6).tolist()
        [1.0, -1.2, 0.5]
    """
    record = single_driven_record(records)
    _check(record, order, block_rows)
    if bootstrap < 0:
        raise InputError(f"bootstrap is {bootstrap}; it must be 0 or more replicates.")
    rate_hz = record.input_rate_hz
    point = (float(record.u.mean()), float(record.y.mean())) if remove_means else (0.0, 0.0)
    inputs, outputs = record.u - point[0], record.y - point[1]
    values, space = _space(inputs, outputs, block_rows)
    count = _gap(values) if order is None else order
    model, simulated = _model(inputs, outputs, space[:, :count], rate_hz)
    residuals = outputs - simulated
    status = ""
    if clipped := clipping_of(record.y, "outputs"):
        status = f"no result: {clipped}"
    elif values[count - 1] <= _LEAST_GAP * values[0]:
        status = f"no result: the data do not support {count} states; lower the order"
    elif (columns := _regressors(model, inputs)) is None:
        status = f"no result: with {count} states, the model grows too far; lower the order"
    elif not _responds(model, columns, residuals):
        status = (
            f"no result: with {count} states, the output shows no response to the input; check the "
            "columns and the sensor, change the order, or record longer"
        )
    if status:
        none = Estimate(math.nan, math.inf, (-math.inf, math.inf), "")
        return SubspaceFit(
            status=status, record=record, operating_point=point, model=None,
            singular_values=values, static_gain=none, modes=(), fit_percent=math.nan,
            residual_whiteness_p=math.nan,
        )  # fmt: skip
    rng = generator(seed)
    repeats = [
        _model(inputs, again, _space(inputs, again, block_rows)[1][:, :count], rate_hz)[0]
        for again in _repeated(simulated, residuals, bootstrap, rng)
    ]
    whiteness = whiteness_p([residuals])
    found = _Columns.of(model, repeats)
    return SubspaceFit(
        status="ok",
        parameters=found.estimates,
        covariance=found.covariance,
        residuals=(residuals,),
        notes=_notes(model, whiteness, record.y.size),
        record=record,
        operating_point=point,
        model=model,
        singular_values=values,
        static_gain=found.estimates["static_gain"],
        modes=_modes(model, found.estimates),
        fit_percent=fit_percent([outputs], [simulated]),
        residual_whiteness_p=whiteness,
    )


def _check(record: Record, order: int | None, block_rows: int) -> None:
    least = 8 * block_rows
    if block_rows < 2 or record.u.size < least:
        raise InputError(
            f"block_rows = {block_rows} for {record.u.size} samples; it must be 2 or more, and "
            f"with {least} samples or more. Lower block_rows, or record longer."
        )
    if order is not None and not 1 <= order < min(block_rows, _MOST_ORDER + 1):
        raise InputError(
            f"order = {order}; it must be 1 to {min(block_rows - 1, _MOST_ORDER)}. "
            "Lower the order, or raise block_rows."
        )


def _space(u: Floats, y: Floats, rows: int) -> tuple[Floats, Floats]:
    """Singular values, and the extended observability space."""
    columns = u.size - 2 * rows + 1

    def shifted(v: Floats, first: int) -> Floats:
        return np.stack([v[first + i : first + i + columns] for i in range(rows)])

    stacked = np.vstack([shifted(u, rows), shifted(u, 0), shifted(y, 0), shifted(y, rows)])
    lower: Floats = np.asarray(np.linalg.qr(stacked.T, mode="r")).T
    left, values, _ = np.linalg.svd(lower[3 * rows :, rows : 3 * rows], full_matrices=False)
    return np.asarray(values), np.asarray(left)


def _gap(values: Floats) -> int:
    """Number of states before the largest ratio of neighbouring singular values."""
    most = min(_MOST_ORDER, values.size - 1)
    floor = _LEAST_GAP * values[0]
    logs = np.log(np.maximum(values[: most + 1], floor))
    return int(np.argmax(logs[:-1] - logs[1:])) + 1


def _model(u: Floats, y: Floats, space: Floats, rate_hz: float) -> tuple[StateSpaceModel, Floats]:
    """State matrix from the shift of the space; the others by least squares."""
    shift = np.linalg.lstsq(space[:-1], space[1:], rcond=None)[0]
    a = np.asarray(shift, dtype=np.float64)
    size = a.shape[0]
    frame = StateSpaceModel(a, np.zeros(size), space[0], 0.0, rate_hz)
    columns = _regressors(frame, u)
    if columns is None:
        return frame, np.zeros(y.size)
    scale = np.sqrt((columns**2).sum(axis=0))
    scale[scale == 0.0] = 1.0
    numbers = np.linalg.lstsq(columns / scale, y, rcond=None)[0] / scale
    model = StateSpaceModel(a, numbers[:size], space[0], float(numbers[size]), rate_hz)
    return model, np.asarray(columns @ numbers)


def _regressors(model: StateSpaceModel, u: Floats) -> Floats | None:
    """Outputs for each of b, d and the initial states, `(N, 2 n + 1)`; None: they grow too far."""
    driven, free = model.responses(u)
    columns = np.column_stack([driven, u, free])
    return columns if np.abs(columns).max() < _LARGEST else None


def _responds(model: StateSpaceModel, columns: Floats, residuals: Floats) -> bool:
    """Whether b and d, for these poles, are larger than noise explains."""
    if not np.abs(residuals).max() > 0.0:
        return True
    size = model.b.size + 1
    covariance = coloured_covariance([columns], [residuals], columns.shape[1])
    return responds(np.append(model.b, model.d), covariance[:size, :size])


def _repeated(
    simulated: Floats, residuals: Floats, count: int, rng: np.random.Generator
) -> list[Floats]:
    """Bootstrap fits to the simulation with new noise of the same spectrum."""
    if count == 0:
        return []
    polynomial, variance = autoregression([residuals])
    lead = 20 * polynomial.size
    noise = rng.normal(scale=math.sqrt(variance), size=(count, simulated.size + lead))
    coloured = np.asarray(lfilter([1.0], polynomial, noise, axis=1))[:, lead:]
    return [simulated + e for e in coloured]


def _rates(model: StateSpaceModel) -> Complexes:
    """Continuous poles with non-negative frequency, the slowest first."""
    z = model.poles
    kept = z[(z.imag > -1e-12) & ~((np.abs(z.imag) <= 1e-12) & (z.real <= 0.0))]
    s = np.log(kept) * model.rate_hz
    return np.asarray(s[np.argsort(np.abs(s.real))])


def _numbers(at: int, s: Complexes) -> dict[str, Floats]:
    """Frequency and damping, or time constant, of mode `at` from its pole and those nearest."""
    if abs(s[0].imag) < 1e-9 * abs(s[0]):
        return {f"time_constant_{at}_s": -1.0 / s.real}
    return {f"natural_frequency_{at}_rad_s": np.abs(s), f"damping_ratio_{at}": -s.real / np.abs(s)}


@dataclass(frozen=True)
class _Columns:
    """Numbers of the model with the spread of the repeated fits.

    Args:
        estimates: by name.
        covariance: of them, in their order. Shape `(P, P)`.
    """

    estimates: dict[str, Estimate]
    covariance: Floats

    @classmethod
    def of(cls, model: StateSpaceModel, repeats: list[StateSpaceModel]) -> _Columns:
        """Each mode beside the nearest ones of the repeated fits."""
        others = [rates for rates in map(_rates, repeats) if rates.size]
        gains = [model.static_gain, *(repeat.static_gain for repeat in repeats)]
        columns = {"static_gain": np.array(gains)}
        for at, s in enumerate(_rates(model), start=1):
            near = [rates[np.argmin(np.abs(rates - s))] for rates in others]
            columns |= _numbers(at, np.array([s, *near]))
        estimates = {
            name: _estimate(column[0], column[1:].tolist(), _unit(name))
            for name, column in columns.items()
        }
        std = np.array([estimate.std for estimate in estimates.values()])
        spread = np.eye(std.size)
        if np.isfinite(std).all() and len({column.size for column in columns.values()}) == 1:
            spread = np.atleast_2d(np.cov([column[1:] for column in columns.values()]))
        return cls(estimates, rescaled(spread, std))


def _unit(name: str) -> str:
    return "rad/s" if name.endswith("_rad_s") else "s" if name.endswith("_s") else ""


def _modes(model: StateSpaceModel, estimates: dict[str, Estimate]) -> tuple[dict[str, Any], ...]:
    """Poles with their numbers."""
    found = []
    for at, s in enumerate(_rates(model), start=1):
        z = np.exp(s / model.rate_hz)
        mode: dict[str, Any] = {
            "z": [float(z.real), float(z.imag)],
            "pole_rad_s": [float(s.real), float(s.imag)],
        }
        for name in _numbers(at, np.array([s])):
            mode[name.replace(f"_{at}", "")] = estimates[name]
        found.append(mode)
    return tuple(found)


def _estimate(value: float, repeats: list[float], unit: str) -> Estimate:
    """Estimate with a robust spread: half the width of the middle 68 % of the replicates."""
    if len(repeats) < 8:
        return Estimate(float(value), math.inf, (-math.inf, math.inf), unit)
    low, high = np.quantile(repeats, [0.1587, 0.8413])
    return Estimate.normal(value, 0.5 * float(high - low), unit)


def _notes(model: StateSpaceModel, whiteness: float, samples: int) -> tuple[str, ...]:
    notes = []
    if not model.is_stable:
        notes.append("The model is unstable; lower the order, or record longer.")
    lasting = model.poles[(np.abs(model.poles) ** samples > _LASTING) & (model.poles.imag > 0.0)]
    if lasting.size:
        shown = ", ".join(f"{one:.4g}" for one in np.angle(lasting) * model.rate_hz / (2.0 * np.pi))
        notes.append(
            f"An oscillation at {shown} Hz keeps more than {100.0 * _LASTING:g} % of its amplitude "
            "until the end of the record. It may be hum. Check the wiring, or record longer."
        )
    if whiteness < _WHITE:
        notes.append(
            f"Output minus simulation is not white (p = {whiteness:.2g}): the noise is coloured, "
            "or the order is too low."
        )
    return tuple(notes)
