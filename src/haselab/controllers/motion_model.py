r"""The identified motion in plain numbers, fast enough for each step of a controller.

$m\,\ddot x = m g + \Delta + F_u(x, V) - F(x) - \sum q_i - d\,\dot x,\qquad
\dot q_i = s_i\,\dot F - q_i/\tau_i$

with the load $\Delta$ beyond the known one. States: length in m, speed in m/s, forces $q_i$ of the
viscoelastic branches in N, $\Delta$ in N.
"""

from __future__ import annotations

import math
from copy import copy

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import GRAVITY_M_S2
from haselab.controllers.known_actuator import KnownActuator

__all__ = ["MotionModel"]

Floats = NDArray[np.float64]
_STEP_S = 1e-3  # longest step of the integration


class MotionModel:
    """Length, speed, creep and load of an identified actuator.

    Args:
        known: the actuator.
    Example:
        >>> from haselab.actuators import DeaStack
        >>> model = MotionModel(KnownActuator(DeaStack(), 0.1, 0.036, 0.0, 1.0, 3000.0))
        >>> state = model.at_rest(0.036, 0.5)
        >>> abs(model.moved(state, 0.5, 0.1)[0] - 0.036) < 1e-9
        True
    """

    def __init__(self, known: KnownActuator) -> None:
        table, losses = known.table, known.law.losses
        self._low_m, self._step_m = table.low_m, table.step_m
        self._elastic = known.elastic_knots_n
        self._last = len(self._elastic) - 2
        self._per_v2: list[list[float]] = table.pull_n_v2.tolist()
        self._step_v, self._gain = table.step_v, known.gain_v_per_v
        self._carrier_v2 = known.carrier_v2
        self.weight_n = GRAVITY_M_S2 * known.mass_kg
        self.inertia_kg = known.mass_kg + known.added_inertia_kg + known.law.moving_mass_kg
        self.damping_n_s_per_m = losses.damping_n_s_per_m
        self.branches = list(zip(losses.branch_share, losses.branch_relaxation_s, strict=True))

    def stiffened(self, length_m: float, factor: float) -> MotionModel:
        """The same motion with another stiffness about a length, at which the force stays.

        Args:
            length_m: of the rest.
            factor: on the stiffness.
        """
        found, rest_n = copy(self), self.elastic_n(length_m)
        found._elastic = [rest_n + factor * (force - rest_n) for force in self._elastic]
        return found

    def hung(self, mass_kg: float) -> MotionModel:
        """The same motion with another hung mass."""
        found, weight_n = copy(self), GRAVITY_M_S2 * mass_kg
        found.inertia_kg += (weight_n - self.weight_n) / GRAVITY_M_S2
        found.weight_n = weight_n
        return found

    def _at(self, length_m: float) -> tuple[int, float]:
        place = (length_m - self._low_m) / self._step_m
        column = min(max(int(place), 0), self._last)
        return column, place - column

    def elastic_n(self, length_m: float) -> float:
        """Elastic force of the relaxed actuator, in N; beyond the table it goes on straight."""
        k, share = self._at(length_m)
        return self._elastic[k] + share * (self._elastic[k + 1] - self._elastic[k])

    def pull_n(self, length_m: float, drive_v: float) -> float:
        """Electric force at a drive, carrier included, in N."""
        k, share = self._at(length_m)
        volt, rows = abs(self._gain * drive_v), self._per_v2
        if len(rows) == 1:
            row = rows[0]
            per_v2 = row[k] + share * (row[k + 1] - row[k])
        else:
            place = volt / self._step_v
            j = min(int(place), len(rows) - 2)
            low, high = (row[k] + share * (row[k + 1] - row[k]) for row in rows[j : j + 2])
            per_v2 = low + (place - j) * (high - low)
        return per_v2 * (volt * volt + self._carrier_v2)

    def at_rest(self, length_m: float, drive_v: float) -> list[float]:
        """State of a relaxed actuator, with the load that explains its rest.

        Args:
            length_m: present, in m.
            drive_v: that acts, in V.
        """
        load_n = self.elastic_n(length_m) - self.weight_n - self.pull_n(length_m, drive_v)
        return [length_m, 0.0, *[0.0] * len(self.branches), load_n]

    def moved(self, state: list[float], drive_v: float, time_s: float) -> list[float]:
        """State after a time at a drive.

        Args:
            state: before.
            drive_v: that acts, in V.
            time_s: how long.
        """
        if time_s <= 0.0:
            return state
        count = math.ceil(time_s / _STEP_S - 1e-9)
        step_s = time_s / count
        length_m, speed, *forces, load_n = state
        branches = [(share, math.exp(-step_s / tau)) for share, tau in self.branches]
        outer_n, inertia = self.weight_n + load_n, self.inertia_kg
        drag = 0.5 * step_s * self.damping_n_s_per_m / inertia
        elastic_n = self.elastic_n(length_m)
        force_n = outer_n + self.pull_n(length_m, drive_v) - elastic_n - sum(forces)
        for _ in range(count):  # velocity Verlet, implicit in the damping
            half = speed + 0.5 * step_s * force_n / inertia - drag * speed
            length_m += step_s * half
            after_n = self.elastic_n(length_m)
            change_n, elastic_n = after_n - elastic_n, after_n
            forces = [
                decay * q + share * change_n
                for q, (share, decay) in zip(forces, branches, strict=True)
            ]
            force_n = outer_n + self.pull_n(length_m, drive_v) - elastic_n - sum(forces)
            speed = (half + 0.5 * step_s * force_n / inertia) / (1.0 + drag)
        return [length_m, speed, *forces, load_n]

    def needed_n(
        self, state: list[float], length_m: float, speed_m_s: float, pushed_m_s2: float
    ) -> float:
        """Electric force for an acceleration at a length that is reached from a state soon.

        Args:
            state: from which the branches and the load are.
            length_m: at which the force acts.
            speed_m_s: then.
            pushed_m_s2: acceleration.
        """
        now_n = self.elastic_n(length_m)
        stretched_n = now_n - self.elastic_n(state[0])
        creep_n = sum(state[2:-1]) + stretched_n * sum(share for share, _ in self.branches)
        held_n = self.inertia_kg * pushed_m_s2 + self.damping_n_s_per_m * speed_m_s
        return held_n + now_n + creep_n - self.weight_n - state[-1]

    def natural_rad_s(self, low_m: float, high_m: float) -> float:
        """Highest natural frequency between two lengths: that of the stiffness before any creep.

        Args:
            low_m: shortest length.
            high_m: longest one.
        Returns:
            Angular frequency, without damping.
        """
        first, last = self._at(low_m)[0], self._at(high_m)[0]
        rises_n = np.diff(self._elastic[first : last + 2])
        branches = 1.0 + sum(share for share, _ in self.branches)
        per_m = max(float(rises_n.max()), 0.0) / self._step_m * branches
        return math.sqrt(per_m / self.inertia_kg)

    def linear(self, length_m: float, drive_v: float, time_s: float) -> Floats:
        """Derivatives of the state after a time by the state, at rest.

        Args:
            length_m: of the rest.
            drive_v: that acts.
            time_s: how long.
        Returns:
            Matrix of shape `(n, n)`.
        """
        rest = self.at_rest(length_m, drive_v)
        changes = [0.1 * self._step_m, 1e-4, *[1e-3] * len(self.branches), 1e-3]
        columns = []
        for k, change in enumerate(changes):
            ends = []
            for sign in (1.0, -1.0):
                state = list(rest)
                state[k] += sign * change
                ends.append(np.array(self.moved(state, drive_v, time_s)))
            columns.append((ends[0] - ends[1]) / (2.0 * change))
        return np.stack(columns, axis=1)
