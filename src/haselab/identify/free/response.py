"""Free response of a dropped mass: decay, frequencies (eqs. 6 and 7) and envelopes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import Estimate, InputError, JsonObject, check_fields, checked
from haselab.base.chart import Chart
from haselab.identify.charts import time_chart
from haselab.identify.fit import CurveFit, Prediction, propagated, rescaled
from haselab.identify.free.envelope import Swing, envelope_decay
from haselab.identify.noise import (
    autoregression,
    coloured_covariance,
    r_squared,
    whiteness_p,
)
from haselab.identify.projection import Basis, Solution, minimise, project
from haselab.identify.record import finite_vector

__all__ = ["FreeResponseFit", "FreeTrial", "fit_free_response"]

Floats = NDArray[np.float64]
_THIN = 400
_SIGNIFICANT = 6.0
_AT_LEAST = 0.05  # of the logarithm: a decay this close to its lower bound is at it
_WHITE = 0.05


@dataclass(frozen=True)
class FreeTrial:
    """One free motion.

    Args:
        x: displacement or strain. Shape `(N,)`.
        time_s: rising times, in s. Shape `(N,)`.
    Raises:
        InputError: wrong shapes, NaN, times that do not rise, a constant motion.
    """

    x: Floats
    time_s: Floats
    made_by: ClassVar[str] = "Make one of two columns: haselab.identify.FreeTrial(x, time_s)."

    def __post_init__(self) -> None:
        check_fields(self)
        for name in ("x", "time_s"):
            object.__setattr__(self, name, finite_vector(name, getattr(self, name), 16))
        if self.x.size != self.time_s.size or not (np.diff(self.time_s) > 0.0).all():
            raise InputError(
                f"x has {self.x.size} values and time_s {self.time_s.size}; they must be equally "
                "long, and the times must rise."
            )
        if np.ptp(self.x) == 0.0:
            raise InputError(
                f"The motion is {self.x[0]:g} throughout; it must change. Name the right column."
            )

    def moving(self) -> FreeTrial:
        """The motion from its largest deflection on, if it starts from rest; else all of it."""
        head = self.x[: max(4, self.x.size // 20)]
        if np.ptp(head) > 0.05 * np.ptp(self.x):
            return self
        rest = float(np.median(self.x[-max(4, self.x.size // 10) :]))
        start = int(np.argmax(np.abs(self.x - rest)))
        if np.abs(head - rest).max() >= 0.9 * abs(float(self.x[start]) - rest):
            start = int(np.argmax(np.abs(self.x - head.mean()) > 0.05 * np.ptp(self.x)))
        start = min(start, self.x.size - 16)
        return FreeTrial(self.x[start:], self.time_s[start:])


@dataclass(frozen=True, kw_only=True)
class FreeResponseFit(CurveFit):
    r"""Fit of $x = x_0 + c\,e^{-t/\tau} + A e^{-\delta t}\cos(\omega_d t - \varphi_0)$.

    Time counts from the first sample, or from the release where the record starts from rest.

    See `Fit` for what all fits have. Its `parameters` are `damped_frequency_rad_s`,
    `decay_rate_per_s`, `natural_frequency_rad_s`, `damping_ratio`, and of the first trial
    `amplitude`, `phase_rad`.

    Args:
        envelope_positive_decay_per_s: decay through the positive peaks; None with fewer than two.
        envelope_negative_decay_per_s: the same through the negative peaks.
        trials: separate fit of each trial; empty for a single trial.
        r_squared: share of the variance that is explained.
        residual_whiteness_p: Ljung-Box probability.
        modelled: fitted motion of each trial. Shape `(N_r,)` each.
        time_s: times of it, in s. Shape `(N_r,)` each.
        motion: of each trial: amplitudes of cosine and sine, position at rest, and creep.
        search: logarithms of decay rate and damped frequency, and with creep of its time constant.
    """

    envelope_positive_decay_per_s: Estimate | None = None
    envelope_negative_decay_per_s: Estimate | None = None
    trials: tuple[FreeResponseFit, ...] = ()
    r_squared: float = math.nan
    residual_whiteness_p: float = math.nan
    modelled: tuple[Floats, ...] = field(repr=False)
    time_s: tuple[Floats, ...] = field(repr=False)
    motion: tuple[Floats, ...] = field(repr=False)
    search: Floats = field(repr=False)

    @checked
    def simulate(self, x: ArrayLike) -> Floats:
        """Motion of the first trial at times since its release, in s; see `CurveFit`."""
        self._require()
        time_s = np.atleast_1d(np.asarray(x, dtype=np.float64))
        return np.asarray(_shapes(self.search, time_s) @ self.motion[0])

    @checked
    def compare(self, x: ArrayLike, y: ArrayLike) -> Prediction:
        """Predict another free motion with the fitted frequency and decay, and compare.

        Amplitude, phase and position at rest are those that suit the new motion best.

        Args:
            x: times, in s. Shape `(N,)`.
            y: motion. Shape `(N,)`.
        Returns:
            The fit in percent, the error, and the predicted motion.
        Raises:
            ResultError: the fit has no result.
            InputError: wrong shapes, times that do not rise, no motion.
        """
        self._require()
        new = FreeTrial(np.asarray(y), np.asarray(x)).moving()
        shapes = _shapes(self.search, new.time_s - new.time_s[0])
        own = np.linalg.lstsq(shapes, new.x, rcond=None)[0]
        return Prediction.of([new.x], [shapes @ own])

    def chart(self, names: tuple[str, str] | None = None) -> Chart:
        """See `Fit`; the first trial from its release on."""
        modelled, time_s = self.modelled[0], np.asarray(self.time_s[0])
        measured = modelled + self.residuals[0]
        output = (names or ("", "Motion"))[1]
        return time_chart("Free response", time_s, measured, modelled, (output, "fit"))

    def answer(self) -> JsonObject:
        """The result under its public JSON keys."""
        keys = ("damped_frequency_rad_s", "decay_rate_per_s", "natural_frequency_rad_s",
                "damping_ratio", "amplitude", "phase_rad")  # fmt: skip
        return {
            **{key: self.parameters.get(key) for key in keys},
            "envelope_positive_decay_per_s": self.envelope_positive_decay_per_s,
            "envelope_negative_decay_per_s": self.envelope_negative_decay_per_s,
            "r_squared": self.r_squared,
            "residual_whiteness_p": self.residual_whiteness_p,
            "trials": [trial.answer() for trial in self.trials],
            "status": self.status,
            "notes": list(self.notes),
        }


@checked
def fit_free_response(
    trials: FreeTrial | Sequence[FreeTrial],
    *,
    creep: bool | None = None,
    near: FreeResponseFit | None = None,
) -> FreeResponseFit:
    r"""Fit all trials jointly, each with its own amplitude, phase, offset and creep.

    $\omega_0 = \sqrt{\omega_d^2 + \delta^2},\quad \zeta = \delta/\omega_0$

    Args:
        trials: free motions, or one; samples before the drop are left out.
        creep: whether to add exponential creep to the oscillation. None: added if the fit
            without it has coloured residuals or no result, and the fit with it is better.
    Returns:
        The fit. With several trials the spread between them widens the intervals.
    Raises:
        InputError: no trial.
    Source: reference study, eqs. 6 and 7; variable projection.
    Example:
        >>> t = np.arange(800) / 400.0
        >>> x = 0.01 * np.exp(-4.0 * t) * np.cos(32.0 * t - 0.3)
        >>> x = x + 1e-4 * np.random.default_rng(1).normal(size=t.size)
        >>> fit = fit_free_response(FreeTrial(x, t))
        >>> low, high = fit.parameters["damped_frequency_rad_s"].ci95
        >>> low < 32.0 < high
        True
    """
    trials = [trials] if isinstance(trials, FreeTrial) else trials
    if len(trials) == 0:
        raise InputError("trials is empty. Pass at least one FreeTrial.")
    moving = [trial.moving() for trial in trials]
    joint = _fit(moving, bool(creep), near)
    if creep is None and not (joint.succeeded and joint.residual_whiteness_p >= _WHITE):
        joint, creep = _better(joint, _fit(moving, True), moving)
    if len(trials) == 1 or not joint.succeeded:
        return joint
    parts = [None] * len(moving) if near is None or not near.trials else near.trials
    alone = tuple(
        _fit([trial], bool(creep), part) for trial, part in zip(moving, parts, strict=True)
    )
    good = [fit for fit in alone if fit.succeeded]
    if len(good) < 2:
        return joint
    estimates = dict(joint.parameters)
    for name in list(estimates)[:4]:
        values = np.array([fit.parameters[name].value for fit in good])
        between = float(values.std(ddof=1) / math.sqrt(values.size))
        old = estimates[name]
        std = max(old.std, between)
        estimates[name] = Estimate.lognormal(old.value, std / old.value, old.unit)
    wider = rescaled(joint.covariance, np.array([e.std for e in estimates.values()]))
    return replace(joint, parameters=estimates, covariance=wider, trials=alone)


def _better(
    plain: FreeResponseFit, creeping: FreeResponseFit, trials: Sequence[FreeTrial]
) -> tuple[FreeResponseFit, bool]:
    """The fit with creep if its BIC is clearly better, and whether it was chosen."""
    if not creeping.succeeded:
        return plain, False
    if not plain.succeeded:
        return creeping, True
    count = sum(trial.x.size for trial in trials)
    numbers = 1 + len(trials)
    gain = count * math.log((1.0 - plain.r_squared) / max(1.0 - creeping.r_squared, 1e-300))
    taken = gain > numbers * math.log(count)
    return (creeping, True) if taken else (plain, False)


def _basis(search: Floats, trial: FreeTrial) -> Basis:
    """`search` is log decay, log damped frequency and, with creep, log time constant."""
    t = trial.time_s - trial.time_s[0]
    decay, omega = math.exp(search[0]), math.exp(search[1])
    own = _shapes(search, t)
    cosine, sine, zero = own[:, 0], own[:, 1], np.zeros(t.size)
    by_search = [
        [-decay * t * cosine, -decay * t * sine, zero],
        [-omega * t * sine, omega * t * cosine, zero],
    ]
    if search.size == 3:
        by_search = [[*row, zero] for row in by_search]
        by_search.append([zero, zero, zero, math.exp(-search[2]) * t * own[:, 3]])
    slopes = np.stack([np.stack(row, axis=1) for row in by_search])
    known_slope = np.zeros((search.size, t.size))
    return Basis(trial.x, np.zeros((t.size, 0)), own, slopes, zero, known_slope)


def _shapes(search: Floats, t: Floats) -> Floats:
    """Decaying cosine and sine, 1, and the creep, at times since the release. Shape `(N, 3|4)`."""
    envelope = np.exp(-math.exp(search[0]) * t)
    swing = math.exp(search[1]) * t
    shapes = [envelope * np.cos(swing), envelope * np.sin(swing), np.ones(t.size)]
    if search.size == 3:
        shapes.append(np.exp(-math.exp(-search[2]) * t))
    return np.stack(shapes, axis=1)


def _bounds(trials: Sequence[FreeTrial], creep: bool) -> tuple[Floats, Floats]:
    span_s = max(float(np.ptp(trial.time_s)) for trial in trials)
    step_s = min(float(np.median(np.diff(trial.time_s))) for trial in trials)
    low = [math.log(0.01 / span_s), math.log(1.0 / span_s)]
    high = [math.log(1.0 / step_s), math.log(math.pi / step_s)]
    if creep:
        low.append(math.log(0.05 * span_s))
        high.append(math.log(20.0 * span_s))
    return np.array(low), np.array(high)


def _search(
    trials: Sequence[FreeTrial], creep: bool, near: FreeResponseFit | None
) -> tuple[Solution, bool]:
    """Grid of frequency and damping on few samples, then all samples."""
    low, high = _bounds(trials, creep)
    if near is not None and near.search.size == low.size:
        return minimise(
            lambda s: [_basis(s, trial) for trial in trials], near.search, (low, high), gain=0.0
        )
    stride = [max(1, trial.x.size // _THIN) for trial in trials]
    few = [FreeTrial(r.x[::k], r.time_s[::k]) for r, k in zip(trials, stride, strict=True)]
    ceiling = min(math.pi / float(np.median(np.diff(trial.time_s))) for trial in few)
    starts = []
    for omega in np.geomspace(math.exp(low[1]), 0.8 * ceiling, 60):
        for ratio in (0.01, 0.05, 0.2, 0.7):
            start = [math.log(ratio * omega), math.log(omega)]
            start += [0.5 * (low[2] + high[2])] if creep else []
            search = np.clip(np.array(start), low, high)
            starts.append(project(search, [_basis(search, trial) for trial in few]))
    starts.sort(key=lambda solution: solution.cost)
    polished = [
        minimise(lambda s: [_basis(s, trial) for trial in few], start.search, (low, high), 20)[0]
        for start in starts[:3]
    ]
    best = min(polished, key=lambda solution: solution.cost)
    return minimise(lambda s: [_basis(s, trial) for trial in trials], best.search, (low, high))


def _fit(
    trials: Sequence[FreeTrial], creep: bool, near: FreeResponseFit | None = None
) -> FreeResponseFit:
    solution, settled = _search(trials, creep, near)
    modelled = tuple(r.x - e for r, e in zip(trials, solution.residuals, strict=True))
    times = tuple(trial.time_s for trial in trials)
    estimates, covariance = _estimates(trials, solution)
    measured, explained = np.concatenate([r.x for r in trials]), np.concatenate(modelled)
    least = _bounds(trials, creep)[0][0]
    status = _judged(solution, estimates, settled, decays=solution.search[0] > least + _AT_LEAST)
    fit = FreeResponseFit(
        status=status, residuals=tuple(solution.residuals), modelled=modelled, time_s=times,
        motion=tuple(solution.own), search=solution.search,
    )  # fmt: skip
    if not fit.succeeded:
        return fit
    envelopes = {sign: _envelope(trials, solution, sign) for sign in (1.0, -1.0)}
    notes = [
        f"Fewer than two {name} peaks are above the noise, so there is no envelope of them."
        for sign, name in ((1.0, "positive"), (-1.0, "negative"))
        if envelopes[sign] is None
    ]
    white = whiteness_p(solution.residuals)
    if white < _WHITE:
        notes.append("The residuals are not white: the motion is not a single decaying cosine.")
    return replace(
        fit,
        parameters=estimates,
        covariance=covariance,
        notes=tuple(notes),
        envelope_positive_decay_per_s=envelopes[1.0],
        envelope_negative_decay_per_s=envelopes[-1.0],
        r_squared=r_squared(measured, explained),
        residual_whiteness_p=white,
    )


def _estimates(
    trials: Sequence[FreeTrial], solution: Solution
) -> tuple[dict[str, Estimate], Floats]:
    """Parameters with intervals by propagation from the joint covariance, and their covariance."""
    bases = [_basis(solution.search, trial) for trial in trials]
    width = sum(basis.own.shape[1] for basis in bases)
    columns, at = [], 0
    for basis, own in zip(bases, solution.own, strict=True):
        full = np.zeros((basis.target.size, solution.search.size + width))
        full[:, : solution.search.size] = (basis.by_search @ own).T
        begin = solution.search.size + at
        full[:, begin : begin + own.size] = basis.own
        at += own.size
        columns.append(full)
    covariance = coloured_covariance(columns, solution.residuals, columns[0].shape[1])
    decay, omega = np.exp(solution.search[:2])
    a, b = solution.own[0][:2]
    natural = math.hypot(omega, decay)
    first = solution.search.size
    share = (decay / natural) ** 2
    square = a * a + b * b or 1.0
    # Derivatives of the logarithm of each number, of the phase itself, by decay, frequency, a, b.
    slopes = np.array([
        [0.0, 1.0, 0.0, 0.0],
        [1.0, 0.0, 0.0, 0.0],
        [share, 1.0 - share, 0.0, 0.0],
        [1.0 - share, share - 1.0, 0.0, 0.0],
        [0.0, 0.0, a / square, b / square],
        [0.0, 0.0, -b / square, a / square],
    ])  # fmt: skip
    places = [0, 1, first, first + 1]
    relative = propagated(slopes, covariance[np.ix_(places, places)])
    std = np.sqrt(np.maximum(np.diag(relative), 0.0))
    size = math.hypot(a, b)
    estimates = {
        "damped_frequency_rad_s": Estimate.lognormal(omega, std[0], "rad/s"),
        "decay_rate_per_s": Estimate.lognormal(decay, std[1], "1/s"),
        "natural_frequency_rad_s": Estimate.lognormal(natural, std[2], "rad/s"),
        "damping_ratio": Estimate.lognormal(decay / natural, std[3], ""),
        "amplitude": Estimate.lognormal(size, std[4], ""),
        "phase_rad": Estimate.normal(math.atan2(b, a), std[5], "rad"),
    }
    scale = np.array([omega, decay, natural, decay / natural, size, 1.0])
    return estimates, np.asarray(relative * np.outer(scale, scale))


def _judged(
    solution: Solution, estimates: dict[str, Estimate], settled: bool, *, decays: bool
) -> str:
    if not decays:
        return "no result: no decay is visible, the oscillation is undamped or grows; record longer"
    if not settled:
        return "no result: the search did not converge; record longer or fit without creep"
    amplitude, omega = estimates["amplitude"], estimates["damped_frequency_rad_s"]
    if amplitude.value <= _SIGNIFICANT * amplitude.std or omega.value <= 3.0 * omega.std:
        return "no result: no decaying oscillation is visible; check the column, or trim the record"
    if any(e.std != e.std or math.isinf(e.std) for e in estimates.values()):
        return "no result: frequency and decay are not identifiable; record more periods"
    return "ok"


def _envelope(trials: Sequence[FreeTrial], solution: Solution, sign: float) -> Estimate | None:
    """Decay through the peaks of one sign, all trials pooled, offset and creep removed."""
    omega = math.exp(solution.search[1])
    decay = math.exp(solution.search[0])
    polynomial, variance = autoregression(solution.residuals)
    count = sum(trial.x.size for trial in trials)
    taken = solution.search.size + sum(own.size for own in solution.own)
    lean = math.atan2(decay, omega)
    swings = []
    for trial, own in zip(trials, solution.own, strict=True):
        basis = _basis(solution.search, trial)
        swing = trial.x - basis.own[:, 2:] @ own[2:]
        phase = math.atan2(own[1], own[0]) - lean + (0.0 if sign > 0 else math.pi)
        height = math.hypot(own[0], own[1]) * math.cos(lean)
        time_s = trial.time_s - trial.time_s[0]
        swings.append(Swing(time_s, sign * swing, phase, height, decay))
    return envelope_decay(swings, omega, (polynomial, variance * count / max(count - taken, 1)))
