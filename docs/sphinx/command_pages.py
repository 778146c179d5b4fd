"""The reference of the commands: a page for each, from the options as click knows them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import click
from api_pages import write_pages
from sphinx.application import Sphinx

from haselab.cli.main import cli

FOLDER = Path(__file__).resolve().parents[1] / "reference" / "commands"
_OPTION = re.compile(r"(?<![\w-])(--[a-z][a-z-]*)")
_SPECIAL = re.compile(r"([*|\\`]|(?<=\w)_(?!\w))")


def _plain(text: str) -> str:
    """Text of a help page, whose marks mean nothing."""
    return _OPTION.sub(r"``\1``", _SPECIAL.sub(r"\\\1", text))


def _paragraphs(text: str) -> Iterator[str]:
    r"""Paragraphs of a help text; one that begins with \b keeps its lines."""
    for paragraph in text.split("\n\n"):
        lines = paragraph.strip("\n").splitlines()
        if lines and lines[0].strip() == "\b":
            yield "\n".join(f"| {_plain(line)}" for line in lines[1:])
        else:
            yield " ".join(_plain(line.strip()) for line in lines)
        yield ""


def _option(option: click.Option, context: click.Context) -> Iterator[str]:
    record = option.get_help_record(context)
    if record is None:
        return
    metavar = "" if option.is_flag or option.count else f" {option.make_metavar(context)}"
    names = [*option.opts, *option.secondary_opts]
    described = re.sub(r"\s+", " ", record[1])
    yield f".. option:: {', '.join(name + metavar for name in names)}"
    yield ""
    yield f"   {_plain(described)}"
    yield ""


def _command(command: click.Command, path: list[str], parent: click.Context) -> Iterator[str]:
    context = click.Context(command, info_name=path[-1], parent=parent)
    title = " ".join(path)
    mark = "=" if len(path) == 2 else "-" if len(path) == 3 else "~"
    usage = command.collect_usage_pieces(context)
    yield from (f".. _command-{'-'.join(path)}:", "", title, mark * len(title), "")
    yield from (".. code-block:: none", "", f"   {' '.join([title, *usage])}", "")
    yield from _paragraphs(command.help or "")
    yield from (f".. program:: {title}", "")
    for parameter in command.get_params(context):
        if isinstance(parameter, click.Option):
            yield from _option(parameter, context)
    if isinstance(command, click.Group):
        for name in command.list_commands(context):
            inner = command.get_command(context, name)
            if inner is not None and not inner.hidden:
                yield from _command(inner, [*path, name], context)


def command_pages() -> dict[str, str]:
    """The page of each command by its name, in reStructuredText."""
    context = click.Context(cli, info_name="haselab")
    pages = {}
    for name in cli.list_commands(context):
        command = cli.get_command(context, name)
        if command is not None and not command.hidden:
            pages[name] = "\n".join(_command(command, ["haselab", name], context))
    return pages


def _write(_: Sphinx) -> None:
    write_pages(FOLDER, command_pages())


def setup(app: Sphinx) -> dict[str, bool]:
    """Write the pages before the sources are read."""
    app.connect("builder-inited", _write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
