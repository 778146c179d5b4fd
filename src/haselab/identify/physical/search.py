"""Find the parameters of a physical model, from a start that may be far off."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from haselab.actuators.threads import in_threads
from haselab.identify.physical.information import vague_information
from haselab.identify.physical.misfit import Misfit
from haselab.identify.physical.unknowns import Unknowns

__all__ = ["SearchResult", "refine", "search"]

Floats = NDArray[np.float64]
_STAGES = 4  # before the last one; in each, the noise is assumed a tenth of that before
_FIRST_SHARE = 3.0  # of the signals' spread: noise of the first stage
_STEPS = 20  # of one stage
_LAST_STEPS = 40
_BEND = 3.0  # standard deviations from which a residual counts less, while the start counts
_DRAWN = 0.7  # widths, of further starts
_TRIALS = 24  # starts that are compared
_TRIED = 6  # of them, followed to the end of the first stage
_EXPLAINED = 0.1  # mean bounded square below which the first stage has explained the records
_LONGEST = 0.5  # step, in what varies over its width or as a logarithm
_FIRST_DAMPING = 1e-4  # of the normal equations, scaled to a diagonal of 1
_DAMPING = 1e-7  # the same of the last stage
_GLIMPSE = 0.1  # of a step, where the second order is measured
_ENOUGH = 1e-3  # relative decrease to be expected that ends a stage
_NEAR = 4.0  # decrease to be expected, in the same, above which nothing was found
_DONE = 1e-2  # the same of the last one, in the mean square of the residuals


@dataclass(frozen=True)
class SearchResult:
    """Result of a search.

    Args:
        unknowns: at the smallest misfit.
        residuals: over their standard deviations. Shape `(N,)`.
        jacobian: of the model over the standard deviations. Shape `(N, P)`.
        left: step of Gauss and Newton that remains, of what varies, as far as it is not longer than
            ten widths. Shape `(P,)`.
        converged: whether it is hardly expected to lower the misfit.
        evaluations: of the model.
    """

    unknowns: Unknowns
    residuals: Floats
    jacobian: Floats
    left: Floats
    converged: bool
    evaluations: int


def search(misfit: Misfit, start: Unknowns, evaluations: int = 0) -> SearchResult | None:
    """Minimise the misfit: first smoothly near the start, then by the data alone.

    A path of growing confidence in the data: in each stage the noise is assumed ten times smaller,
    and the start counts as an observation with the widths of the unknowns. So what the data
    determine well comes right first, while what they hardly determine stays near the start, and
    the strongly curved valley of the last stage is entered near its floor. Parts of the records
    that the model misses altogether, such as a collapse that the start predicts, count little
    there; if much of the records remains so after the first stage, another start is drawn within
    the widths. In the last stage, Levenberg-Marquardt, the start counts with ten times the widths:
    too little to move what the data determine, enough to end the search for what they do not. A
    stage that leaves more than the noise it assumed is the last one.

    Args:
        misfit: to minimise.
        start: first values.
        evaluations: of the model, made before.
    Returns:
        What was found; None if no motion exists near the start.
    """
    noise = max(1.0, _FIRST_SHARE * _spread(misfit))
    now, count = _first_stage(misfit, start, noise)
    if now is None:
        return None
    for _ in range(1, _STAGES):
        noise = max(1.0, 0.1 * noise)
        now, used = _descend(misfit, now, start, noise, _STEPS)
        count += used
        if float(np.mean(now.residuals**2)) > noise**2:  # a law that lacks something ends here
            return SearchResult(
                now.unknowns, now.residuals, now.jacobian, 0.0 * now.unknowns.values, False,
                evaluations + count,
            )  # fmt: skip
    return _last_stage(misfit, now, start, evaluations + count)


def refine(
    misfit: Misfit,
    start: Unknowns,
    evaluations: int = 0,
    *,
    steps: int = _LAST_STEPS,
    begun: Unknowns | None = None,
) -> SearchResult | None:
    """Minimise the misfit from near its minimum.

    Args:
        misfit: to minimise.
        start: first values.
        evaluations: of the model, made before.
        steps: at most.
        begun: starting values that count as a weak observation, of the same names; None: `start`.
            When a search continues, pass those of its first call; otherwise poorly determined
            parameters drift with each call.
    Returns:
        The new result; None if no motion exists there.
    """
    first = misfit.linearised(start)
    if first is None:
        return None
    return _last_stage(misfit, _State(start, *first), begun or start, evaluations + 1, steps)


def _last_stage(
    misfit: Misfit, now: _State, start: Unknowns, evaluations: int, steps: int = _LAST_STEPS
) -> SearchResult:
    now, used = _descend(misfit, now, start, 1.0, steps, last=True)
    pull = np.sqrt(vague_information(now.unknowns))
    columns = np.vstack([now.jacobian, np.diag(pull)])
    wanted = np.concatenate([now.residuals, -pull * now.unknowns.distance(start)])
    scale = np.linalg.norm(columns, axis=0)
    left, _ = _inside(
        now.unknowns,
        lambda free: np.linalg.lstsq(np.where(free, columns / scale, 0.0), wanted, rcond=None)[0],
    )
    expected = float(np.sum((columns @ (left / scale)) ** 2))
    usual = float(np.mean(now.residuals**2))
    return SearchResult(
        now.unknowns, now.residuals, now.jacobian, left / scale,
        expected < _NEAR * max(1.0, usual), evaluations + used,
    )  # fmt: skip


def _solution(matrix: Floats, slope: Floats, free: NDArray[np.bool_]) -> Floats:
    """Solve normal equations for some of the unknowns; the others stay."""
    some = np.ix_(free, free)
    found = np.zeros(slope.size)
    found[free] = np.linalg.lstsq(matrix[some], slope[free], rcond=1e-15)[0]
    return found


def _inside(
    unknowns: Unknowns, solution: Callable[[NDArray[np.bool_]], Floats]
) -> tuple[Floats, NDArray[np.bool_]]:
    """Step that crosses no limit, and which of the unknowns it moves.

    An unknown that the records hardly determine may end at its limit; the others go on.
    """
    free = np.ones(unknowns.values.size, dtype=np.bool_)
    step = solution(free)
    while (stopped := free & unknowns.at_limit(step)).any():
        free = free & ~stopped
        step = solution(free)
    return step, free


def _first_stage(misfit: Misfit, start: Unknowns, noise: float) -> tuple[_State | None, int]:
    """The best end of the first stage, from the start and others near it; evaluations used."""
    rng = np.random.default_rng(0)
    trials = [start] + [
        start.moved(_DRAWN * start.widths * rng.standard_normal(start.widths.size))
        for _ in range(_TRIALS)
    ]
    found = in_threads(misfit.residuals, trials, os.cpu_count() or 1)
    costs = [np.inf if part is None else _bounded(part, noise) for part in found]
    best: tuple[float, _State] | None = None
    count = len(trials)
    for k in np.argsort(costs)[:_TRIED]:
        first = misfit.linearised(trials[k])
        count += 1
        if first is None:
            continue
        now, used = _descend(misfit, _State(trials[k], *first), start, noise, _STEPS)
        count += used
        cost = _bounded(now.residuals, noise)
        if best is None or cost < best[0]:
            best = cost, now
        if cost < _EXPLAINED * now.residuals.size:
            break
    return (None if best is None else best[1]), count


def _bounded(residuals: Floats, noise: float) -> float:
    """Squares over the noise, of which large ones count little."""
    if not np.isfinite(residuals).all():
        return np.inf
    return float(_BEND**2 * np.log1p((residuals / (_BEND * noise)) ** 2).sum())


def _spread(misfit: Misfit) -> float:
    """Standard deviation of the signals over that of their noise."""
    parts = []
    for record in misfit.records:
        parts.append(np.std(record.length_m / record.length_std_m) if record.length_m.size else 0.0)
        if record.capacitance_f.size:
            parts.append(np.std(record.capacitance_f / record.capacitance_std_f))
    return float(max(parts))


@dataclass(frozen=True)
class _State:
    unknowns: Unknowns
    residuals: Floats
    jacobian: Floats


def _descend(
    misfit: Misfit, now: _State, start: Unknowns, noise: float, most: int, *, last: bool = False
) -> tuple[_State, int]:
    """One stage: state, evaluations used."""
    # at its limit, the own width of an inverse is hardly more than 0
    widths = start.vague_widths
    pull = vague_information(now.unknowns) if last else widths**-2.0

    def cost_of(unknowns: Unknowns, residuals: Floats) -> float:
        away = float((pull * unknowns.distance(start) ** 2).sum())
        return away + (float(residuals @ residuals) if last else _bounded(residuals, noise))

    damping = _DAMPING if last else _FIRST_DAMPING
    cost, count = cost_of(now.unknowns, now.residuals), 0
    for _ in range(most):
        weights = np.ones(now.residuals.size)
        if not last:
            weights = 1.0 / (noise**2 + (now.residuals / _BEND) ** 2)
        weighed = now.jacobian * weights[:, None]
        normal = weighed.T @ now.jacobian + np.diag(pull)
        slope = weighed.T @ now.residuals - pull * now.unknowns.distance(start)
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        correlation, slope = normal / np.outer(scale, scale), slope / scale
        left = float(slope @ _inside(now.unknowns, partial(_solution, correlation, slope))[0])
        done = _DONE * max(1.0, cost / now.residuals.size)
        if left < (done if last else max(_ENOUGH * cost, 1.0)):
            return now, count
        better: tuple[Unknowns, float] | None = None
        while better is None and damping < 1e6:
            damped = correlation + damping * np.eye(scale.size)
            step, free = _inside(now.unknowns, partial(_solution, damped, slope))
            step = step / scale
            longest = float(np.abs(np.where(now.unknowns.by_logarithm, step, step / widths)).max())
            step *= min(1.0, _LONGEST / max(longest, 1e-300))
            near = misfit.residuals(now.unknowns.moved(_GLIMPSE * step).within_limits())
            count += 1
            residuals = None
            if near is not None:
                # residuals of the second order, which bend the step along a curved valley
                bend = near - now.residuals + _GLIMPSE * (now.jacobian @ step)
                turn = weighed.T @ bend * (1.0 / _GLIMPSE**2) / scale
                bent = _solution(damped, turn, free) / scale
                if np.linalg.norm(bent * scale) < np.linalg.norm(step * scale):
                    trial = now.unknowns.moved(step + bent).within_limits()
                    residuals = misfit.residuals(trial)
                    count += 1
            if residuals is not None and np.isfinite(residuals).all():
                reached = cost_of(trial, residuals)
                if reached < cost:
                    better = trial, reached
                    continue
            damping *= 10.0
        if better is None:
            return now, count
        cost = better[1]
        found = misfit.linearised(better[0])
        count += 1
        if found is None:
            return now, count
        now, damping = _State(better[0], *found), max(0.1 * damping, 1e-12)
    return now, count
