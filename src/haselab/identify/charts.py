"""Figures of fits: measured and modelled data, and residuals."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from haselab.base.chart import Chart, Curve, Panel, same_unit
from haselab.identify.record import Record

__all__ = [
    "curve_chart",
    "lines_chart",
    "loop_chart",
    "odds_chart",
    "records_chart",
    "time_chart",
]

Floats = NDArray[np.float64]


def time_chart(
    title: str, time_s: Floats, measured: Floats, modelled: Floats, names: tuple[str, str]
) -> Chart:
    """Measured and modelled output in time, and their difference.

    Args:
        title: of the figure.
        time_s: shape `(N,)`.
        measured: shape `(N,)`.
        modelled: shape `(N,)`.
        names: of the output's axis, and of the model.
    Returns:
        The chart.
    """
    output, model = names
    return Chart(title, (
        Panel("Time (s)", output, (Curve(time_s, measured, "measured", "points"),
                                   Curve(time_s, modelled, model))),
        Panel("Time (s)", same_unit("Residual", output),
              (Curve(time_s, measured - modelled, "", "points"),)),
    ))  # fmt: skip


def records_chart(
    title: str,
    records: Sequence[Record],
    residuals: Sequence[Floats],
    names: tuple[str, str] | None,
) -> Chart:
    """Records one after the other, with the input, the model and the residuals.

    Args:
        title: of the figure.
        records: that were fitted.
        residuals: measured minus modelled, of each. Shape `(M_r,)` each.
        names: of the axes of input and output.
    Returns:
        The chart.
    """
    source, output = names or ("Input", "Output")
    times, inputs, start_s = [], [], 0.0
    for record in records:
        times.append(start_s + record.output_time_s)
        inputs.append(start_s + np.arange(record.u.size) / record.input_rate_hz)
        start_s = max(times[-1][-1], inputs[-1][-1])
    time_s, left = np.concatenate(times), np.concatenate(list(residuals))
    measured = np.concatenate([record.y for record in records])
    chart = time_chart(title, time_s, measured, measured - left, (output, "model"))
    u = Curve(np.concatenate(inputs), np.concatenate([r.u for r in records]), "", "steps")
    return Chart(title, (*chart.panels, Panel("Time (s)", source, (u,))))


def lines_chart(
    title: str,
    frequency_hz: Floats,
    measured: NDArray[np.complex128],
    modelled: NDArray[np.complex128],
) -> Chart:
    """Measured lines of a frequency response, and the model's.

    Args:
        title: of the figure.
        frequency_hz: in Hz. Shape `(K,)`.
        measured: complex gain. Shape `(K,)`.
        modelled: the same of the model. Shape `(K,)`.
    Returns:
        The chart.
    """
    panels = []
    for label, of, log_y in (
        ("Magnitude", np.abs, True),
        ("Phase (°)", lambda g: np.degrees(np.unwrap(np.angle(g))), False),
    ):
        curves = (
            Curve(frequency_hz, np.asarray(of(measured)), "measured", "points"),
            Curve(frequency_hz, np.asarray(of(modelled)), "fit"),
        )
        panels.append(Panel("Frequency (Hz)", label, curves, log_x=True, log_y=log_y))
    return Chart(title, panels)


def curve_chart(
    title: str,
    axes: tuple[str, str],
    measured: tuple[Floats, Floats],
    fitted: tuple[Floats, Floats],
    std: Floats | None = None,
) -> Chart:
    """A fitted curve through measured points.

    Args:
        title: of the figure.
        axes: names of abscissa and ordinate.
        measured: abscissa and ordinate. Shape `(N,)` each.
        fitted: the same of the curve. Shape `(M,)` each.
        std: standard deviation of the curve. Shape `(M,)`.
    Returns:
        The chart.
    """
    curves = (Curve(*measured, "measured", "points"), Curve(*fitted, "fit", "line", std))
    return Chart(title, (Panel(*axes, curves),))


def loop_chart(
    title: str, axes: tuple[str, str], loops: Sequence[tuple[Floats, Floats, Floats]]
) -> Chart:
    """Loops of measured and modelled output over the input.

    Args:
        title: of the figure.
        axes: names of abscissa and ordinate.
        loops: input, measured and modelled output of each record. Shape `(N_r,)` each.
    Returns:
        The chart.
    """
    u, y, model = (np.concatenate(parts) for parts in zip(*loops, strict=True))
    return Chart(title, (
        Panel(*axes, (Curve(u, y, "measured", "points"), Curve(u, model, "model"))),
        Panel(axes[0], same_unit("Residual", axes[1]), (Curve(u, y - model, "", "points"),)),
    ))  # fmt: skip


def odds_chart(
    title: str, names: Sequence[str], values: Sequence[float], axis: str = "Probability"
) -> Chart:
    """Bars, such as the probabilities of candidate models.

    Args:
        title: of the figure.
        names: of the bars.
        values: of each.
        axis: what they are.
    Returns:
        The chart.
    """
    places = np.arange(len(names), dtype=np.float64)
    bars = Curve(places, np.asarray(values, dtype=np.float64), "", "bars")
    return Chart(title, (Panel("", axis, (bars,), ticks=tuple(names)),))
