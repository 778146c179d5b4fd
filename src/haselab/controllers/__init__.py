"""The extension point for controllers: protocol, declared parameters, and registry."""

from haselab.controllers.builtin import OpenLoop, PidController, pid_controller
from haselab.controllers.kind import ChosenController, ControllerKind, Parameter
from haselab.controllers.known_actuator import KnownActuator, known_actuator
from haselab.controllers.protocol import (
    ChipController,
    Controller,
    ControllerSetting,
    LinearisableController,
    Measurement,
)
from haselab.controllers.registry import CONTROLLERS, chosen_controller, parameters_of

__all__ = [
    "CONTROLLERS",
    "ChipController",
    "ChosenController",
    "Controller",
    "ControllerKind",
    "ControllerSetting",
    "KnownActuator",
    "LinearisableController",
    "Measurement",
    "OpenLoop",
    "Parameter",
    "PidController",
    "chosen_controller",
    "known_actuator",
    "parameters_of",
    "pid_controller",
]
