"""Protect existing results: a command refuses to overwrite them, or moves them aside."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import click

from haselab.base import InputError
from haselab.store.claim import (
    claimed_file,
    claimed_folder,
    is_occupied,
    joined_folder,
    move_aside,
    shared_folder,
)
from haselab.store.text_file import parse_toml, read_text

__all__ = ["OutputKind", "OutputRule", "reserved"]

OutputKind = Literal["file", "folder", "joined", "late", "last"]


@dataclass(frozen=True)
class OutputRule:
    """Where a command writes.

    Args:
        kind: of `out`, or a function of the parameters that returns it. `file` must not exist and
            is created at once; `folder` is new or empty, and locked until the command ends;
            `joined` is a folder that the command continues, with other programs; `late` is a file
            that must not exist and is created when it is complete; `last` is a file that is checked
            only when it is written, because the command has more urgent work.
        options: names of parameters besides `out` that name a file.
        built: names of parameters that name a folder whose files are rewritten each time.
        beside: endings of the files that are written beside `out`, in place of its own ending.
        own: the path, if any, whose derived files this command rewrites on purpose.
    """

    kind: OutputKind | Callable[[Mapping[str, Any]], OutputKind] = "file"
    options: Sequence[str] = ()
    built: Sequence[str] = ()
    beside: Callable[[Mapping[str, Any]], Sequence[str]] = field(default=lambda parameters: ())
    own: Callable[[Mapping[str, Any]], Path | None] = field(default=lambda parameters: None)

    def outputs(self, parameters: Mapping[str, Any]) -> list[tuple[str, Path, OutputKind]]:
        """Every path that the command writes, the option that names it, and its kind."""
        own = self.own(parameters)
        kind = self.kind if isinstance(self.kind, str) else self.kind(parameters)
        found: list[tuple[str, Path, OutputKind]] = []
        for name in ("out", *self.options):
            path = parameters.get(name)
            if isinstance(path, Path) and not (own and _same(path, own)):
                found.append((f"--{_option_of(name)}", path, kind if name == "out" else "file"))
        out = parameters.get("out")
        if isinstance(out, Path) and out.name:
            beside = self.beside(parameters)
            found += [("--out", out.with_name(out.stem + ending), "file") for ending in beside]
        return found


def _option_of(name: str) -> str:
    """The option that sets a parameter, which may have another name in the code."""
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
    """Make sure that a command overwrites nothing.

    Args:
        rule: of the command.
        parameters: of the command, as it receives them.
        force: move existing results aside.
    Raises:
        InputError: a result exists already, or `force` would move what the command reads.
    """
    outputs = rule.outputs(parameters)
    early = [each for each in outputs if each[2] != "last"]  # `last` never comes before 0 V
    _refuse_inputs(rule, parameters, early, force)
    with contextlib.ExitStack() as opened:
        for option, path, kind in outputs:
            if kind == "folder":
                aside = opened.enter_context(claimed_folder(path, force=force))
                if aside is not None:
                    _report_move(path, aside)
            elif kind == "joined":
                _join(opened, path, force)
            elif kind != "last":
                _reserve_file(opened, option, path, kind, force)
        for name in rule.built:
            opened.enter_context(shared_folder(parameters[name]))
        yield


def _join(opened: contextlib.ExitStack, path: Path, force: bool) -> None:
    """Continue a folder, or move it aside and begin anew."""
    if path.exists() and not path.is_dir():
        raise InputError(f"--out names a file, not a folder. Name a folder. {path}")
    if force and is_occupied(path):
        with claimed_folder(path, force=True) as aside:
            assert aside is not None
            _report_move(path, aside)
    opened.enter_context(joined_folder(path))


def _reserve_file(
    opened: contextlib.ExitStack, option: str, path: Path, kind: OutputKind, force: bool
) -> None:
    if path.is_dir():
        raise InputError(f"{option} names a folder, not a file. Name a file in it. {path}")
    if is_occupied(path):
        if not force:
            raise InputError(
                f"{option} names an existing result, which was not changed. Name a new path, or "
                f"add --force to move it aside. {path}"
            )
        opened.enter_context(_moved(path))
    if kind == "file":
        opened.enter_context(claimed_file(path))


def _refuse_inputs(
    rule: OutputRule,
    parameters: Mapping[str, Any],
    outputs: Sequence[tuple[str, Path, OutputKind]],
    force: bool,
) -> None:
    """Refuse to overwrite or move a file that the command reads."""
    given: list[Any] = []
    for name, value in parameters.items():
        if name not in ("out", *rule.options, *rule.built):
            given += value if isinstance(value, (list, tuple)) else [value]
    sources = [item for item in map(_as_path, given) if item is not None and item.exists()]
    named = [(inner, source) for source in sources for inner in _named_in(source)] if force else []
    for option, path, _ in outputs:
        for source in sources:
            if _same(source, path) and path.is_file():
                raise InputError(f"{option} names a file that is read. Name another file. {path}")
        for source, file in [*((each, None) for each in sources), *named]:
            if force and source.resolve().is_relative_to(path.resolve()):
                why = "this command reads" if file is None else f"{file} names"
                raise InputError(
                    f"--force would move {source} aside, which {why}. Name another path. {path}"
                )


def _as_path(value: Any) -> Path | None:
    """Return a parameter as a path if it is one or looks like one; some options take both."""
    if isinstance(value, str) and Path(value).suffix:
        return Path(value)
    return value if isinstance(value, Path) else None


def _named_in(source: Path) -> list[Path]:
    """Existing paths in a settings file, such as the session of a rig of kind replay."""
    if source.suffix.lower() != ".toml" or not source.is_file():
        return []
    try:
        texts = [text for text in _texts(parse_toml(read_text(source))) if "\0" not in text]
    except (InputError, ValueError, RecursionError):  # the command reports what is wrong
        return []
    found = [folder / text for text in texts for folder in (source.parent, Path()) if text]
    return [path for path in found if _exists(path)]


def _texts(value: Any) -> list[str]:
    if isinstance(value, Mapping):
        value = list(value.values())
    if isinstance(value, list):
        return [text for item in value for text in _texts(item)]
    return [value] if isinstance(value, str) else []


def _exists(path: Path) -> bool:
    try:
        return path.exists()
    except OSError:  # too long for a file name
        return False


def _report_move(path: Path, aside: Path) -> None:
    click.echo(f"haselab: moved {path} to {aside}", err=True)


@contextlib.contextmanager
def _moved(path: Path) -> Iterator[None]:
    """Move a result aside, and back if the command fails before it writes a new one."""
    aside = move_aside(path)
    _report_move(path, aside)
    try:
        yield
    except BaseException:
        if not path.exists():
            aside.rename(path)
            click.echo(f"haselab: moved {path} back; no new result was written", err=True)
        raise
