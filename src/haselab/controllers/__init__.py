"""The extension point for controllers: protocol, declared parameters, and registry."""

from haselab.controllers.builtin import OpenLoop, PidController, pid_controller
from haselab.controllers.kind import ChosenController, ControllerKind, Parameter
from haselab.controllers.protocol import (
    Controller,
    ControllerSetting,
    LinearisableController,
    Measurement,
)
from haselab.controllers.registry import (
    GROUP,
    chosen_controller,
    controller_kind,
    controller_names,
    installed_controllers,
    parameters_of,
)

__all__ = [
    "GROUP",
    "ChosenController",
    "Controller",
    "ControllerKind",
    "ControllerSetting",
    "LinearisableController",
    "Measurement",
    "OpenLoop",
    "Parameter",
    "PidController",
    "chosen_controller",
    "controller_kind",
    "controller_names",
    "installed_controllers",
    "parameters_of",
    "pid_controller",
]
