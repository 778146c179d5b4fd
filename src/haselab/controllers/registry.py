"""The registry of controllers: built-in kinds, and entry points of installed packages."""

from __future__ import annotations

from collections.abc import Mapping

from haselab.base import InputError, is_real, shown
from haselab.base.registry import Registry
from haselab.controllers.kind import ChosenController, ControllerKind, Parameter

__all__ = ["CONTROLLERS", "chosen_controller", "parameters_of"]

_LONGEST_PREVIEW_S = 60.0


def _fault(kind: object, name: str) -> str:
    """Return what is wrong with the object of an entry point, or an empty text."""
    if not isinstance(kind, ControllerKind):
        return f"it is of the type {type(kind).__name__!r}, not a ControllerKind"
    if kind.output not in ("strain", "voltage"):
        return f"its output is {kind.output!r}, neither 'strain' nor 'voltage'"
    if not is_real(kind.preview_s) or not 0.0 <= kind.preview_s <= _LONGEST_PREVIEW_S:
        return f"its preview_s is {shown(kind.preview_s)}, but must be 0 to {_LONGEST_PREVIEW_S:g}"
    good = isinstance(kind.parameters, tuple)
    if not good or not all(isinstance(one, Parameter) for one in kind.parameters):
        return "its parameters are not a tuple of Parameter"
    return "" if kind.name == name else f"its name is {kind.name!r}"


CONTROLLERS: Registry[ControllerKind] = Registry(
    "controller",
    "haselab.controllers",
    {
        "open-loop": "haselab.controllers.builtin:OPEN_LOOP",
        "pi": "haselab.controllers.builtin:PI",
        "pid": "haselab.controllers.builtin:PID",
        "force": "haselab.controllers.force:FORCE",
        "chip-force": "haselab.controllers.chip.force:CHIP_FORCE",
        "chip-observer": "haselab.controllers.chip.observer:CHIP_OBSERVER",
        "observer": "haselab.controllers.observer_design:OBSERVER",
        "learning": "haselab.controllers.adaptive.learning:LEARNING",
        "hybrid": "haselab.controllers.adaptive.hybrid:HYBRID",
        "alternating": "haselab.controllers.model_based.alternating:ALTERNATING",
        "h-infinity": "haselab.controllers.model_based.h_infinity_design:H_INFINITY",
        "mpc": "haselab.controllers.model_based.mpc:MPC",
        "network": "haselab.controllers.network:NETWORK",
        "scheduled-pid": "haselab.controllers.adaptive.scheduled:SCHEDULED",
    },
    _fault,
)


def chosen_controller(table: Mapping[str, object], source: object = "") -> ChosenController:
    """The controller of a section `[controller]`.

    Args:
        table: its keys `kind` and `parameters`; without the latter, all other keys are parameters.
        source: file of the section, for the message.
    Returns:
        The controller with all values checked.
    Raises:
        InputError: The kind is missing or unknown, or does not accept the parameters.
    Example:
        >>> chosen_controller({"kind": "pi", "kp": 0.85, "ki": 1.5}).summary()
        'pi, kp = 0.85, ki = 1.5 1/s'
    """
    kind, values = table.get("kind"), parameters_of(table)
    if not isinstance(kind, str):
        raise InputError(
            f"The section [controller] has no kind. Set kind to one of: "
            f"{', '.join(CONTROLLERS.packages())}.{f' {source}' if source else ''}"
        )
    return CONTROLLERS.find(kind).choose(values, source)


def parameters_of(table: Mapping[str, object]) -> dict[str, object]:
    """Read the parameters in a section `[controller]` without checking them.

    Args:
        table: of the section.
    Returns:
        The table `parameters` if there is one, else all keys except `kind`.
    Example:
        >>> parameters_of({"kind": "pi", "parameters": {"kp": 1.0}, "margins": {}})
        {'kp': 1.0}
    """
    parameters = table.get("parameters")
    if isinstance(parameters, Mapping):
        return {str(name): value for name, value in parameters.items()}
    return {name: value for name, value in table.items() if name != "kind"}
