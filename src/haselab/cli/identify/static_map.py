"""`haselab identify map`: fit a smooth curve, with its inverse, to any static map."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.cli.columns import column_options
from haselab.cli.common import answer_options
from haselab.cli.identify.common import FILE, emit_fit, read_valid
from haselab.cli.options import OTHER_SIGN
from haselab.cli.plot import save_plot
from haselab.identify.statics.monotone_map import fit_map
from haselab.store.columns.selection import ColumnOptions

__all__ = ["spline_map"]


@click.command("map")
@FILE
@click.option(
    "--x", "abscissa", default="x", show_default=True, metavar="COLUMN",
    help=f"Name the column to map from; {OTHER_SIGN}.",
)  # fmt: skip
@click.option(
    "--y", "ordinate", default="y", show_default=True, metavar="COLUMN",
    help=f"Name the column to map to; {OTHER_SIGN}.",
)  # fmt: skip
@click.option(
    "--monotone", is_flag=True,
    help="Require a curve that only rises or only falls, so that it can be inverted.",
)  # fmt: skip
@column_options
@answer_options(plot=True)
def spline_map(
    file: Path,
    abscissa: str,
    ordinate: str,
    monotone: bool,
    *,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Fit a smooth curve to two columns.

    The rows of FILE are in order of time. The smoothness is chosen from the data.
    """
    table = read_valid(file, [abscissa, ordinate], columns, ["--x", "--y"])
    fit = fit_map(table[abscissa], table[ordinate], monotone=monotone)
    emit_fit(fit, [file], as_json, out)
    save_plot(plot, lambda: fit.chart((abscissa, ordinate)))
