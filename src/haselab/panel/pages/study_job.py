"""The studies that a panel can play: chosen by a page, checked before the bench is armed."""

from __future__ import annotations

import contextlib
import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from haselab.base import HaselabError, InputError, Json, JsonObject, shown
from haselab.models.actuator import ActuatorTables
from haselab.panel.files import PanelFiles
from haselab.pipelines.design.model_file import read_tables
from haselab.rig import RigDescription
from haselab.rig.bench_config import BenchConfig
from haselab.rig.operator import OperatorWeights
from haselab.rig.rig_file import RigFile, TwinFile, load_rig
from haselab.rig.twin.twin_bench import describe
from haselab.runtime.camera_recorder import KeepVideo
from haselab.store.actuator_file import ACTUATOR
from haselab.store.folder import write_text
from haselab.store.text_file import read_text
from haselab.study.analysis import experiments_of
from haselab.study.definition import Study, builtin_study, load_study
from haselab.study.feasibility import (
    check_settings,
    check_study,
    check_study_on_rig,
    rated_rig,
    study_drives,
)
from haselab.study.known import with_actuator_tables
from haselab.study.run import RunOptions

__all__ = [
    "PageOperator", "StudyJob", "available", "check", "chosen_study",
]  # fmt: skip

_REFERENCE = "reference study"
_MOST_BYTES, _MOST_FILES = 65536, 200


@dataclass(frozen=True)
class StudyJob:
    """A study that a bench is armed for.

    Args:
        study: that is played.
        options: of its recording.
        actuator: actuator file that it starts from; None: there is none.
    """

    study: Study
    options: RunOptions
    actuator: Path | None

    @classmethod
    def of(cls, files: PanelFiles, file: RigFile, values: JsonObject) -> StudyJob:
        """Prepare the study that a page has chosen.

        Args:
            files: of the panel.
            file: the rig file.
            values: `study`, `quick`, `experiments` and `keep_video` of the page.
        Returns:
            The job; its folder is a new one.
        Raises:
            InputError: there is no such study, or no result can come from it.
            LimitError: the bench cannot play it.
        """
        study = chosen_study(files, values)
        if "sha256" in values and values["sha256"] != _hash_of(study):
            raise InputError("The study has changed since it was checked. Press Check again.")
        feasible = check_study_on_rig(file, study, files.rig)
        if feasible is not None:
            feasible.require()
        keep: KeepVideo = "none" if values.get("keep_video") == "none" else "sample"
        named = re.sub(r"[^\w.-]+", "-", study.name)[:60].strip("-.")
        name = f"{datetime.now():%Y-%m-%d-%H%M%S}-{named}"
        folder, number = files.runs / name, 1
        while folder.exists():  # another study began in the same second
            number += 1
            folder = files.runs / f"{name}-{number}"
        rig_config, seed = file.model_dump(mode="json"), 0
        if isinstance(file, TwinFile):  # the recording says so, and of which actuator
            rig_config, seed = file.configuration(files.rig).model_dump(mode="json"), file.seed
        options = RunOptions(folder, seed, keep, rig_config, _tables(files))
        return cls(study, options, files.actuator)

    def begin(self) -> None:
        """Put a copy of the actuator file into the folder of the run, which is added to there."""
        if self.actuator is not None:
            text = read_text(self.actuator, "actuator file")
            write_text(self.options.folder / ACTUATOR, text)

    def highest_v(self, rig: RigDescription) -> float:
        """Highest drive that its experiments declare, in V."""
        return _highest_v(self.study, rig)


def _tables(files: PanelFiles) -> ActuatorTables | None:
    return None if files.actuator is None else read_tables(files.actuator)


def _study_files(files: PanelFiles) -> list[Path]:
    """TOML files in the folder from which the panel was started that may be studies."""
    places = sorted([*Path().glob("*.toml"), *Path("studies").glob("*.toml")])[:_MOST_FILES]
    others = {files.rig.resolve(), files.actuator.resolve() if files.actuator else None}
    found = []
    for path in places:
        with contextlib.suppress(OSError):  # a link to nothing
            small = path.is_file() and path.stat().st_size <= _MOST_BYTES  # and no pipe
            if small and path.resolve() not in others:
                found.append(path)
    return [path for path in found if not path.name.startswith(".")]


def available(files: PanelFiles) -> JsonObject:
    """Names of the studies that can be chosen, with the titles of their experiments.

    Args:
        files: of the panel.
    Returns:
        `studies`: each with `name` and `experiments`: their tables, titles, and planned `seconds`
        on the clock of the bench, in full and in the short version; null if that is not known.
    """
    rig, tables = _described(files), None
    with contextlib.suppress(InputError):  # the check says what is wrong with the file
        tables = _tables(files)
    found: list[JsonObject] = []
    for name in [_REFERENCE, *map(str, _study_files(files))]:
        try:
            full, short = (_study_of(name, quick=quick) for quick in (False, True))
        except InputError:  # another kind of file
            continue
        played = [_seconds(study, rig, tables) for study in (full, short)]
        listed: list[Json] = [
            one | {"seconds": [seconds.get(str(one["table"])) for seconds in played]}
            for one in _experiments(full)
        ]
        found.append({"name": name, "experiments": listed})
    return {"studies": found}


def _described(files: PanelFiles) -> RigDescription | None:
    """The rig of the file; None if it cannot be described."""
    with contextlib.suppress(InputError):
        file = load_rig(files.rig)
        if isinstance(file, TwinFile):
            return describe(file.configuration(files.rig))
        if isinstance(file, BenchConfig):
            return file.describe()
    return None


def _seconds(
    study: Study, rig: RigDescription | None, tables: ActuatorTables | None
) -> dict[str, float]:
    """Planned time of each experiment; none that cannot be planned."""
    found: dict[str, float] = {}
    with contextlib.suppress(HaselabError):
        if rig is not None:
            if tables is not None:
                study = with_actuator_tables(study, tables)
            found = {one.table: float(one.seconds(rig)) for one in experiments_of(study)}
    return found


def _study_of(name: str, *, quick: bool) -> Study:
    return builtin_study(quick=quick) if name == _REFERENCE else load_study(Path(name), quick=quick)


def _experiments(study: Study) -> list[JsonObject]:
    played = [one for one in experiments_of(study) if one.recordings()]
    return [{"table": one.table, "title": one.title} for one in played]


def chosen_study(files: PanelFiles, values: JsonObject) -> Study:
    """The study that a page has chosen, with what the actuator file knows.

    Args:
        files: of the panel.
        values: `study`, a name of `available`; `quick`; `experiments`, the tables to be played, or
            none for all of them.
    Returns:
        The study.
    Raises:
        InputError: there is no such study or experiment, or no result can come from it.
    """
    name, quick = values.get("study"), values.get("quick") is True
    if name == _REFERENCE or name in [str(path) for path in _study_files(files)]:
        study = _study_of(str(name), quick=quick)
    else:
        raise InputError(
            f"There is no study {shown(name)} in this folder. Choose one from the list."
        )
    study = _reduced(study, values.get("experiments"))
    if (tables := _tables(files)) is not None:
        study = with_actuator_tables(study, tables)
    check_settings(study)
    return study


def _reduced(study: Study, wanted: object) -> Study:
    """The study with some of its experiments; what is not played is kept, such as [control]."""
    played = {str(one["table"]): one for one in _experiments(study)}
    if wanted is None:
        return study
    if not isinstance(wanted, list):
        raise InputError(f"The experiments are {shown(wanted)}, but they must be a list of names.")
    unknown = [one for one in wanted if not isinstance(one, str) or one not in played]
    if unknown or not wanted:
        fault = f"The study has no experiment {shown(unknown[0])}" if unknown else "None is chosen"
        raise InputError(f"{fault}. Choose from its experiments: {', '.join(played)}.")
    if set(wanted) == set(played):
        return study
    content = study.model_dump(mode="json")
    content["name"] = f"{study.name}: {', '.join(wanted)}"
    kept = {name: table for name, table in content.items() if name not in set(played) - set(wanted)}
    return Study.model_validate(kept)


def check(files: PanelFiles, values: JsonObject) -> JsonObject:
    """Check whether the bench can play a study, before anybody arms it.

    Args:
        files: of the panel.
        values: as in `chosen_study`.
    Returns:
        `checks`, each with the number and its limit; `ok`; `rated`: whether the rating of the bench
        is known; `seconds` on the clock of the bench; `highest_v`, of the drive; and `sha256` of
        the study, with which a page arms the bench for this study alone.
    Raises:
        InputError: as `chosen_study`.
    """
    study, file = chosen_study(files, values), load_rig(files.rig)
    rated = rated_rig(file, study, files.rig)
    if rated is None:
        return {
            "checks": [], "ok": True, "rated": False, "seconds": None, "highest_v": None,
            "sha256": _hash_of(study),
        }  # fmt: skip
    found = check_study(study, *rated)
    return {
        "checks": [
            {"name": one.name, "where": one.where, "requested": one.requested,
             "limit": one.allowed, "unit": one.unit, "ok": one.ok,
             "advice": "" if one.ok else one.advice}
            for one in found.checks
        ],
        "ok": found.ok,
        "rated": True,
        "sha256": _hash_of(study),
        "seconds": sum(float(one.seconds(rated[0])) for one in experiments_of(study)),
        "highest_v": _highest_v(study, rated[0]),
    }  # fmt: skip


def _highest_v(study: Study, rig: RigDescription) -> float:
    return max((float(abs(one.values_v).max()) for one in study_drives(study, rig)), default=0.0)


def _hash_of(study: Study) -> str:
    content = json.dumps(study.model_dump(mode="json"), sort_keys=True)
    return hashlib.sha256(content.encode()).hexdigest()


class _Replies:
    """The page's confirmation of a step, as the stream that a person at the terminal types on."""

    def __init__(self, confirmed: Callable[[], bool]) -> None:
        self._confirmed = confirmed

    def readline(self) -> str:
        """Wait for the confirmation; empty if the study is to end."""
        return "\n" if self._confirmed() else ""


class _Prompts:
    """Where prompts go."""

    def __init__(self, show: Callable[[str], None]) -> None:
        self._show = show

    def write(self, text: str) -> int:
        """Show a prompt on the page that armed the bench."""
        self._show(text.replace("\a", "").replace(" and press Enter:", ".").strip())
        return len(text)

    def flush(self) -> None:
        """Nothing is kept back."""


class PageOperator(OperatorWeights):
    """A person at the page that armed the bench hangs the masses.

    Args:
        show: shows a prompt.
        confirmed: waits for the confirmation; False if the study is to end instead.
    """

    def __init__(self, show: Callable[[str], None], confirmed: Callable[[], bool]) -> None:
        super().__init__(_Replies(confirmed), _Prompts(show))
