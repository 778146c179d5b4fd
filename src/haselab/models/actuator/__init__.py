"""The actuator file: its sections, its maps, and the required keys of model files."""

from haselab.models.actuator.sections import ActuatorTables, ControllerSection
from haselab.models.actuator.strain_map import StrainMap

__all__ = ["ActuatorTables", "ControllerSection", "StrainMap"]
