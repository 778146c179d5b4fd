"""What a study has found so far: each fit is made once, when its result is first needed."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar, cast

from haselab.base import HaselabError, InputError, ResultError
from haselab.rig import RigDescription
from haselab.study.definition import Study
from haselab.study.experiment import Experiment, NotPlayedError, Outcome
from haselab.study.fits.observe import Observation, Source
from haselab.study.registry import experiment_classes

__all__ = ["Analysis", "AnyExperiment", "experiments_of", "fitting", "foreign"]

AnyExperiment = Experiment[Any]
Value = TypeVar("Value")


class _NotRecordedError(InputError):
    """The session lacks a recording: bad input, not a fit without a result."""


def experiments_of(study: Study) -> tuple[AnyExperiment, ...]:
    """The experiments that a study holds, in the order of playing."""
    found = [cast("type[AnyExperiment]", kind).of(study) for kind in experiment_classes()]
    return tuple(experiment for experiment in found if experiment is not None)


class Analysis:
    """The findings of one study while they are made.

    Args:
        study: what is played and fitted.
        rig: nominal values of the bench.
        source: observations by name; the fits know nothing else of the session.
        told: is called with the title of each fit as it begins.
        fitted: is called with each outcome, as soon as it is known.
        repeated: values of another run, by type, that are played again instead of those found here.
        known: values of an actuator file, by type, for what no experiment of the study gives.
    """

    def __init__(
        self,
        study: Study,
        rig: RigDescription,
        source: Source,
        told: Callable[[str], None] = lambda what: None,
        fitted: Callable[[Outcome], None] = lambda outcome: None,
        repeated: Mapping[type, object] | None = None,
        known: Mapping[type, object] | None = None,
    ) -> None:
        self.study, self.rig = study, rig
        self.experiments = experiments_of(study)
        self._source, self._told, self._fitted = source, told, fitted
        self._repeated, self._known = repeated or {}, known or {}
        self._seen: dict[str, Observation] = {}
        self._outcomes: dict[str, Outcome | NotPlayedError] = {}
        self._under_way: list[str] = []

    def observe(self, name: str) -> Observation:
        """What was recorded under a name, in physical units.

        Raises:
            InputError: the session does not hold it.
        """
        if name not in self._seen:
            try:
                self._seen[name] = self._source(name)
            except InputError as error:
                raise _NotRecordedError(str(error)) from error
        return self._seen[name]

    def need(self, kind: type[Value]) -> Value:
        """A value that an experiment gives, or the actuator file, such as `Maps`.

        Args:
            kind: its type.
        Raises:
            NotPlayedError: no experiment of this study gives it.
            ResultError: the fit that gives it has no result.
        """
        for experiment in self.experiments:
            if kind in experiment.gives:
                for value in self.outcome(experiment).values:
                    if isinstance(value, kind):
                        return value
                raise NotPlayedError(f"[{experiment.table}] of this study gives no {kind.__name__}")
        if kind in self._known:
            return cast("Value", self._known[kind])
        tables = [c.table for c in experiment_classes() if kind in c.gives]
        wanted = f"[{tables[0]}]" if tables else f"an experiment that gives a {kind.__name__}"
        raise NotPlayedError(f"needs {wanted}, which is not in this study")

    def find(self, kind: type[Value]) -> Value | None:
        """The same; None where no experiment of this study gives it."""
        with contextlib.suppress(NotPlayedError):
            return self.need(kind)
        return None

    def repeated(self, kind: type[Value]) -> Value | None:
        """The value of the run that is repeated; None where none is."""
        return cast("Value | None", self._repeated.get(kind))

    def to_play(self, kind: type[Value]) -> Value:
        """The value that is played: that of the run that is repeated, else the one found here.

        Raises:
            NotPlayedError: as of `need`.
        """
        repeated = self.repeated(kind)
        return self.need(kind) if repeated is None else repeated

    def outcome(self, experiment: AnyExperiment) -> Outcome:
        """What the fit of an experiment gives; made at the first call.

        Raises:
            NotPlayedError: it needs an experiment that is not in the study.
            ResultError: no result, or the recorded data are refused by the fit.
        """
        known = self._outcomes.get(experiment.table)
        if isinstance(known, NotPlayedError):
            raise known
        if known is not None:
            return known
        if experiment.table in self._under_way:
            circle = " -> ".join([*self._under_way, experiment.table])
            raise InputError(f"Experiments need each other's results in a circle: {circle}.")
        self._under_way.append(experiment.table)
        self._told(experiment.title)
        try:
            with fitting(experiment.title), foreign(experiment, "fit"):
                found = experiment.fit(self)
            _check_rows(experiment, found)
        except NotPlayedError as reason:
            self._outcomes[experiment.table] = reason
            raise
        finally:
            self._under_way.pop()
        self._outcomes[experiment.table] = found
        self._fitted(found)
        return found


def _check_rows(experiment: AnyExperiment, found: Outcome) -> None:
    """Refuse results that the report would have no row for.

    Raises:
        ResultError: naming them.
    """
    unnamed = sorted({*found.quantities, *found.missing} - set(experiment.rows()))
    if unnamed:
        raise ResultError(
            f"The experiment [{experiment.table}] gives {', '.join(unnamed)}, but its method "
            "'rows' does not name them. Add a Quantity for each there."
        )


@contextlib.contextmanager
def foreign(experiment: AnyExperiment, doing: str) -> Iterator[None]:
    """The code of another package, which may fail in any way: named, not a defect of haselab.

    Args:
        experiment: whose code runs.
        doing: "play" or "fit".
    Raises:
        ResultError: in place of an error that is none of haselab's.
    """
    try:
        yield
    except HaselabError:
        raise
    except Exception as error:
        package = type(experiment).__module__.partition(".")[0]
        if package == __name__.partition(".")[0]:
            raise
        raise ResultError(
            f"The method '{doing}' of the experiment [{experiment.table}], package {package!r}, "
            f"fails: {type(error).__name__}: {error}. What was recorded is kept. Add --debug for "
            "the place in its code."
        ) from error


@contextlib.contextmanager
def fitting(what: str) -> Iterator[None]:
    """A fit that refuses recorded data has no result: the user gave it nothing wrong.

    Args:
        what: is fitted.
    Raises:
        ResultError: in place of an `InputError`.
    """
    try:
        yield
    except _NotRecordedError:
        raise
    except InputError as error:
        raise ResultError(
            f"{what}: the recorded data give no result. {error} What was recorded is kept."
        ) from error
