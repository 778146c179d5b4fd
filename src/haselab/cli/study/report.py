"""`haselab report DIR`: write the report and the figures of a run."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.base import InputError
from haselab.cli.common import answer_options, emit
from haselab.cli.output import OutputRule
from haselab.report import compose_page, read_folder, save_page

__all__ = ["command"]


@click.command("report")
@click.argument("folder", metavar="DIR", type=click.Path(path_type=Path))
@answer_options(
    OutputRule(own=lambda parameters: parameters["folder"] / "report.html"),
    "An HTML page. Default: DIR/report.html.",
)
def command(folder: Path, as_json: bool, out: Path | None) -> None:
    """Write the report and the figures of a run.

    DIR is the folder of the run. The figures are written to DIR/figures/*.svg.
    """
    page_path = out or folder / "report.html"
    if page_path.is_dir():
        raise InputError(f"--out names a folder, not a file. Add a file name: {page_path}")
    page = compose_page(read_folder(folder))
    save_page(page, folder, page_path)
    drawn = [drawing.plan.name for drawing in page.drawings if drawing.document]
    for name, reason in page.left_out.items():
        click.echo(f"haselab: {name}: {reason}", err=True)
    answer = {"report": str(page_path), "figures": drawn, "left_out": page.left_out}
    emit(answer, as_json=as_json, out=None)
