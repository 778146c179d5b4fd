"""What an experiment is: it declares its drives, plays, observes, fits, and names its results."""

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

__all__ = ["Chart", "Curve", "Experiment", "NotPlayedError", "Outcome"]

Settings = TypeVar("Settings", bound=Section)


class NotPlayedError(ResultError):
    """A result needs something that this study does not play; the message is the reason."""


@dataclass(frozen=True)
class Curve:
    """One curve of a chart.

    Args:
        name: in the legend.
        x: shape `(N,)`.
        y: shape `(N,)`; NaN leaves a gap.
        points: drawn as separate points; else as a line.
    """

    name: str
    x: ArrayLike
    y: ArrayLike
    points: bool = False


@dataclass(frozen=True)
class Chart:
    """A figure of the report as data, so that the report is drawn without the experiment's code.

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
        """As analysis.json holds it."""
        curves = [
            {"name": c.name, "x": np.asarray(c.x), "y": np.asarray(c.y), "points": c.points}
            for c in self.curves
        ]
        return {
            "name": self.name, "title": self.title, "caption": self.caption,
            "x_label": self.x_label, "y_label": self.y_label, "curves": curves,
        }  # fmt: skip


@dataclass(frozen=True)
class Outcome:
    """What the fit of an experiment gives.

    Args:
        quantities: estimates by id, each with a row of `Experiment.rows`.
        notes: by id, what the reader should know.
        charts: figures of the report.
        figures: sections of analysis.json, for figures that the report draws by itself.
        values: objects that other experiments may ask for by their type, see `Experiment.gives`.
        missing: why a result could not be found, by id.
    """

    quantities: Mapping[str, Estimate] = field(default_factory=dict)
    notes: Mapping[str, str] = field(default_factory=dict)
    charts: tuple[Chart, ...] = ()
    figures: Mapping[str, object] = field(default_factory=dict)
    values: tuple[object, ...] = ()
    missing: Mapping[str, str] = field(default_factory=dict)


class Experiment(ABC, Generic[Settings]):
    """One experiment of a study.

    A subclass names its table in STUDY.toml and implements `drives`, `play`, `fit` and `rows`. What
    it plays is compared with the drives that it has declared: an experiment whose drives are not
    declared cannot be played, so that none escapes the feasibility check.

    Args:
        study: that holds it.
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
        """The experiment as a study holds it; None where the study does not."""
        settings = study.tables.get(cls.table)
        return None if settings is None else cls(study, settings)  # type: ignore[arg-type]

    def recordings(self) -> dict[str, str]:
        """Names under which it records, and the kind of each; the default is one recording."""
        return {self.table: self.title}

    def plans(self) -> list[ExperimentPlan]:
        """The same for the session file."""
        return [ExperimentPlan(name, kind, FIDUCIALS, {}) for name, kind in
                self.recordings().items()]  # fmt: skip

    @abstractmethod
    def drives(self, rig: RigDescription) -> Sequence[Drive]:
        """Every output that the experiment makes, in V ahead of the amplifier.

        The feasibility check judges them before anything moves, and `play` may not leave their
        range. Where a voltage depends on an earlier fit, declare the largest that it may have.

        Args:
            rig: nominal values of the bench.
        """

    def masses_kg(self) -> tuple[float, ...]:
        """Masses that it hangs besides the rig's own."""
        return ()

    def seconds(self, rig: RigDescription) -> float:
        """How long the recorded part takes, in s, for the progress bar."""
        return rig.block_s * sum(len(drive.values_v) for drive in self.drives(rig))

    @abstractmethod
    def play(self, player: Player) -> None:
        """Play and record it.

        Args:
            player: puts out, records, and gives what earlier experiments have found.
        Raises:
            NotPlayedError: it needs the result of an experiment that the study does not hold.
        """

    @abstractmethod
    def fit(self, analysis: Analysis) -> Outcome:
        """Results from what was recorded; reads nothing else, so that it can be repeated.

        Args:
            analysis: gives the observations, and what other experiments have found.
        Raises:
            NotPlayedError: it needs the result of an experiment that the study does not hold.
            ResultError: the data give no result.
        """

    @abstractmethod
    def rows(self) -> Mapping[str, Quantity]:
        """All results that it may have, by id, in the order of the report."""
