r"""Energy losses of an actuator, slow changes of it in a record, and its electrical circuit.

A drift changes all elastic forces, such as by ageing, or the permittivity, such as by warming. The
factor is

$1 + r\,\tau\,(1 - e^{-t/\tau})$

a time $t$ after the record's first edge, with the rate $r$ there and the time constant $\tau$. The
family does not depend on when the change began: later, it has another rate and the same $\tau$.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import LimitError

__all__ = [
    "DRIFTS",
    "DRIFT_LIMITS",
    "DRIFT_TIMES",
    "DRIFT_UNITS",
    "Circuit",
    "Losses",
    "drift_pairs",
]

Floats = NDArray[np.float64]
STIFFNESS = ("drift.stiffness_per_s", "drift.stiffness_s")
PERMITTIVITY = ("drift.permittivity_per_s", "drift.permittivity_s")
DRIFTS = (*STIFFNESS, *PERMITTIVITY)
DRIFT_TIMES = (STIFFNESS[1], PERMITTIVITY[1])
DRIFT_UNITS = {name: "s" if name in DRIFT_TIMES else "1/s" for name in DRIFTS}
DRIFT_LIMITS = {name: (10.0, 1e6) if name in DRIFT_TIMES else (-0.01, 0.01) for name in DRIFTS}
_LEAST = 0.1  # of stiffness or permittivity that is left


@dataclass(frozen=True)
class Losses:
    r"""Losses of an actuator: damping, viscoelasticity, softening, charge creep, hysteresis.

    Viscoelastic branches act on the elastic force $F_e$: $\dot b = g\,\dot F_e - b/\tau$. Softening
    (Mullins effect) makes the elastic force of a new actuator larger until the length has been
    reached once. Charge creep delays the effect of a fraction of the voltage.

    Hysteresis depends on the path of the length and not on its speed. Its force $h$ has the largest
    value $F_h$ and follows a reversal within a length $W$, the width times the free length:

    $\dot h = (F_h\,\dot x - h\,|\dot x|)/W$

    It stores the energy $\tfrac12 h^2 W/F_h$ and dissipates $|\dot x|\,h^2/F_h \ge 0$.

    Args:
        damping_n_s_per_m: linear damper beside the actuator.
        branch_share: stiffness of each branch over the elastic one. Shape `(B,)`.
        branch_relaxation_s: its time constant. Shape `(B,)`.
        softening_share: stiffness that a new actuator loses; 0: none.
        softening_stretch: where half of it is lost, length over free length.
        softening_transition: of that transition, in stretch.
        charge_share: part of the voltage that acts with a delay; 0: none.
        charge_relaxation_s: time constant of that part.
        hysteresis_n: largest force of the hysteresis; 0: none.
        hysteresis_width: change of stretch within which that force follows a reversal.
    Raises:
        LimitError: A branch has no time constant, or a share or time is not positive.
    Source: Dahl, The Aerospace Corporation TOR-0158(3107-18)-1 (1968), for the hysteresis.
    """

    damping_n_s_per_m: float = 0.1
    branch_share: tuple[float, ...] = ()
    branch_relaxation_s: tuple[float, ...] = ()
    softening_share: float = 0.0
    softening_stretch: float = 1.5
    softening_transition: float = 0.02
    charge_share: float = 0.0
    charge_relaxation_s: float = 1.0
    hysteresis_n: float = 0.0
    hysteresis_width: float = 0.02

    def __post_init__(self) -> None:
        if len(self.branch_share) != len(self.branch_relaxation_s):
            raise LimitError(
                f"The law has {len(self.branch_share)} branch shares and "
                f"{len(self.branch_relaxation_s)} relaxation times. Give one of each per branch."
            )
        times = (*self.branch_relaxation_s, self.charge_relaxation_s, self.softening_transition)
        if min(times) <= 0.0 or min((*self.branch_share, 0.0)) < 0.0:
            raise LimitError(
                "A relaxation time, softening_transition or a branch share is negative or zero. "
                "Use positive numbers."
            )
        if self.hysteresis_n < 0.0 or self.hysteresis_width <= 0.0:
            raise LimitError(
                f"The hysteresis has a force of {self.hysteresis_n:g} N and a width of "
                f"{self.hysteresis_width:g}. The force must not be negative, and the width must be "
                "above 0."
            )

    def softening(self, stretch: ArrayLike) -> Floats:
        """Factor on the elastic force.

        Args:
            stretch: longest length so far over the free length. Shape `(...)`.
        Returns:
            1 plus what is left of the new actuator's stiffness. Shape `(...)`.
        """
        reached = (np.asarray(stretch) - self.softening_stretch) / self.softening_transition
        with np.errstate(over="ignore"):
            return np.asarray(1.0 + self.softening_share / (1.0 + np.exp(reached)))


@dataclass(frozen=True)
class Circuit:
    """Electrical side of an actuator: a resistor in series, a leakage and a breakdown field.

    Args:
        series_ohm: of electrodes and leads.
        leakage_ohm: of the dielectric.
        breakdown_v_per_m: field that destroys it.
    """

    series_ohm: float = 5e3
    leakage_ohm: float = 2e10
    breakdown_v_per_m: float = 40e6


def drift_pairs(values: Mapping[str, float]) -> dict[str, tuple[float, float]]:
    """Rates and time constants as the compiled motion takes them.

    Args:
        values: by the names of `DRIFTS`; those that are missing are 0.
    Returns:
        Pairs by the fields of the compiled motion; a time constant of 0 switches a drift off.
    Raises:
        LimitError: Hardly anything would be left of the stiffness or of the permittivity.
    Example:
        >>> drift_pairs({"drift.stiffness_per_s": -1e-5, "drift.stiffness_s": 600.0})
        {'elastic_drift': (-1e-05, 600.0), 'electric_drift': (0.0, 0.0)}
    """
    found = {}
    for field, (rate, time) in (("elastic_drift", STIFFNESS), ("electric_drift", PERMITTIVITY)):
        pair = values.get(rate, 0.0), values.get(time, 0.0)
        if not 1.0 + pair[0] * pair[1] > _LEAST:
            raise LimitError(
                f"{rate} = {pair[0]:g} and {time} = {pair[1]:g} reduce the initial value to "
                f"less than {_LEAST:g} of it. Make one of them smaller."
            )
        found[field] = pair
    return found
