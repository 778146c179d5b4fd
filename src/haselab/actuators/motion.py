"""The motion of an actuator that follows a law: its state, and steps in time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.actuators.law import ActuatorLaw
from haselab.base import InputError

__all__ = ["ActuatorState", "advance", "rates", "simulate"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class ActuatorState:
    """State of an actuator. All shapes may have any number of leading axes.

    Args:
        length_m: present length.
        speed_m_s: its rate.
        branch_n: force of each viscoelastic branch. Shape `(..., B)`.
        slow_v: present value of the delayed part of the voltage.
        longest_m: largest length so far, for the softening.
        elastic_n: elastic force one step before.
    """

    length_m: Floats
    speed_m_s: Floats
    branch_n: Floats
    slow_v: Floats
    longest_m: Floats
    elastic_n: Floats

    @classmethod
    def new(cls, law: ActuatorLaw, length_m: ArrayLike | None = None) -> Self:
        """Create the state of a new, relaxed actuator.

        Args:
            law: of the actuator.
            length_m: at which all branches are relaxed; None: the free length. Shape `(...)`.
        """
        length = np.array(law.free_length_m if length_m is None else length_m, dtype=np.float64)
        branches = len(law.losses.branch_share)
        return cls(
            length,
            np.zeros_like(length),
            np.zeros((*length.shape, branches)),
            np.zeros_like(length),
            np.maximum(length, law.free_length_m),
            _elastic_n(law, length, np.maximum(length, law.free_length_m)),
        )


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
        state: present one; `longest_m` is kept, so the length is below it.
        voltage_v: of the actuator. Broadcasts with the state.
        load_n: pulls at the moving end.
        mass_kg: that moves with it, without the actuator's own.
    Returns:
        Rates in the fields of a state, per s; those of `longest_m` and `elastic_n` are 0.
    """
    losses = law.losses
    share, relaxation_s = np.array(losses.branch_share), np.array(losses.branch_relaxation_s)
    voltage = np.asarray(voltage_v, dtype=np.float64)
    acting_v = (1.0 - losses.charge_share) * voltage + losses.charge_share * state.slow_v
    force = np.asarray(load_n) + law.electric_force_n(state.length_m, acting_v)
    force = force - _elastic_n(law, state.length_m, state.longest_m)
    force = force - state.branch_n.sum(axis=-1) - losses.damping_n_s_per_m * state.speed_m_s
    step_m = 1e-4 * law.free_length_m
    stiffer = _elastic_n(law, state.length_m + step_m, state.longest_m)
    stiffness = (stiffer - _elastic_n(law, state.length_m - step_m, state.longest_m)) / (2 * step_m)
    flow = (stiffness * state.speed_m_s)[..., None] * share - state.branch_n / relaxation_s
    none = np.zeros_like(state.length_m)
    return ActuatorState(
        state.speed_m_s + none,
        np.asarray(force / (np.asarray(mass_kg) + law.moving_mass_kg)),
        flow,
        (voltage - state.slow_v) / losses.charge_relaxation_s + none,
        none,
        none,
    )


def advance(
    law: ActuatorLaw,
    state: ActuatorState,
    voltage_v: ArrayLike,
    load_n: ArrayLike,
    mass_kg: ArrayLike,
    step_s: float,
) -> ActuatorState:
    """Compute the state one step later, by the scheme of native/twin/twin.c.

    Branches go by backward Euler, speed before length (symplectic Euler). A step is valid where
    the fastest motion has at least 12 of them in a period.

    Args:
        law: of the actuators.
        state: present one. Shape `(...)`.
        voltage_v: during the step. Broadcasts with the state.
        load_n: pulls at the moving end.
        mass_kg: that moves with it, without the actuator's own.
        step_s: duration.
    Returns:
        The next state.
    """
    losses, voltage = law.losses, np.asarray(voltage_v, dtype=np.float64)
    slow_v, acting_v = state.slow_v, voltage
    if losses.charge_share > 0.0:
        slow_v = slow_v + (voltage - slow_v) * step_s / (losses.charge_relaxation_s + step_s)
        acting_v = (1.0 - losses.charge_share) * voltage + losses.charge_share * slow_v
    length = state.length_m
    longest = np.maximum(state.longest_m, length)
    elastic = _elastic_n(law, length, longest)
    relaxation_s = np.array(losses.branch_relaxation_s)
    change = (elastic - state.elastic_n)[..., None] * np.array(losses.branch_share)
    branch = relaxation_s / (relaxation_s + step_s) * (state.branch_n + change)
    force = np.asarray(load_n) + law.electric_force_n(length, acting_v) - elastic
    force = force - branch.sum(axis=-1)
    inertia = np.asarray(mass_kg) + law.moving_mass_kg
    share = step_s * losses.damping_n_s_per_m / inertia
    speed = (state.speed_m_s + step_s * force / inertia) / (1.0 + share)
    moved = np.asarray(length + step_s * speed)
    return ActuatorState(moved, np.asarray(speed), branch, slow_v, longest, elastic)


def simulate(
    law: ActuatorLaw,
    voltage_v: ArrayLike,
    *,
    load_n: ArrayLike,
    mass_kg: ArrayLike,
    step_s: float,
    start: ActuatorState | None = None,
) -> tuple[Floats, ActuatorState]:
    """Simulate the lengths under a voltage that changes every step.

    Args:
        law: of the actuators.
        voltage_v: Shape `(N, ...)`.
        load_n: pulls at the moving end. Broadcasts with a row of `voltage_v`.
        mass_kg: that moves with it, without the actuator's own.
        step_s: duration of a step.
        start: state to begin from; None: a new actuator at its free length.
    Returns:
        Lengths after each step, in m, shape `(N, ...)`, and the state at the end.
    Raises:
        InputError: There is no voltage.
    Example:
        >>> from haselab.actuators import DeaStack
        >>> rest = np.zeros(3)
        >>> lengths, _ = simulate(DeaStack(), rest, load_n=0.0, mass_kg=0.1, step_s=1e-4)
        >>> bool(np.allclose(lengths, 0.035, rtol=1e-9))
        True
    """
    voltage = np.asarray(voltage_v, dtype=np.float64)
    if voltage.ndim == 0 or voltage.shape[0] == 0:
        raise InputError("voltage_v has no values. Give one value per step.")
    shape = np.broadcast_shapes(voltage.shape[1:], np.shape(load_n), np.shape(mass_kg))
    if start is None:
        start = ActuatorState.new(law, np.full(shape, law.free_length_m))
    lengths, state = np.empty((voltage.shape[0], *_shape(start, shape))), start
    for k, value in enumerate(voltage):
        state = advance(law, state, value, load_n, mass_kg, step_s)
        lengths[k] = state.length_m
    return lengths, state


def _shape(state: ActuatorState, shape: tuple[int, ...]) -> tuple[int, ...]:
    """Of the lengths under inputs of a shape."""
    return np.broadcast_shapes(state.length_m.shape, shape)
