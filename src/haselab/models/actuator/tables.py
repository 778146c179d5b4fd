"""Convert maps to sections of actuator.toml: the inverse of `sections`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict

from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap

__all__ = ["strain_map_section", "voltage_map_section"]


def strain_map_section(to_strain: StrainMap) -> Mapping[str, object]:
    """Convert a strain map to the section `[sensing.strain_map]`.

    Args:
        to_strain: capacitance in F to strain.
    Returns:
        Its keys; None for missing properties.
    Example:
        >>> {k: v for k, v in strain_map_section(StrainMap(4.9e8, -0.27)).items() if v}
        {'slope_per_f': 490000000.0, 'offset': -0.27, 'coverage': 0.95}
    """
    known = asdict(to_strain)
    return {
        name: None if isinstance(value, float) and math.isnan(value) else value
        for name, value in known.items()
    }


def voltage_map_section(to_volt: VoltageMap) -> Mapping[str, object]:
    """Convert a voltage map to the section `[drive.voltage_map]`, with its range of strains."""
    return asdict(to_volt)
