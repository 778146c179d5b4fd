"""Energy losses of an actuator, and its electrical circuit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import LimitError

__all__ = ["Circuit", "Losses"]

Floats = NDArray[np.float64]


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
