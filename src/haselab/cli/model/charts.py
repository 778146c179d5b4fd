"""The figure of `haselab compare`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.base.chart import Chart, Curve, Panel, same_unit
from haselab.base.estimate import Z95
from haselab.identify.fit import Prediction

__all__ = ["prediction_chart"]

Floats = NDArray[np.float64]


def prediction_chart(found: Prediction, time_s: Floats, title: str, output: str) -> Chart:
    """Measured and predicted output of records, one after the other, and what is left.

    Args:
        found: the prediction.
        time_s: of its samples; records follow each other. Shape `(M,)`.
        title: of the figure.
        output: label of the output's axis.
    Returns:
        The chart.
    """
    std = found.half_band / Z95 if found.half_band.size else None
    label = "predicted" if std is None else "predicted, 95 % band"
    return Chart(title, (
        Panel("Time (s)", output, (Curve(time_s, found.measured, "measured", "points"),
                                   Curve(time_s, found.predicted, label, std=std))),
        Panel("Time (s)", same_unit("Measured less predicted", output),
              (Curve(time_s, found.measured - found.predicted),)),
    ))  # fmt: skip
