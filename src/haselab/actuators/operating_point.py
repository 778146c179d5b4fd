"""Equilibria of an actuator under voltage and load, and linear models about them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigvals

from haselab.actuators.law import ActuatorLaw
from haselab.base import LimitError
from haselab.base.root import root

__all__ = ["OperatingPoint", "equilibrium_m", "feedthrough", "linearise"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_GRID = 4001
_CLOSE_M = 1e-17
_STEP = 1e-4  # of the derivatives, in free lengths
_FAR = 1e9  # a zero farther than that many times the fastest pole is one at infinity


@dataclass(frozen=True)
class OperatingPoint:
    r"""A linear model about an equilibrium: $\dot z = A z + b\,u,\ y = c z + d\,u$.

    The input is the change of the actuator's voltage in V, the output that of its length in m. The
    states are length, speed, the force of each viscoelastic branch and, with charge creep, the slow
    voltage.

    Args:
        length_m: at equilibrium.
        voltage_v: at equilibrium.
        load_n: at equilibrium.
        a: Shape `(n, n)`.
        b: Shape `(n,)`.
        c: Shape `(n,)`.
        d: from input to output; 0.
    """

    length_m: float
    voltage_v: float
    load_n: float
    a: Floats
    b: Floats
    c: Floats
    d: float = 0.0

    @property
    def poles(self) -> Complexes:
        """In rad/s. Shape `(n,)`."""
        return np.asarray(np.linalg.eigvals(self.a), dtype=np.complex128)

    @property
    def zeros(self) -> Complexes:
        """In rad/s, as many as the model has."""
        n = self.b.size
        system = np.block([[self.a, self.b[:, None]], [self.c[None], np.array([[self.d]])]])
        found = eigvals(system, np.diag([1.0] * n + [0.0]))
        far = _FAR * np.abs(self.poles).max()
        return np.asarray(found[np.isfinite(found) & (np.abs(found) < far)])

    @property
    def gain_m_per_v(self) -> float:
        """Change of the equilibrium length per change of the voltage."""
        return float(self.d - self.c @ np.linalg.solve(self.a, self.b))


def _net_force_n(
    law: ActuatorLaw, length_m: Floats, voltage_v: float, load_n: float, longest_m: float
) -> Floats:
    reached = np.maximum(length_m, longest_m) / law.free_length_m
    elastic = law.elastic_force_n(length_m) * law.losses.softening(reached)
    if voltage_v == 0.0:
        return np.asarray(load_n - elastic)
    return np.asarray(load_n + law.electric_force_n(length_m, voltage_v) - elastic)


def _next_rest_m(
    law: ActuatorLaw, start_m: float, voltage_v: float, load_n: float, longest_m: float
) -> float | None:
    """First length at which the forces balance, in the direction of motion."""
    limits = law.length_limits_m
    pushed = float(_net_force_n(law, np.array(start_m), voltage_v, load_n, longest_m))
    if pushed == 0.0:
        return start_m
    end = limits.high if pushed > 0.0 else limits.low
    grid = np.linspace(start_m, end, _GRID)
    turned = _net_force_n(law, grid, voltage_v, load_n, longest_m) * pushed <= 0.0
    if not turned.any():
        return None
    k = max(1, int(np.argmax(turned)))  # at the start the sign may be one of rounding
    near, far = float(grid[k - 1]), float(grid[k])

    def ahead(length_m: float) -> float:
        return float(_net_force_n(law, np.array(length_m), voltage_v, load_n, longest_m)) * pushed

    # many lengths at once and a single one may differ by rounding
    if near == far or ahead(near) <= 0.0:
        return near
    if ahead(far) >= 0.0:
        return far
    return root(ahead, near, far, xtol=_CLOSE_M, rtol=4.0 * np.finfo(np.float64).eps)


def equilibrium_m(
    law: ActuatorLaw, voltage_v: float, load_n: float, *, longest_m: float | None = None
) -> float:
    """Equilibrium length: loaded first, then the voltage rises slowly.

    Args:
        law: of the actuator.
        voltage_v: of the actuator.
        load_n: pulls at the moving end.
        longest_m: largest length that the actuator has had before; None: it is new.
    Returns:
        Length, in m, with all branches relaxed.
    Raises:
        LimitError: The load or the voltage moves the actuator outside the limits of its law, for
            example because the layers collapse.
    Example:
        >>> from haselab.actuators import DeaStack
        >>> round(equilibrium_m(DeaStack(), 0.0, 0.0), 6)
        0.035
    """
    longest = law.free_length_m if longest_m is None else longest_m
    length = law.free_length_m
    for value_v in (0.0, voltage_v):
        rest = _next_rest_m(law, length, value_v, load_n, longest)
        if rest is None:
            limits = law.length_limits_m
            raise LimitError(
                f"The {law.kind} has no equilibrium between {1e3 * limits.low:.4g} and "
                f"{1e3 * limits.high:.4g} mm at {value_v:g} V and {load_n:g} N. Lower the voltage "
                "or the load."
            )
        length = rest
    return length


def feedthrough(law: ActuatorLaw, length_m: float, voltage_v: float, gain_m_per_v: float) -> float:
    """Fraction of a steady-state change of the capacitance that a held length does not prevent.

    Args:
        law: of the actuator.
        length_m: at equilibrium.
        voltage_v: at equilibrium.
        gain_m_per_v: change of the equilibrium length per change of the voltage.
    Returns:
        What the change of the voltage at constant length contributes, divided by the whole change;
        0 for a capacitance that depends on the length alone.
    Example:
        >>> from haselab.actuators import PeanoHasel, PlanarHasel
        >>> for law, load_n in ((PlanarHasel(), 2.45), (PeanoHasel(), 1.0)):
        ...     point = linearise(law, 5000.0, load_n, load_n / 9.81)
        ...     print(round(feedthrough(law, point.length_m, 5000.0, point.gain_m_per_v), 3))
        0.0
        0.248
    """
    step_m, step_v = _STEP * law.free_length_m, max(_STEP * abs(voltage_v), 1e-3)
    lengths = length_m + step_m * np.array([-1.0, 1.0])
    volts = voltage_v + step_v * np.array([-1.0, 1.0])
    by_length = float(np.diff(law.differential_capacitance_f(lengths, voltage_v))[0]) / step_m
    by_volt = float(np.diff(law.differential_capacitance_f(length_m, volts))[0]) / step_v
    whole = by_volt + by_length * gain_m_per_v
    return by_volt / whole if by_volt else 0.0


def linearise(
    law: ActuatorLaw,
    voltage_v: float,
    load_n: float,
    mass_kg: float,
    *,
    longest_m: float | None = None,
) -> OperatingPoint:
    """Linearise about the equilibrium, for motion within the lengths reached before.

    With hysteresis, the motion must be small against its width: its force then acts like a spring.

    Args:
        law: of the actuator.
        voltage_v: at equilibrium.
        load_n: at equilibrium.
        mass_kg: mass that moves with the end, without the actuator's own.
        longest_m: largest length that the actuator has had; None: the equilibrium length.
    Returns:
        Length, state-space matrices, poles, zeros and gain.
    Raises:
        LimitError: There is no equilibrium.
    Example:
        >>> from haselab.actuators import PlanarHasel
        >>> point = linearise(PlanarHasel(), 5000.0, 2.45, 0.25)
        >>> round(float(np.abs(point.poles).max()), 1)
        33.9
    """
    length = equilibrium_m(law, voltage_v, load_n, longest_m=longest_m)
    losses, longest = law.losses, max(length, longest_m or law.free_length_m)
    softening = float(losses.softening(longest / law.free_length_m))
    step_m, step_v = _STEP * law.free_length_m, max(1e-4 * abs(voltage_v), 1e-3)
    ends = length + step_m * np.array([-1.0, 1.0])
    stiffness = softening * float(np.diff(law.elastic_force_n(ends))[0]) / (2.0 * step_m)
    held = losses.hysteresis_n / (losses.hysteresis_width * law.free_length_m)
    softer = float(np.diff(law.electric_force_n(ends, voltage_v))[0]) / (2.0 * step_m)
    values = voltage_v + step_v * np.array([-1.0, 1.0])
    per_v = float(np.diff(law.electric_force_n(length, values))[0]) / (2.0 * step_v)
    count, late = len(losses.branch_share), losses.charge_share
    inertia = mass_kg + law.moving_mass_kg
    a = np.zeros((3 + count, 3 + count))
    a[0, 1] = 1.0
    a[1] = [softer - stiffness - held, -losses.damping_n_s_per_m, *[-1.0] * count, per_v * late]
    a[1] /= inertia
    a[2 : 2 + count, 1] = stiffness * np.array(losses.branch_share)
    decay = [-1.0 / value for value in (*losses.branch_relaxation_s, losses.charge_relaxation_s)]
    a[range(2, 3 + count), range(2, 3 + count)] = decay
    b = np.zeros(3 + count)
    b[1], b[-1] = per_v * (1.0 - late) / inertia, 1.0 / losses.charge_relaxation_s
    c = np.zeros(3 + count)
    c[0] = 1.0
    used = 3 + count if late > 0.0 else 2 + count
    return OperatingPoint(length, voltage_v, load_n, a[:used, :used], b[:used], c[:used])
