"""What a command does about a result that lies where it is to write: refuse, or move it aside."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import click

from haselab.base import InputError
from haselab.store.claim import claimed_folder, is_occupied, move_aside

__all__ = ["OutputRule", "reserved"]


@dataclass(frozen=True)
class OutputRule:
    """Where a command writes.

    Args:
        kind: `file` must not exist, `any` is a file or a folder with content that must not exist,
            `recording` a folder that is locked until the command ends, `last` a file that is
            checked when it is written, because the command has something more important to do.
        options: names of parameters besides `out` that name a result.
        beside: endings of the files that are written beside `out`, in the place of its own ending.
        own: the path, if any, whose derived files this command writes anew by purpose.
    """

    kind: Literal["file", "any", "recording", "last"] = "file"
    options: Sequence[str] = ()
    beside: Callable[[Mapping[str, Any]], Sequence[str]] = field(default=lambda parameters: ())
    own: Callable[[Mapping[str, Any]], Path | None] = field(default=lambda parameters: None)

    def outputs(self, parameters: Mapping[str, Any]) -> list[tuple[str, Path]]:
        """Every path that the command writes, and the option that names it."""
        own = self.own(parameters)
        found: list[tuple[str, Path]] = []
        for name in ("out", *self.options):
            path = parameters.get(name)
            if isinstance(path, Path) and not (own and _same(path, own)):
                found.append((f"--{_option_of(name)}", path))
        out = parameters.get("out")
        if isinstance(out, Path) and out.name:
            beside = self.beside(parameters)
            found += [("--out", out.with_name(out.stem + ending)) for ending in beside]
        return found


def _option_of(name: str) -> str:
    """The option of a parameter, which may have another name in the code."""
    context = click.get_current_context(silent=True)
    for parameter in context.command.params if context else ():
        if parameter.name == name and parameter.opts:
            return parameter.opts[0].lstrip("-")
    return name


def _same(one: Path, other: Path) -> bool:
    return one.resolve() == other.resolve() or (
        one.exists() and other.exists() and one.samefile(other)
    )


@contextlib.contextmanager
def reserved(rule: OutputRule, parameters: Mapping[str, Any], *, force: bool) -> Iterator[None]:
    """See that a command overwrites nothing.

    Args:
        rule: of the command.
        parameters: of the command, as it gets them.
        force: move what is there aside.
    Raises:
        InputError: there is a result already, or `force` would move what the command reads.
    """
    outputs = rule.outputs(parameters)
    _refuse_inputs(rule, parameters, outputs, force)
    with contextlib.ExitStack() as opened:
        for option, path in outputs:
            if rule.kind == "recording" and option == "--out":
                aside = opened.enter_context(claimed_folder(path, force=force))
                if aside is not None:
                    _tell(path, aside)
            elif rule.kind == "last" or (rule.kind == "file" and path.is_dir()):
                continue  # the command itself refuses it
            elif is_occupied(path):
                if not force:
                    raise InputError(
                        f"{option} names an existing result; nothing in it was changed. Name a new "
                        f"path, or add --force to move this one aside. {path}"
                    )
                opened.enter_context(_moved(path))
        yield


def _refuse_inputs(
    rule: OutputRule,
    parameters: Mapping[str, Any],
    outputs: Sequence[tuple[str, Path]],
    force: bool,
) -> None:
    """Refuse to write over, or to move, what the command reads."""
    given: list[Any] = []
    for name, value in parameters.items():
        if name not in ("out", *rule.options):
            given += value if isinstance(value, (list, tuple)) else [value]
    sources = [item for item in given if isinstance(item, Path) and item.exists()]
    for option, path in outputs:
        for source in sources:
            if _same(source, path) and path.is_file():
                raise InputError(f"{option} names what is read. Name another file. {path}")
            if force and source.resolve().is_relative_to(path.resolve()):
                raise InputError(
                    f"--force would move {source} aside, which this command reads. Name another "
                    f"path. {path}"
                )


def _tell(path: Path, aside: Path) -> None:
    click.echo(f"haselab: moved {path} to {aside}", err=True)


@contextlib.contextmanager
def _moved(path: Path) -> Iterator[None]:
    """Move a result aside; back again where the command fails before it has written another."""
    aside = move_aside(path)
    _tell(path, aside)
    try:
        yield
    except BaseException:
        if not path.exists():
            aside.rename(path)
            click.echo(f"haselab: moved {path} back; no new result was written", err=True)
        raise
