"""Strain of the gauge between the points named upper* and lower*."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from haselab.base import JsonObject
from haselab.pipelines.tracking.points import Points
from haselab.pipelines.tracking.track_collector import TrackCollector
from haselab.tracking import GaugeStrain, Tracks, gauge_strain
from haselab.tracking.options import Floats

__all__ = ["gauge_of", "strain_answer"]


def gauge_of(points: Points, rest_px: Floats, kept: TrackCollector) -> GaugeStrain | None:
    """Strain between the points upper* and lower*; NaN if a group is lost."""
    upper, lower = points.group("upper"), points.group("lower")
    if not upper.size or not lower.size:
        return None
    tracks, count = kept.always(), upper.size
    valid = tracks.valid
    seen = np.logical_and(valid[:, :count].any(axis=1), valid[:, count:].any(axis=1))
    rest = rest_px[np.concatenate([upper, lower])]
    names = ("x_px", "y_px", "std_x_px", "std_y_px", "quality", "valid")
    part = Tracks(**{name: getattr(tracks, name)[seen] for name in names})
    found = gauge_strain(part, rest, np.arange(count), np.arange(count, len(rest)))
    full = np.full((3, len(valid)), np.nan)
    full[:, seen] = found.strain, found.std, found.length_px
    marks = valid[:, :count].sum(axis=1), valid[:, count:].sum(axis=1)
    return GaugeStrain(full[0], full[1], full[2], found.rest_length_px, *marks)


def strain_answer(gauge: GaugeStrain | None, kept: TrackCollector, out: Path) -> JsonObject | None:
    """Summarise the strain for the answer; write that of all frames to a table beside `out`."""
    if gauge is None:
        return None
    path = out.with_name(out.stem + "-strain.csv")
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["frame", "time_s", "strain", "strain_std", "upper_marks", "lower_marks"])
        marks = gauge.upper_marks.tolist(), gauge.lower_marks.tolist()
        rows = zip(kept.number.tolist(), kept.time_s, gauge.strain, gauge.std, *marks, strict=True)
        for number, *values, upper, lower in rows:
            writer.writerow([number, *(f"{value:.9g}" for value in values), upper, lower])
    known = np.isfinite(gauge.strain)
    fewer = known & ~kept.always().valid.all(axis=1)
    return {
        "smallest": float(gauge.strain[known].min()) if known.any() else None,
        "largest": float(gauge.strain[known].max()) if known.any() else None,
        "std": float(np.median(gauge.std[known])) if known.any() else None,
        "frames": int(known.sum()),
        "frames_with_fewer_marks": int(fewer.sum()),
        "rest_length_px": gauge.rest_length_px,
        "table": str(path),
    }
