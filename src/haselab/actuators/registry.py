"""The registry of actuator kinds: built-in ones, and entry points of installed packages."""

from __future__ import annotations

from collections.abc import Mapping

from haselab.actuators.law import ActuatorLaw
from haselab.base import InputError, LimitError
from haselab.base.registry import Registry

__all__ = ["ACTUATORS", "actuator_law"]


def _fault(law: object, kind: str) -> str:
    """Return what is wrong with the law of an entry point, or an empty text."""
    if not (isinstance(law, type) and issubclass(law, ActuatorLaw)):
        return "it is not a class derived from ActuatorLaw"
    own = getattr(law, "kind", None)
    return "" if own == kind else f"its attribute kind is {own!r}"


ACTUATORS: Registry[type[ActuatorLaw]] = Registry(
    "actuator",
    "haselab.actuators",
    {
        "planar-hasel": "haselab.actuators.planar_hasel:PlanarHasel",
        "peano-hasel": "haselab.actuators.peano_hasel:PeanoHasel",
        "curling-hasel": "haselab.actuators.curling_hasel:CurlingHasel",
        "dea-stack": "haselab.actuators.dea_stack:DeaStack",
    },
    _fault,
)


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
    law = ACTUATORS.find(kind)
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
