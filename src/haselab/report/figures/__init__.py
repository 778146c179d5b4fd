"""The figures of the report, one file each, in the paper's order."""

from haselab.report.figures import (
    chain,
    chip,
    chirp,
    free_response,
    further,
    loop,
    maps,
    residuals,
    sensing,
    static,
    steps,
    tracks,
)
from haselab.report.figures.plan import DrawnFigure, FigurePlan, draw_figure

__all__ = ["PLANS", "DrawnFigure", "FigurePlan", "draw_figure"]

PLANS: tuple[FigurePlan, ...] = (
    *(
        room.PLAN
        for room in (
            tracks, maps, static, free_response, steps, loop, chirp, sensing, residuals, chip
        )
    ),
    chip.MINIATURE,
    chain.PLAN,
    further.PLAN,
)  # fmt: skip
