"""How the program was called: for the provenance of results and for early Ctrl-C."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

__all__ = ["Invocation"]


@dataclass(frozen=True)
class Invocation:
    """How the program was called.

    Args:
        arguments: of the command line, without the program's name.
        on_command: called when the command's modules are imported, before it does anything.
    """

    arguments: Sequence[str]
    on_command: Callable[[], None]
