"""Play and fit the experiments of a study in order, or repeat only the fits from a recording."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar, cast

from haselab.base import Estimate, ResultError
from haselab.rig import RigDescription
from haselab.runtime.runner import Runner
from haselab.study.analysis import Analysis, Given
from haselab.study.definition import Study
from haselab.study.experiment import Chart, ExperimentResult, NotPlayedError
from haselab.study.experiments.foreign import foreign, rows_of_experiment
from haselab.study.fits.observe import Observation, Source
from haselab.study.player import Player

__all__ = ["Findings", "play_and_fit"]

Value = TypeVar("Value")


@dataclass(frozen=True)
class Findings:
    """All findings of a study.

    Args:
        quantities: estimates by id.
        notes: by id, remarks for the reader.
        figures: sections of analysis.json.
        values: maps, plant, controllers and others, by type.
        charts: further figures of the report.
        missing: why a result was not found, by id.
        direct: results of the experiments' own fits, by id, where those of the identified physical
            model stand in `quantities`.
        observations: what the fits have seen, by the recording's name.
        failed: why an experiment could not be played or fitted; not those that only need another
            one that is not in the study.
    """

    quantities: Mapping[str, Estimate]
    notes: Mapping[str, str]
    figures: Mapping[str, Any]
    values: Mapping[type, object] = field(default_factory=dict)
    charts: tuple[Chart, ...] = ()
    missing: Mapping[str, str] = field(default_factory=dict)
    direct: Mapping[str, Estimate] = field(default_factory=dict)
    observations: Mapping[str, Observation] = field(default_factory=dict, repr=False)
    failed: tuple[str, ...] = ()

    def find(self, kind: type[Value]) -> Value | None:
        """Return a value by its type; None if this study has not found one."""
        return cast("Value | None", self.values.get(kind))

    def require_complete(self, where: str = "") -> None:
        """Raise the error of the first experiment that failed.

        Args:
            where: one sentence on where the other results are.
        Raises:
            ResultError: with the first reason, and the number of the other reasons.
        """
        if not self.failed:
            return
        first, *others = self.failed
        first = first if first.endswith((".", "?", "!")) else f"{first}."
        more = f" Failures for another reason: {len(others)} more." if others else ""
        raise ResultError(f"{first}{more}{f' {where}' if where else ''}")


def play_and_fit(
    source: Source,
    study: Study,
    rig: RigDescription,
    runner: Runner | None = None,
    on_fit: Callable[[str], None] = lambda what: None,
    repeated: Mapping[type, object] | None = None,
    fitted: Callable[[ExperimentResult], None] = lambda outcome: None,
    known: Mapping[type, object] | None = None,
) -> Findings:
    """Play and fit all experiments of a study.

    With a runner each experiment is played before it is fitted; without one, the source already has
    all of them. The fits are the same in both cases.

    If an experiment fails, its results and those that need it are missing. If it fails while the
    study is played, the rest of the study is not played.

    Args:
        source: observations by the experiment's name.
        study: what is played and fitted.
        rig: nominal values of the bench.
        runner: plays the experiments; None if they are already recorded.
        on_fit: called with the title of each fit as it begins.
        repeated: baseline, maps and controllers of another run, to play again exactly.
        fitted: called with each outcome, as soon as it is known.
        known: values of an actuator file that no experiment of the study finds.
    Returns:
        All results.
    Raises:
        InputError: an experiment is missing from the source.
    """

    def begin(what: str) -> None:
        if runner is not None and runner.present_drive_v != 0.0:
            runner.rest()  # while the fit is made
        on_fit(what)

    given = Given({} if repeated is None else repeated, known or {})
    analysis = Analysis(study, rig, source, begin, fitted, given)
    left_out = {} if runner is None else _play(analysis, runner)
    outcomes = []
    for experiment in analysis.experiments:
        if experiment.table not in left_out:
            try:
                outcomes.append(analysis.outcome(experiment))
                continue
            except ResultError as reason:
                left_out[experiment.table] = reason
        unfound = dict.fromkeys(rows_of_experiment(experiment), str(left_out[experiment.table]))
        outcomes.append(ExperimentResult(missing=unfound))
    failed = [str(one) for one in left_out.values() if not isinstance(one, NotPlayedError)]
    return Findings(
        quantities=_joined([part.quantities for part in outcomes]),
        notes=_joined_notes([part.notes for part in outcomes]),
        figures=_joined([part.figures for part in outcomes]),
        values={type(value): value for part in outcomes for value in part.values},
        charts=tuple(chart for part in outcomes for chart in part.charts),
        missing=_joined([part.missing for part in outcomes]),
        observations=analysis.observed,
        failed=tuple(dict.fromkeys(failed)),
    )


def _play(analysis: Analysis, runner: Runner) -> dict[str, ResultError]:
    """Play the experiments; return why some were not played, by their tables."""
    left_out: dict[str, ResultError] = {}
    for place, experiment in enumerate(analysis.experiments):
        try:
            with foreign(experiment, "play"):
                experiment.play(Player(runner, experiment, analysis))
        except NotPlayedError as reason:
            left_out[experiment.table] = reason
        except ResultError as failure:  # nobody knows whether the rest may be played
            runner.rest()
            left_out |= {one.table: failure for one in analysis.experiments[place:]}
            break
    return left_out


def _joined_notes(parts: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """Join notes by id; those of one id in the order of the parts."""
    found: dict[str, str] = {}
    for key, note in (item for part in parts for item in part.items()):
        found[key] = f"{found[key]}; {note}" if key in found else note
    return found


def _joined(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Join sections; one that occurs in several parts gets the entries of all of them."""
    found: dict[str, Any] = {}
    for key, value in (item for part in parts for item in part.items()):
        old = found.get(key)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        found[key] = {**cast("Mapping[str, Any]", old), **value} if both else value
    return found
