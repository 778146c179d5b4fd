"""One physical model of an actuator, identified jointly from all its experiments."""

from haselab.identify.physical.fit import ActuatorFit, fit_actuator
from haselab.identify.physical.record import MotionRecord

__all__ = ["ActuatorFit", "MotionRecord", "fit_actuator"]
