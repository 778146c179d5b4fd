r"""A desired length that is planned in each update by a quadratic program over a horizon.

The planned motion is that of the identified actuator without sensor, in the force $w$ that is left
when all of the model but inertia $m$, damping $d$ and a mean stiffness $K$ is subtracted:

$m\,\ddot x + d\,\dot x + K\,(x - x_0) = w,\quad w = F_u - h(x)$

with the rest $h$ of elastic force, branches, weight and load. Over a horizon of stages of constant
$w$, the plan minimises

$\sum_k \beta_k (x_k - r_k)^2 + \frac{4}{\omega^2} (\dot x_k - \dot r_k)^2 +
\frac{1}{\omega^4} (\ddot x_k - \ddot r_k)^2,\quad l_k \le w_k \le h_k$

so that without limits it follows the reference with two poles, the slower one at $-0.52\,\omega$.
The box is that of the electric force between the lowest drive and the highest one that drive and
field allow at the length of stage $k$, less a reserve for the feedback. The weight $\beta_k$ is 1,
and 25 for lengths beyond a desired one that stays: otherwise a limited force would overshoot.
Box, weights and $h$ are computed along the plan of the previous iteration; the first one uses
the plan of the previous update.

While the actuator cannot follow the plan because the drive is at its limit, the plan starts from
the estimated length and speed instead of those that were planned.

Source: D. Q. Mayne, M. M. Seron and S. V. Rakovic, Automatica 41 (2005), 219, for a plan on the
nominal model with tightened limits beside a feedback; M. Diehl, H. G. Bock and J. P. Schloeder,
SIAM J. Control Optim. 43 (2005), 1714, for one program in each update.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from haselab.controllers.known_actuator import KnownActuator
from haselab.controllers.model_based.box_qp import solve_box
from haselab.controllers.motion_model import MotionModel
from haselab.controllers.reference_plan import ReferencePlan, cubic

__all__ = ["STAGES", "PredictedPlan"]

Floats = NDArray[np.float64]
_Here = tuple[float, float]
STAGES = 16
_SPEED = 2.0  # of the pole's time constant: weight of the speed's error
_BEYOND = 5.0  # weight of a length beyond a desired one that stays
_LENGTHS = 201  # of the tables of forces
_STIFFNESSES = 5  # of the models over the reachable range
_ROUNDS, _FIRST_ROUNDS = 1, 6  # of a program: along a known plan, and after a jump
_NEAR_END = 0.2  # of the force that is left at the desired length, for the feedback at most
_RESTS = 1e-6  # of the reachable range: so near, the plan rests
_SAME_N = 1e-9


class PredictedPlan(ReferencePlan):
    """The desired length at the time at which a drive acts, by receding-horizon programs.

    Args:
        model: of the motion.
        known: limits of drive and field.
        period_s: between two drives.
        reserve: share of the force's range that a plan leaves to the feedback.
        rate_v_per_s: fastest change of the drive.
        pole_rad_s: of the planned motion where no limit acts.
        stage_s: duration of a stage; the nearest whole number of periods is used.
    """

    def __init__(
        self, model: MotionModel, known: KnownActuator, period_s: float, reserve: float,
        rate_v_per_s: float, pole_rad_s: float, stage_s: float,
    ) -> None:  # fmt: skip
        self._pole, self._steps = pole_rad_s, max(round(stage_s / period_s), 1)
        self._stage_s = self._steps * period_s
        super().__init__(model, known, period_s, reserve, rate_v_per_s)

    def exchange(self, model: MotionModel, known: KnownActuator) -> None:
        """Plan with another model from now on.

        Args:
            model: of the motion.
            known: limits of drive and field.
        """
        super().exchange(model, known)
        low, high = known.reachable()
        width = known.zero_length_m * (high - low)
        self._near_m = _RESTS * width
        ends_m = known.length_m(low) - 0.5 * width, known.length_m(high) + 0.5 * width
        lengths_m = self._lengths_m = np.linspace(*ends_m, _LENGTHS)
        each = lengths_m.tolist()
        self._elastic_n = np.array([model.elastic_n(length_m) for length_m in each])
        low_v = max(known.low_v, 0.0)
        forces_n = np.array([
            sorted((model.pull_n(x, low_v), model.pull_n(x, max(known.highest_drive_v(x), low_v))))
            for x in each
        ])  # fmt: skip
        self._least_n, self._most_n = forces_n.T.copy()
        self._creeping = 1.0 + sum(share for share, _ in model.branches)
        inside = (lengths_m >= known.length_m(low)) & (lengths_m <= known.length_m(high))
        slopes = self._creeping * np.gradient(self._elastic_n, lengths_m)[inside]
        values = np.linspace(float(slopes.min()), float(slopes.max()), _STIFFNESSES)
        self._programs = [_Program(model, stiffness, self._stage_s, self._pole, self._period_s)
                          for stiffness in values.tolist()]  # fmt: skip

    def begin(self, length_m: float) -> None:
        """Rest at a length."""
        super().begin(length_m)
        self._planned: Floats | None = None  # lengths of the stages, the first at the next drive
        self._forces_n = np.zeros(STAGES)
        self._beyond = False

    def next(
        self, wanted_m: list[float], acts_s: float, state: list[float]
    ) -> tuple[float, float, float]:
        """Length, speed, and mean acceleration until the next drive.

        Args:
            wanted_m: desired length of the block that ended, and of those that come.
            acts_s: from the end of that block to the effect of the drive.
            state: then.
        """
        samples = self._samples_m(wanted_m)
        place = acts_s / self._period_s + 2.0  # of the samples, the drive's effect
        at = min(int(place + 1e-9), len(samples) - 1)
        # a plan that asks for more than the limits starts again where the actuator is
        here, target_m = (state[0], state[1]) if self._beyond else self._here, samples[at]
        self._beyond = False
        if len(samples) > at + 4 and self.smooth(samples, at):
            samples = self.before_step(samples, at)
            reference = self._followed(samples, place)
            rests = max(samples) - min(samples) < self._near_m
        else:
            reference, rests = np.tile([[target_m], [0.0]], STAGES + 1), True
        if rests and target_m != self._target_m:
            self._planned = None
        self._target_m = target_m
        near = abs(here[0] - target_m) < self._near_m
        if rests and near and abs(here[1]) * self._stage_s < self._near_m:
            self._planned, self._here = None, (target_m, 0.0)
            return target_m, 0.0, 0.0
        after = self._here = self._solved(here, reference, state, rests)
        return (*here, (after[1] - here[1]) / self._period_s)

    def _followed(self, samples: list[float], place: float) -> Floats:
        """Length and speed of a smooth reference at the ends of the stages, on straight after."""
        last, period_s = float(len(samples) - 2), self._period_s
        places = place + self._steps * np.arange(STAGES + 1.0)
        known = [cubic(samples, at, period_s) for at in places[places < last].tolist()]
        length_m, speed = cubic(samples, last, period_s)
        after_s = period_s * (places[places >= last] - last)
        on = np.stack([length_m + after_s * speed, np.full(after_s.size, speed)])
        return np.hstack([np.array(known).reshape(-1, 2).T, on])

    def _solved(self, here: _Here, reference: Floats, state: list[float], rests: bool) -> _Here:
        """Length and speed one period later, on the plan that is best from here on.

        Args:
            here: length and speed at the next drive.
            reference: length and speed at the ends of all stages, the beginning first.
            state: from which the branches and the load are.
            rests: whether the desired length is one that stays.
        """
        rounds = _ROUNDS
        if self._planned is None:
            rounds, way = _FIRST_ROUNDS, np.arange(STAGES + 1) / STAGES
            self._planned = here[0] + way * (reference[0, -1] - here[0])
        reached_m = np.r_[self._planned, reference[0, -1], here[0]]
        program = self._program_of(float(reached_m.min()), float(reached_m.max()))
        weights = np.ones(STAGES)
        for _ in range(rounds):
            lengths_m = 0.5 * (self._planned[1:] + self._planned[:-1])
            box_n, least_n, most_n, rest_n = self._box(lengths_m, reference, state)
            rest_n -= program.stiffness_n_per_m * (lengths_m - here[0])
            low_n, high_n = box_n - rest_n
            self._forces_n, ends_m = program.solved(
                here, reference, (low_n, high_n), self._forces_n, weights
            )
            if rests:
                beyond = (ends_m - reference[0, 1:]) * (reference[0, -1] - here[0]) > 0.0
                weights = np.where(beyond, _BEYOND, 1.0)
            self._planned = np.r_[here[0], ends_m]
        after = program.moved(here, float(self._forces_n[0]))
        first_n = float(self._forces_n[0] + rest_n[0])
        self._beyond = not least_n[0] - _SAME_N <= first_n <= most_n[0] + _SAME_N
        if self._steps == 1:
            self._planned = np.r_[self._planned[1:], self._planned[-1]]
            self._forces_n = np.r_[self._forces_n[1:], self._forces_n[-1]]
        return after

    def _box(
        self, lengths_m: Floats, reference: Floats, state: list[float]
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Least and largest electric force of the plan, those of the drive, and that of rest."""
        start_n = float(np.interp(state[0], self._lengths_m, self._elastic_n))
        outer_n = sum(state[2:-1]) - self._model.weight_n - state[-1]
        outer_n -= (self._creeping - 1.0) * start_n
        at, end = (
            [self._interpolated(where_m, table)
             for table in (self._elastic_n, self._least_n, self._most_n)]
            for where_m in (lengths_m, reference[0, 1:])
        )  # fmt: skip
        least_n, most_n, held_n = at[1], at[2], outer_n + self._creeping * end[0]
        spare_n = self._reserve * (most_n - least_n)
        box_n = np.stack([
            least_n + np.clip(_NEAR_END * (held_n - end[1]), -spare_n, spare_n),
            most_n - np.clip(_NEAR_END * (end[2] - held_n), -spare_n, spare_n),
        ])  # fmt: skip
        return box_n, least_n, most_n, outer_n + self._creeping * at[0]

    def _interpolated(self, lengths_m: Floats, table: Floats) -> Floats:
        return np.asarray(np.interp(lengths_m, self._lengths_m, table))

    def _program_of(self, low_m: float, high_m: float) -> _Program:
        """That of the mean stiffness between two lengths."""
        if high_m - low_m < 1e-3 * (self._lengths_m[-1] - self._lengths_m[0]):
            middle_m, width_m = 0.5 * (low_m + high_m), self._lengths_m[1] - self._lengths_m[0]
            low_m, high_m = middle_m - width_m, middle_m + width_m
        low_n, high_n = np.interp([low_m, high_m], self._lengths_m, self._elastic_n).tolist()
        stiffness = self._creeping * (high_n - low_n) / (high_m - low_m)
        return min(self._programs, key=lambda one: abs(one.stiffness_n_per_m - stiffness))


class _Program:
    """The quadratic program of one stiffness, in constant forces of the stages.

    Args:
        model: of the motion.
        stiffness_n_per_m: of the plan.
        stage_s: duration of a stage.
        pole_rad_s: of the planned motion.
        period_s: of an update.
    """

    def __init__(
        self, model: MotionModel, stiffness_n_per_m: float, stage_s: float, pole_rad_s: float,
        period_s: float,
    ) -> None:  # fmt: skip
        self.stiffness_n_per_m = stiffness_n_per_m
        mass, drag = model.inertia_kg, model.damping_n_s_per_m
        self._step, self._into = _held(mass, drag, stiffness_n_per_m, stage_s)
        self._period = _held(mass, drag, stiffness_n_per_m, period_s)
        free, forced = [np.eye(2)], [np.zeros((2, STAGES))]
        for k in range(STAGES):
            free.append(self._step @ free[-1])
            row = self._step @ forced[-1]
            row[:, k] += self._into
            forced.append(row)
        # errors of length, of speed over pole, and of acceleration over its square: rows of y
        w_speed, w_push = _SPEED / pole_rad_s, 1.0 / pole_rad_s**2
        x_free, x_forced = np.stack(free), np.stack(forced)  # (K+1, 2, 2) and (K+1, 2, K)
        push_free = np.diff(x_free[:, 1], axis=0) / stage_s
        push_forced = np.diff(x_forced[:, 1], axis=0) / stage_s
        self._free = np.concatenate(
            [x_free[1:, 0], w_speed * x_free[1:, 1], w_push * push_free]
        )  # (3K, 2)
        self._forced = np.concatenate(
            [x_forced[1:, 0], w_speed * x_forced[1:, 1], w_push * push_forced]
        )
        self._weights, self._stage_s = (w_speed, w_push), stage_s
        self._lengths = x_free[1:, 0], x_forced[1:, 0]
        # in units of the force that moves by a length of 1 at the pole
        self._unit_n = mass * pole_rad_s**2
        self._hessian = self._unit_n**2 * self._forced.T @ self._forced

    def moved(self, here: _Here, force_n: float) -> _Here:
        """Length and speed one period later, from those about which the stiffness acts."""
        step, into = self._period
        length_m, speed = step @ np.array([0.0, here[1]]) + into * force_n
        return here[0] + float(length_m), float(speed)

    def solved(
        self, here: _Here, reference: Floats, box_n: tuple[Floats, Floats], start_n: Floats,
        weights: Floats,
    ) -> tuple[Floats, Floats]:  # fmt: skip
        """Forces of the stages, and the lengths at their ends.

        Args:
            here: length and speed at the beginning.
            reference: length and speed at the ends of all stages, the beginning first.
            box_n: least and largest forces.
            start_n: first guess.
            weights: of the errors of length.
        """
        w_speed, w_push = self._weights
        first = np.array([0.0, here[1]])
        wanted = np.concatenate([
            reference[0, 1:] - here[0], w_speed * reference[1, 1:],
            w_push * np.diff(reference[1]) / self._stage_s,
        ])  # fmt: skip
        unit = self._unit_n
        scale = np.r_[weights, np.ones(2 * STAGES)]
        rows = unit * scale[:, None] * self._forced
        slope = rows.T @ (scale * (self._free @ first - wanted))
        low, high = box_n
        found = solve_box(rows.T @ rows, slope, low / unit, high / unit, start_n / unit)
        forces_n = unit * found.x
        free, forced = self._lengths
        return forces_n, here[0] + free @ first + forced @ forces_n


def _held(
    mass_kg: float, drag_n_s_per_m: float, stiffness_n_per_m: float, time_s: float
) -> tuple[Floats, Floats]:
    """Change of length and speed over a time, and by a constant force of 1 N."""
    block = np.zeros((3, 3))
    block[0, 1] = 1.0
    block[1] = -stiffness_n_per_m / mass_kg, -drag_n_s_per_m / mass_kg, 1.0 / mass_kg
    power = expm(block * time_s)
    return np.asarray(power[:2, :2]), np.asarray(power[:2, 2])
