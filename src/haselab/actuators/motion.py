"""The motion of an actuator that follows a law: its state, and its rates."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.actuators.law import ActuatorLaw

__all__ = ["ActuatorState", "rates"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ActuatorState:
    r"""State of an actuator. All shapes may have any number of leading axes.

    A viscoelastic branch of share $g$ and time constant $\tau$ pulls with $g\,(F - y)$: $F$ is the
    elastic force and $y$ the force to which the branch has relaxed, $\dot y = (F - y)/\tau$.

    Args:
        length_m: present length.
        speed_m_s: its rate.
        relaxed_n: force to which each branch has relaxed. Shape `(..., B)`.
        charge_v: present value of the delayed part of the voltage.
        longest_m: largest length so far, for the softening.
        hysteresis_n: present force of the hysteresis, see `Losses`.
    """

    length_m: Floats
    speed_m_s: Floats
    relaxed_n: Floats
    charge_v: Floats
    longest_m: Floats
    hysteresis_n: Floats = field(default_factory=lambda: np.zeros(()))

    @classmethod
    def at_rest(
        cls,
        law: ActuatorLaw,
        length_m: ArrayLike | None = None,
        *,
        longest_m: ArrayLike = 0.0,
        charge_v: ArrayLike = 0.0,
    ) -> Self:
        """Create the state of a relaxed actuator.

        Args:
            law: of the actuator.
            length_m: at which all branches are relaxed; None: the free length. Shape `(...)`.
            longest_m: largest length before, if that was longer.
            charge_v: delayed part of the voltage.
        """
        length = np.array(law.free_length_m if length_m is None else length_m, dtype=np.float64)
        longest = np.maximum(length, longest_m)
        force = _elastic_n(law, length, longest)
        relaxed = np.repeat(force[..., None], len(law.losses.branch_share), axis=-1)
        none = np.zeros_like(length)
        return cls(length, none, relaxed, none + np.asarray(charge_v), longest, none)


def _elastic_n(law: ActuatorLaw, length_m: Floats, longest_m: Floats) -> Floats:
    softening = law.losses.softening(longest_m / law.free_length_m)
    return np.asarray(law.elastic_force_n(length_m) * softening)


def rates(
    law: ActuatorLaw,
    state: ActuatorState,
    voltage_v: ArrayLike,
    load_n: ArrayLike,
    mass_kg: ArrayLike,
) -> ActuatorState:
    """Time derivatives of a state, for any solver of differential equations.

    Args:
        law: of the actuator.
        state: present one.
        voltage_v: of the actuator. Broadcasts with the state.
        load_n: pulls at the moving end.
        mass_kg: that moves with it, without the actuator's own.
    Returns:
        Rates in the fields of a state, per s; that of `longest_m` is the speed where the length is
        the largest so far and grows, else 0.
    """
    losses = law.losses
    share, relaxation_s = np.array(losses.branch_share), np.array(losses.branch_relaxation_s)
    voltage = np.asarray(voltage_v, dtype=np.float64)
    acting_v = (1.0 - losses.charge_share) * voltage + losses.charge_share * state.charge_v
    elastic = _elastic_n(law, state.length_m, np.maximum(state.longest_m, state.length_m))
    lag = elastic[..., None] - state.relaxed_n
    force = np.asarray(load_n) + law.electric_force_n(state.length_m, acting_v) - elastic
    force = force - (share * lag).sum(axis=-1) - losses.damping_n_s_per_m * state.speed_m_s
    slip_m = losses.hysteresis_width * law.free_length_m
    if losses.hysteresis_n > 0.0:
        force = force - state.hysteresis_n
    turned = losses.hysteresis_n * state.speed_m_s - state.hysteresis_n * np.abs(state.speed_m_s)
    none = np.zeros_like(state.length_m)
    grows = (state.length_m >= state.longest_m) & (state.speed_m_s > 0.0)
    return ActuatorState(
        state.speed_m_s + none,
        np.asarray(force / (np.asarray(mass_kg) + law.moving_mass_kg)),
        lag / relaxation_s,
        (voltage - state.charge_v) / losses.charge_relaxation_s + none,
        np.where(grows, state.speed_m_s, 0.0),
        np.asarray(turned / slip_m) if losses.hysteresis_n > 0.0 else none,
    )
