"""Figures as data: panels of curves, points and bands, which `haselab.report` draws."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Chart", "Curve", "Panel", "gain_label", "same_unit"]

Array = NDArray[np.float64]
# By name, because it imports this module; so matplotlib is loaded when one draws.
_DRAWS = "haselab.report.chart_file"
Style = Literal["line", "points", "steps", "bars"]


def same_unit(quantity: str, axis: str) -> str:
    """Label of a quantity with the unit of another axis, such as a residual.

    Args:
        quantity: name of it, without a unit.
        axis: label whose unit it shares.
    Example:
        >>> same_unit("Residual", "y (m)"), same_unit("Residual", "y")
        ('Residual (m)', 'Residual')
    """
    return f"{quantity} ({axis[axis.rindex(' (') + 2 : -1]})" if _has_unit(axis) else quantity


def gain_label(quantity: str, source: str, output: str) -> str:
    """Label of a gain with the unit of output over input, where both axes state their unit.

    Args:
        quantity: name of it, without a unit.
        source: label of the input.
        output: label of the output.
    Example:
        >>> gain_label("Magnitude", "u (V)", "y (m)"), gain_label("Magnitude", "u (V)", "strain")
        ('Magnitude (m/V)', 'Magnitude (1/V)')
        >>> gain_label("Magnitude", "u", "y (m)"), gain_label("Magnitude", "strain", "strain")
        ('Magnitude', 'Magnitude (1)')
    """
    units = [_unit(source), _unit(output)]
    if "" in units:
        return quantity
    if units[0] == units[1]:
        return f"{quantity} (1)" if units[0] == "1" else f"{quantity} ({units[1]}/{units[0]})"
    return f"{quantity} ({units[1]})" if units[0] == "1" else f"{quantity} ({units[1]}/{units[0]})"


def _has_unit(axis: str) -> bool:
    return axis.endswith(")") and " (" in axis


def _unit(axis: str) -> str:
    """Unit of an axis; "1" of a strain, which has none; empty where it is not known."""
    if _has_unit(axis):
        return axis[axis.rindex(" (") + 2 : -1]
    return "1" if axis.lower().endswith("strain") else ""


@dataclass(frozen=True)
class Curve:
    """Values over an axis.

    Args:
        x: abscissa. Shape `(N,)`.
        y: ordinate. Shape `(N,)`.
        label: in the legend; empty: none.
        style: how it is drawn.
        std: standard deviation of the ordinate, drawn as a band of 95 %. Shape `(N,)`.
    """

    x: Array
    y: Array
    label: str = ""
    style: Style = "line"
    std: Array | None = None


@dataclass(frozen=True)
class Panel:
    """One pair of axes.

    Args:
        x_label: with its unit.
        y_label: with its unit.
        curves: measured ones first.
        log_x: the abscissa is logarithmic.
        log_y: the ordinate is logarithmic.
        ticks: names of 0, 1, 2 ... on the abscissa, for bars.
        y_limits: ends of the ordinate; None: those of the curves.
    """

    x_label: str
    y_label: str
    curves: Sequence[Curve]
    log_x: bool = False
    log_y: bool = False
    ticks: Sequence[str] = ()
    y_limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class Chart:
    """A figure.

    Args:
        title: what it shows, in one line.
        panels: from top to bottom.
        shared_x: the panels share one abscissa.
    """

    title: str
    panels: Sequence[Panel]
    shared_x: bool = True

    def plot(self) -> Figure:
        """Draw the chart.

        Returns:
            A matplotlib figure: a notebook shows it, and `savefig` writes it.
        """
        figure: Figure = importlib.import_module(_DRAWS).ChartFigure.of(self)
        return figure
