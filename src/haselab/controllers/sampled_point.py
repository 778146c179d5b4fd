r"""An actuator about an operating point, as a sampled loop sees it, for the design of controllers.

The input is the mean square of the actuator's voltage, $w = V^2$, the output the length. A value
computed from the length at $t_k$ takes effect a delay $\delta$ later and is held:

$z_{k+1} = \Phi z_k + \Gamma_0 w_{k-d} + \Gamma_1 w_{k-d-1},\quad x_k = c\,z_k$

with the whole periods $d$ of the delay.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from haselab.actuators import GRAVITY_M_S2, linearise
from haselab.base import InputError
from haselab.controllers.protocol import ControllerSetting

__all__ = ["SampledPoint", "sampled_point"]

Floats = NDArray[np.float64]
_LEAST_V = 100.0  # of the actuator: below, the voltage has no effect to first order


@dataclass(frozen=True)
class SampledPoint:
    """A linear model about an equilibrium, with the delayed inputs as states.

    Args:
        strain: at equilibrium.
        volt2: mean square of the voltage there, in V^2.
        pull_per_v2: force per mean square, in N/V^2.
        pull_per_v2_m: its slope over the length.
        a: of the states, the delayed inputs last. Shape `(n, n)`.
        b: of the input $w$. Shape `(n,)`.
        load: of a force along the length that acts from one sample to the next. Shape `(n,)`.
        c: the length. Shape `(n,)`.
    """

    strain: float
    volt2: float
    pull_per_v2: float
    pull_per_v2_m: float
    a: Floats
    b: Floats
    load: Floats
    c: Floats


def sampled_point(
    setting: ControllerSetting,
    strain: float,
    *,
    stiffness: float = 1.0,
    later_s: float = 0.0,
) -> SampledPoint:
    """Linearise the actuator of a setting where it holds a strain, and sample it.

    Args:
        setting: with the actuator; without a delay, half a period is assumed.
        strain: held.
        stiffness: factor on the elastic force's slope, to try how robust a design is.
        later_s: added to the delay, likewise.
    Returns:
        The model.
    Raises:
        InputError: The setting has no actuator.
        LimitError: The strain cannot be held.
    """
    known = setting.actuator
    if known is None:
        raise InputError("The setting has no actuator. Identify it first.")
    delay_s = 0.5 * setting.period_s if setting.delay_s is None else setting.delay_s
    volt = max(known.gain_v_per_v * known.static_drive_v(strain), _LEAST_V)
    inertia_kg = known.mass_kg + known.added_inertia_kg
    load_n = known.mass_kg * GRAVITY_M_S2
    acting_v = math.hypot(volt, math.sqrt(known.carrier_v2))
    point = linearise(known.law, acting_v, load_n, inertia_kg, longest_m=known.longest_m or None)
    a, inertia = point.a.copy(), inertia_kg + known.law.moving_mass_kg
    length_m, step_m = point.length_m, known.table.step_m
    drive_v = volt / known.gain_v_per_v
    pulls = [known.pull_per_v2(length_m + s * step_m, drive_v) for s in (-1.0, 0.0, 1.0)]
    slope = (pulls[2] - pulls[0]) / (2.0 * step_m)
    elastic = -inertia * a[1, 0] + slope * acting_v**2
    a[1, 0] -= (stiffness - 1.0) * elastic / inertia
    force = np.zeros(a.shape[0])
    force[1] = 1.0 / inertia
    per_w = point.b / (2.0 * acting_v)
    return SampledPoint(
        known.strain(length_m), acting_v**2, pulls[1], slope,
        *_sampled(a, per_w, force, point.c, setting.period_s, delay_s + later_s),
    )  # fmt: skip


def _sampled(
    a: Floats, b: Floats, force: Floats, c: Floats, period_s: float, delay_s: float
) -> tuple[Floats, Floats, Floats, Floats]:
    """Exact discretisation with a delayed and held input."""
    whole = math.floor(delay_s / period_s + 1e-9)
    late_s = max(delay_s - whole * period_s, 0.0)
    size = a.shape[0]
    step, _ = _held(a, b, period_s)
    rest, new = _held(a, b, period_s - late_s)
    _, before = _held(a, b, late_s)
    _, pushed = _held(a, force, period_s)
    count = whole + 1  # inputs that still act or wait: the latest first
    big = np.zeros((size + count, size + count))
    big[:size, :size] = step
    big[size + 1 :, size:-1] = np.eye(count - 1)
    into = np.zeros(size + count)
    into[size] = 1.0
    if whole == 0:
        into[:size] = new
    else:
        big[:size, size + whole - 1] += new
    big[:size, size + whole] += rest @ before
    return big, into, np.r_[pushed, np.zeros(count)], np.r_[c, np.zeros(count)]


def _held(a: Floats, b: Floats, time_s: float) -> tuple[Floats, Floats]:
    """Transition matrix over a time, and the state after a unit input of that length."""
    size = b.size
    block = np.zeros((size + 1, size + 1))
    block[:size, :size], block[:size, size] = a, b
    power = expm(block * time_s)
    return np.asarray(power[:size, :size]), np.asarray(power[:size, size])
