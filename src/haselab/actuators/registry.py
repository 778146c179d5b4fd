"""The registry of actuator kinds: built-in ones, and entry points of installed packages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Real

import numpy as np

from haselab.actuators.law import ActuatorLaw
from haselab.actuators.losses import Circuit, Losses
from haselab.base import HaselabError, InputError, LimitError, Limits, described, shown
from haselab.base.exits import no_exit
from haselab.base.registry import Registry

__all__ = ["ACTUATORS", "actuator_law"]

_OWN = __name__.partition(".")[0]
_POINTS = 3
_PROPERTIES = {
    "free_length_m": Real, "length_limits_m": Limits, "losses": Losses, "circuit": Circuit,
    "moving_mass_kg": Real, "width_m": Real, "area_m2": Real, "lateral_stretch": Real,
}  # fmt: skip


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
        made = law(**values)
    except LimitError as error:
        raise InputError(str(error)) from error
    if not law.__module__.startswith(f"{_OWN}."):
        _check_returned(made)
    return made


def _check_returned(law: ActuatorLaw) -> None:
    """Refuse a law that returns what would fail later in code of haselab.

    Raises:
        InputError: the message names the method and what it returns.
    """
    for name, kind in _PROPERTIES.items():
        value = _got(law, name)
        finite = not isinstance(value, Real) or math.isfinite(value)
        if not (isinstance(value, kind) and finite):
            what = "finite number" if kind is Real else kind.__name__
            raise InputError(f"{_place(law, name)} is {shown(value)}. Return a {what} there.")
    limits = law.length_limits_m
    length_m = np.linspace(limits.low, limits.high, _POINTS)
    for name in ("elastic_energy_j", "capacitance_f", "gap_m"):
        found = _got(law, name, length_m)
        numbers = np.asarray(found)
        if numbers.shape != length_m.shape or numbers.dtype.kind not in "fiu":
            raise InputError(
                f"{_place(law, name)} returns {shown(found)} for an array of {_POINTS} lengths. "
                "Return an array with a number for each."
            )


def _got(law: ActuatorLaw, name: str, *lengths: object) -> object:
    """A property of a law, or what its method returns.

    Raises:
        InputError: it raised an exception that is not one of haselab's.
    """
    try:
        with no_exit():
            found = getattr(law, name)
            return found(*lengths) if lengths else found
    except HaselabError:
        raise
    except Exception as error:
        why = described(error)
        raise InputError(f"{_place(law, name)} failed: {why}. Repair it.") from error


def _place(law: ActuatorLaw, name: str) -> str:
    return f"{name} of the actuator kind {law.kind!r} ({type(law).__qualname__})"
