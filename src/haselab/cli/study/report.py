"""`haselab report`: write the report of a run, or the page of an actuator file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click

from haselab.base import InputError
from haselab.cli.actuator_file import load_actuator
from haselab.cli.common import answer_options, emit
from haselab.cli.output import OutputRule
from haselab.cli.study.analyse import check_ends
from haselab.control.gains import gain_units
from haselab.models.actuator import ActuatorTables
from haselab.pipelines.design.model_file import read_any_plant, read_origin, read_posterior
from haselab.pipelines.design.stated_margins import (
    controller_doubt,
    delay_doubt,
    model_doubt,
)
from haselab.report import compose_page, read_folder, save_page
from haselab.report.actuator_page import ActuatorReport, actuator_page, missing_sections
from haselab.store.actuator_file import read_actuator
from haselab.store.folder import write_text
from haselab.store.session.writer import SessionReader

__all__ = ["command"]


def _is_actuator(source: Path) -> bool:
    return source.suffix.lower() == ".toml" and not source.is_dir()


def _own_page(parameters: Mapping[str, Any]) -> Path:
    """The default path of the page, which is rewritten each time."""
    source: Path = parameters["source"]
    if _is_actuator(source):
        return source.with_name(f"{source.stem}-report.html")
    return source / "report.html"


@click.command("report")
@click.argument("source", metavar="DIR|A.toml", type=click.Path(path_type=Path))
@answer_options(
    OutputRule(own=_own_page), "It is an HTML page. Default: DIR/report.html, or A-report.html.",
    force_detail="It applies to another --out only. The default page is always replaced.",
)  # fmt: skip
def command(source: Path, as_json: bool, out: Path | None) -> None:
    """Write the report of a run, or the page of an actuator.

    For DIR, the folder of a run, the report is DIR/report.html, with its figures in DIR/figures.
    For A.toml, an actuator file, the page shows calibration, maps with their bands, model with
    intervals, controller with margins and provenance, and the commands that add what is missing.
    """
    page_path = out or _own_page({"source": source})
    if page_path.is_dir():
        raise InputError(f"--out names a folder, not a file. Add a file name: {page_path}")
    if _is_actuator(source):
        _report_actuator(source, page_path, as_json)
        return
    session = source / "session.h5"
    if session.is_file() and not (source / "results.json").exists():
        with SessionReader(session, unverified=True) as recorded:
            _require_analysis(recorded, source)  # of a run that was interrupted
    page = compose_page(read_folder(source))
    save_page(page, source, page_path)
    drawn = [drawing.plan.name for drawing in page.drawings if drawing.document]
    for name, reason in page.left_out.items():
        click.echo(f"haselab: {name}: {reason}", err=True)
    answer = {"report": str(page_path), "figures": drawn, "left_out": page.left_out}
    emit(answer, as_json=as_json, out=None)


def _require_analysis(recorded: SessionReader, folder: Path) -> None:
    """Refuse a recording that was cut short, which has no results yet."""
    if recorded.cut_short() and recorded.complete():
        raise InputError(
            "The run ended early and has no results yet. Compute those of the complete experiments "
            f"with: haselab analyse {folder}"
        )
    check_ends(recorded, folder / "session.h5")


def _report_actuator(path: Path, page_path: Path, as_json: bool) -> None:
    tables = load_actuator(path)
    has_model = tables.model is not None and {"gain", "numerator"} & set(
        tables.model.model_extra or {}
    )
    origin = read_origin(path) if has_model else None
    report = ActuatorReport(
        read_actuator(path),
        tables,
        read_any_plant(path) if has_model else None,
        read_posterior(path) if has_model else None,
        {"model": model_doubt(path), "controller": _controller_doubts(tables, path)},
        gain_units(origin.input_unit, origin.output_unit, strains=origin.is_of_strains)
        if origin
        else {},
    )
    doubts = {name: doubt for name, doubt in report.doubts.items() if doubt}
    for doubt in doubts.values():
        click.echo(f"haselab: warning: {doubt}", err=True)
    write_text(page_path, actuator_page(report))
    answer = {"report": str(page_path), "missing": missing_sections(report), "doubts": doubts}
    emit(answer, as_json=as_json, out=None)


def _controller_doubts(tables: ActuatorTables, path: Path) -> str:
    """Margins of all controllers of the file that are not those of its model."""
    kinds = [] if tables.controller is None else tables.controller.all_kinds
    doubts = [check(path, kind) for kind in kinds for check in (controller_doubt, delay_doubt)]
    return " ".join(filter(None, doubts))
