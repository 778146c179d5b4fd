"""haselab: the open bench for soft electrostatic actuators (HASEL, dielectric elastomers).

`import haselab as hl` is quick: what a name needs is imported when the name is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    __version__: str

    from haselab import control, identify, models, sensing, signals, tracking
    from haselab.api.bench import Recording, Runner, twin
    from haselab.api.data import Session, example, load, records, table
    from haselab.api.design import Actuator, design
    from haselab.api.sensing import sense, track
    from haselab.base import Estimate, HaselabError
    from haselab.identify import (
        Fit,
        Record,
        estimate_frequency_response,
        find_regions,
        fit_arx,
        fit_capacitance_map,
        fit_creep,
        fit_free_response,
        fit_hyperelastic,
        fit_hysteresis,
        fit_map,
        fit_subspace,
        fit_transfer,
        fit_voltage_map,
    )
    from haselab.models import Plant
    from haselab.rig import Rig
    from haselab.safety.armed import armed
    from haselab.sensing.strain import fit_strain_map
    from haselab.store.columns.table import Table

_PACKAGES = ("control", "identify", "models", "sensing", "signals", "tracking")
_HOMES = {
    "haselab.api.bench": ("Recording", "Runner", "twin"),
    "haselab.api.data": ("Session", "example", "load", "records", "table"),
    "haselab.api.design": ("Actuator", "design"),
    "haselab.api.sensing": ("sense", "track"),
    "haselab.base": ("Estimate", "HaselabError"),
    "haselab.identify": (
        "Fit",
        "Record",
        "estimate_frequency_response",
        "find_regions",
        "fit_arx",
        "fit_capacitance_map",
        "fit_creep",
        "fit_free_response",
        "fit_hyperelastic",
        "fit_hysteresis",
        "fit_map",
        "fit_subspace",
        "fit_transfer",
        "fit_voltage_map",
    ),
    "haselab.models": ("Plant",),
    "haselab.rig": ("Rig",),
    "haselab.safety.armed": ("armed",),
    "haselab.sensing.strain": ("fit_strain_map",),
    "haselab.store.columns.table": ("Table",),
}
_HOME = {name: home for home, names in _HOMES.items() for name in names}

__all__ = [
    "Actuator",
    "Estimate",
    "Fit",
    "HaselabError",
    "Plant",
    "Record",
    "Recording",
    "Rig",
    "Runner",
    "Session",
    "Table",
    "armed",
    "control",
    "design",
    "estimate_frequency_response",
    "example",
    "find_regions",
    "fit_arx",
    "fit_capacitance_map",
    "fit_creep",
    "fit_free_response",
    "fit_hyperelastic",
    "fit_hysteresis",
    "fit_map",
    "fit_strain_map",
    "fit_subspace",
    "fit_transfer",
    "fit_voltage_map",
    "identify",
    "load",
    "models",
    "records",
    "sense",
    "sensing",
    "signals",
    "table",
    "track",
    "tracking",
    "twin",
]


def __getattr__(name: str) -> object:
    if name == "__version__":
        return _version()
    if name in _PACKAGES:
        return importlib.import_module(f"haselab.{name}")
    if name in _HOME:
        value: object = getattr(importlib.import_module(_HOME[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'haselab' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})


def _version() -> str:
    """Version of the installed package, from the tag of the commit it was built from."""
    from importlib import metadata

    try:
        return metadata.version(__name__)
    except metadata.PackageNotFoundError:
        return "0+unknown"  # imported from a folder that was never installed
