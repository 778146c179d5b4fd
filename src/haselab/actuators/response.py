"""Lengths and capacitances of an actuator under given voltages and loads, with derivatives."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab import _motion
from haselab.actuators.law import ActuatorLaw
from haselab.actuators.motion import ActuatorState
from haselab.actuators.table import LawTable, law_table
from haselab.base import InputError

__all__ = ["Drive", "Response", "motion_parameters"]

Floats = NDArray[np.float64]
_LONGEST_STEP_S = 2.5e-3
_PHASE = 0.1  # of the fastest motion in a step, rad
_SHORTEST_STEP_S = 1e-6
_STEP = 1e-4  # of a parameter, for the derivatives of the law's table


def motion_parameters(law: ActuatorLaw) -> NDArray[np.void]:
    """Losses and own inertia of a law, as the compiled motion takes them.

    Args:
        law: of the actuator.
    Returns:
        One record of the parameters. Shape `(1,)`.
    Raises:
        InputError: The law has more branches than the compiled motion.
    """
    losses, count = law.losses, len(law.losses.branch_share)
    if count > _motion.BRANCHES:
        raise InputError(
            f"The law {law.kind} has {count} viscoelastic branches; at most {_motion.BRANCHES} "
            "can be simulated. Remove some."
        )
    found = np.zeros(1, _motion.PARAMETERS)
    found["free_length_m"] = law.free_length_m
    found["softening_share"] = losses.softening_share
    found["softening_stretch"] = losses.softening_stretch
    found["softening_width"] = losses.softening_transition
    found["branch_share"][0, :count] = losses.branch_share
    found["branch_s"][0, :count] = losses.branch_relaxation_s
    found["damping_n_s_m"] = losses.damping_n_s_per_m
    found["inertia_kg"] = law.moving_mass_kg
    found["charge_share"] = losses.charge_share
    found["charge_s"] = losses.charge_relaxation_s
    found["step_s"], found["phase"] = _LONGEST_STEP_S, _PHASE
    return found


@dataclass(frozen=True)
class Drive:
    """What acts on an actuator, constant from each edge to the next.

    Args:
        edge_s: rising. Shape `(N + 1,)`.
        voltage_v: of the actuator. Shape `(N,)`.
        load_n: pulls at the moving end. Shape `(N,)`.
        mass_kg: that moves with it, without the actuator's own. Shape `(N,)`.
        ripple_v2: mean square of the carrier's voltage. Shape `(N,)`.
    Raises:
        InputError: The shapes do not fit together, or the edges do not rise.
    """

    edge_s: Floats
    voltage_v: Floats
    load_n: Floats
    mass_kg: Floats
    ripple_v2: Floats

    def __post_init__(self) -> None:
        count = self.voltage_v.size
        parts = (self.load_n, self.mass_kg, self.ripple_v2)
        if count == 0 or self.edge_s.size != count + 1 or any(part.size != count for part in parts):
            raise InputError(
                f"A drive has {self.edge_s.size} edges and {count} voltages. Give one edge more "
                "than voltages, loads, masses and ripples."
            )
        if not (np.diff(self.edge_s) > 0.0).all():
            raise InputError("The edges of a drive do not rise. Sort them, without repeated times.")


@dataclass(frozen=True)
class Response:
    """Simulated motion of an actuator.

    Args:
        length_m: at the wanted times. Shape `(T,)`.
        speed_m_s: at the wanted times. Shape `(T,)`.
        capacitance_f: mean over each interval; 0 where not wanted. Shape `(N,)`.
        end: state after the last interval.
    """

    length_m: Floats
    speed_m_s: Floats
    capacitance_f: Floats
    end: ActuatorState


