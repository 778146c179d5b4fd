"""One resonance with a cubic spring (Duffing), or with a curve of its output (Wiener)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from haselab import _identify
from haselab.base import Estimate, InputError, ResultError, checked
from haselab.identify.fit import several
from haselab.identify.hold import fine_input
from haselab.identify.noise import coloured_covariance, fit_percent, whiteness_p
from haselab.identify.nonlinear.nonlinear_fit import NonlinearFit, fitted_part, no_fit, remarks
from haselab.identify.record import Record
from haselab.identify.transfer.layout import TransferStructure, layout_of
from haselab.identify.transfer.search import Best, best_fit
from haselab.identify.transfer.start import search_bounds

__all__ = ["fit_duffing", "fit_output_curve"]

Floats = NDArray[np.float64]
_PLANT = ("natural_frequency_rad_s", "damping_ratio", "gain", "delay_s")
_AT = _identify.OSCILLATOR  # places among the numbers of oscillator.h
_PLACES = (_AT["log_omega"], _AT["log_zeta"], _AT["gain"], _AT["delay"])
_SPRING = {2: _AT["q2"], 3: _AT["q3"]}
_BEGIN = [_AT["start"], _AT["rate"]]
_SHARES = (0.0, 0.1, 0.4, 1.5, -0.1, -0.4)  # cubic share of the spring's force
_FIRST = 3000  # outputs used to compare starts
_FIRST_STEPS = 8
_STEPS = 60
_WHITE = 1e-3  # whiteness above which no other start is tried
_KEPT = 2
_AT_REST = 1e-4  # relative decrease of the residuals' variance that ends the search
_MOST = 1e4  # of the output's span: a larger motion has diverged


@dataclass(frozen=True)
class _Oscillator:
    """Searched parameters: free ones of the plant, of the curve, and of each record.

    Args:
        structure: of the linear part; its fixed parameters are kept.
        powers: of the spring, or of the curve of the output.
        spring: whether they belong to the spring, not the output.
    """

    structure: TransferStructure
    powers: tuple[int, ...]
    spring: bool

    @property
    def kind(self) -> str:
        """Name of the model."""
        if not self.spring:
            return "wiener"
        return "duffing-asymmetric" if 2 in self.powers else "duffing"

    @property
    def given(self) -> Floats:
        """Fixed parameters of the plant in searched form, else NaN. Shape `(4,)`."""
        layout = layout_of(self.structure)
        omega, zeta, delay = layout.template
        return np.array([omega, zeta, layout.factor_template[0], delay])

    @property
    def free(self) -> NDArray[np.intp]:
        """Positions of the plant's free parameters."""
        return np.flatnonzero(np.isnan(self.given))

    @property
    def own(self) -> int:
        """Number of parameters of one record: initial state and offset."""
        return 2 * self.structure.initial_state + self.structure.offset

    @property
    def shared(self) -> int:
        """Number of parameters common to all records."""
        return self.free.size + len(self.powers)

    def names(self) -> tuple[str, ...]:
        """Names of the nonlinearity's parameters."""
        stem = "stiffness_ratio" if self.spring else "output_curve"
        return tuple(f"{stem}_{k}" for k in self.powers)


@dataclass(frozen=True)
class _End:
    numbers: Floats
    residuals: tuple[Floats, ...]
    columns: tuple[Floats, ...]
    cost: float
    settled: bool


class _Search:
    """Least squares over several records; parameters as in `_Oscillator`."""

    def __init__(self, model: _Oscillator, records: Sequence[Record]) -> None:
        self.model, self.records = model, records
        self._inputs = [fine_input(r) for r in records]
        self._count = sum(r.y.size for r in records)
        self._largest = _MOST * max(float(np.ptp(r.y)) for r in records)

    def at(self, numbers: Floats) -> _End | None:
        """Residuals and sensitivities; None where the motion diverges."""
        size = numbers.size
        residuals, columns, cost = [], [], 0.0
        for i, r in enumerate(self.records):
            modelled, z = self._record(numbers, i, size)
            if modelled is None:
                return None
            e = r.y - modelled
            cost += float(e @ e)
            residuals.append(e)
            columns.append(z)
        if not math.isfinite(cost):
            return None
        return _End(numbers, tuple(residuals), tuple(columns), cost, False)

    def _record(self, numbers: Floats, i: int, size: int) -> tuple[Floats | None, Floats]:
        model, r = self.model, self.records[i]
        plant = model.given.copy()
        plant[model.free] = numbers[: model.free.size]
        curve = numbers[model.free.size : model.shared]
        first = model.shared + i * model.own
        inner = np.zeros(len(_AT))
        inner[list(_PLACES)] = plant
        if model.spring:
            inner[[_SPRING[k] for k in model.powers]] = curve
        if model.structure.initial_state:
            inner[_BEGIN] = numbers[first : first + 2]
        u, rate_hz = self._inputs[i]
        x, by, finite = _identify.oscillate(
            u, rate_hz, r.input_before or 0.0, r.hold != "zero",
            np.ascontiguousarray(r.output_time_s), inner.tolist(), self._largest,
        )  # fmt: skip
        z = np.zeros((r.y.size, size))
        if not finite:
            return None, z
        modelled, slope = x, np.ones(1)
        if not model.spring:
            modelled = x + sum(c * x**k for c, k in zip(curve, model.powers, strict=True))
            slope = 1.0 + sum(
                k * c * x ** (k - 1) for c, k in zip(curve, model.powers, strict=True)
            )
        z[:, : model.free.size] = (slope * by[[_PLACES[k] for k in model.free]]).T
        for column, k in enumerate(model.powers, start=model.free.size):
            z[:, column] = by[_SPRING[k]] if model.spring else x**k
        if model.structure.initial_state:
            z[:, first : first + 2] = (slope * by[_BEGIN]).T
        if model.structure.offset:
            z[:, first + model.own - 1] = 1.0
            modelled = modelled + numbers[first + model.own - 1]
        return modelled, z

    def minimise(self, start: Floats, bounds: tuple[Floats, Floats], steps: int) -> _End | None:
        """Levenberg-Marquardt search, with bounds on the parameters of the plant."""
        end = self.at(start)
        if end is None:
            return None
        damping = 1e-3
        free = self.model.free.size
        for _ in range(steps):
            z = np.vstack(end.columns)
            e = np.concatenate(end.residuals)
            scale = np.maximum(np.linalg.norm(z, axis=0), 1e-300)
            gram, right = (z / scale).T @ (z / scale), (z / scale).T @ e
            better = None
            while damping < 1e8:
                step = np.linalg.solve(gram + damping * np.eye(scale.size), right) / scale
                numbers = end.numbers + step
                numbers[:free] = np.clip(numbers[:free], *bounds)
                better = self.at(numbers)
                if better is not None and better.cost < end.cost:
                    break
                better, damping = None, 6.0 * damping
                if float(right @ (scale * step)) < _AT_REST * end.cost / self._count:
                    break
            if better is None:
                return replace(end, settled=True)
            gained, end = end.cost - better.cost, better
            damping = max(damping / 10.0, 1e-12)
            if gained < _AT_REST * end.cost / self._count and damping < 1e-2:
                return replace(end, settled=True)
        return end


@dataclass(frozen=True)
class _Fitted:
    model: _Oscillator
    numbers: Floats
    bounds: tuple[Floats, Floats]

    def simulated_after(self, records: Sequence[Record]) -> list[Floats] | None:
        """Outputs simulated with a fit to the first three quarters."""
        early = fitted_part(records)
        if early is None:
            return None
        end = _Search(self.model, early).minimise(self.numbers, self.bounds, _STEPS)
        whole = None if end is None else _Search(self.model, records).at(end.numbers)
        if whole is None:
            return None
        return [r.y - e for r, e in zip(records, whole.residuals, strict=True)]

    def simulated(self, u: Floats, rate_hz: float) -> Floats:
        """Output for a new input, from rest at the input 0."""
        record = Record.sampled(u, np.arange(float(u.size)), rate_hz, 0.0)
        resting = replace(self.model.structure, initial_state=False, offset=False)
        search = _Search(replace(self.model, structure=resting), [record])
        return record.y - self._end(search, self.numbers[: self.model.shared]).residuals[0]

    def modelled(self, record: Record) -> Floats:
        """Output for a new record with the initial state and constant that suit it best."""
        search, shared = _Search(self.model, [record]), self.model.shared
        numbers = np.concatenate([self.numbers[:shared], np.zeros(self.model.own)])
        for _ in range(_FIRST_STEPS):
            end = self._end(search, numbers)
            own = end.columns[0][:, shared:]
            numbers[shared:] += np.linalg.lstsq(own, end.residuals[0], rcond=None)[0]
        return record.y - self._end(search, numbers).residuals[0]

    def _end(self, search: _Search, numbers: Floats) -> _End:
        end = search.at(numbers)
        if end is None:
            raise ResultError(
                "The model's motion grows without bound for this input. Use a smaller one."
            )
        return end


@checked
def fit_duffing(
    records: Record | Sequence[Record],
    structure: TransferStructure | None = None,
    powers: tuple[int, ...] = (3,),
    linear: Best | None = None,
) -> NonlinearFit:
    r"""Fit a resonance with a cubic spring (Duffing's equation) to all records.

    $\ddot x + 2\zeta\omega_n\dot x + \omega_n^2(x + q_2 x^2 + q_3 x^3) = g\,\omega_n^2 u(t - T_d)$,
    $y = x + y_0$: `stiffness_ratio_2` and `stiffness_ratio_3` are $q_2 = k_2/k$ and $q_3 = k_3/k$
    of $m\ddot x + c\dot x + k x + k_2 x^2 + k_3 x^3 = b u$.

    Args:
        records: experiments, or one.
        structure: two poles, no zeros or slow branches; its fixed parameters are kept.
        powers: `(3,)`, or `(2, 3)` for a spring that differs between both directions.
        linear: linear fit to start from; None: it is fitted first.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: another structure or power.
    Source: output-error least squares with sensitivities; Wigren and Schoukens, Proc. ECC (2013),
        2933 (the Silverbox).
    Example:
        >>> from haselab.models import Plant
        >>> rng = np.random.default_rng(7)
        >>> u, time_s = np.repeat(rng.normal(size=400), 10), np.arange(4000) / 400.0
        >>> y = Plant(0.5, 5.11, 0.09).simulate(u, 400.0, time_s) + 0.01 * rng.normal(size=4000)
        >>> fit = fit_duffing(Record(u, 400.0, y, time_s))
        >>> low, high = fit.parameters["stiffness_ratio_3"].ci95
        >>> fit.status, low < 0.0 < high
        ('ok', True)
    """
    return _fit(records, structure or TransferStructure(), powers, linear, spring=True)


@checked
def fit_output_curve(
    records: Record | Sequence[Record],
    structure: TransferStructure | None = None,
    powers: tuple[int, ...] = (2, 3),
    linear: Best | None = None,
) -> NonlinearFit:
    r"""Fit a resonance followed by a static curve of the output (Wiener model) to all records.

    $y = x + q_2 x^2 + q_3 x^3 + y_0$, with $x$ the output of the linear part

    Args:
        records: experiments, or one.
        structure: two poles, no zeros or slow branches; its fixed parameters are kept.
        powers: of the curve, 2 or 3 each.
        linear: as in `fit_duffing`.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: another structure or power.
    """
    return _fit(records, structure or TransferStructure(), powers, linear, spring=False)


def _fit(
    records: Record | Sequence[Record],
    structure: TransferStructure,
    powers: tuple[int, ...],
    linear: Best | None,
    *,
    spring: bool,
) -> NonlinearFit:
    if structure.poles != 2 or structure.zeros or structure.slow_modes:
        raise InputError(
            f"The structure has {structure.poles} poles, {structure.zeros} zeros and "
            f"{structure.slow_modes} slow branches; a nonlinear {'spring' if spring else 'output'} "
            "needs 2, 0 and 0. Fit one resonance."
        )
    if not powers or not set(powers) <= {2, 3}:
        raise InputError(f"powers = {powers}; it must be 2 or 3.")
    model = _Oscillator(structure, powers, spring)
    kind = model.kind
    layout, records = layout_of(structure), several(records)
    linear = best_fit(layout, records) if linear is None else linear
    if linear is None:
        return no_fit(structure, kind, "no start led to a stable linear model")
    settled = [
        replace(r, input_before=known.input_before or 0.0)
        for r, known in zip(records, linear.records, strict=True)
    ]
    low, high = search_bounds(layout, settled)
    bounds = _bounds(model, low, high, layout.free)
    starts = _starts(model, linear, settled)
    whole = _Search(model, settled)
    found = whole.minimise(starts[0], bounds, _STEPS)
    if found is None or whiteness_p(found.residuals) < _WHITE:
        tried = _Search(model, [_begin(r) for r in settled])
        ranked = [tried.minimise(s, bounds, _FIRST_STEPS) for s in starts[1:]]
        best = sorted((e for e in ranked if e is not None), key=lambda e: e.cost)[:_KEPT]
        ends = [found, *(whole.minimise(e.numbers, bounds, _STEPS) for e in best)]
        found = min((e for e in ends if e is not None), key=lambda e: e.cost, default=None)
    if found is None:
        return no_fit(structure, kind, "the motion diverges from every start")
    return _described(model, settled, found, bounds)


def _begin(record: Record) -> Record:
    """The first outputs of a record."""
    if record.y.size <= _FIRST or np.ptp(record.y[:_FIRST]) == 0.0:
        return record
    return replace(record, y=record.y[:_FIRST], output_time_s=record.output_time_s[:_FIRST])


def _bounds(
    model: _Oscillator, low: Floats, high: Floats, searched: NDArray[np.intp]
) -> tuple[Floats, Floats]:
    """Bounds of the linear search, in the order of the plant's parameters; a gain has none."""
    place = {0: 0, 1: 1, 2: 3}  # of a layout's numbers
    lowest, highest = np.full(4, -np.inf), np.full(4, np.inf)
    for k, at in enumerate(searched):
        lowest[place[int(at)]], highest[place[int(at)]] = low[k], high[k]
    return lowest[model.free], highest[model.free]


def _starts(model: _Oscillator, linear: Best, records: Sequence[Record]) -> list[Floats]:
    """Starts from the linear fit, with several splits of its stiffness into linear and cubic.

    For the same mean energy a cubic part $q_3$ adds $3 q_3 \\langle x^2\\rangle$ to the stiffness.
    """
    layout = layout_of(model.structure)
    omega, zeta, delay = layout.full(linear.found.search)
    factors = layout.factor_template.copy()
    factors[np.isnan(factors)] = linear.found.shared
    modelled = [r.y - e for r, e in zip(linear.records, linear.columns.residuals, strict=True)]
    # The model output without its offset is not known here; its mean is a close approximation.
    moved = [m - m.mean() for m in modelled]
    swing = float(np.mean(np.concatenate(moved) ** 2))
    starts = []
    for share in _SHARES:
        plant = np.array([omega, zeta, factors[0], delay])
        plant[0] -= 0.5 * math.log1p(share)
        plant[2] *= 1.0 + share
        curve = np.zeros(len(model.powers))
        if 3 in model.powers:
            third = share / (3.0 * swing) if swing > 0.0 else 0.0
            curve[model.powers.index(3)] = third if model.spring else -third
        own = []
        for record, m in zip(records, modelled, strict=True):
            if model.structure.initial_state:
                own += [float(factors[0]) * (record.input_before or 0.0), 0.0]
            if model.structure.offset:
                own.append(float(m.mean()) - float(factors[0]) * float(record.u.mean()))
        starts.append(np.concatenate([plant[model.free], curve, own]))
        if not model.spring and share == 0.0:
            return starts
    return starts


def _described(
    model: _Oscillator, records: Sequence[Record], found: _End, bounds: tuple[Floats, Floats]
) -> NonlinearFit:
    structure, shared = model.structure, model.shared
    kind = model.kind
    freed, own = _freed(found.columns, shared, model.own)
    inner = coloured_covariance(freed, found.residuals, found.numbers.size, own)
    if not np.isfinite(inner).all():
        return no_fit(structure, kind, "the parameters are not identifiable")
    plant = model.given.copy()
    plant[model.free] = found.numbers[: model.free.size]
    jacobian = np.zeros((4 + len(model.powers), shared))
    slope = np.array([math.exp(plant[0]), math.exp(plant[1]), 1.0, 1.0])
    jacobian[model.free, np.arange(model.free.size)] = slope[model.free]
    jacobian[4:, model.free.size :] = np.eye(len(model.powers))
    covariance = jacobian @ inner @ jacobian.T
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    omega, zeta = math.exp(plant[0]), math.exp(plant[1])
    estimates = {
        _PLANT[0]: Estimate.lognormal(omega, float(std[0]) / omega, "rad/s"),
        _PLANT[1]: Estimate.lognormal(zeta, float(std[1]) / zeta, ""),
        _PLANT[2]: Estimate.normal(float(plant[2]), float(std[2]), ""),
        _PLANT[3]: Estimate.normal(float(plant[3]), float(std[3]), "s"),
    }
    curve = found.numbers[model.free.size : shared]
    for k, name in enumerate(model.names()):
        estimates[name] = Estimate.normal(float(curve[k]), float(std[4 + k]), "")
    order = [0, 1, 3, 2, *range(4, 4 + curve.size)]  # order of a linear fit
    names = list(estimates)
    estimates = {names[k]: estimates[names[k]] for k in order}
    modelled = [r.y - e for r, e in zip(records, found.residuals, strict=True)]
    root = np.emath.sqrt(zeta * zeta - 1.0)
    terms = " + ".join(
        f"{c:.4g} x^{k}" for c, k in zip(curve.tolist(), model.powers, strict=True)
    ).replace("+ -", "- ")
    force = f"{plant[2]:.4g} u(t - {max(plant[3], 0.0):.4g} s)"
    equation = (
        f"x''/w^2 + 2 z x'/w + x + {terms} = {force}, w = {omega:.5g} rad/s, z = {zeta:.4g}, "
        "y = x + offset (Duffing)"
        if model.spring
        else f"y = x + {terms} + offset, x = G(s) u with one resonance (Wiener)"
    ).replace("+ -", "- ")
    return NonlinearFit(
        status="ok" if found.settled else "no result: the search did not converge",
        structure=structure,
        parameters=estimates,
        covariance=covariance[np.ix_(order, order)],
        poles=(complex(omega * (-zeta + root)), complex(omega * (-zeta - root))),
        fit_percent=fit_percent([r.y for r in records], modelled),
        residual_whiteness_p=whiteness_p(found.residuals),
        residuals=found.residuals,
        notes=(
            "Gain, natural frequency and damping ratio belong to the linear model for small "
            "motions about the input 0.",
            *remarks(whiteness_p(found.residuals), estimates["gain"]),
        ),
        kind=kind,
        equation=equation,
        operating_input=0.0,
        curve=model.names(),
        fitted_records=tuple(records),
        count=found.numbers.size,
        model=_Fitted(model, found.numbers, bounds),
    )


def _freed(
    columns: Sequence[Floats], shared: int, own: int
) -> tuple[list[Floats], list[Floats] | None]:
    """Common sensitivities orthogonal to each record's own functions, and these functions."""
    if not own:
        return [z[:, :shared] for z in columns], None
    freed, bases = [], []
    for i, z in enumerate(columns):
        first = shared + i * own
        basis = np.linalg.qr(z[:, first : first + own])[0]
        freed.append(z[:, :shared] - basis @ (basis.T @ z[:, :shared]))
        bases.append(basis)
    return freed, bases
