"""The figure of `haselab track`: how far each point moved."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from haselab.base.chart import Chart, Curve, Panel

__all__ = ["track_chart"]

_MOST_LABELS = 8


def track_chart(table: Path) -> Chart:
    """Displacements of all points from their first valid frame.

    Args:
        table: CSV that `haselab track` wrote.
    Returns:
        The chart.
    """
    rows: dict[str, list[tuple[float, float, float]]] = {}
    with table.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if row["valid"] == "1":
                place = (float(row["time_s"]), float(row["x_px"]), float(row["y_px"]))
                rows.setdefault(row["point"], []).append(place)
    panels = []
    for axis, name in ((1, "x"), (2, "y")):
        curves = []
        for point, values in rows.items():
            columns = np.array(values).T
            label = point if len(rows) <= _MOST_LABELS and axis == 1 else ""
            curves.append(Curve(columns[0], columns[axis] - columns[axis][0], label))
        panels.append(Panel("Time (s)", f"Displacement {name} (px)", curves))
    return Chart(f"Tracks, {len(rows)} points", panels)
