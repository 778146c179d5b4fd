"""The registry of experiments: those of haselab and those of installed packages."""

from __future__ import annotations

from collections.abc import Collection
from typing import ClassVar, Protocol

from haselab.base.registry import Registry
from haselab.store.toml import Section

__all__ = ["EXPERIMENTS", "ExperimentClass", "table_types"]


class ExperimentClass(Protocol):
    """What the registry needs of a class of experiments."""

    table: ClassVar[str]
    settings_type: ClassVar[type[Section]]
    gives: ClassVar[tuple[type, ...]]


def _fault(kind: object, name: str) -> str:
    """Return what is wrong with the class of an entry point, or an empty text."""
    table, settings = getattr(kind, "table", None), getattr(kind, "settings_type", None)
    if table != name:
        return f"its attribute table is {table!r}"
    if not (isinstance(settings, type) and issubclass(settings, Section)):
        return f"its attribute settings_type is {settings!r}, not a class derived from Section"
    missing = sorted(getattr(kind, "__abstractmethods__", ()))
    missing += [each for each in ("title", "of", "gives") if not hasattr(kind, each)]
    return f"it has no {', '.join(missing)}" if missing else ""


EXPERIMENTS: Registry[type[ExperimentClass]] = Registry(
    "experiment",
    "haselab.experiments",
    {  # in the order of playing; experiments of other packages follow
        "triangle": "haselab.study.experiments.triangle:TriangleTest",
        "static_load": "haselab.study.experiments.static_load:StaticLoadTest",
        "operating_point": "haselab.study.experiments.operating_point:OperatingPointTest",
        "free_response": "haselab.study.experiments.free_response:FreeResponseTest",
        "chirp": "haselab.study.experiments.chirp:ChirpTest",
        "control": "haselab.study.experiments.design:ControllerDesign",
        "steps": "haselab.study.experiments.steps:StepTest",
        "model_control": "haselab.study.experiments.model_control:ModelControlTest",
    },
    _fault,
)


def table_types(names: Collection[str]) -> dict[str, type[Section]]:
    """The classes that check the tables of a study.

    Args:
        names: of the study's tables; other experiments are not loaded.
    Returns:
        The classes by name, in the order of playing.
    Raises:
        InputError: an experiment of an installed package cannot be used.
    """
    return {
        name: EXPERIMENTS.find(name).settings_type
        for name in EXPERIMENTS.packages()
        if name in names and name != "operating_point"  # which every study has
    }
