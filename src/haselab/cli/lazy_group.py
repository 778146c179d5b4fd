"""Groups of commands that import a command when it is used."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

import click

from haselab.cli.invocation import Invocation

__all__ = ["LazyGroup"]


class LazyGroup(click.Group):
    """A group that imports a command when it is used: one command needs few of the libraries.

    Args:
        places: module and attribute of each command, as "module:attribute".
        options: of `click.Group`.
    """

    def __init__(self, *, places: Mapping[str, str], **options: Any) -> None:
        super().__init__(**options)
        self._places = places

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of the commands in the order of the help."""
        return list(self._places)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a command; None if there is none of this name."""
        if cmd_name not in self._places:
            return None
        module, _, attribute = self._places[cmd_name].partition(":")
        command: click.Command = getattr(importlib.import_module(module), attribute)
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Import the command, then call `on_command`; a group inside this one does so itself."""
        found = super().resolve_command(ctx, args)
        if isinstance(ctx.obj, Invocation) and not isinstance(found[1], LazyGroup):
            ctx.obj.on_command()
        return found
