"""Physical laws of actuators: energy, capacitance, masses and losses in one object."""

from haselab.actuators.dea_stack import DeaStack
from haselab.actuators.law import VACUUM_F_PER_M, ActuatorLaw, Parameter, parameter
from haselab.actuators.losses import Circuit, Losses
from haselab.actuators.motion import ActuatorState, advance, rates, simulate
from haselab.actuators.operating_point import OperatingPoint, equilibrium_m, linearise
from haselab.actuators.planar_hasel import PlanarHasel
from haselab.actuators.registry import ACTUATORS, actuator_law
from haselab.actuators.table import LawTable, law_table, motion_substeps

__all__ = [
    "ACTUATORS",
    "VACUUM_F_PER_M",
    "ActuatorLaw",
    "ActuatorState",
    "Circuit",
    "DeaStack",
    "LawTable",
    "Losses",
    "OperatingPoint",
    "Parameter",
    "PlanarHasel",
    "actuator_law",
    "advance",
    "equilibrium_m",
    "law_table",
    "linearise",
    "motion_substeps",
    "parameter",
    "rates",
    "simulate",
]
