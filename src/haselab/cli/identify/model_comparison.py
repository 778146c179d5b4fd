"""`haselab identify model-comparison`: compare models, and report which one the records support."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from haselab.base import Estimate, InputError, ResultError, to_plain
from haselab.cli.columns import column_options
from haselab.cli.common import LIMIT, REAL, answer_options, emit
from haselab.cli.identify.common import (
    FILES,
    OUTPUT,
    RATE,
    name_files_in_errors,
    rate_hz_of,
    read_record,
    refuse_copies,
)
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.identify.charts import odds_chart
from haselab.identify.model_comparison.agreement import Agreement, compare_estimates
from haselab.identify.model_comparison.comparison import CandidateModel, ModelComparison, compare
from haselab.identify.model_comparison.hypotheses import (
    QUESTIONS,
    hypotheses_of,
    linear_mode_hypotheses,
)
from haselab.identify.record import Record
from haselab.models.actuator.model_tables import EstimateTable
from haselab.store.columns.selection import ColumnOptions
from haselab.store.folder import read_json, write_json
from haselab.store.toml import validated

__all__ = ["model_comparison"]

_AGREEMENT = "agreement"


@click.command("model-comparison")
@FILES
@click.option(
    "--question",
    type=click.Choice([*QUESTIONS, _AGREEMENT]),
    required=True,
    help="Choose the question. reading: is the natural frequency in rad/s or Hz; creep: is creep "
    "mechanical or electrical; modes: are there one or two modes; agreement: do the answers in "
    "JSON files agree.",
)
@shared_option(
    "--input", "source", default="drive_v", show_default=True, detail="It is the drive, in V."
)
@OUTPUT
@RATE
@click.option(
    "--linear", is_flag=True,
    help="Assume that the output is proportional to the input, not to its square (question modes).",
)  # fmt: skip
@click.option(
    "--slew", type=LIMIT, default=float("inf"),
    help="Set the slew rate limit of the drive, in V/s. Default: no limit.",
)  # fmt: skip
@click.option(
    "--key", default="natural_frequency_rad_s", show_default=True, metavar="NAME",
    help="Name the number to compare (question agreement).",
)  # fmt: skip
@click.option(
    "--risk", type=REAL, default=0.01, show_default=True,
    help="Set the accepted probability of a wrong conclusion.",
)  # fmt: skip
@column_options
@answer_options(plot=True)
def model_comparison(
    files: tuple[Path, ...],
    question: str,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
    **options: Any,
) -> None:
    """Compare models; report which the records support.

    The answer may be that the records do not decide. All FILES are fitted together; they contain
    the columns of the drive, in V with its sign, and of the output. For the question agreement,
    FILES are JSON files that other commands wrote with --out.
    """
    if question == _AGREEMENT:
        agreement = _agreement(files, options["key"], options["risk"])
        _give(agreement, _agreement_page(agreement), as_json, out)
        pairs = [f"{one} - {other}" for one, other in agreement.pairs]
        sizes = [abs(z) for z in agreement.pairs.values()]
        save_plot(plot, lambda: odds_chart(agreement.verdict, pairs, sizes, "|z|"))
        return
    if options["linear"] and question != "modes":
        raise InputError(
            f"--linear is not supported with --question {question}, only with modes. Leave it out: "
            "the force grows with the square of the voltage."
        )
    candidates = (
        linear_mode_hypotheses()
        if options["linear"]
        else hypotheses_of(question, slew_v_s=options["slew"])
    )
    records = [_record(file, columns, options) for file in files]
    refuse_copies(files, [record.y for record in records])
    found = compare(candidates, records, risk=options["risk"])
    if not found.succeeded:
        listed = " ".join(str(file) for file in files)
        raise ResultError(f"{found.status}: {listed}")
    _give(found, _page(found), as_json, out)
    save_plot(plot, lambda: odds_chart(
        found.verdict, [candidate.name for candidate in found.candidates],
        [candidate.probability for candidate in found.candidates],
    ))  # fmt: skip


def _record(file: Path, columns: ColumnOptions, options: dict[str, Any]) -> Record:
    source, output = options["source"], options["output"]
    with name_files_in_errors(file):
        table = read_record(file, [source, output], options["rate_hz"], columns)
        rate_hz = rate_hz_of(table, options["rate_hz"], file)
        return Record.sampled(table[source], table[output], rate_hz)


def _give(
    found: ModelComparison | Agreement, page: Sequence[str], as_json: bool, out: Path | None
) -> None:
    answer = found.answer()
    if isinstance(found, ModelComparison):
        answer |= found.candidates[0].model
    if out is not None:
        write_json(out, answer)
    if as_json:
        emit(answer, as_json=True, out=None)
    else:
        click.echo("\n".join(page))


def _page(found: ModelComparison) -> list[str]:
    """The answer as lines to read."""
    lines = [found.verdict, ""]
    lines.append("hypothesis        misfit  parameters   2 ln odds     lead  probability")
    lines += [_row(candidate) for candidate in found.candidates]
    lines.append(f"effective number of independent samples: {found.effective_samples:.3g}")
    lines += ["", *found.notes]
    best = found.candidates[0]
    lines += ["", best.name]
    for name, estimate in best.estimates.items():
        low, high = estimate.ci95
        lines.append(
            f"  {name:32s} {estimate.value:.5g} {estimate.unit}   95 % [{low:.5g}, {high:.5g}]"
        )
    return lines


def _row(candidate: CandidateModel) -> str:
    if candidate.status != "ok":
        return f"{candidate.name:14s} {candidate.status}"
    lead = "" if candidate.lead != candidate.lead else f"{candidate.lead:.1f}"
    mark = "  excluded" if candidate.excluded else ""
    return (
        f"{candidate.name:14s} {100.0 * candidate.misfit:7.2f} % {candidate.parameters:10d} "
        f"{0.0 - candidate.bic:11.1f} {lead:>8s} {candidate.probability:12.3g}{mark}"
    )


def _agreement(files: Sequence[Path], key: str, risk: float) -> Agreement:
    estimates: dict[str, Estimate] = {}
    for file in files:
        name = file.stem if file.stem not in estimates else str(file)
        estimates[name] = _estimate(file, key)
    return compare_estimates(estimates, risk=risk)


def _estimate(file: Path, key: str) -> Estimate:
    data = read_json(file)
    entry = data.get(key) if isinstance(data, dict) else None
    if not isinstance(entry, dict) or not {"value", "std", "ci95", "unit"} <= set(entry):
        present = (
            [name for name, item in data.items() if isinstance(item, dict) and "std" in item]
            if isinstance(data, dict)
            else []
        )
        raise InputError(
            f"The file has no estimate {key}, only {', '.join(present) or 'none at all'}. Name "
            f"another one with --key, or repeat the fit with --out. {file}"
        )
    table = validated(EstimateTable, entry, file)
    low, high = table.ci95
    return Estimate(
        _number(table.value), _number(table.std), (_number(low), _number(high)), table.unit
    )


def _number(value: float | None) -> float:
    """Read null, a number that is not identifiable, as NaN."""
    return math.nan if value is None else value


def _agreement_page(found: Agreement) -> list[str]:
    lines = [found.verdict, "", *found.notes, ""]
    for (a, b), z in found.pairs.items():
        lines.append(f"{a} minus {b}: {z:+.1f} standard deviations")
    low, high = found.mean.ci95
    lines.append(
        f"mean {found.mean.value:.5g} {found.mean.unit}   95 % [{low:.5g}, {high:.5g}], "
        f"Birge ratio {to_plain(found.birge_ratio)}"
    )
    return lines
