"""Write the page about a tracked video from the answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from haselab.base import Estimate
from haselab.pipelines.tracking.points import Points
from haselab.pipelines.tracking.track_collector import TrackCollector
from haselab.report.track_page import TrackReport, TrackStrain, track_page
from haselab.store.folder import write_text
from haselab.tracking import GaugeStrain
from haselab.tracking.options import Floats, Frame

__all__ = ["write_report"]

_LEFT_OUT = ("strain", "chosen", "incomplete", "expected_wrong_basis")


def _text(value: Any) -> str:
    if isinstance(value, Estimate):
        return f"{value.value:.6g} {value.unit}, standard deviation {value.std:.2g}"
    if isinstance(value, float):
        return f"{value:.5g}"
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_text(item)}" for key, item in value.items())
    if isinstance(value, bool):
        return "yes" if value else "no"
    return str(value)


def _facts(answer: Mapping[str, Any]) -> dict[str, str]:
    shown = {
        key.replace("_", " "): _text(value)
        for key, value in answer.items()
        if key not in _LEFT_OUT and value is not None and value != []
    }
    for number, why in enumerate(answer.get("chosen", ()), 1):
        shown[f"choice {number}"] = why
    return shown


def write_report(
    path: Path,
    answer: Mapping[str, Any],
    clip: tuple[Frame, Points, Floats],
    kept: TrackCollector,
    gauge: GaugeStrain | None,
    warnings: Sequence[str],
) -> None:
    """Write the page.

    Args:
        path: of the page.
        answer: of the command.
        clip: first frame, points, their positions at rest.
        kept: tracks.
        gauge: strain of all frames.
        warnings: lines for the top of the page.
    """
    frame, points, rest_px = clip
    thin, times = kept.thinned(), kept.time_s
    has_time = bool(np.isfinite(times).all())
    strain = None
    if gauge is not None:
        shown = times if has_time else kept.number.astype(float)
        strain = TrackStrain(shown, gauge.strain, gauge.std, gauge.upper_marks + gauge.lower_marks)
    page = track_page(
        TrackReport(
            title=f"Tracks of {Path(str(answer['video'])).name}",
            frame=frame,
            rest_px=rest_px,
            gauge=np.concatenate([points.group("upper"), points.group("lower")]),
            time_s=thin.time_s if has_time else thin.frame.astype(float),
            has_time=has_time,
            tracks=thin.tracks,
            strain=strain,
            facts=_facts(answer),
            warnings=warnings,
        )
    )
    write_text(path, page)
