"""`haselab identify arx` and `subspace`: discrete-time models of a sampled record."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.base import InputError
from haselab.cli.columns import column_options
from haselab.cli.common import INTEGER, SEED, answer_options
from haselab.cli.identify.common import (
    FILE,
    INPUT,
    OUTPUT,
    RATE,
    axis_names,
    emit_fit,
    rate_hz_of,
    read_valid,
)
from haselab.cli.options import shared_option
from haselab.cli.plot import save_plot
from haselab.identify.record import Record
from haselab.identify.sampled.arx import fit_arx
from haselab.identify.sampled.arx_equation import ArxOrders
from haselab.identify.sampled.subspace import fit_subspace
from haselab.store.columns.selection import ColumnOptions

__all__ = ["arx", "subspace"]


@click.command("arx")
@FILE
@INPUT
@OUTPUT
@RATE
@click.option(
    "--na", type=INTEGER,
    help="Set the number of past outputs, 0 to 12. Default: chosen by --criterion, with --nb and "
    "--nk.",
)  # fmt: skip
@click.option(
    "--nb", type=INTEGER,
    help="Set the number of past inputs, 1 to 64. Default: chosen by --criterion.",
)  # fmt: skip
@click.option(
    "--nk", type=INTEGER,
    help="Set the delay from input to output in samples, 0 to 1000. Default: chosen by "
    "--criterion.",
)  # fmt: skip
@click.option(
    "--criterion", type=click.Choice(["bic", "aic"]), default="bic", show_default=True,
    help="Choose the criterion that selects --na, --nb and --nk.",
)  # fmt: skip
@click.option(
    "--skip-rows", type=INTEGER, default=0, show_default=True,
    help="Leave out this many rows at the start, 0 or more.",
)  # fmt: skip
@click.option("--rows", type=INTEGER, help="Use this many rows, 1 or more. Default: all.")
@shared_option("--keep-means", is_flag=True)
@column_options
@answer_options(plot=True)
def arx(
    file: Path,
    source: str,
    output: str,
    rate_hz: float | None,
    na: int | None,
    nb: int | None,
    nk: int | None,
    criterion: str,
    skip_rows: int,
    rows: int | None,
    keep_means: bool,
    *,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Fit a difference equation (ARX) by least squares.

    The poles are also given in continuous time. Use it for sampled plants whose noise passes
    through the same poles. Sensor noise biases the fit: use `transfer` instead. FILE has the
    columns of input and output.
    """
    given = (na, nb, nk)
    if any(order is None for order in given) and any(order is not None for order in given):
        raise InputError(
            f"--na, --nb, --nk are {na}, {nb}, {nk}. Give all three, or none to choose them."
        )
    if skip_rows < 0 or (rows is not None and rows < 1):
        raise InputError(
            f"--skip-rows is {skip_rows} and --rows is {rows}. Use --skip-rows 0 or more, and "
            "--rows "
            "1 or more."
        )
    orders = None if na is None or nb is None or nk is None else ArxOrders(na, nb, nk)
    table = read_valid(file, [source, output], columns)
    used = slice(skip_rows, None if rows is None else skip_rows + rows)
    rate = rate_hz_of(table, rate_hz, file)
    record = Record.sampled(table[source][used], table[output][used], rate)
    fit = fit_arx(record, orders, criterion=criterion, remove_means=not keep_means)
    emit_fit(fit, [file], as_json, out)
    save_plot(plot, lambda: fit.chart(axis_names(source, output, table)))


@click.command("subspace")
@FILE
@INPUT
@OUTPUT
@RATE
@click.option(
    "--order", type=INTEGER,
    help="Set the number of states, 1 to 10 and less than --block-rows. Default: up to the largest "
    "gap of the singular values.",
)  # fmt: skip
@click.option(
    "--block-rows", type=INTEGER, default=15, show_default=True,
    help="Set the number of past samples, and of future samples, in the data matrices: at least 2, "
    "at most an eighth of the number of rows.",
)  # fmt: skip
@shared_option("--bootstrap", type=click.IntRange(2, 1000), default=50, show_default=True)
@shared_option(
    "--seed", type=SEED, default=1, show_default=True, detail="Only --bootstrap uses it."
)
@shared_option("--keep-means", is_flag=True)
@column_options
@answer_options(plot=True)
def subspace(
    file: Path,
    source: str,
    output: str,
    rate_hz: float | None,
    keep_means: bool,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
    **options: int,
) -> None:
    """Fit a state-space model by projections (MOESP).

    It is a fast way to see how many modes a record shows; `transfer` gives smaller intervals. FILE
    has the columns of input and output.
    """
    table = read_valid(file, [source, output], columns)
    rate = rate_hz_of(table, rate_hz, file)
    fit = fit_subspace(
        Record.sampled(table[source], table[output], rate), options["order"],
        block_rows=options["block_rows"], remove_means=not keep_means,
        bootstrap=options["bootstrap"], seed=options["seed"],
    )  # fmt: skip
    emit_fit(fit, [file], as_json, out)
    save_plot(plot, lambda: fit.chart(axis_names(source, output, table)))
