"""What a case of a campaign computes: the protocol of case kinds, and their registry."""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np

from haselab.base import Estimate, Json, JsonObject
from haselab.base.registry import Registry
from haselab.store.toml import Section, validated

__all__ = ["CASE_KINDS", "BaseFile", "CaseKind", "Inputs", "Results"]

Settings = TypeVar("Settings", bound=Section)

#: What a case returns: estimates with their intervals, and numbers that are computed exactly.
Results = Mapping[str, Estimate | float]


@dataclass(frozen=True)
class BaseFile:
    """A file that cases start from.

    Args:
        name: in `[base]`, and of the table whose keys can be varied.
        built_in: a value that needs no file.
        load: reads what `[base]` names, a built-in or a path relative to a folder, as a table with
            all its keys.
    """

    name: str
    built_in: str
    load: Callable[[str, Path], JsonObject]


@dataclass(frozen=True)
class Inputs:
    """The tables of one case, with the values of its parameters in place.

    Args:
        tables: `case` and those of the files of `[base]`, by name.
    """

    tables: Mapping[str, Mapping[str, Json]]

    def settings(self, model: type[Settings]) -> Settings:
        """The checked table `[case]`.

        Args:
            model: class of the table.
        Raises:
            InputError: an unknown key, or a value out of range.
        """
        return validated(model, self.tables["case"], "", "case")


class CaseKind(abc.ABC):
    """What a case computes. Subclass it, and register an instance (`haselab.cases`)."""

    name: ClassVar[str]
    files: ClassVar[tuple[BaseFile, ...]] = ()
    settings: ClassVar[type[Section]]
    #: Keys and tables without effect on the results, such as `twin.camera`; none can be varied.
    ignored: ClassVar[tuple[str, ...]] = ()

    def ignored_by(self, inputs: Inputs) -> tuple[str, ...]:
        """Return the keys without effect on a case, in addition to those of all cases.

        Args:
            inputs: of the case.
        """
        return ()

    @abc.abstractmethod
    def check(self, inputs: Inputs) -> None:
        """Check the tables without computing anything.

        Args:
            inputs: of a case.
        Raises:
            InputError: a table cannot be used.
        """

    @abc.abstractmethod
    def compute(self, inputs: Inputs, rng: np.random.Generator) -> Results:
        """Compute one case.

        The results depend on the arguments alone. An exception becomes a failed case.

        Args:
            inputs: of the case.
            rng: random numbers of the case.
        Returns:
            Results by name, SI, the unit last in the name of a bare number. NaN: the case has no
            such number. Infinity: it was not reached, which is larger than any number. `NAME.true`
            is the true value of the estimate `NAME`, from which the report computes the coverage.
        """


def _fault(kind: Any, name: str) -> str:
    """Return what is wrong with the object of an entry point, or an empty text."""
    if not isinstance(kind, CaseKind):
        return f"it is of the type {type(kind).__name__!r}, not a CaseKind"
    if kind.name != name:
        return f"its name is {kind.name!r}"
    if not (isinstance(kind.settings, type) and issubclass(kind.settings, Section)):
        return "its settings are not a class derived from Section"
    if not all(isinstance(each, BaseFile) for each in kind.files):
        return "a file is not a BaseFile"
    texts = isinstance(kind.ignored, tuple) and all(isinstance(key, str) for key in kind.ignored)
    return "" if texts else "its attribute ignored is not a tuple of texts"


CASE_KINDS: Registry[CaseKind] = Registry(
    "kind of case",
    "haselab.cases",
    {
        "transfer": "haselab.campaign.kinds.transfer:TRANSFER",
        "geometry": "haselab.campaign.kinds.geometry:GEOMETRY",
        "controller": "haselab.campaign.kinds.controller:CONTROLLER",
        "play": "haselab.campaign.kinds.play:PLAY",
    },
    _fault,
)
