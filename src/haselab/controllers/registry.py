"""The registry of controllers: built-in kinds, and entry points of installed packages."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping

from haselab.base import InputError
from haselab.controllers.builtin import BUILTIN
from haselab.controllers.kind import ChosenController, ControllerKind

__all__ = [
    "GROUP",
    "chosen_controller",
    "controller_kind",
    "controller_names",
    "installed_controllers",
    "parameters_of",
]

GROUP = "haselab.controllers"  # of the entry points


def controller_names() -> list[str]:
    """Names of all registered kinds.

    Returns:
        The names, in alphabetical order.
    Example:
        >>> {"open-loop", "pi", "pid"} <= set(controller_names())
        True
    """
    return sorted({*BUILTIN, *(point.name for point in _entry_points())})


def installed_controllers() -> list[tuple[str, str]]:
    """List the kinds of other packages without importing them.

    Returns:
        Name of the kind, and name and version of its package.
    """
    return [
        (point.name, f"{point.dist.name} {point.dist.version}" if point.dist else point.value)
        for point in sorted(_entry_points(), key=lambda point: point.name)
    ]


def controller_kind(name: str) -> ControllerKind:
    """Find a kind of controller by its name.

    Args:
        name: as in `kind = "..."`.
    Returns:
        The kind; its package is imported now.
    Raises:
        InputError: The kind is unknown, registered twice, or its package does not load.
    """
    found = [point for point in _entry_points() if point.name == name]
    if len(found) + (name in BUILTIN) > 1:
        packages = [point.dist.name for point in found if point.dist is not None]
        raise InputError(
            f"Controller {name!r} is registered more than once, by {', '.join(packages)}"
            f"{' and by haselab itself' if name in BUILTIN else ''}. Uninstall or rename one."
        )
    if name in BUILTIN:
        return BUILTIN[name]
    if not found:
        raise InputError(
            f"No controller of kind {name!r} is registered. Known kinds: "
            f"{', '.join(controller_names())}. Install the package that provides it, or change "
            "kind."
        )
    return _loaded(found[0])


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
            f"{', '.join(controller_names())}.{f' {source}' if source else ''}"
        )
    return controller_kind(kind).choose(values, source)


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


def _entry_points() -> importlib.metadata.EntryPoints:
    return importlib.metadata.entry_points(group=GROUP)


def _loaded(point: importlib.metadata.EntryPoint) -> ControllerKind:
    try:
        kind = point.load()
    except Exception as error:  # another package may raise anything
        raise InputError(
            f"Controller {point.name!r} cannot be imported from {point.value}: "
            f"{type(error).__name__}: {error}. Fix or uninstall that package."
        ) from error
    if not isinstance(kind, ControllerKind) or kind.name != point.name:
        raise InputError(
            f"{point.value} is {getattr(kind, 'name', type(kind).__name__)!r}, not a "
            f"ControllerKind with the name {point.name!r}. Fix the package's entry point."
        )
    return kind
