"""`haselab session`: a recording in the form of other tools, and back."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from haselab.app.common import Real, answer_options, emit, tell_doubt, unverified_option
from haselab.app.output import OutputRule
from haselab.base import InputError
from haselab.store.export import FOLDERS, FORMS, export_session
from haselab.store.import_session import ImportPlan, import_session

__all__ = ["command"]


@click.group("session")
def command() -> None:
    """A recording in the form of other tools, and back."""


@command.command("export")
@click.argument("session", type=click.Path(path_type=Path))
@click.option(
    "--to", "form", type=click.Choice(sorted(FORMS)), required=True,
    help="csv and parquet: a folder of tables; mat: structs of version 5; tdms: LabVIEW; nwb.",
)  # fmt: skip
@answer_options(OutputRule(lambda given: "folder" if given["form"] in FOLDERS else "file"))
@unverified_option
def _export(session: Path, form: str, unverified: bool, as_json: bool, out: Path | None) -> None:
    """SESSION, a run's folder or its session.h5, written to --out for another tool."""
    if out is None:
        raise InputError("--to needs a place to write; allowed is any new path. Give --out PATH.")
    done = export_session(session, form, out, unverified=unverified)
    tell_doubt(done.doubt, session)
    answer: dict[str, Any] = {
        "files": [str(path) for path in done.files],
        "experiments": done.experiments,
    }
    emit(answer | ({"unverified": True} if done.doubt else {}), as_json=as_json, out=None)


@command.command("import")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--v", "v_column", default="v_monitor_v", show_default=True, help="Column, in V.")
@click.option("--i", "i_column", default="i_monitor_v", show_default=True, help="Column, in V.")
@click.option("--experiment", default="imported", show_default=True, help="Name in the session.")
@click.option("--rate-hz", type=Real(1e-3, 1e8), help="Unless the file tells.")
@click.option(
    "--volt-per-code", type=Real(1e-12, 1e6),
    help="Of the converter; without it the finest that holds all readings.",
)  # fmt: skip
@click.option(
    "--block-samples", type=click.IntRange(20, 2_000_000), default=2000, show_default=True,
    help="Samples a channel in one block.",
)  # fmt: skip
@answer_options(OutputRule("folder"))
def _import(
    file: Path,
    v_column: str,
    i_column: str,
    experiment: str,
    rate_hz: float | None,
    volt_per_code: float | None,
    block_samples: int,
    as_json: bool,
    out: Path | None,
) -> None:
    """FILE (CSV, MAT, NPZ, HDF5, TDMS) with both monitors as a session in the folder --out."""
    if out is None:
        raise InputError("A session needs a folder; allowed is any new path. Give --out DIR.")
    plan = ImportPlan(experiment, (v_column, i_column), block_samples, rate_hz, volt_per_code)
    emit(asdict(import_session(file, out, plan)), as_json=as_json, out=None)
