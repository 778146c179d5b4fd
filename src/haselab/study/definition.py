"""Studies as data: read STUDY.toml and check all its tables at once."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from pydantic import ConfigDict, Field, create_model, model_validator

from haselab.base import InputError, JsonObject
from haselab.controllers import CONTROLLERS
from haselab.store.toml import Section, read_toml, validated
from haselab.study.registry import EXPERIMENTS, table_types
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
    "builtin_table",
    "checked_study",
    "file_model",
    "load_step_study",
    "load_study",
    "quick_note",
    "recorded_study",
    "reference_actuator",
    "step_study_of",
]

REFERENCE_STUDY = "hasel-iros2018"  # only its results are compared with the paper
_STUDIES = Path(__file__).parent / "studies"

_name: Any = Field(description="title of the report", examples=["one triangle"])

Table = TypeVar("Table", bound=Section)
_Kind = TypeVar("_Kind", bound=Section)


class _Head(Section):
    """The tables that every study has, whatever it plays."""

    name: str = _name
    sensing: Sensing = Sensing()
    operating_point: OperatingPoint = OperatingPoint()


class Study(_Head):
    """The experiments of a study, one table each.

    The possible tables are those of the registered experiments (`haselab.study.registry`); an
    experiment without a table is not played. The file may have the tables in any order.

    Example:
        >>> triangle = dict(low_v=0, high_v=2, frequency_hz=0.25, cycles=5, skipped_cycles=1,
        ...                 frame_rate_hz=100)
        >>> study = Study.model_validate({"name": "one triangle", "triangle": triangle})
        >>> study.triangle.high_v, study.has("chirp"), study.nominal_baseline_v
        (2.0, False, 1.0)
    """

    model_config = ConfigDict(extra="allow")

    @model_validator(mode="before")
    @classmethod
    def _tables_are_known(cls, data: Any) -> Any:
        """Check every table with its own class, all of them at once."""
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
        """Whether the study has a table."""
        return table in self.tables

    def table(self, name: str, kind: type[Table]) -> Table:
        """Return one table.

        Args:
            name: in the file.
            kind: the class that checks it.
        Raises:
            InputError: the study has no such table.
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
        """The given baseline, or the middle of the triangle, around which the baseline is found.

        Raises:
            InputError: no baseline is given, and there is no triangle.
        """
        given = self.operating_point.baseline_v
        if given is not None:
            return given
        if not self.has("triangle"):
            raise InputError(
                f"The study {self.name!r} has no [triangle], whose middle would be the voltage of "
                "zero strain. Add operating_point.baseline_v, in V at the DAQ output."
            )
        return 0.5 * (self.triangle.low_v + self.triangle.high_v)


class StepStudy(Section):
    """Step trials alone, for a rig that closes its own loop."""

    name: str = _name
    step_trials: StepTrials


def file_model(data: Mapping[str, Any]) -> type[_Head]:
    """Return the model of a study file with these tables.

    Args:
        data: of the file; keys that are not tables of experiments are refused.
    """
    fields: dict[str, Any] = {name: (kind, ...) for name, kind in table_types(data).items()}
    return create_model("StudyFile", __base__=_Head, **fields)


def _merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in changes.items():
        old = merged.get(key)
        both = isinstance(value, dict) and isinstance(old, dict)
        merged[key] = _merged(old, value) if both and isinstance(old, dict) else value
    return merged


def load_study(path: Path, *, quick: bool = False) -> Study:
    """Read STUDY.toml; report all errors at once, with their paths in the file.

    Args:
        path: of the TOML file; its table `quick` has the changes of a quick run.
        quick: apply those changes.
    Returns:
        The checked study.
    Raises:
        InputError: no such file, invalid TOML, an unknown key or a value out of range.
    """
    return _checked_file(path, quick, _study_of)


def _study_of(data: Mapping[str, Any], path: Path) -> Study:
    if "step_trials" in data:
        raise InputError(
            'The study has a table [step_trials], which needs a rig with kind = "chip". '
            f"Use such a rig, or the table [steps]. {path}"
        )
    return _with_all_parameters(checked_study(data, path), path)


def _with_all_parameters(study: Study, path: Path) -> Study:
    """Add the default of each parameter that the study leaves out for its own controller.

    Raises:
        InputError: the kind is not registered, or does not accept the parameters.
    """
    if not study.has("control") or study.control.kind is None:
        return study
    control = study.control
    values = dict(CONTROLLERS.find(str(control.kind)).choose(control.parameters, path).values)
    return study.model_copy(update={"control": control.model_copy(update={"parameters": values})})


def checked_study(data: Mapping[str, Any], source: object) -> Study:
    """Make a study from its tables, read from a file or from a recording.

    Args:
        data: the tables.
        source: where they come from, for error messages.
    Raises:
        InputError: an unknown table, no experiment at all, or a value
            out of range.
    """
    kinds = [name for name in EXPERIMENTS.packages() if name not in _Head.model_fields]
    fields = {*_Head.model_fields, *kinds}
    if loose := sorted(key for key in set(data) - fields if not isinstance(data[key], Mapping)):
        raise InputError(
            f"The study has the key {loose[0]} outside its tables, where only name may be. Write "
            f"it below the heading of its table, such as [{kinds[0]}]. {source}"
        )
    if unknown := sorted(set(data) - fields):
        close = difflib.get_close_matches(unknown[0], fields, 1)
        meant = f" Did you mean [{close[0]}]?" if close else ""
        raise InputError(
            f"The study has a table [{unknown[0]}], but no installed experiment has that "
            f"name.{meant} The known tables are {', '.join(sorted(fields - {'name'}))}. Change the "
            f"name, or install the package of the experiment. {source}"
        )
    if not table_types(data):
        raise InputError(
            "The study has no experiment. Add at least one of the tables "
            f"{', '.join(f'[{name}]' for name in kinds)}. {source}"
        )
    validated(file_model(data), data, source)  # whose messages know the keys of each table
    return Study.model_validate(data)


def recorded_study(tables: JsonObject) -> JsonObject:
    """The tables of a study in a recording, with the present names of keys that were renamed.

    Args:
        tables: in the recording's header.
    Returns:
        The tables.
    """
    found = dict(tables)
    for name, kind in table_types(tables).items():
        table = found[name]
        if isinstance(table, dict):
            found[name] = {kind.former_names.get(key, key): value for key, value in table.items()}
    return found


def load_step_study(path: Path, *, quick: bool = False) -> StepStudy:
    """Read a STUDY.toml of step trials only, for a chip.

    Args:
        path: of the TOML file.
        quick: apply its table `quick`.
    Returns:
        The checked study.
    Raises:
        InputError: see `load_study`.
    """
    return _checked_file(path, quick, _step_study_of)


def _step_study_of(data: Mapping[str, Any], path: Path) -> StepStudy:
    if "step_trials" not in data:
        raise InputError(
            "The study has no table [step_trials] (step, zero_s, step_s, rest_s, frame_rate_hz, "
            f"trials), the only one that a chip can play. Add it, or use another rig. {path}"
        )
    return validated(StepStudy, data, path)


def step_study_of(study: Study, *, quick: bool = False) -> StepStudy:
    """Convert the steps of a study to step trials for a chip, row S26.

    Args:
        study: whose step it is.
        quick: one short trial.
    """
    path = _STUDIES / "chip-steps.toml"
    steps = load_step_study(path, quick=quick)
    trials = steps.step_trials.model_copy(update={"step": study.steps.step})
    return steps.model_copy(update={"step_trials": trials})


def _checked_file(
    path: Path, quick: bool, check: Callable[[Mapping[str, Any], Path], _Kind]
) -> _Kind:
    """Read a study and check it, and its table `quick` also if it is not applied."""
    data = read_toml(path, "study")
    changes = data.pop("quick", {})
    if not isinstance(changes, dict):
        raise InputError(f"The study's quick is not a table. Write it under [quick.TABLE]. {path}")
    study = check(_merged(data, changes) if quick else data, path)
    if changes and not quick:
        try:
            check(_merged(data, changes), path)
        except InputError as error:
            raise InputError(f"With the changes of [quick]: {error}") from None
    return study


def quick_note(path: Path) -> str:
    """Say that a study has no shorter form, so that a quick run plays all of it.

    Args:
        path: of a study that can be read.
    Returns:
        What happens and what to add; empty if the study has a table `quick`.
    """
    data = read_toml(path, "study")
    if data.get("quick"):
        return ""
    tables = [name for name, table in data.items() if isinstance(table, Mapping)]
    played = next((name for name in tables if name not in _Head.model_fields), "triangle")
    return (
        f"--quick changes nothing, because the study has no table [quick]: all of it is played. "
        f"Add [quick.{played}] with the keys of [{played}] that a quick run changes. {path}"
    )


def builtin_table(name: str, kind: type[Table]) -> Table:
    """A table of settings that comes with the package, in a file of its own.

    Args:
        name: of the file.
        kind: the class that checks it.
    """
    path = _STUDIES / f"{name}.toml"
    return validated(kind, read_toml(path, "study"), path)


def reference_actuator() -> str:
    """The actuator file that the quick reference study wrote on the twin, without physical model.

    It was written by `haselab reproduce --quick --no-physical-model`.
    """
    return (_STUDIES / f"{REFERENCE_STUDY}-actuator.toml").read_text(encoding="utf-8")


def builtin_study(*, quick: bool = False) -> Study:
    """The reference study that comes with the package."""
    return load_study(_STUDIES / f"{REFERENCE_STUDY}.toml", quick=quick)
