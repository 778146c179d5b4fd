"""`haselab identify arx` and `subspace`: sampled models of a sampled record."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.base import InputError
from haselab.cli.columns import column_options
from haselab.cli.common import INTEGER, SEED, answer_options
from haselab.cli.identify.common import FILE, INPUT, OUTPUT, RATE, give, rate_hz_of, read_valid
from haselab.cli.plot import save_plot
from haselab.identify.record import Record
from haselab.identify.sampled.arx import ArxOrders, fit_arx
from haselab.identify.sampled.subspace import fit_subspace
from haselab.store.columns.selection import ColumnOptions

__all__ = ["arx", "subspace"]


@click.command("arx")
@FILE
@INPUT
@OUTPUT
@RATE
@click.option(
    "--na", type=INTEGER, help="Outputs remembered; all three are chosen when none is given."
)
@click.option("--nb", type=INTEGER, help="Inputs remembered.")
@click.option(
    "--nk", type=INTEGER, help="Samples from an input to the first output that knows of it."
)
@click.option("--criterion", type=click.Choice(["bic", "aic"]), default="bic", show_default=True)
@click.option("--first", type=INTEGER, default=0, help="Rows to leave out at the start.")
@click.option("--count", type=INTEGER, help="Rows to use.")
@click.option("--keep-means", is_flag=True, help="The columns count from rest already.")
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
    first: int,
    count: int | None,
    keep_means: bool,
    *,
    columns: ColumnOptions,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
) -> None:
    """Difference equation (ARX) by least squares, its poles in continuous time.

    For sampled plants whose noise passes through the same poles; with noise of a sensor use
    `transfer`, which is not biased by it.
    """
    given = (na, nb, nk)
    if any(order is None for order in given) and any(order is not None for order in given):
        raise InputError(
            f"--na, --nb, --nk = {na}, {nb}, {nk}; allowed are all three or none. Give the others."
        )
    if first < 0 or (count is not None and count < 1):
        raise InputError(
            f"--first = {first}, --count = {count}; allowed are 0 and 1 or above. Correct them."
        )
    orders = None if na is None or nb is None or nk is None else ArxOrders(na, nb, nk)
    table = read_valid(file, [source, output], columns)
    rows = slice(first, None if count is None else first + count)
    rate = rate_hz_of(table, rate_hz, file)
    record = Record.sampled(table[source][rows], table[output][rows], rate)
    fit = fit_arx(record, orders, criterion=criterion, remove_means=not keep_means)
    give(fit, [file], as_json, out)
    save_plot(plot, lambda: fit.chart((source, output)))


@click.command("subspace")
@FILE
@INPUT
@OUTPUT
@RATE
@click.option("--order", type=INTEGER, help="States; up to the largest gap when not given.")
@click.option(
    "--block-rows",
    type=INTEGER,
    default=15,
    show_default=True,
    help="Samples of past and of future.",
)
@click.option(
    "--bootstrap",
    type=click.IntRange(2, 1000),
    default=50,
    show_default=True,
    help="Repeated fits for intervals.",
)
@click.option("--seed", type=SEED, default=1, show_default=True, help="Of the repeated fits.")
@click.option("--keep-means", is_flag=True, help="The columns count from rest already.")
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
    """State model of any order by projections (MOESP), without a search.

    A quick look at how many modes a record shows; `transfer` has the smaller intervals.
    """
    table = read_valid(file, [source, output], columns)
    rate = rate_hz_of(table, rate_hz, file)
    fit = fit_subspace(
        Record.sampled(table[source], table[output], rate), options["order"],
        block_rows=options["block_rows"], remove_means=not keep_means,
        bootstrap=options["bootstrap"], seed=options["seed"],
    )  # fmt: skip
    give(fit, [file], as_json, out)
    save_plot(plot, lambda: fit.chart((source, output)))
