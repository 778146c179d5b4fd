"""Hammerstein model: a polynomial of the input ahead of a linear transfer function."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, InputError, checked
from haselab.identify.fit import several
from haselab.identify.noise import coloured_covariance, fit_percent
from haselab.identify.nonlinear.nonlinear_fit import NonlinearFit, fitted_part, no_fit, remarks
from haselab.identify.prediction import fitted_output
from haselab.identify.record import Record
from haselab.identify.residual_tests import lags_of, means_before
from haselab.identify.transfer.fit import TransferFit
from haselab.identify.transfer.layout import Layout, TransferStructure, layout_of
from haselab.identify.transfer.parameters import numbers_of, poles_of, zeros_of
from haselab.identify.transfer.problem import Columns, TransferProblem
from haselab.identify.transfer.search import Best, best_fit
from haselab.identify.transfer.start import delay_margin_s

__all__ = ["DEGREES", "fit_hammerstein"]

Floats = NDArray[np.float64]
DEGREES = (2, 3)
_STEPS = 20
_HALVINGS = 6
_AT_REST = 1e-4  # relative decrease of the residuals' variance that ends the search
_WHITE = 1e-3  # whiteness above which no other start is tried


@dataclass(frozen=True)
class _Curve:
    r"""$v = \sum_k c_k \phi_k(d)$, $d = (u - m)/h$; with polynomials orthogonal on the inputs.

    Args:
        middle: m.
        half: h.
        basis: factors of $d, d^2, \dots$ of each polynomial. Shape `(D, D)`.
        factors: c; that of `lead` is 1, since the gain of the linear part multiplies all.
        lead: position of the largest factor.
    """

    middle: float
    half: float
    basis: Floats
    factors: Floats
    lead: int

    @classmethod
    def over(cls, records: Sequence[Record], degree: int, *, offset: bool) -> _Curve:
        u = np.concatenate([r.u for r in records])
        middle = 0.5 * float(u.max() + u.min()) if offset else 0.0
        half = float(np.abs(u - middle).max())
        powers = ((u - middle) / half)[:, None] ** np.arange(1, degree + 1)
        powers -= powers.mean(axis=0) * offset
        r = np.linalg.qr(powers / math.sqrt(u.size), mode="r")
        return cls(middle, half, np.linalg.inv(r).T, np.eye(degree)[0], 0)

    @property
    def searched(self) -> list[int]:
        """Positions of the factors that are searched."""
        return [k for k in range(self.factors.size) if k != self.lead]

    @property
    def powers(self) -> Floats:
        r"""Factors of $d, d^2, \dots$."""
        return np.asarray(self.factors @ self.basis)

    def turned(self, factors: Floats) -> _Curve:
        """The curve with other factors, the largest of them scaled to 1."""
        lead = int(np.argmax(np.abs(factors)))
        return replace(self, factors=factors / factors[lead], lead=lead)

    def at(self, u: Floats, factors: Floats | None = None) -> Floats:
        """Value of the curve, or of one with other factors."""
        powers = self.powers if factors is None else factors @ self.basis
        d = (u - self.middle) / self.half
        return np.asarray(np.polynomial.polynomial.polyval(d, np.concatenate([[0.0], powers])))

    def applied(
        self, records: Sequence[Record], factors: Floats | None = None
    ) -> list[Record] | None:
        """The records after the curve; None where an input becomes constant."""
        out = []
        for r in records:
            before = r.input_before
            if before is not None:
                before = float(self.at(np.array([before]), factors)[0])
            try:
                out.append(replace(r, u=self.at(r.u, factors), input_before=before))
            except InputError:
                return None
        return out

    def parts(self, records: Sequence[Record]) -> list[list[Record] | None]:
        """The records after each polynomial of the basis."""
        return [self.applied(records, row) for row in np.eye(self.factors.size)]

    def about(self, at: float) -> Floats:
        """Matrix from `factors` to those of $(u - at)^k$. Shape `(D, D)`."""
        d, size = (at - self.middle) / self.half, self.factors.size
        matrix = np.zeros((size, size))
        for k in range(1, size + 1):
            for j in range(1, k + 1):
                matrix[j - 1, k - 1] = math.comb(k, j) * d ** (k - j) / self.half**j
        return np.asarray(matrix @ self.basis.T)


@dataclass(frozen=True)
class _Solution:
    curve: _Curve
    best: Best
    columns: Columns


@dataclass(frozen=True)
class _Hammerstein:
    layout: Layout
    solution: _Solution
    linear: TransferFit  # behind the curve

    def simulated_after(self, records: Sequence[Record]) -> list[Floats] | None:
        """Outputs simulated with a fit to the first three quarters."""
        early = fitted_part(records)
        if early is None:
            return None
        at = self.solution
        found = _searched(self.layout, early, at.curve, [at.best.found.search])
        whole = None if found is None else found.curve.applied(records)
        if found is None or whole is None:
            return None
        # An offset of the curve is part of the record's own offset, which has been fitted.
        return TransferProblem(self.layout, whole, delay_margin_s(whole)).predict(found.best.found)

    def simulated(self, u: Floats, rate_hz: float) -> Floats:
        """Output for a new input, from rest at the input 0."""
        at = self.solution.curve.at
        bent = at(u) - at(np.zeros(1))
        return self.linear.rational.simulate(bent, rate_hz, np.arange(u.size) / rate_hz)

    def modelled(self, record: Record) -> Floats:
        """Output for a new record with the initial state and constant that suit it best."""
        bent = self.solution.curve.applied([record])
        if bent is None:
            return np.full_like(record.y, record.y.mean())  # the curve makes the input constant
        return fitted_output(self.linear.rational, bent[0])


@checked
def fit_hammerstein(
    records: Record | Sequence[Record],
    structure: TransferStructure | None = None,
    degree: int = 2,
    known: Sequence[Floats] = (),
) -> NonlinearFit:
    r"""Fit $y = G(s)\,f(u)$ with a polynomial $f$ of degree 2 or 3 to all records.

    $f(u) = g\,(u - u_0) + g_2 (u - u_0)^2 + g_3 (u - u_0)^3$ about the mean input $u_0$; $G$ has
    the static gain 1. `gain`, `gain_2` and `gain_3` are these factors, so `gain` is the slope at
    $u_0$. The strain of an actuator over its voltage squared is a polynomial of degree 2.

    Args:
        records: experiments, or one.
        structure: structure of the linear part. Default: one resonance with a delay.
        degree: 2 or 3.
        known: searched parameters of a linear fit to start from; its delay is then kept.
    Returns:
        The fit; `status` says "ok" or why there is no result.
    Raises:
        InputError: a degree other than 2 or 3.
    Source: output-error least squares by variable projection, the factors of the curve together
        with the poles; Ljung, System Identification (1999), section 5.2.
    Example:
        >>> from haselab.models import Plant
        >>> rng = np.random.default_rng(7)
        >>> u, time_s = np.repeat(rng.uniform(0.0, 2.0, 400), 10), np.arange(4000) / 400.0
        >>> y = Plant(0.5, 5.11, 0.09).simulate(u**2, 400.0, time_s) + 0.01 * rng.normal(size=4000)
        >>> fit = fit_hammerstein(Record(u, 400.0, y, time_s))
        >>> low, high = fit.parameters["gain_2"].ci95
        >>> fit.status, low < 0.5 < high
        ('ok', True)
    """
    records, structure = several(records), structure or TransferStructure()
    layout, kind = layout_of(structure), f"hammerstein-{degree}"
    if degree not in DEGREES:
        raise InputError(f"degree = {degree}; it must be 2 or 3.")
    levels = np.unique(np.concatenate([r.u for r in records]))
    if levels.size <= degree:
        return no_fit(
            structure,
            kind,
            f"the input has {levels.size} levels, but a curve of degree {degree} needs "
            f"{degree + 1}",
        )
    straight = _Curve.over(records, degree, offset=structure.offset)
    units = [straight.turned(row) for row in np.eye(degree)]
    solutions: list[_Solution] = []
    curves = units[:1] if known else (*units[:1], _likely(straight, records), *units[1:])
    for curve in curves:
        found = _searched(layout, records, curve, known)
        if found is None:
            continue
        solutions.append(found)
        if not known:  # search all delays
            again = _searched(layout, records, found.curve, [])
            solutions += [] if again is None else [again]
        if solutions[-1].best.whiteness_p > _WHITE:
            break
    if not solutions:
        return no_fit(structure, kind, "no start led to a stable model")
    return _described(layout, records, min(solutions, key=lambda s: s.best.found.cost))


def _likely(curve: _Curve, records: Sequence[Record]) -> _Curve:
    """Initial curve from a model with one impulse response for each polynomial.

    Source: Bai, Automatica 34 (1998), 333.
    """
    lags_s = lags_of(records)
    blocks = []
    for part in curve.parts(records):
        if part is None:
            return curve
        blocks.append(np.vstack([means_before(r, lags_s) for r in part]))
    y = np.concatenate([r.y - r.y.mean() for r in records])
    responses = np.linalg.lstsq(np.hstack(blocks), y, rcond=1e-6)[0].reshape(len(blocks), -1)
    sizes = np.array([np.linalg.norm(b, axis=0) for b in blocks]).mean(axis=0)
    return curve.turned(np.linalg.svd(responses * sizes)[0][:, 0])


def _searched(
    layout: Layout, records: Sequence[Record], curve: _Curve, known: Sequence[Floats]
) -> _Solution | None:
    """Gauss-Newton steps in curve and poles together; each is followed by a search of the poles."""
    curved = curve.applied(records)
    best = None if curved is None else best_fit(layout, curved, known)
    if best is None:
        return None
    margin_s = delay_margin_s(records)
    problems = [
        None if p is None else TransferProblem(layout, p, margin_s) for p in curve.parts(records)
    ]
    count = sum(r.y.size for r in records)
    columns = _extended(curve, problems, best)
    for _ in range(_STEPS):
        z = np.vstack(columns.sensitivities)
        step = np.linalg.lstsq(z, np.concatenate(columns.residuals), rcond=1e-12)[0]
        size = best.found.search.size
        # The output is linear in the gain times the curve, so both change together.
        shared = best.found.shared
        grown = float(step[size : size + shared.size] @ shared) / float(shared @ shared)
        change = np.zeros(curve.factors.size)
        change[curve.searched] = step[size + shared.size :]
        found = None
        for halving in range(_HALVINGS):
            part = 0.5**halving
            turned = curve.turned((1.0 + part * grown) * curve.factors + part * change)
            curved = turned.applied(records)
            if curved is None:
                continue
            start = np.clip(best.found.search + part * step[:size], *best.bounds)
            found = best_fit(layout, curved, [start])
            if found is not None and found.found.cost < best.found.cost:
                break
            found = None
        if found is None:
            break
        gained = best.found.cost - found.found.cost
        curve, best = turned, found
        columns = _extended(curve, problems, best)
        if gained < _AT_REST * best.found.cost / count:
            break
    return _Solution(curve, best, columns)


def _extended(curve: _Curve, problems: Sequence[TransferProblem | None], best: Best) -> Columns:
    """Sensitivities of poles and common factors, then of the curve's factors."""
    base = best.columns
    free = replace(best.found, own=[np.zeros_like(own) for own in best.found.own])
    extra = []
    for k in curve.searched:
        problem = problems[k]
        if problem is None:
            extra.append([np.zeros(e.size) for e in base.residuals])
            continue
        extra.append(
            [x - own @ (own.T @ x) for x, own in zip(problem.predict(free), base.own, strict=True)]
        )
    sensitivities = tuple(
        np.column_stack([z, *(part[i] for part in extra)]) for i, z in enumerate(base.sensitivities)
    )
    return Columns(base.residuals, sensitivities, base.own)


def _described(layout: Layout, records: Sequence[Record], at: _Solution) -> NonlinearFit:
    """Parameters with intervals about the mean input."""
    found, curve, structure = at.best.found, at.curve, layout.structure
    own = sum(factors.size for factors in found.own)
    degree, powers = curve.factors.size, curve.factors.size - 1
    kind = f"hammerstein-{degree}"
    parameters = found.search.size + found.shared.size + own + powers
    residuals = at.best.columns.residuals
    inner = coloured_covariance(at.columns.sensitivities, residuals, parameters, at.columns.own)
    if not np.isfinite(inner).all():
        return no_fit(structure, kind, "the curve is not identifiable")
    operating = float(
        np.average([r.u.mean() for r in records], weights=[r.u.size for r in records])
    )
    to_local = curve.about(operating)
    local = to_local @ curve.factors
    estimates, _, notes = numbers_of(layout, at.best, inner[:-powers, :-powers])
    names = list(estimates)
    linear = TransferFit(
        status="ok",
        structure=structure,
        parameters=dict(estimates),
        poles=poles_of(layout, layout.full(found.search), estimates),
        zeros=zeros_of(layout, layout.full(found.search), found),
    )
    # From (searched, common factors, curve) to (searched, local factors, local curve).
    size, shared = found.search.size, found.shared.size
    free = np.concatenate([np.isnan(layout.template), np.isnan(layout.factor_template)])
    logarithmic = np.array([name != "delay_s" for name in layout.names])
    numbers = layout.full(found.search)
    slope = np.where(logarithmic, np.exp(np.where(logarithmic, numbers, 0.0)), 1.0)
    factors = layout.factor_template.copy()
    factors[np.isnan(factors)] = found.shared
    by_curve = to_local[:, curve.searched]
    rows = len(names) + powers
    jacobian = np.zeros((rows, inner.shape[0]))
    at_free = np.flatnonzero(free)
    n = len(layout.names)
    for column, row in enumerate(at_free[:size]):
        jacobian[row, column] = slope[row]
    for column, row in enumerate(at_free[size:], start=size):
        jacobian[row, column] = local[0]
    jacobian[n : n + factors.size, size + shared :] = np.outer(factors, by_curve[0])
    gain = factors[0]
    gain_free = bool(np.isnan(layout.factor_template[0]))
    for k in range(1, degree):
        row = len(names) + k - 1
        if gain_free:
            jacobian[row, size] = local[k]
        jacobian[row, size + shared :] = gain * by_curve[k]
    covariance = jacobian @ inner @ jacobian.T
    blind = [i for i, name in enumerate(names) if not math.isfinite(estimates[name].std)]
    covariance[blind] = covariance[:, blind] = np.inf
    std = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    values = dict(zip(layout.factor_names, (factors * local[0]).tolist(), strict=True))
    for i, name in enumerate(names):
        if name in values and i not in blind:
            estimates[name] = Estimate.normal(values[name], float(std[i]), "")
    curve_names = tuple(f"gain_{k}" for k in range(2, degree + 1))
    for k, name in enumerate(curve_names, start=1):
        estimates[name] = Estimate.normal(
            float(gain * local[k]), float(std[len(names) + k - 1]), ""
        )
    modelled = [r.y - e for r, e in zip(records, residuals, strict=True)]
    terms = " + ".join(
        f"{estimates[name].value:.4g} d{'' if k == 1 else f'^{k}'}"
        for k, name in enumerate(("gain", *curve_names), start=1)
    )
    operation = f"{operating:.4g}"
    return NonlinearFit(
        status="ok" if found.settled else "no result: the search did not converge",
        structure=structure,
        parameters=estimates,
        covariance=covariance,
        poles=poles_of(layout, numbers, estimates),
        zeros=zeros_of(layout, numbers, found),
        fit_percent=fit_percent([r.y for r in records], modelled),
        residual_whiteness_p=at.best.whiteness_p,
        residuals=tuple(residuals),
        notes=(
            *notes,
            f"Gain, poles and zeros are the linear model for small changes about the input "
            f"{operation}, the mean of the records.",
            *remarks(at.best.whiteness_p, estimates["gain"]),
        ),
        kind=kind,
        equation=f"y = G(s) f(u), G(0) = 1, f = {terms}, d = u - {operation} (Hammerstein)",
        operating_input=operating,
        curve=curve_names,
        fitted_records=tuple(records),
        count=parameters,
        model=_Hammerstein(layout, at, linear),
    )
