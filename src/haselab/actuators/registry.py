"""The registry of actuator kinds: built-in ones, and entry points of installed packages."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Mapping

from haselab.actuators.curling_hasel import CurlingHasel
from haselab.actuators.dea_stack import DeaStack
from haselab.actuators.law import ActuatorLaw
from haselab.actuators.peano_hasel import PeanoHasel
from haselab.actuators.planar_hasel import PlanarHasel
from haselab.base import InputError, LimitError

__all__ = ["GROUP", "actuator_kind", "actuator_kinds", "actuator_law"]

GROUP = "haselab.actuators"
_BUILT_IN: Mapping[str, type[ActuatorLaw]] = {
    law.kind: law for law in (PlanarHasel, PeanoHasel, CurlingHasel, DeaStack)
}


def actuator_kinds() -> list[str]:
    """Names of all registered kinds.

    Returns:
        The names, in alphabetical order.
    Example:
        >>> {"planar-hasel", "dea-stack"} <= set(actuator_kinds())
        True
    """
    return sorted({*_BUILT_IN, *(point.name for point in _entry_points())})


def actuator_kind(kind: str) -> type[ActuatorLaw]:
    """Find the law of a kind of actuator.

    Args:
        kind: as in `kind = "dea-stack"` of TWIN.toml.
    Returns:
        The class; its package is imported now.
    Raises:
        InputError: The kind is unknown, registered twice, or its package does not load.
    """
    found = [point for point in _entry_points() if point.name == kind]
    if len(found) + (kind in _BUILT_IN) > 1:
        packages = [point.dist.name for point in found if point.dist is not None]
        raise InputError(
            f"The actuator kind {kind!r} is registered more than once, by {', '.join(packages)}"
            f"{' and by haselab itself' if kind in _BUILT_IN else ''}. Uninstall or rename one."
        )
    if kind in _BUILT_IN:
        return _BUILT_IN[kind]
    if not found:
        raise InputError(
            f"No actuator of kind {kind!r} is registered. Known kinds: "
            f"{', '.join(actuator_kinds())}. Install the package that provides it, or change kind."
        )
    return _loaded(found[0])


def actuator_law(kind: str, values: Mapping[str, float | tuple[float, ...]]) -> ActuatorLaw:
    """Create a law with its parameters.

    Args:
        kind: of the actuator.
        values: by the names of the fields; missing ones take their defaults.
    Returns:
        The law.
    Raises:
        InputError: A kind or name is unknown, or a value is outside its limits.
    Example:
        >>> actuator_law("dea-stack", {"layers": 40.0}).free_length_m
        0.028
    """
    law = actuator_kind(kind)
    known = {about.name: about for about in law.described()}
    for name, value in values.items():
        if name not in known:
            raise InputError(
                f"actuator.{name} is not a parameter of the kind {kind!r}. Its parameters are "
                f"{', '.join(known)}."
            )
        default = getattr(law, name)
        if isinstance(default, tuple) != isinstance(value, tuple):
            wanted = "a list of numbers" if isinstance(default, tuple) else "a number"
            raise InputError(f"actuator.{name} is {value}, but it must be {wanted}. Change it.")
    try:
        return law(**values)
    except LimitError as error:
        raise InputError(str(error)) from error


def _entry_points() -> importlib.metadata.EntryPoints:
    return importlib.metadata.entry_points(group=GROUP)


def _loaded(point: importlib.metadata.EntryPoint) -> type[ActuatorLaw]:
    try:
        law = point.load()
    except Exception as error:  # another package may raise anything
        raise InputError(
            f"The actuator kind {point.name!r} cannot be imported from {point.value}: "
            f"{type(error).__name__}: {error}. Fix or uninstall that package."
        ) from error
    if not (isinstance(law, type) and issubclass(law, ActuatorLaw)) or law.kind != point.name:
        raise InputError(
            f"{point.value} is not an ActuatorLaw with kind = {point.name!r}. Fix the entry point "
            "of that package."
        )
    return law
