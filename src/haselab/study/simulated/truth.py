"""The parameters of a simulated bench, and the results that follow from them."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any

from pydantic import ValidationError

from haselab.base import JsonObject
from haselab.rig.protocols import PLANAR_HASEL
from haselab.rig.twin.config import PLANAR_SECTIONS, TwinConfig, twin_of_reading

__all__ = [
    "follows_from_twin",
    "identified_as",
    "is_simulated",
    "parameters",
    "set_in_twin",
    "twin_of",
    "used_configuration",
    "with_default_twin",
]

_SAME = 0.02  # relative difference from the default twin within which a parameter is the same
_STATIC = ("shell", "electrodes", "load", "dielectric")
# Results that the default twin's parameters were chosen to give (ADR 3), and those parameters.
_SET = {
    "S13.residual_first": ("stiffness of the virgin actuator", ("mullins",)),
    "S14": ("span of eq. 4 over the triangle", _STATIC),
    "S15": ("slope and offset of eq. 5", _STATIC),
    "S16": ("shell material of the open tensile record", ("shell",)),
    "S17": ("stiffening of the electrodes", ("shell", "electrodes")),
    "S18": ("stiffening of the electrodes, span of eq. 4", _STATIC),
    "S19": ("frequency and damping of the interpretation", (*_STATIC, "viscosity")),
    "S20.omega_n": ("frequency of the interpretation", _STATIC),
    "S20.zeta": ("damping of the interpretation", (*_STATIC, "viscosity")),
    "S20.eq8_omega_n": ("frequency of the interpretation", _STATIC),
    "S20.eq8_zeta": ("damping of the interpretation", (*_STATIC, "viscosity")),
    "S20.slow": ("viscoelastic branch for a rise of 6 to 8 s", ("viscosity",)),
    "S24.rise_open": ("viscoelastic branch for a rise of 6 to 8 s", ("viscosity",)),
}
# Parameters of any twin that determine a result, whatever their values.
_FOLLOWS = {
    "S13": "stiffness and viscosity",
    "S14": "stiffness and dielectric",
    "S15": "dielectric and geometry",
    "S16": "shell",
    "S17": "shell and electrodes",
    "S18": "stiffness, dielectric and hung mass",
    "S19": "mass, inertia, stiffness and damping",
    "S20.gain": "stiffness, dielectric and viscosity",
    "S20.eq8_gain": "stiffness, dielectric and viscosity",
    "S20.omega_n": "mass, inertia and stiffness",
    "S20.eq8_omega_n": "mass, inertia and stiffness",
    "S20.zeta": "mass, inertia, stiffness and damping",
    "S20.eq8_zeta": "mass, inertia, stiffness and damping",
    "S20.slow": "viscosity",
    "S24.rise": "viscosity, and the gains scaled to the plant",
    "S24.rise_open": "viscosity",
    "S24.error_open": "viscosity",
}


def twin_of(rig_config: Mapping[str, Any]) -> TwinConfig | None:
    """The twin in a session's header, or in the provenance of results; None for another rig."""
    planar = "shell" in rig_config and "electrodes" in rig_config
    if not planar and not {"kind", "actuator", "amplifier", "acquisition"} <= set(rig_config):
        return None
    try:
        return TwinConfig.model_validate(rig_config)
    except ValidationError:
        return None


def used_configuration(rig_config: Mapping[str, Any]) -> Mapping[str, Any]:
    """The configuration of a rig without the parts of a twin that describe no part of it.

    Args:
        rig_config: of a session's header, where a twin of another kind has the default shell,
            electrodes and so on of the planar HASEL, too.
    Returns:
        What had an effect.
    """
    twin = twin_of(rig_config)
    if twin is None or twin.kind == PLANAR_HASEL:
        return rig_config
    unused = {*PLANAR_SECTIONS, "reading"}
    return {key: value for key, value in rig_config.items() if key not in unused}


def with_default_twin(
    rig_config: Mapping[str, Any],
) -> tuple[JsonObject, JsonObject] | None:
    """Parameters of the default twin with the same reading, and of the twin of a session.

    Args:
        rig_config: of the header.
    Returns:
        Both as JSON types; None for another rig.
    """
    twin = twin_of(rig_config)
    if twin is None:
        return None
    default = twin_of_reading(twin.reading)
    return default.model_dump(mode="json"), twin.model_dump(mode="json")


def identified_as(rig_config: Mapping[str, Any]) -> str:
    """Which identified actuator a twin simulates, in words.

    Args:
        rig_config: of a session's header.
    Returns:
        A noun phrase; empty for another rig.
    Example:
        >>> identified_as({"origin": {"actuator": "leg", "file": "A.toml", "draw": 3}})
        "the twin of the identified actuator 'leg' (A.toml, drawn with seed 3)"
    """
    origin = rig_config.get("origin")
    if not isinstance(origin, Mapping):
        return ""
    draw = origin.get("draw")
    how = "" if draw is None else f", drawn with seed {draw}"
    name, file = origin.get("actuator"), origin.get("file")
    return f"the twin of the identified actuator {name!r} ({file}{how})"


def is_simulated(rig_config: Mapping[str, Any]) -> bool:
    """Whether the bench of a session was a twin, or a chip in co-simulation."""
    return twin_of(rig_config) is not None or bool(rig_config.get("simulator"))


def parameters(twin: TwinConfig) -> dict[str, float]:
    """Results that are parameters of the twin, by id; other laws have none."""
    if twin.kind != PLANAR_HASEL:
        return {}
    return {
        "S16.mu": twin.shell.shear_modulus_pa,
        "S16.lambda_m": twin.shell.locking_stretch,
    }


def set_in_twin(twin: TwinConfig, key: str) -> str:
    """What in the default twin was set to the paper's value of a result.

    Args:
        twin: of the session.
        key: id of the result.
    Returns:
        The reason; empty if the result was not set, or if the twin differs from the default one in
        parameters that the result depends on.
    """
    name = _named(key, _SET)
    if name is None or twin.kind != PLANAR_HASEL:
        return ""
    reason, sections = _SET[name]
    default = twin_of_reading(twin.reading)
    same = all(
        _alike(getattr(twin, name).model_dump(), getattr(default, name).model_dump())
        for name in sections
    )
    return reason if same else ""


def follows_from_twin(key: str) -> str:
    """Which parameters of a twin determine a result, so that no twin can confirm the paper.

    The answer does not depend on the values: a twin with one changed parameter has the others.

    Args:
        key: id of the result.
    Returns:
        The parameters; empty if no small set of them determines the result.
    """
    name = _named(key, _FOLLOWS)
    return "" if name is None else _FOLLOWS[name]


def _named(key: str, names: Collection[str]) -> str | None:
    """The longest name that is the id or a prefix of it."""
    found = [name for name in names if key == name or key.startswith((f"{name}.", f"{name}_"))]
    return max(found, key=len, default=None)


def _alike(one: Any, other: Any) -> bool:
    """Whether all numbers agree within 2 %."""
    if isinstance(one, dict):
        return all(_alike(one[name], other[name]) for name in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(_alike, one, other))
    return math.isclose(one, other, rel_tol=_SAME)
