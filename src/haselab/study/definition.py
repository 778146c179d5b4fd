"""A study as data: STUDY.toml, its tables checked all at once."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ConfigDict, create_model, model_validator

from haselab.base import InputError
from haselab.controllers import controller_kind
from haselab.store.toml import Section, read_toml, validated
from haselab.study.registry import table_types
from haselab.study.tables import (
    Chirp,
    Control,
    FreeResponse,
    OperatingPoint,
    Sensing,
    StaticLoad,
    Steps,
    StepTrials,
    Triangle,
)

__all__ = [
    "REFERENCE_STUDY",
    "StepStudy",
    "Study",
    "builtin_study",
    "checked_study",
    "file_model",
    "load_step_study",
    "load_study",
    "step_study_of",
]

REFERENCE_STUDY = "hasel-iros2018"  # whose results are compared with the paper
_STUDIES = Path(__file__).parent / "studies"

Table = TypeVar("Table", bound=Section)


class _Head(Section):
    """What every study has, whatever it plays."""

    name: str
    sensing: Sensing = Sensing()
    operating_point: OperatingPoint = OperatingPoint()


class Study(_Head):
    """What a run needs to know besides the rig: what is played, one table an experiment.

    Which tables there may be is the business of the experiments, see `haselab.study.registry`; one
    that is not there is not played. The file may hold them in any order.

    Example:
        >>> triangle = dict(low_v=0, high_v=2, frequency_hz=0.25, cycles=5, left_out_cycles=1,
        ...                 frame_rate_hz=100)
        >>> study = Study.model_validate({"name": "one triangle", "triangle": triangle})
        >>> study.triangle.high_v, study.has("chirp"), study.nominal_baseline_v
        (2.0, False, 1.0)
    """

    model_config = ConfigDict(extra="allow")

    @model_validator(mode="before")
    @classmethod
    def _tables_are_known(cls, data: Any) -> Any:
        """Check every table by its own class, all of them at once."""
        if not isinstance(data, Mapping):
            return data
        checked = file_model(data).model_validate(data)
        return {name: getattr(checked, name) for name in data if name in type(checked).model_fields}

    @property
    def tables(self) -> dict[str, Section]:
        """The experiments' tables by name, in the order of the file."""
        return dict(self.__pydantic_extra__ or {})

    @property
    def is_reference(self) -> bool:
        """Whether its results are compared with the paper, row by row."""
        return self.name == REFERENCE_STUDY

    def has(self, table: str) -> bool:
        """Whether the study holds a table."""
        return table in self.tables

    def table(self, name: str, kind: type[Table]) -> Table:
        """One table.

        Args:
            name: in the file.
            kind: class that has checked it.
        Raises:
            InputError: the study does not hold it.
        """
        found = self.tables.get(name)
        if not isinstance(found, kind):
            raise InputError(f"The study {self.name!r} has no table [{name}]. Add one.")
        return found

    @property
    def triangle(self) -> Triangle:
        """Table [triangle]."""
        return self.table("triangle", Triangle)

    @property
    def static_load(self) -> StaticLoad:
        """Table [static_load]."""
        return self.table("static_load", StaticLoad)

    @property
    def free_response(self) -> FreeResponse:
        """Table [free_response]."""
        return self.table("free_response", FreeResponse)

    @property
    def chirp(self) -> Chirp:
        """Table [chirp]."""
        return self.table("chirp", Chirp)

    @property
    def steps(self) -> Steps:
        """Table [steps]."""
        return self.table("steps", Steps)

    @property
    def control(self) -> Control:
        """Table [control]."""
        return self.table("control", Control)

    @property
    def nominal_baseline_v(self) -> float:
        """The baseline that is given, or the middle of the triangle, about which one is found.

        Raises:
            InputError: none is given and there is no triangle.
        """
        given = self.operating_point.baseline_v
        if given is not None:
            return given
        if not self.has("triangle"):
            raise InputError(
                f"The study {self.name!r} has no [triangle] whose middle could be the voltage of "
                "zero strain. Give operating_point.baseline_v, in V at the DAQ output."
            )
        return 0.5 * (self.triangle.low_v + self.triangle.high_v)


class StepStudy(Section):
    """Step trials alone, for a rig that closes its own loop."""

    name: str
    step_trials: StepTrials


def file_model(data: Mapping[str, Any]) -> type[_Head]:
    """The model of a study file that holds these tables.

    Args:
        data: of the file; what it holds besides tables of experiments is not allowed there.
    """
    known = {name: kind for name, kind in table_types().items() if name in data}
    fields: dict[str, Any] = {name: (kind, ...) for name, kind in known.items()}
    return create_model("StudyFile", __base__=_Head, **fields)


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        both = isinstance(value, dict) and isinstance(old, dict)
        merged[key] = _merged(old, value) if both and isinstance(old, dict) else value
    return merged


def load_study(path: Path, *, quick: bool = False) -> Study:
    """Read STUDY.toml; every fault is told at once, with its path in the file.

    Args:
        path: of the TOML file; its table `quick` holds the changes of a quick run.
        quick: apply those changes.
    Returns:
        The checked study.
    Raises:
        InputError: no such file, no TOML, an unknown key or a value out of range.
    """
    data = _read(path, quick)
    if "step_trials" in data:
        raise InputError(
            'The study holds a table [step_trials], which only a rig with kind = "mega" plays. '
            f"Name such a rig, or use the table [steps]. {path}"
        )
    return _with_all_parameters(checked_study(data, path), path)


def _with_all_parameters(study: Study, path: Path) -> Study:
    """The study with the default of each parameter that its own controller leaves out.

    Raises:
        InputError: the kind is not registered, or does not accept the parameters.
    """
    if not study.has("control") or study.control.kind is None:
        return study
    control = study.control
    values = dict(controller_kind(str(control.kind)).choose(control.parameters, path).values)
    return study.model_copy(update={"control": control.model_copy(update={"parameters": values})})


def checked_study(data: Mapping[str, Any], source: object) -> Study:
    """The study that some tables are, from a file or from a recording.

    Args:
        data: the tables.
        source: where they come from, for the message.
    Raises:
        InputError: a table that no installed experiment reads, no experiment at all, or a value
            out of range.
    """
    kinds = table_types()
    fields = {*_Head.model_fields, *kinds}
    if unknown := sorted(set(data) - fields):
        close = difflib.get_close_matches(unknown[0], fields, 1)
        meant = f" Did you mean [{close[0]}]?" if close else ""
        raise InputError(
            f"The study holds a table [{unknown[0]}] that no installed experiment reads.{meant} "
            f"Tables are {', '.join(sorted(fields - {'name'}))}; install the package of the "
            f"experiment, or correct the name. {source}"
        )
    if not set(data) & set(kinds):
        raise InputError(
            "The study holds no experiment. Add at least one of the tables "
            f"{', '.join(f'[{name}]' for name in kinds)}. {source}"
        )
    return validated(Study, data, source)


def load_step_study(path: Path, *, quick: bool = False) -> StepStudy:
    """The same for a study of step trials alone.

    Args:
        path: of the TOML file.
        quick: apply its table `quick`.
    Returns:
        The checked study.
    Raises:
        InputError: as of `load_study`.
    """
    data = _read(path, quick)
    if "step_trials" not in data:
        raise InputError(
            "The study holds no table [step_trials], which is all that a chip plays (step, zero_s, "
            f"step_s, rest_s, frame_rate_hz, trials). Give one, or name another rig. {path}"
        )
    return validated(StepStudy, data, path)


def step_study_of(study: Study, *, quick: bool = False) -> StepStudy:
    """The study's step as step trials for a chip, row S26.

    Args:
        study: whose step it is.
        quick: one short trial.
    """
    path = _STUDIES / "chip-steps.toml"
    steps = load_step_study(path, quick=quick)
    trials = steps.step_trials.model_copy(update={"step": study.steps.step})
    return steps.model_copy(update={"step_trials": trials})


def _read(path: Path, quick: bool) -> dict[str, Any]:
    data = read_toml(path, "study")
    changes = data.pop("quick", {})
    if not isinstance(changes, dict):
        raise InputError(f"The study's quick is not a table. Write it under [quick.TABLE]. {path}")
    return _merged(data, changes) if quick else data


def builtin_study(*, quick: bool = False) -> Study:
    """The reference study that comes with the package."""
    return load_study(_STUDIES / f"{REFERENCE_STUDY}.toml", quick=quick)
