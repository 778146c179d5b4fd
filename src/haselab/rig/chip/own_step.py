"""A controller of one's own on the microcontroller: the section [controller] and its C file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from haselab.base import InputError
from haselab.controllers import ChosenController, chosen_controller, parameters_of
from haselab.firmware import ChipSettings, ControllerStep, FrontEnd, settings_of_run
from haselab.store.text_file import read_text

__all__ = ["OWN", "own_settings"]

OWN = "own"  # structure of a firmware with the controller of the section [controller]
_PID = {"kp": 0.0, "ki": 0.0, "kd": 0.0, "derivative_filter_s": 0.0}


def own_settings(
    model: Mapping[str, Any],
    controller: Mapping[str, Any],
    front_end: FrontEnd,
    source: Path | None,
    file: Path,
) -> ChipSettings:
    """Settings with the controller of the section [controller].

    Args:
        model: of model.json.
        controller: of controller.toml.
        front_end: of the chip's board.
        source: C file; None: the one that the kind brings.
        file: path of controller.toml, for messages.
    Returns:
        The settings.
    Raises:
        InputError: no such section, an unknown kind, or a kind without a C step.
    """
    table = controller.get("controller")
    if not isinstance(table, Mapping):
        if source is None:
            raise InputError(
                "controller.toml has no section [controller]. Add one with kind and parameters, "
                f"or name a C file with --controller-source. {file}"
            )
        return _with(model, controller, front_end, ControllerStep(source.stem, (), _c_text(source)))
    if source is not None:
        return _with(model, controller, front_end, _unregistered(table, source))
    chosen = chosen_controller(table, file)
    if chosen.kind.c_source is not None:
        step = ControllerStep(chosen.kind.name, chosen.values, _c_text(chosen.kind.c_source))
        return _with(model, controller, front_end, step)
    gains = _PID | dict(chosen.values)
    if chosen.kind.name not in ("pi", "pid"):
        raise InputError(
            f"Controller {chosen.kind.name!r} has no C step, so it runs on the computer alone. "
            "Name a C file with --controller-source, or choose another kind."
        )
    return settings_of_run(model, {**controller, OWN: gains}, OWN, front_end)


def _with(
    model: Mapping[str, Any],
    controller: Mapping[str, Any],
    front_end: FrontEnd,
    step: ControllerStep,
) -> ChipSettings:
    settings = settings_of_run(model, {**controller, OWN: _PID}, OWN, front_end)
    return replace(settings, own=step)


def _unregistered(table: Mapping[str, Any], source: Path) -> ControllerStep:
    """Parameters in the order of the kind where it is registered, else in that of the section."""
    values = parameters_of(table)
    kind = str(table.get("kind", source.stem))
    try:
        chosen: ChosenController | None = chosen_controller(table)
    except InputError:
        chosen = None
    if chosen is not None:
        return ControllerStep(kind, chosen.values, _c_text(source))
    try:
        numbers = tuple((name, float(str(value))) for name, value in values.items())
    except (TypeError, ValueError):
        raise InputError(
            f"Section [controller]: {values} holds something that is not a number. Give numbers."
        ) from None
    return ControllerStep(kind, numbers, _c_text(source))


def _c_text(path: Path) -> str:
    text = read_text(path, "controller's C file")
    for name in ("hs_controller_init", "hs_controller_step"):
        if name not in text:
            raise InputError(
                f"The C file does not define {name}(). Define both functions of "
                f"core/include/hs_controller.h. {path}"
            )
    return text
