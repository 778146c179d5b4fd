"""The findings of a study so far: each fit is made once, when its result is first needed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import TypeVar, cast

from haselab.base import InputError, ResultError
from haselab.rig import RigDescription
from haselab.study.definition import Study
from haselab.study.experiment import ExperimentResult, NotPlayedError
from haselab.study.experiments.foreign import (
    AnyExperiment,
    check_result,
    foreign,
    refuse_repeated,
    rows_of_experiment,
)
from haselab.study.fits.observe import Observation, Source
from haselab.study.registry import EXPERIMENTS

__all__ = ["Analysis", "Given", "experiments_of", "fitting"]

Value = TypeVar("Value")


class _NotRecordedError(InputError):
    """The session lacks a recording, which is bad input, not a failed fit."""


def experiments_of(study: Study) -> tuple[AnyExperiment, ...]:
    """The experiments of a study, in the order of playing."""
    tables = ("operating_point", *study.tables)
    names = [name for name in EXPERIMENTS.packages() if name in tables]
    found = [cast("type[AnyExperiment]", EXPERIMENTS.find(name)).of(study) for name in names]
    experiments = tuple(experiment for experiment in found if experiment is not None)
    refuse_repeated("result", [key for one in experiments for key in rows_of_experiment(one)])
    return experiments


@dataclass(frozen=True)
class Given:
    """Values that an analysis does not find itself, by type.

    Args:
        repeated: of another run, to play instead of those found here.
        known: of an actuator file, that no experiment of the study finds.
        near: of the same fits on almost the same observations. A fit may start there, and may leave
            out figures and intervals.
    """

    repeated: Mapping[type, object] = field(default_factory=dict)
    known: Mapping[type, object] = field(default_factory=dict)
    near: Mapping[type, object] = field(default_factory=dict)


class Analysis:
    """The findings of a study while its fits are made.

    Args:
        study: what is played and fitted.
        rig: nominal values of the bench.
        source: returns observations by name; the fits have no other access to the session.
        on_fit: called with the title of each fit as it begins.
        fitted: called with each outcome, as soon as it is known.
        given: values that it does not find itself; None: none.
    """

    def __init__(
        self,
        study: Study,
        rig: RigDescription,
        source: Source,
        on_fit: Callable[[str], None] = lambda what: None,
        fitted: Callable[[ExperimentResult], None] = lambda outcome: None,
        given: Given | None = None,
    ) -> None:
        self.study, self.rig = study, rig
        self.experiments = experiments_of(study)
        self._source, self._on_fit, self._fitted = source, on_fit, fitted
        self._given = given or Given()
        self._seen: dict[str, Observation] = {}
        self._outcomes: dict[str, ExperimentResult | ResultError] = {}
        self._under_way: list[str] = []

    def observe(self, name: str) -> Observation:
        """Return what was recorded under a name, in physical units.

        Raises:
            InputError: the session has no such recording.
        """
        if name not in self._seen:
            try:
                self._seen[name] = self._source(name)
            except InputError as error:
                raise _NotRecordedError(str(error)) from error
        return self._seen[name]

    @property
    def observed(self) -> Mapping[str, Observation]:
        """What `observe` has returned so far, by name."""
        return self._seen

    def need(self, kind: type[Value]) -> Value:
        """Return a value that an experiment finds, or that of the actuator file, such as `Maps`.

        Args:
            kind: its type.
        Raises:
            NotPlayedError: no experiment of this study finds it.
            ResultError: the fit has no result.
        """
        for experiment in self.experiments:
            if kind in experiment.gives:
                for value in self.outcome(experiment).values:
                    if isinstance(value, kind):
                        return value
                raise NotPlayedError(
                    f"[{experiment.table}] of this study did not find a {kind.__name__}"
                )
        if kind in self._given.known:
            return cast("Value", self._given.known[kind])
        tables = [name for name, c in EXPERIMENTS.usable().items() if kind in c.gives]
        wanted = f"[{tables[0]}]" if tables else f"an experiment that finds a {kind.__name__}"
        raise NotPlayedError(f"needs {wanted}, which is not in this study")

    def find(self, kind: type[Value]) -> Value | None:
        """Return a value like `need`; None if no experiment of this study finds it."""
        with contextlib.suppress(NotPlayedError):
            return self.need(kind)
        return None

    def repeated(self, kind: type[Value]) -> Value | None:
        """Return the value of the run that is repeated; None if there is none."""
        return cast("Value | None", self._given.repeated.get(kind))

    def near(self, kind: type[Value]) -> Value | None:
        """Return the value of a fit of almost the same observations; None if there is none."""
        return cast("Value | None", self._given.near.get(kind))

    def to_play(self, kind: type[Value]) -> Value:
        """Return the value to play: that of a run that is repeated, else the one found here.

        Raises:
            NotPlayedError: see `need`.
        """
        repeated = self.repeated(kind)
        return self.need(kind) if repeated is None else repeated

    def outcome(self, experiment: AnyExperiment) -> ExperimentResult:
        """Return the outcome of an experiment's fit, which is made at the first call.

        Raises:
            NotPlayedError: the fit needs an experiment that is not in the study.
            ResultError: no result, or the fit refuses the recorded data.
        """
        known = self._outcomes.get(experiment.table)
        if isinstance(known, ResultError):
            raise known
        if known is not None:
            return known
        if experiment.table in self._under_way:
            circle = " -> ".join([*self._under_way, experiment.table])
            raise InputError(
                f"The experiments depend on each other in a circle: {circle}. Remove one "
                "dependency."
            )
        self._under_way.append(experiment.table)
        self._on_fit(experiment.title)
        try:
            with fitting(experiment.title), foreign(experiment, "fit"):
                found = experiment.fit(self)
            with foreign(experiment, "fit"):
                check_result(experiment, found)
        except ResultError as reason:
            self._outcomes[experiment.table] = reason
            raise
        finally:
            self._under_way.pop()
        self._outcomes[experiment.table] = found
        self._fitted(found)
        return found


@contextlib.contextmanager
def fitting(what: str) -> Iterator[None]:
    """Turn a fit's refusal of recorded data into a missing result: it is not the user's input.

    Args:
        what: title of the fit.
    Raises:
        ResultError: replaces an `InputError`.
    """
    try:
        yield
    except _NotRecordedError:
        raise
    except InputError as error:
        raise ResultError(
            f"{what}: no result from the recorded data. {error} The recorded data are kept."
        ) from error
