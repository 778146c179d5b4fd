"""What is known of a bench that is simulated: parameters of the twin, and what was set in it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from haselab.rig.twin.config import TwinConfig, twin_of_reading

__all__ = ["is_simulated", "parameters", "set_in_twin", "twin_of"]

_SAME = 0.02  # relative difference from the default twin within which a parameter is the same
_STATIC = ("shell", "electrodes", "load", "dielectric")
# What the default twin's numbers were chosen from (docs/adr/0003) and where they lie, by row.
_SET = {
    "S13.residual_first": ("stiffness of the virgin actuator", ("mullins",)),
    "S14": ("span of eq. 4 over the triangle", _STATIC),
    "S15": ("slope and offset of eq. 5", _STATIC),
    "S16": ("shell material of the open tensile record", ("shell",)),
    "S17": ("stiffening of the electrodes", ("shell", "electrodes")),
    "S18": ("stiffening of the electrodes, span of eq. 4", _STATIC),
    "S19": ("frequency and damping of the reading", (*_STATIC, "viscosity")),
    "S20.omega_n": ("frequency of the reading", _STATIC),
    "S20.zeta": ("damping of the reading", (*_STATIC, "viscosity")),
    "S20.eq8_omega_n": ("frequency of the reading", _STATIC),
    "S20.eq8_zeta": ("damping of the reading", (*_STATIC, "viscosity")),
    "S20.slow": ("viscoelastic branch for a rise of 6 to 8 s", ("viscosity",)),
    "S24.rise_open": ("viscoelastic branch for a rise of 6 to 8 s", ("viscosity",)),
}


def twin_of(rig_config: Mapping[str, Any]) -> TwinConfig | None:
    """The twin of a session's header; None for another rig."""
    if "shell" not in rig_config or "electrodes" not in rig_config:
        return None
    try:
        return TwinConfig.model_validate(rig_config)
    except ValidationError:
        return None


def is_simulated(rig_config: Mapping[str, Any]) -> bool:
    """Whether the bench of a session's header was a twin, or a chip beside one."""
    return twin_of(rig_config) is not None or bool(rig_config.get("simulator"))


def parameters(twin: TwinConfig) -> dict[str, float]:
    """Results that are parameters of the twin, by id."""
    return {
        "S16.mu": twin.shell.shear_modulus_pa,
        "S16.lambda_m": twin.shell.locking_stretch,
    }


def set_in_twin(twin: TwinConfig, key: str) -> str:
    """What of the default twin was set to the paper's value of a result.

    Args:
        twin: of the session.
        key: id of the result.
    Returns:
        The reason; empty for a result that was not put in, and where the twin has other numbers in
        what the result depends on.
    """
    found = [name for name in _SET if key == name or key.startswith((f"{name}.", f"{name}_"))]
    if not found:
        return ""
    reason, sections = _SET[max(found, key=len)]
    default = twin_of_reading(twin.reading)
    same = all(
        _alike(getattr(twin, name).model_dump(), getattr(default, name).model_dump())
        for name in sections
    )
    return reason if same else ""


def _alike(one: Any, other: Any) -> bool:
    """Whether all numbers are the same within 2 %."""
    if isinstance(one, dict):
        return all(_alike(one[name], other[name]) for name in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(_alike, one, other))
    return math.isclose(one, other, rel_tol=_SAME)
