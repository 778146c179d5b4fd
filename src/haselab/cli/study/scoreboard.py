"""`haselab scoreboard`: compare controllers with each other and with the physical limit."""

from __future__ import annotations

import json
import os
from pathlib import Path

import click

from haselab import __version__
from haselab.base import InputError, JsonObject, to_plain
from haselab.cli.common import SEED, WORKERS, answer_options, progress_bar
from haselab.cli.options import shared_option
from haselab.cli.output import OutputRule
from haselab.report.scoreboard_page import scoreboard_page
from haselab.scoreboard import (
    CLASSES,
    TASKS,
    Game,
    Plan,
    Row,
    board_rows,
    entering_kinds,
    limits_of,
    play_board,
)
from haselab.store.folder import write_text

__all__ = ["command"]

_QUICK_TASKS = ("T1", "T2", "T3", "T4")
_QUICK_CLASSES = ("host-100hz",)
_USUAL_CLASSES = ("host-100hz", "chip-1khz", "oracle")


@click.command("scoreboard")
@shared_option(
    "--controller", "controllers", multiple=True,
    detail="Repeat the option for several. Default: all kinds with an automatic design or "
    "defaults.",
)  # fmt: skip
@click.option(
    "--task", "tasks", multiple=True, metavar="NAME",
    help=f"Play this task; repeat the option for several: {', '.join(TASKS)}. Default: all tasks.",
)  # fmt: skip
@click.option(
    "--class", "classes", multiple=True, type=click.Choice(list(CLASSES)),
    help="Play in this class of loop; repeat the option for several. host: on a computer; chip: on "
    "the microcontroller; oracle: with the true physical model, not ranked. Default: all classes.",
)  # fmt: skip
@shared_option("--seed", type=SEED, default=1, show_default=True)
@click.option(
    "--seeds", type=click.IntRange(1, 1000),
    help="Play each task with this many seeds. Default: 5, with --quick 1.",
)  # fmt: skip
@shared_option("--quick", is_flag=True, detail="It has T1 to T4 at 100 Hz and one seed.")
@shared_option("--workers", type=WORKERS)
@answer_options(
    OutputRule("folder"), "It is a folder for scoreboard.json and scoreboard.html.  [required]"
)
def command(
    controllers: tuple[str, ...],
    tasks: tuple[str, ...],
    classes: tuple[str, ...],
    seed: int,
    seeds: int | None,
    *,
    quick: bool,
    workers: int | None,
    as_json: bool,
    out: Path | None,
) -> None:
    """Play controllers against tasks on simulated devices.

    Each controller is designed from a model that is identified from a simulated record, except pi,
    which has the gains of the paper, and network, which was trained. Each controller plays each
    task. The scores are computed from the true length of the actuator, and compared with what is
    physically possible.
    """
    if out is None:
        raise click.UsageError("Missing option '--out': the folder of the results.")
    unknown = [name for name in tasks if name not in TASKS]
    if unknown:
        raise InputError(f"No task {', '.join(unknown)}. The tasks are {', '.join(TASKS)}.")
    plan = Plan(
        controllers=tuple(kind.name for kind in entering_kinds(controllers)),
        tasks=tuple(dict.fromkeys(tasks)) or (_QUICK_TASKS if quick else tuple(TASKS)),
        classes=tuple(dict.fromkeys(classes)) or (_QUICK_CLASSES if quick else _USUAL_CLASSES),
        seed=seed,
        seeds=seeds or (1 if quick else 5),
        workers=workers or os.cpu_count() or 1,
    )
    game = play_board(plan, progress_bar())
    rows = board_rows(game)
    text = json.dumps(to_plain(_answer(game, rows)), indent=2)
    write_text(out / "scoreboard.json", text + "\n")
    write_text(out / "scoreboard.html", scoreboard_page(game))
    lines = [*_table(rows), *_reasons(game), *(f"bound of {task} {', '.join(names)}: {limit}."
                              for task, limit, names in limits_of(plan.tasks))]  # fmt: skip
    click.echo(text if as_json else "\n".join([*lines, f"written to {out}"]))


def _answer(game: Game, rows: list[Row]) -> JsonObject:
    plan = game.plan
    return {
        "rows": [row.answer() for row in rows],
        "failures": [
            {"controller": one.controller, "class": one.loop, "task": one.task,
             "seed": one.index, "reason": one.failure}
            for one in game.played if one.failure
        ],
        "designs": [
            {"controller": one.controller, "class": one.loop, "device": one.device,
             "parameters": dict(one.values), "reason": one.reason}
            for one in game.entries
        ],
        "bounds": [
            {"task": task, "metrics": list(names), "assumptions": limit}
            for task, limit, names in limits_of(plan.tasks)
        ],
        "identification": dict(game.identification),
        "seed": plan.seed,
        "simulated": True,
        "version": __version__,
    }  # fmt: skip


def _reasons(game: Game) -> list[str]:
    """Why tasks were not done: each reason of a controller once, with its tasks."""
    tasks: dict[tuple[str, str], list[str]] = {}
    for one in game.played:
        if one.failure:
            tasks.setdefault((one.controller, one.failure), []).append(one.task)
    return [
        f"{controller}, {', '.join(dict.fromkeys(names))}: {reason}"
        for (controller, reason), names in tasks.items()
    ]


def _table(rows: list[Row]) -> list[str]:
    """The rows as aligned text."""
    head = ("task", "metric", "unit", "class", "controller", "median", "worst", "bound", "ratio",
            "viol.")  # fmt: skip
    cells = [head] + [
        (row.task, row.metric, row.unit, row.loop, row.controller, _text(row.median),
         _text(row.worst), "" if row.bound is None else f"{row.bound:.4g}",
         "" if row.ratio_to_bound is None else f"{row.ratio_to_bound:.2f}", str(row.violations))
        for row in sorted(rows, key=lambda row: (row.task, row.metric, row.loop))
    ]  # fmt: skip
    widths = [max(len(line[k]) for line in cells) for k in range(len(head))]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in cells
    ]


def _text(value: float | None) -> str:
    return "not reached" if value is None else f"{value:.4g}"
