"""What is known of a bench that is simulated: parameters of the twin, and what was set in it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import ValidationError

from haselab.rig.twin.config import TwinConfig, twin_of_reading

__all__ = ["is_simulated", "parameters", "set_in_twin", "twin_of"]

# What the default twin's numbers were chosen from (docs/adr/0003), by row.
_SET = {
    "S13.return_first": "stiffness of the virgin sheet",
    "S14": "span of eq. 4 over the triangle",
    "S15": "slope and offset of eq. 5",
    "S16": "shell material of the open tensile record",
    "S17": "stiffening of the electrodes",
    "S18.baseline": "stiffening of the electrodes",
    "S18.centring": "stiffening of the electrodes",
    "S19.omega_d": "frequency of the reading",
    "S19.omega_0": "frequency of the reading",
    "S19.decay": "damping of the reading",
    "S19.printed_omega": "frequency of the reading",
    "S19.printed_decay": "damping of the reading",
    "S20.omega_n": "frequency of the reading",
    "S20.zeta": "damping of the reading",
    "S20.eq8_omega_n": "frequency of the reading",
    "S20.eq8_zeta": "damping of the reading",
    "S20.slow": "viscoelastic branch for a rise of 6 to 8 s",
    "S24.rise_open": "viscoelastic branch for a rise of 6 to 8 s",
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
        The reason; empty for a result that was not put in, and for a twin with other numbers.
    """
    default = twin_of_reading(twin.reading)
    sections = ("shell", "electrodes", "viscosity", "mullins", "load", "dielectric")
    if any(getattr(twin, name) != getattr(default, name) for name in sections):
        return ""
    found = [name for name in _SET if key == name or key.startswith((f"{name}.", f"{name}_"))]
    return _SET[max(found, key=len)] if found else ""
