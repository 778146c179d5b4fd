"""`haselab session`: export a recording for other tools, or import one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Literal, cast

import click
import numpy as np

from haselab.base import InputError
from haselab.cli.columns import (
    advice_on_columns,
    check_strain,
    column_options,
    note_seconds,
    refuse_other_sign,
)
from haselab.cli.common import Real, answer_options, emit, unverified_option, warn_unverified
from haselab.cli.options import OTHER_SIGN, shared_option
from haselab.cli.output import OutputRule
from haselab.pipelines.sensing.series import derived_series
from haselab.runtime.observer import FIDUCIALS
from haselab.store.columns.reader import open_columns
from haselab.store.columns.selection import ColumnOptions
from haselab.store.export.import_session import ImportPlan, LengthColumn, import_session
from haselab.store.export.session import FOLDERS, FORMS, export_session, nothing_derived

__all__ = ["command"]


_LENGTHS = {"--strain": "strain", "--displacement": "displacement", "--length": "length"}
_ROWS = 100_000


@click.group("session")
def command() -> None:
    """Export a recording for another tool, or import one."""


@command.command("export")
@click.argument("session", type=click.Path(path_type=Path))
@shared_option(
    "--to", "form", type=click.Choice(sorted(FORMS)), required=True,
    detail="csv and parquet: a folder of tables; mat: structs of version 5; tdms: LabVIEW; nwb: "
    "Neurodata Without Borders.",
)  # fmt: skip
@shared_option(
    "--experiment", "experiments", multiple=True,
    detail="It selects what is exported. Repeat the option for more. Default: all.",
)  # fmt: skip
@click.option(
    "--derived/--recorded-only", default=True, show_default=True,
    help="Export capacitance and strain of each experiment too, where they can be computed.",
)  # fmt: skip
@shared_option(
    "--zero-length-m", type=Real(1e-6, 10.0),
    detail="The column strain of each table of strains is computed with it. Default: that of an "
    "imported session, else that of the actuator file beside the session; without any, there is no "
    "such column.",
)  # fmt: skip
@answer_options(
    OutputRule(lambda given: "folder" if given["form"] in FOLDERS else "file"),
    "It is a file, or a folder of tables.  [required]",
)
@unverified_option
def _export(
    session: Path,
    form: str,
    experiments: tuple[str, ...],
    derived: bool,
    zero_length_m: float | None,
    unverified: bool,
    as_json: bool,
    out: Path | None,
) -> None:
    """Export a recording for another tool.

    SESSION is the folder of a run or its session.h5.
    """
    if out is None:
        raise InputError("Missing option '--out': the file or folder to write.")
    done = export_session(
        session,
        form,
        out,
        experiments=experiments,
        derived=partial(derived_series, zero_length_m=zero_length_m)
        if derived
        else nothing_derived,
        unverified=unverified,
    )
    warn_unverified(done.doubt, session)
    for why in done.unreadable.values():
        click.echo(f"haselab: left out: {why}", err=True)
    if done.empty:
        click.echo(
            f"haselab: not written, because nothing was recorded for them: {', '.join(done.empty)}",
            err=True,
        )
    answer: dict[str, Any] = {
        "files": [str(path) for path in done.files],
        "experiments": done.experiments,
    }
    if done.empty:
        answer["empty"] = done.empty
    if done.doubt:
        answer["unverified"] = True
    if done.unreadable:
        answer["unreadable"] = done.unreadable
    emit(answer, as_json=as_json, out=None)


@command.command("import")
@click.argument("file", type=click.Path(path_type=Path))
@shared_option("--v", "v_column", default="v_monitor_v", show_default=True)
@shared_option("--i", "i_column", default="i_monitor_v", show_default=True)
@click.option(
    "--drive", metavar="COLUMN",
    help="Name the column of the drive voltage before the amplifier, in V; the median of each "
    f"block is kept; {OTHER_SIGN}. Default: none.",
)  # fmt: skip
@click.option(
    "--strain", "strain_column", metavar="COLUMN",
    help=f"Name the column of the strain; {OTHER_SIGN}. The mean of each block is kept as the "
    "track of a camera. Default: none.",
)  # fmt: skip
@click.option(
    "--displacement", "displacement_column", metavar="COLUMN",
    help="Name the column of the displacement from the length at zero strain, in m, in place of "
    f"--strain; {OTHER_SIGN}. Default: none.",
)  # fmt: skip
@click.option(
    "--length", "length_column", metavar="COLUMN",
    help="Name the column of the length, in m, in place of --strain. Default: none.",
)  # fmt: skip
@shared_option(
    "--zero-length-m", type=Real(1e-6, 10.0),
    detail="It converts lengths to strains and strains to lengths. Required with --displacement. "
    "Default: none.",
)  # fmt: skip
@shared_option(
    "--experiment", default="imported", show_default=True,
    detail="The imported experiment gets this name.",
)  # fmt: skip
@shared_option("--rate-hz", type=Real(1e-3, 1e8), detail="Default: the rate in the file.")
@click.option(
    "--volt-per-code", type=Real(1e-12, 1e6),
    help="Set the converter resolution in V per code. Default: the smallest that covers every "
    "sample.",
)  # fmt: skip
@click.option(
    "--block-samples", type=click.IntRange(20, 2_000_000), default=2000, show_default=True,
    help="Set the number of samples per channel in one block.",
)  # fmt: skip
@shared_option(
    "--volt-per-monitor-volt", type=Real(1e-9, 1e9),
    detail="Default: 5000, or from the peak for a column in kV.",
)  # fmt: skip
@shared_option(
    "--ampere-per-monitor-volt", type=Real(1e-15, 1e3),
    detail="Default: 0.002, or from the peak for a column in A.",
)  # fmt: skip
@shared_option(
    "--carrier-hz", type=Real(1e-3, 1e8),
    detail="It is stored for `haselab sense`. Default: none.",
)  # fmt: skip
@shared_option("--skew-s", type=Real(-1.0, 1.0), default=0.0, show_default=True)
@column_options
@answer_options(OutputRule("folder"), "It is a new folder for the session.  [required]")
def _import(
    file: Path,
    v_column: str,
    i_column: str,
    drive: str | None,
    experiment: str,
    rate_hz: float | None,
    volt_per_code: float | None,
    block_samples: int,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    zero_length_m: float | None,
    **more: Any,
) -> None:
    """Import columns of a file as a recording.

    FILE is CSV, MAT, NPZ, HDF5 or TDMS, with columns of voltage and current. The session can be
    sensed, exported and read like a recorded one. A strain, displacement or length is stored like
    the tracks of a camera.
    """
    if out is None:
        raise InputError("Missing option '--out': the new folder of the session.")
    plan = ImportPlan(
        experiment, (v_column, i_column), block_samples, rate_hz, volt_per_code, columns,
        more["volt_per_monitor_volt"], more["ampere_per_monitor_volt"], more["carrier_hz"],
        more["skew_s"] or 0.0, drive, _length(more, zero_length_m, file, columns),
    )  # fmt: skip
    named = [option for option in ("--drive", *_LENGTHS) if more.get(f"{option[2:]}_column")]
    with advice_on_columns(["--v", "--i", *(["--drive"] if drive else []), *named]):
        answer = asdict(import_session(file, out, plan))
    if assumed := answer.pop("assumed_seconds"):
        note_seconds(assumed, file)
    if start_s := answer.pop("start_s"):
        click.echo(
            f"haselab: the times in {file} begin at {start_s:.9g} s; those of the session begin at "
            "0.",
            err=True,
        )
    emit(answer, as_json=as_json, out=None)


def _length(
    given: Mapping[str, Any], zero_length_m: float | None, file: Path, columns: ColumnOptions
) -> LengthColumn | None:
    """The column that shows the length, from the options."""
    named = {option: given[f"{kind}_column"] for option, kind in _LENGTHS.items()}
    found = [option for option, column in named.items() if column is not None]
    if len(found) > 1:
        raise InputError(f"{' and '.join(found)} name the same quantity. Give one of them. {file}")
    if not found:
        if zero_length_m is not None:
            raise InputError(
                f"--zero-length-m has no effect without {', '.join(_LENGTHS)}. Name a column of "
                f"the length, or leave it out. {file}"
            )
        return None
    kind = cast(Literal["strain", "displacement", "length"], _LENGTHS[found[0]])
    if kind == "displacement" and zero_length_m is None:
        raise InputError(
            f"A displacement needs the length at zero strain. State it with --zero-length-m. {file}"
        )
    column = named[found[0]]
    if kind == "length":
        refuse_other_sign("--length", column, file)
    if kind == "strain":
        _check_ratio(column, file, columns)
    return LengthColumn(column, kind, FIDUCIALS, zero_length_m)


def _check_ratio(column: str, file: Path, columns: ColumnOptions) -> None:
    """Refuse a strain without a unit that is probably in per cent."""
    with (
        advice_on_columns(["--strain"]),
        open_columns(file, [column], use_times=False, options=columns) as stream,
    ):
        if stream.units[0] is None:
            parts = (np.abs(part) for (part,) in stream.chunks(_ROWS))
            largest = [float(np.nanmax(part, initial=0.0)) for part in parts]
            check_strain(column, np.array(largest), None, file)
