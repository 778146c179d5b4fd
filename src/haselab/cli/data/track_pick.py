"""`haselab track --pick`: choose points on a page in the browser."""

from __future__ import annotations

from pathlib import Path

import click

from haselab.cli.common import emit

__all__ = ["save_picked"]

_WITH_PICK = {"video", "pick", "no_browser", "page_port", "out", "force", "as_json", "debug"}


def _announce(address: str, as_json: bool) -> None:
    click.echo(address, err=as_json)
    click.echo("haselab: Open this address in a browser. Ctrl-C saves nothing.", err=True)


def _refuse_others() -> None:
    """Refuse options that the page does not use.

    Raises:
        UsageError: there is one.
    """
    context = click.get_current_context()
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if source is click.core.ParameterSource.COMMANDLINE and parameter.name not in _WITH_PICK:
            raise click.UsageError(
                f"--pick excludes {parameter.opts[0]}. Add it to the command that --pick prints."
            )


def save_picked(
    video: Path, out: Path | None, page_port: int, *, no_browser: bool, as_json: bool
) -> None:
    """Serve the page until points are saved, and print where they are.

    Args:
        video: to pick points in.
        out: table of points; None: beside the video.
        page_port: TCP port of the page; 0: a free one.
        no_browser: only print the address.
        as_json: print one JSON document; the address is then on stderr.
    Raises:
        KeyboardInterrupt: a signal ended the page before.
    """
    from haselab.panel.pick_server import pick_points  # slow to load

    _refuse_others()
    found = pick_points(
        video, out, page_port, browser=not no_browser,
        announce=lambda address: _announce(address, as_json),
    )  # fmt: skip
    if isinstance(found, int):
        raise KeyboardInterrupt
    emit(found, as_json=as_json, out=None)
