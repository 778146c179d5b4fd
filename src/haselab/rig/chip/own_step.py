"""Your own controller on the microcontroller: its parameters and its C file."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from haselab.base import InputError
from haselab.controllers import (
    CONTROLLERS,
    ChipController,
    ChosenController,
    ControllerSetting,
    chosen_controller,
)
from haselab.firmware import ControllerStep
from haselab.models.actuator.sections import ControllerSection
from haselab.store.text_file import read_text

__all__ = ["controller_step"]


def controller_step(
    controller: ControllerSection,
    source: Path | None,
    setting: Callable[[], ControllerSetting | None],
) -> ControllerStep:
    """Read the C step of a controller of the actuator file.

    Args:
        controller: its kind and parameters. If the kind is registered, they are checked and
            passed in the order of the kind, else in that of the section.
        source: C file; None: that of the kind.
        setting: returns that of the microcontroller's loop, for kinds that write their C step; None
            without the identified actuator.
    Returns:
        The controller to compile in place of the PID.
    Raises:
        InputError: The kind is unknown, refuses the values, or has no C step.
    """
    if source is not None:
        return ControllerStep(controller.kind, _values(controller), _c_text(source))
    chosen = _chosen(controller)
    made = chosen.make()
    if isinstance(made, ChipController):
        return ControllerStep(
            chosen.kind.name, chosen.values, _written(chosen, made, setting()), in_volts=True
        )
    if chosen.kind.c_source is None:
        raise InputError(
            f"Controller {chosen.kind.name!r} has no C step, so it runs only on the computer. Give "
            "a C file with --controller-source, or choose another kind."
        )
    return ControllerStep(chosen.kind.name, chosen.values, _c_text(chosen.kind.c_source))


def _written(
    chosen: ChosenController, made: ChipController, setting: ControllerSetting | None
) -> str:
    if setting is None:
        raise InputError(
            f"Controller {chosen.kind.name!r} needs [model.physical] of the actuator. Identify it "
            "with haselab identify actuator."
        )
    return made.c_text(setting)


def _chosen(controller: ControllerSection) -> ChosenController:
    return chosen_controller({"kind": controller.kind, "parameters": controller.parameters})


def _values(controller: ControllerSection) -> tuple[tuple[str, float], ...]:
    if controller.kind in CONTROLLERS.packages():
        return _chosen(controller).values
    return tuple((name, float(value)) for name, value in controller.parameters.items())


def _c_text(path: Path) -> str:
    text = read_text(path, "controller's C file")
    for name in ("hs_controller_init", "hs_controller_step"):
        if name not in text:
            raise InputError(
                f"The C file does not define {name}(). Define both functions of "
                f"core/include/hs_controller.h. {path}"
            )
    return text
