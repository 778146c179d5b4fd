"""Grey-box model from voltage to output with one kind of creep, for model comparison."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, logit

from haselab.base import Estimate, InputError, JsonObject, checked
from haselab.base.chart import Chart
from haselab.identify.charts import records_chart
from haselab.identify.fit import RecordFit, rescaled
from haselab.identify.noise import coloured_covariance, fit_percent, whiteness_p
from haselab.identify.projection import Basis, Solution, minimise, project
from haselab.identify.record import Record, finite_vector
from haselab.models.plant import Plant
from haselab.models.voltage_plant import VoltagePlant

__all__ = [
    "VoltagePlantFit",
    "VoltageStructure",
    "fit_voltage_plant",
    "predicted_std",
    "spread_indices",
]

Floats = NDArray[np.float64]
_THIN = 300  # outputs of a record in the first search
_STEP = 1e-4  # of a searched parameter, for its derivative
_GOLDEN = 0.6180339887498949
_FIRST, _LAST = 25, 15  # steps of the search on thinned outputs, and on all
_END = 9.0  # logit of the place in its range, where a parameter has reached its bound
_LEANS = 6.0  # logit beyond which a parameter is near its bound
_POLISHED = 4  # of the starting points
_TWINS = 2  # starting points of one natural frequency that are refined
_SPACING = 0.26  # of the natural frequencies that are tried first, in their logarithm
_DEPTH, _CREEP_S = 1e-2, 0.4  # a time constant below this fraction of the record and below this
# time is not creep
_MOST_VOLTS = 100.0
_SECOND = ("second_natural_frequency_rad_s", "second_damping_ratio", "second_share")
_NAMES = (
    "natural_frequency_rad_s", "damping_ratio", "delay_s", "creep_share", "creep_time_constant_s",
    *_SECOND,
)  # fmt: skip
_AT = {name: place for place, name in enumerate(_NAMES)}
_FREQUENCY, _CREEP, _BESIDE = (
    _AT["natural_frequency_rad_s"], _AT["creep_time_constant_s"], _AT[_SECOND[0]],
)  # fmt: skip
_LOGARITHMIC = np.array([name not in ("delay_s", "creep_share", "second_share") for name in _NAMES])
_LONGEST_DELAY_S = 0.05


@dataclass(frozen=True)
class VoltageStructure:
    """Structure of a voltage plant.

    Args:
        creep: "mechanical" or "electrical".
        powers: of the static curve over the square of the voltage; 1 means a straight line.
        two_modes: whether there is a second resonance.
        lowest_rad_s: lowest natural frequency, in rad/s. None: lowest that the records can show.
        highest_rad_s: highest natural frequency, in rad/s. None: highest that the records can show.
        slew_v_s: fastest change of the drive, in V/s.
    Raises:
        InputError: an unknown creep, a value out of range.
    """

    creep: str = "mechanical"
    powers: int = 2
    two_modes: bool = False
    lowest_rad_s: float | None = None
    highest_rad_s: float | None = None
    slew_v_s: float = math.inf

    def __post_init__(self) -> None:
        if not 1 <= self.powers <= 4:
            raise InputError(f"powers = {self.powers}; it must be 1 to 4.")
        if not self.slew_v_s > 0.0:
            raise InputError(f"slew_v_s = {self.slew_v_s:g} V/s; it must be above 0 V/s.")
        low, high = self.lowest_rad_s or 1e-3, self.highest_rad_s or 1e6
        if not 0.0 < low < high:
            raise InputError(
                f"Natural frequency from {low:g} to {high:g} rad/s; the range must rise and be "
                "above 0."
            )
        VoltagePlant(self.creep, (1.0,), 1.0, 0.1)

    @property
    def size(self) -> int:
        """Number of searched parameters."""
        return len(_NAMES) if self.two_modes else len(_NAMES) - len(_SECOND)


@dataclass(frozen=True)
class _Range:
    """Bounds of the parameters; the search uses the logit of the position between them.

    A bound is never reached, so a search near it still converges.
    """

    structure: VoltageStructure
    low: Floats
    high: Floats

    def numbers(self, search: Floats) -> Floats:
        """Parameters from logits; frequencies and times as logarithms."""
        return np.asarray(self.low + (self.high - self.low) * expit(search))

    def slopes(self, search: Floats) -> Floats:
        """Derivatives of `numbers` with respect to the logits."""
        place = expit(search)
        return np.asarray((self.high - self.low) * place * (1.0 - place))

    def search(self, numbers: Floats) -> Floats:
        """Logits of given parameters."""
        span = np.where(self.high > self.low, self.high - self.low, 1.0)
        return np.asarray(logit(np.clip((numbers - self.low) / span, 0.01, 0.99)))

    def near(self, plant: VoltagePlant) -> Floats:
        """Logits of a plant, moved inside the bounds."""
        second = dict(zip(_SECOND, plant.second_mode or (1.0, 0.1, 0.0), strict=True))
        names = _NAMES[: self.low.size]
        values = np.array([second[n] if n in second else getattr(plant, n) for n in names])
        logarithmic = _LOGARITHMIC[: self.low.size]
        return self.search(np.where(logarithmic, np.log(np.maximum(values, 1e-9)), values))

    def plant(self, search: Floats) -> VoltagePlant:
        """Plant from logits, with gains of one."""
        numbers = self.numbers(search)
        values = np.where(_LOGARITHMIC[: numbers.size], np.exp(numbers), numbers).tolist()
        named = dict(zip(_NAMES, values, strict=False))
        second = None
        if self.structure.two_modes:
            frequency, damping, share = (named.pop(name) for name in _SECOND)
            second = (frequency, damping, share)
        ones = (1.0,) * self.structure.powers
        return VoltagePlant(self.structure.creep, ones, **named, second_mode=second)


@dataclass(frozen=True, kw_only=True)
class VoltagePlantFit(RecordFit[Record]):
    """A fitted voltage plant; see `Fit` for what all fits have.

    Of its `parameters`, `gain_1` is output per V^2, `gain_2` per V^4.

    Args:
        structure: what was fitted.
        records: the experiments.
        plant: with the fitted parameters, identifiable or not; None without a result.
        parameter_count: fitted parameters, including each record's own.
        modelled: fitted output of each record. Shape `(M_r,)` each.
    """

    structure: VoltageStructure
    records: tuple[Record, ...] = field(default=(), repr=False)
    plant: VoltagePlant | None = None
    parameter_count: int = 0
    modelled: tuple[Floats, ...] = field(default=(), repr=False)

    @property
    def fitted_outputs(self) -> tuple[Floats, ...]:
        """See `RecordFit`."""
        return tuple(record.y for record in self.records)

    @checked
    def simulate(self, u: ArrayLike, rate_hz: float | None = None) -> Floats:
        """See `RecordFit`; the first voltage has stood for ever."""
        plant = self._fitted()
        rate = self.records[0].input_rate_hz if rate_hz is None else rate_hz
        inputs = finite_vector("u", u, 1)
        return plant.simulate(inputs, rate, np.arange(inputs.size) / rate)

    def _fitted(self) -> VoltagePlant:
        return self._present(self.plant)

    def _modelled(self, record: Record) -> tuple[Floats, Floats]:
        moved = self._fitted().simulate(record.u, record.input_rate_hz, record.output_time_s)
        return record.y, moved + (record.y - moved).mean()

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """See `Fit`."""
        self._require()
        return records_chart("Voltage plant", self.records, self.residuals, names)

    def answer(self) -> JsonObject:
        """The result under its public JSON keys."""
        measured = [m + e for m, e in zip(self.modelled, self.residuals, strict=True)]
        return {
            **self.parameters,
            "fit_percent": fit_percent(measured, self.modelled) if measured else math.nan,
            "residual_whiteness_p": whiteness_p(self.residuals) if measured else math.nan,
            "status": self.status,
            "notes": list(self.notes),
        }


@checked
def fit_voltage_plant(
    records: Sequence[Record],
    structure: VoltageStructure | None = None,
    near: Sequence[VoltagePlant] = (),
) -> VoltagePlantFit:
    r"""Fit one voltage plant to all records, each with its own offset and initial state.

    The resonance, the delay and the creep are searched; gains, offsets, initial motion and the
    rest of earlier creep are solved for. No initial guess is needed.

    Args:
        records: experiments; the input is the drive in V, with its sign.
        structure: model structure. Default: mechanical creep and two powers.
        near: plants to start from, for example of another hypothesis; none: starts over all ranges.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: no record, fewer samples than parameters, a drive that is not in volts.
    Source: variable projection, Golub and Pereyra (1973) and Kaufman (1975).
    Example:
        >>> rng = np.random.default_rng(3)
        >>> drive_v = np.repeat(rng.uniform(0.2, 1.8, 40), 50)
        >>> time_s = np.arange(2000) / 100.0
        >>> truth = VoltagePlant("mechanical", (0.03, 0.004), 5.11, 0.09, 0.01, 0.3, 4.0)
        >>> y = truth.simulate(drive_v, 100.0, time_s) + 1e-3 * rng.normal(size=2000)
        >>> fit = fit_voltage_plant([Record(drive_v, 100.0, y, time_s)])
        >>> low, high = fit.parameters["creep_share"].ci95
        >>> fit.status, low < 0.3 < high
        ('ok', True)
    """
    structure = structure or VoltageStructure()
    _check(records, structure)
    ranges = _ranges(records, structure)
    few = [_thinned(record) for record in records]
    limits = (np.full(structure.size, -_END), np.full(structure.size, _END))

    def on(chosen: Sequence[Record], search: Floats) -> list[Basis]:
        return [_basis(ranges, record, search) for record in chosen]

    first = [ranges.near(plant) for plant in near]
    if not first:
        tried = (project(s, [_basis(ranges, r, s, sloped=False) for r in few])
                 for s in _starts(ranges))  # fmt: skip
        first = _apart(sorted(tried, key=lambda solution: solution.cost))
    polished = [
        minimise(lambda search: on(few, search), start, limits, _FIRST, 1e-4)[0] for start in first
    ]
    best = min(polished, key=lambda solution: solution.cost)
    solution, settled = minimise(
        lambda search: on(records, search), best.search, limits, _LAST, 1e-5
    )
    if not math.isfinite(solution.cost):
        reason = "no result: no start led to a finite model; record longer, or use a larger drive"
        return VoltagePlantFit(status=reason, structure=structure)
    return _describe(records, ranges, solution, settled)


def predicted_std(
    plant: VoltagePlant, records: Sequence[Record], noise_std: float, samples: float
) -> tuple[dict[str, float], float]:
    r"""Predict the standard deviations of a fit from the inverse of Fisher's information.

    Offset, initial motion and earlier creep of each record are unknown.

    Args:
        plant: assumed true plant.
        records: planned experiments with the predicted output.
        noise_std: of one independent sample, in the unit of the output.
        samples: independent samples in all records together.
    Returns:
        Standard deviation by name, relative except for delay and share; and the logarithm of the
        information's determinant.
    Source: Ljung, System Identification, 2nd ed., sec. 13.3.
    """
    structure = VoltageStructure(plant.creep, len(plant.gains), plant.second_mode is not None)
    ranges = _ranges(records, structure)
    search = ranges.near(plant)
    columns = np.vstack(project(search, [_basis(ranges, r, search) for r in records]).columns)
    # Derivatives of the parameters (logarithms of gains) with respect to the search variables.
    slopes = np.concatenate([ranges.slopes(search), 1.0 / np.array(plant.gains)])
    columns = columns / slopes
    scale = np.sqrt((columns**2).sum(axis=0))
    known = scale > 0.0
    worth = samples / columns.shape[0] / noise_std**2
    scaled = columns[:, known] / scale[known]
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    values = np.maximum(values, 1e-14)
    std = np.full(scale.size, math.inf)
    std[known] = np.sqrt((vectors**2 / values).sum(axis=1) / worth) / scale[known]
    names = [*_NAMES[: search.size], *(f"gain_{k + 1}" for k in range(len(plant.gains)))]
    log_det = float(np.log(values * worth).sum() + 2.0 * np.log(scale[known]).sum())
    return dict(zip(names, std.tolist(), strict=True)), log_det if known.all() else -math.inf


def _check(records: Sequence[Record], structure: VoltageStructure) -> None:
    if not records:
        raise InputError("records is empty. Pass at least one record.")
    if any(record.hold != "zero" for record in records):
        raise InputError(
            "A record's input is not held between its updates; hold must be zero. Give "
            "the drive as the converter put it out."
        )
    count = sum(record.y.size for record in records)
    wanted = structure.size + structure.powers + 4 * len(records)
    if count < 2 * wanted:
        raise InputError(
            f"The records have {count} outputs; {wanted} parameters need at least {2 * wanted}. "
            "Record longer."
        )
    if all(np.ptp(record.u) == 0.0 for record in records):
        raise InputError(
            f"The drive is {records[0].u[0]:g} V throughout, so it excites nothing. It "
            "must change. Name the right column, or record the time before a step too."
        )
    largest_v = max(float(np.abs(record.u).max()) for record in records)
    if largest_v > _MOST_VOLTS:
        raise InputError(
            f"The drive reaches {largest_v:g} V; it must be at most {_MOST_VOLTS:g} V ahead of the "
            "amplifier. Give the drive, or divide by the amplifier's gain."
        )


def spread_indices(count: int, wanted: int) -> NDArray[np.intp]:
    """Some of `count` samples, one in each of `wanted` equal segments, irregularly spaced.

    Regular spacing would alias some frequencies.

    Args:
        count: number of samples.
        wanted: largest number of samples to keep.
    Returns:
        Rising indices, nearly as many as wanted. Shape `(W,)`.
    Example:
        >>> spread_indices(10, 5).tolist()
        [0, 3, 4, 7, 8]
    """
    if count <= wanted:
        return np.arange(count)
    piece = np.arange(wanted)
    return np.unique(((piece + (piece * _GOLDEN) % 1.0) * count / wanted).astype(np.intp))


def _thinned(record: Record) -> Record:
    kept = spread_indices(record.y.size, _THIN)
    return replace(record, y=record.y[kept], output_time_s=record.output_time_s[kept])


def _ranges(records: Sequence[Record], structure: VoltageStructure) -> _Range:
    """Bounds of the searched parameters."""
    longest_s = max(record.duration_s for record in records)
    period_s = min(float(np.median(np.diff(record.output_time_s))) for record in records)
    reach = (math.log(2.0 * math.pi / longest_s), math.log(0.8 * math.pi / period_s))
    low, high = structure.lowest_rad_s, structure.highest_rad_s
    first = (math.log(low) if low else reach[0], math.log(high) if high else reach[1])
    shortest_s = max(min(_DEPTH * longest_s, _CREEP_S), 3.0 * period_s)
    slow = (math.log(shortest_s), math.log(2.0 * longest_s))
    damping = (math.log(2e-3), math.log(1.5))
    ends = {
        "natural_frequency_rad_s": first,
        "damping_ratio": damping,
        "delay_s": (0.0, _LONGEST_DELAY_S),
        "creep_share": (0.0, 0.95),
        "creep_time_constant_s": slow,
        "second_natural_frequency_rad_s": reach,
        "second_damping_ratio": damping,
        "second_share": (-0.95, 0.95),
    }
    low_ends, high_ends = np.array([ends[name] for name in _NAMES[: structure.size]]).T
    return _Range(structure, low_ends, np.maximum(high_ends, low_ends))


def _starts(ranges: _Range) -> list[Floats]:
    """Starting values over the range of natural frequency and of creep."""
    low, span = ranges.low, ranges.high - ranges.low
    known = {
        "damping_ratio": math.log(0.1),
        "delay_s": 0.012,
        "creep_share": 0.3,
        "second_damping_ratio": math.log(0.05),
        "second_share": 0.1,
    }
    middle = np.array([known.get(name, 0.0) for name in _NAMES[: low.size]])
    starts = []
    count = max(math.ceil(span[_FREQUENCY] / _SPACING), 3)
    for part in (np.arange(count) + 0.5) / count:
        for slow in (0.4, 0.75):
            start = middle.copy()
            for place, share in ((_FREQUENCY, part), (_CREEP, slow)):
                start[place] = low[place] + share * span[place]
            for apart in (0.35, 0.7) if ranges.structure.two_modes else (0.0,):
                if apart:
                    start = start.copy()
                    away = start[_FREQUENCY] - low[_BESIDE] + apart * span[_BESIDE]
                    start[_BESIDE] = low[_BESIDE] + away % span[_BESIDE]
                starts.append(ranges.search(start))
    return starts


def _columns(ranges: _Range, record: Record, search: Floats) -> tuple[Floats, Floats]:
    """Responses with common factors, and those with factors of one record."""
    plant = ranges.plant(search)
    time_s = record.output_time_s
    slew_v_s = ranges.structure.slew_v_s
    shared = plant.shapes(record.u, record.input_rate_hz, time_s, slew_v_s)
    own = np.column_stack([
        np.ones_like(time_s),
        np.exp(-time_s / plant.creep_time_constant_s),
        *_free(plant, time_s),
    ])  # fmt: skip
    return shared, own


def _free(plant: VoltagePlant, time_s: Floats) -> tuple[Floats, Floats]:
    """Free motion from a displacement, and from a velocity of equal amplitude."""
    first, second = Plant(0.0, plant.natural_frequency_rad_s, plant.damping_ratio).poles[:2]
    if first.imag:
        swing = np.exp(first * time_s)
        rate = swing.imag / abs(first.imag)
        return swing.real - first.real * rate, plant.natural_frequency_rad_s * rate
    a, b = np.exp(first.real * time_s), np.exp(second.real * time_s)
    span = (second - first).real
    displaced = (second.real * a - first.real * b) / span
    return displaced, plant.natural_frequency_rad_s * (b - a) / span


def _apart(solutions: Sequence[Solution]) -> list[Floats]:
    """The best starts, at most two of one natural frequency."""
    kept: list[Floats] = []
    for solution in solutions:
        if sum(other[_FREQUENCY] == solution.search[_FREQUENCY] for other in kept) < _TWINS:
            kept.append(solution.search)
        if len(kept) == _POLISHED:
            break
    return kept


def _basis(ranges: _Range, record: Record, search: Floats, *, sloped: bool = True) -> Basis:
    """Functions of one record and their numerical derivatives."""
    shared, own = _columns(ranges, record, search)
    here = np.hstack([shared, own])
    slopes = np.zeros((search.size, record.y.size, shared.shape[1] + own.shape[1]))
    for k, step in enumerate(_STEP * np.eye(search.size)) if sloped else ():
        slopes[k] = (np.hstack(_columns(ranges, record, search + step)) - here) / _STEP
    none = np.zeros(record.y.size)
    return Basis(record.y, shared, own, slopes, none, np.zeros((search.size, none.size)))


def _describe(
    records: Sequence[Record], ranges: _Range, solution: Solution, settled: bool
) -> VoltagePlantFit:
    """Parameters with intervals."""
    structure, size = ranges.structure, solution.search.size
    parameters = size + solution.shared.size + sum(factors.size for factors in solution.own)
    covariance = coloured_covariance(solution.columns, solution.residuals, parameters)
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    std[:size] *= ranges.slopes(solution.search)
    numbers = ranges.numbers(solution.search)
    estimates: dict[str, Estimate] = {}
    notes = [] if settled else ["The search ended before it converged: the minimum is flat."]
    for k, (at, spread) in enumerate(zip(numbers, std, strict=False)):
        name = _NAMES[k]
        unit = "rad/s" if name.endswith("_rad_s") else "s" if name.endswith("_s") else ""
        at_end = abs(float(solution.search[k])) > _LEANS
        identifiable = spread < (1.0 if _LOGARITHMIC[k] else 0.5)
        if not at_end and identifiable:
            estimates[name] = (
                Estimate.lognormal(math.exp(at), spread, unit)
                if _LOGARITHMIC[k]
                else Estimate.normal(at, spread, unit)
            )
        else:
            estimates[name] = Estimate(math.nan, math.inf, (-math.inf, math.inf), unit)
            where = "reached the end of its range and is" if at_end else "is"
            notes.append(f"{name} {where} not identifiable.")
    for k, (gain, spread) in enumerate(zip(solution.shared, std[size:], strict=True), start=1):
        estimates[f"gain_{k}"] = Estimate.normal(gain, spread, f"1/V^{2 * k}")
    modelled = tuple(r.y - e for r, e in zip(records, solution.residuals, strict=True))
    plant = replace(
        ranges.plant(solution.search), gains=tuple(float(gain) for gain in solution.shared)
    )
    spread = np.array([estimate.std for estimate in estimates.values()])
    return VoltagePlantFit(
        status="ok",
        parameters=estimates,
        covariance=rescaled(covariance, spread),
        residuals=tuple(solution.residuals),
        notes=tuple(notes),
        structure=structure,
        records=tuple(records),
        plant=plant,
        parameter_count=parameters,
        modelled=modelled,
    )
