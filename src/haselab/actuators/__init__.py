"""Physical laws of actuators: energy, capacitance, masses and losses in one object."""

from haselab.actuators.curling_hasel import CurlingHasel
from haselab.actuators.dea_stack import DeaStack
from haselab.actuators.law import VACUUM_F_PER_M, ActuatorLaw, LawValues, Parameter, parameter
from haselab.actuators.losses import DRIFT_LIMITS, DRIFT_TIMES, DRIFT_UNITS, DRIFTS, Circuit, Losses
from haselab.actuators.motion import ActuatorState, rates
from haselab.actuators.operating_point import (
    OperatingPoint,
    equilibrium_m,
    feedthrough,
    linearise,
)
from haselab.actuators.peano_hasel import PeanoHasel
from haselab.actuators.planar_hasel import PlanarHasel
from haselab.actuators.pouch import Pouch
from haselab.actuators.registry import ACTUATORS, actuator_law
from haselab.actuators.response import (
    ADDED_INERTIA,
    GRAVITY_M_S2,
    Drive,
    Response,
    SampledLaw,
    measured_parameters,
    motion_parameters,
    with_parameters,
    with_stated,
)
from haselab.actuators.table import LawTable, law_table
from haselab.actuators.uncertain import Scales, draw_parameters

__all__ = [
    "ACTUATORS",
    "ADDED_INERTIA",
    "DRIFTS",
    "DRIFT_LIMITS",
    "DRIFT_TIMES",
    "DRIFT_UNITS",
    "GRAVITY_M_S2",
    "VACUUM_F_PER_M",
    "ActuatorLaw",
    "ActuatorState",
    "Circuit",
    "CurlingHasel",
    "DeaStack",
    "Drive",
    "LawTable",
    "LawValues",
    "Losses",
    "OperatingPoint",
    "Parameter",
    "PeanoHasel",
    "PlanarHasel",
    "Pouch",
    "Response",
    "SampledLaw",
    "Scales",
    "actuator_law",
    "draw_parameters",
    "equilibrium_m",
    "feedthrough",
    "law_table",
    "linearise",
    "measured_parameters",
    "motion_parameters",
    "parameter",
    "rates",
    "with_parameters",
    "with_stated",
]
