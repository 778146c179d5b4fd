"""`haselab campaign`: compute many cases over parameters and seeds."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import cast

import click
import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, JsonObject, ResultError, to_plain
from haselab.campaign.definition import load_campaign
from haselab.campaign.executors.executor import Executor
from haselab.campaign.executors.processes import ProcessExecutor
from haselab.campaign.folder import (
    changes_of,
    described_in,
    doubts_about,
    finished_rows,
    open_folder,
    plan_of,
    read_results,
    table_checksum,
    write_table,
)
from haselab.campaign.groups import LEAST_CASES, groups_of, result_names
from haselab.campaign.plan import Plan, Problem
from haselab.campaign.run import Progressed, run_cases
from haselab.campaign.summary import (
    compared,
    draws_are_independent,
    is_random,
    most_important,
    paired,
    share_cases,
    summarised,
    with_infinities,
)
from haselab.campaign.work import compute_case
from haselab.cli.common import WORKERS, answer_options, progress_bar
from haselab.cli.interrupt import Interruptible
from haselab.cli.options import shared_option
from haselab.cli.output import OutputRule
from haselab.store.campaign.shards import CaseRow
from haselab.store.folder import write_json, write_text

__all__ = ["command"]


@click.command("campaign")
@click.argument("campaign", type=click.Path(path_type=Path))
@shared_option("--workers", type=WORKERS)
@click.option(
    "--scheduler", metavar="ADDRESS",
    help="Use the workers of this Dask scheduler. With 'local', a Dask cluster starts on this "
    "computer. Default: processes without Dask.",
)  # fmt: skip
@click.option(
    "--retry-failed", is_flag=True, help="Compute failed cases again, and keep the others."
)
@click.option(
    "--case", "index", type=click.IntRange(0), metavar="INDEX",
    help="Compute only the case with this index, print its results or its traceback, and write "
    "nothing. Default: all cases.",
)  # fmt: skip
@click.option(
    "--compare", "other", type=click.Path(path_type=Path), metavar="DIR",
    help="Compare the results with those of the campaign in this folder. Default: none.",
)  # fmt: skip
@answer_options(
    OutputRule(lambda parameters: "joined" if parameters.get("index") is None else "last"),
    "It is a folder for the finished cases and the results; a campaign in it continues. "
    "Default: none; required without --case.",
    force_detail="The campaign starts again.",
)
def command(
    campaign: Path,
    workers: int | None,
    scheduler: str | None,
    *,
    retry_failed: bool,
    index: int | None,
    other: Path | None,
    as_json: bool,
    out: Path | None,
) -> None:
    """Compute many cases over parameters and seeds.

    CAMPAIGN is a TOML file. It says what a case computes, from which twin and study, which
    parameters vary, and how. Each finished case is kept in --out. After Ctrl-C, a failure of the
    computer or the loss of a scheduler, the same command continues. Several programs with the same
    --out share the work.
    """
    if index is not None:
        if out is not None or other is not None or scheduler is not None or retry_failed:
            raise click.UsageError(
                "--case computes one case here and writes nothing. Leave out --out, --compare, "
                "--scheduler and --retry-failed."
            )
        _compute_one(Plan(load_campaign(campaign)), index, as_json=as_json)
        return
    if out is None:
        raise click.UsageError("Missing option '--out': the folder of the campaign.")
    plan = plan_of(load_campaign(campaign), out)
    there = None if other is None else (read_results(other), described_in(other))
    doubts = [] if other is None else doubts_about(other, plan.code)
    open_folder(plan, out)
    count = workers or os.cpu_count() or 1

    def executor(problem: Problem, waiting: int) -> Executor:
        if scheduler is None:
            return ProcessExecutor(problem, min(count, waiting), plan.campaign.time_limit_s)
        from haselab.campaign.executors.dask import DaskExecutor  # an optional package

        return DaskExecutor(problem, scheduler, count, plan.campaign.time_limit_s)

    progress = Interruptible(progress_bar())
    found = run_cases(plan, out, executor, progress, retry_failed=retry_failed)
    if found.outdated:
        click.echo(
            f"haselab: {found.outdated:,} finished cases in {out} are of another version of "
            "haselab and were not used", err=True,
        )  # fmt: skip
    answer, important = _answer(found), ""
    if found.is_complete:
        from haselab.report.campaign_page import campaign_page  # matplotlib is slow to import

        rows = finished_rows(plan, out)
        write_table(plan, rows, out)
        summary = summarised(plan, rows) | {"table_crc32": table_checksum(out)}
        for path in cast("list[str]", summary["without_effect"]):
            click.echo(
                f"haselab: warning: no result depends on {path}; the kind "
                f"{plan.campaign.kind!r} may not use it", err=True,
            )  # fmt: skip
        if there is not None:
            both = (plan.campaign.described(), there[1])
            independent = all(
                is_random(each) and draws_are_independent(each, grouped=False) for each in both
            )
            shared = share_cases(*both)
            comparison = compared(rows, there[0], independent=independent, in_pairs=shared)
            pairs = paired(rows, there[0], independent=independent) if shared else []
            if not comparison and not pairs:
                click.echo(
                    f"haselab: No comparison: no result has at least {LEAST_CASES} values and a "
                    f"finite median in both campaigns. File: {other}", err=True,
                )  # fmt: skip
            for doubt in doubts:
                click.echo(f"haselab: warning: the campaign in {other}: {doubt}", err=True)
            summary |= {
                "comparison": comparison, "paired": pairs, "compared_with": str(other),
                "doubts": doubts, "differs_in": changes_of(there[1], plan.campaign.described()),
            }  # fmt: skip
        write_text(out / "report.html", campaign_page(summary, _values(plan, rows)))
        answer["summary"] = with_infinities(summary)
        write_json(out / "summary.json", answer["summary"])
        important = most_important(summary, rows)
    lines = _lines(found, out, important)
    click.echo(json.dumps(to_plain(answer), indent=2) if as_json else "\n".join(lines))
    if found.is_complete and found.failed == found.cases:
        raise ResultError(f"All {found.cases:,} cases failed. See {out / 'failed.txt'}.")


def _compute_one(plan: Plan, index: int, *, as_json: bool) -> None:
    """Compute a case here, and print it."""
    if index >= plan.count:
        raise InputError(
            f"--case is {index}, but the campaign has the cases 0 to {plan.count - 1}. Choose one "
            "of them."
        )
    row = compute_case(plan.problem, plan.job(index, ""))
    if row.error:
        click.echo(row.traceback.rstrip(), err=True)
        raise ResultError(f"Case {index} failed: {row.error}")
    if as_json:
        found: JsonObject = {
            "index": index, "parameters": dict(row.values), "results": dict(row.results),
        }  # fmt: skip
        click.echo(json.dumps(to_plain(with_infinities(found)), indent=2))
        return
    for name, value in {**row.values, **row.results}.items():
        click.echo(f"{name} = {value:.6g}" if isinstance(value, float) else f"{name} = {value}")


def _values(plan: Plan, rows: list[CaseRow]) -> dict[str, dict[str, NDArray[np.float64]]]:
    groups = groups_of(plan.campaign, rows)
    return {
        name: {group.label: group.present(name) for group in groups} for name in result_names(rows)
    }


def _answer(found: Progressed) -> JsonObject:
    return {
        "cases": found.cases,
        "done": found.done,
        "failed": found.failed,
        "wall_s": found.wall_s,
        "efficiency": found.efficiency,
        "computed": found.computed,
        "elsewhere": found.elsewhere,
        "workers": found.workers,
    }


def _lines(found: Progressed, out: Path, important: str) -> list[str]:
    lines = [f"{found.done:,} of {found.cases:,} cases have a result, {found.failed:,} failed"]
    if found.computed:
        workers = "1 worker" if found.workers == 1 else f"{found.workers} workers"
        lines.append(
            f"{found.computed:,} computed in {found.wall_s:.1f} s by {workers}; the cases took "
            f"{100.0 * (found.efficiency or 0.0):.0f} % of the workers' time"
        )
    if found.elsewhere:
        lines.append(f"{found.elsewhere:,} are being computed by another program")
    if important:
        lines.append(important)
    return [*lines, f"written to {out}"]
