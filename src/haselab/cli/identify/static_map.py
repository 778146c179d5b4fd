"""`haselab identify map`: any static map as a smooth curve with its inverse."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.cli.columns import column_options
from haselab.cli.common import answer_options
from haselab.cli.identify.common import FILE, give, read_valid
from haselab.cli.plot import save_plot
from haselab.identify.statics.monotone_map import fit_map
from haselab.store.columns.selection import ColumnOptions

__all__ = ["spline_map"]


@click.command("map")
@FILE
@click.option("--x", "abscissa", default="x", show_default=True, help="Column to map from.")
@click.option("--y", "ordinate", default="y", show_default=True, help="Column to map to.")
@click.option("--monotone", is_flag=True, help="Keep it rising, or falling, so it can be inverted.")
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
    """Smooth curve through two columns, rows in order of time; the data choose how smooth."""
    table = read_valid(file, [abscissa, ordinate], columns, ["--x", "--y"])
    fit = fit_map(table[abscissa], table[ordinate], monotone=monotone)
    give(fit, [file], as_json, out)
    save_plot(plot, lambda: fit.chart((abscissa, ordinate)))
