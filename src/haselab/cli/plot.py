"""`--plot FILE`: the figure of a command."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click

from haselab.base import InputError
from haselab.base.chart import Chart

__all__ = ["PLOT", "save_plot"]

_ENDINGS = (".svg", ".png", ".html")


def _checked(context: click.Context, parameter: click.Parameter, path: Path | None) -> Path | None:
    """Refuse a file name that is not a figure before anything is computed."""
    del context, parameter
    if path is not None and path.suffix.lower() not in _ENDINGS:
        raise InputError(
            f"--plot cannot write '{path.suffix}'. Use a name that ends with "
            f"{', '.join(_ENDINGS)}: {path}"
        )
    return path


PLOT = click.option(
    "--plot", type=click.Path(path_type=Path), metavar="FILE.svg|png|html", callback=_checked,
    help="Write the figure of the result to this file. Default: none.",
)  # fmt: skip


def save_plot(path: Path | None, chart: Callable[[], Chart]) -> None:
    """Draw the figure and write it to `path`, if one is given."""
    if path is None:
        return
    from haselab.report.chart_file import write_chart  # matplotlib takes a second to import

    write_chart(chart(), path)
