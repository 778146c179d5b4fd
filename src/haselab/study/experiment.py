"""The interface of an experiment: it declares its drives, plays, fits and names its results."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Generic, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from haselab.base import Estimate, ResultError
from haselab.rig import RigDescription
from haselab.runtime.observer import FIDUCIALS
from haselab.safety.feasibility import Drive
from haselab.store.session.writer import ExperimentPlan
from haselab.store.toml import Section
from haselab.study.definition import Study
from haselab.study.quantity import Quantity

if TYPE_CHECKING:
    from haselab.study.analysis import Analysis
    from haselab.study.player import Player

__all__ = ["Chart", "Curve", "Experiment", "ExperimentResult", "NotPlayedError"]

Settings = TypeVar("Settings", bound=Section)


class NotPlayedError(ResultError):
    """A result needs an experiment that this study does not play; the message says which."""


@dataclass(frozen=True)
class Curve:
    """One curve of a chart.

    Args:
        name: in the legend.
        x: shape `(N,)`.
        y: shape `(N,)`; NaN leaves a gap.
        points: draw separate points instead of a line.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    points: bool = False


@dataclass(frozen=True)
class Chart:
    """A figure of the report as data, so that the report needs no code of the experiment.

    Args:
        name: of the file in `figures/`: letters, digits and hyphens.
        title: what it shows, in a few words.
        caption: what is shown, and how to read it.
        x_label: of the horizontal axis, with its unit.
        y_label: of the vertical axis, with its unit.
        curves: in the order of drawing.
    """

    name: str
    title: str
    caption: str
    x_label: str
    y_label: str
    curves: tuple[Curve, ...]

    def to_dict(self) -> dict[str, object]:
        """Convert to JSON types, for analysis.json."""
        curves = [
            {"name": c.name, "x": np.asarray(c.x), "y": np.asarray(c.y), "points": c.points}
            for c in self.curves
        ]
        return {
            "name": self.name, "title": self.title, "caption": self.caption,
            "x_label": self.x_label, "y_label": self.y_label, "curves": curves,
        }  # fmt: skip


@dataclass(frozen=True)
class ExperimentResult:
    """The result of an experiment's fit.

    Args:
        quantities: estimates by id, each with a row of `Experiment.rows`.
        notes: by id, remarks for the reader.
        charts: further figures of the report.
        figures: sections of analysis.json, for the report's built-in figures.
        values: objects for other experiments, which request them by type; see `Experiment.gives`.
        missing: why a result was not found, by id.
    """

    quantities: Mapping[str, Estimate] = field(default_factory=dict)
    notes: Mapping[str, str] = field(default_factory=dict)
    charts: tuple[Chart, ...] = ()
    figures: Mapping[str, object] = field(default_factory=dict)
    values: tuple[object, ...] = ()
    missing: Mapping[str, str] = field(default_factory=dict)


class Experiment(ABC, Generic[Settings]):
    """One experiment of a study.

    A subclass names its table in STUDY.toml and implements `drives`, `play`, `fit` and `rows`. An
    experiment can only play the drives that it has declared, so that the feasibility check covers
    all of them.

    Args:
        study: the study of the experiment.
        settings: its table, checked.
    Example: `docs/extend/add-an-experiment.md` and `examples/plugins/haselab-myexperiment`.
    """

    table: ClassVar[str]
    title: ClassVar[str]
    settings_type: ClassVar[type[Section]]
    gives: ClassVar[tuple[type, ...]] = ()
    report_figures: ClassVar[tuple[str, ...]] = ()

    def __init__(self, study: Study, settings: Settings) -> None:
        self.study = study
        self.settings = settings

    @classmethod
    def of(cls, study: Study) -> Self | None:
        """Make the experiment of a study; None if the study does not have it."""
        settings = study.tables.get(cls.table)
        return None if settings is None else cls(study, settings)  # type: ignore[arg-type]

    def recordings(self) -> dict[str, str]:
        """Names of its recordings, and the kind of each; the default is one recording."""
        return {self.table: self.title}

    def plans(self) -> list[ExperimentPlan]:
        """The recordings as plans for the session file."""
        return [ExperimentPlan(name, kind, FIDUCIALS, {}) for name, kind in
                self.recordings().items()]  # fmt: skip

    @abstractmethod
    def drives(self, rig: RigDescription) -> Sequence[Drive]:
        """Declare every output of the experiment, in V before the amplifier.

        The feasibility check compares them with the limits before anything moves, and `play` may
        not leave their range. If a voltage depends on an earlier fit, declare the largest possible
        one.

        Args:
            rig: nominal values of the bench.
        """

    def check(self) -> None:
        """Refuse settings with which `fit` cannot have a result; called before anything moves.

        Raises:
            InputError: such a setting, and what to change.
        """
        return

    def masses_kg(self) -> tuple[float, ...]:
        """Masses that are hung in the experiment, besides the rig's own."""
        return ()

    def seconds(self, rig: RigDescription) -> float:
        """Duration on the bench's clock in s, waits included, for the check and the progress bar.

        This default is the duration of the declared drives, without waits.
        """
        return rig.block_s * sum(len(drive.values_v) for drive in self.drives(rig))

    @abstractmethod
    def play(self, player: Player) -> None:
        """Play and record the experiment.

        Args:
            player: plays, records, and returns the findings of earlier experiments.
        Raises:
            NotPlayedError: it needs the result of an experiment that is not in the study.
        """

    @abstractmethod
    def fit(self, analysis: Analysis) -> ExperimentResult:
        """Compute the results from the recording only, so that the fit can be repeated.

        Args:
            analysis: returns the observations, and the findings of other experiments.
        Raises:
            NotPlayedError: it needs the result of an experiment that is not in the study.
            ResultError: no result from these data.
        """

    @abstractmethod
    def rows(self) -> Mapping[str, Quantity]:
        """All possible results by id, in the order of the report."""
