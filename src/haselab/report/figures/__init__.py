"""The figures of the report, one file each, in the paper's order."""

from haselab.report.figures import (
    chip,
    chirp,
    free_response,
    loop,
    maps,
    residuals,
    sensing,
    static,
    steps,
    tracks,
)
from haselab.report.figures.plan import Drawing, FigurePlan, draw_figure

__all__ = ["PLANS", "Drawing", "FigurePlan", "draw_figure"]

PLANS: tuple[FigurePlan, ...] = (
    *(
        room.PLAN
        for room in (
            tracks, maps, static, free_response, steps, loop, chirp, sensing, residuals, chip
        )
    ),
    chip.MINIATURE,
)  # fmt: skip
