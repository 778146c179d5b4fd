"""The actuator file: its sections, the maps in it, and what a file of a model must hold."""

from haselab.models.actuator.sections import ActuatorTables, ControllerSection
from haselab.models.actuator.strain_map import StrainMap

__all__ = ["ActuatorTables", "ControllerSection", "StrainMap"]
