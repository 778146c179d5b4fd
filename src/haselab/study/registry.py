"""The registry of experiments: those of haselab and those of installed packages."""

from __future__ import annotations

import functools
from collections.abc import Iterable
from importlib.metadata import EntryPoint, entry_points
from typing import ClassVar, Protocol

from haselab.base import InputError
from haselab.store.toml import Section

__all__ = ["GROUP", "ExperimentClass", "experiment_classes", "table_types"]

GROUP = "haselab.experiments"  # of entry points
# In the order of playing; experiments of other packages follow.
_BUILT_IN = {
    "triangle": "haselab.study.experiments.triangle:TriangleTest",
    "static_load": "haselab.study.experiments.static_load:StaticLoadTest",
    "operating_point": "haselab.study.experiments.operating_point:OperatingPointTest",
    "free_response": "haselab.study.experiments.free_response:FreeResponseTest",
    "chirp": "haselab.study.experiments.chirp:ChirpTest",
    "control": "haselab.study.experiments.design:ControllerDesign",
    "steps": "haselab.study.experiments.steps:StepTest",
}


class ExperimentClass(Protocol):
    """What the registry needs of a class of experiments."""

    table: ClassVar[str]
    settings_type: ClassVar[type[Section]]
    gives: ClassVar[tuple[type, ...]]


@functools.cache
def experiment_classes() -> tuple[type[ExperimentClass], ...]:
    """All classes of experiments, in the order of playing.

    Returns:
        Those of haselab, then those of installed packages in the order of their names.
    Raises:
        InputError: a package's experiment cannot be loaded, or its table has a name in use.
    """
    built_in = [EntryPoint(name, value, GROUP) for name, value in _BUILT_IN.items()]
    return _loaded([*built_in, *sorted(entry_points(group=GROUP), key=lambda point: point.name)])


def _loaded(points: Iterable[EntryPoint]) -> tuple[type[ExperimentClass], ...]:
    found: dict[str, type[ExperimentClass]] = {}
    for point in points:
        try:
            loaded = point.load()
            table = loaded.table
        except Exception as error:  # another package's code may fail in any way
            raise InputError(
                f"The experiment {point.name!r} of an installed package ({point.value}) cannot be "
                f"loaded: {type(error).__name__}: {error}. Repair or uninstall that package."
            ) from error
        if table in found:
            raise InputError(
                f"The experiment {point.name!r} ({point.value}) has the table [{table}], which "
                f"{found[table].__module__} already uses. Rename its table, or uninstall its "
                "package."
            )
        found[table] = loaded
    return tuple(found.values())


def table_types() -> dict[str, type[Section]]:
    """The classes that check the tables of a study, by name, in the order of playing."""
    return {
        kind.table: kind.settings_type
        for kind in experiment_classes()
        if kind.table != "operating_point"  # which every study has
    }
