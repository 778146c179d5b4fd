"""Read and write actuator files, with the running command as provenance."""

from __future__ import annotations

import contextlib
import shlex
from collections.abc import Collection, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path

import click

from haselab import __version__
from haselab.actuators import ACTUATORS
from haselab.base import HaselabError, Json, table_at
from haselab.cli.invocation import Invocation
from haselab.models.actuator import ActuatorTables
from haselab.models.actuator.spelling import misspelled_keys
from haselab.store.actuator_file import (
    Provenance,
    check_writable,
    hashed,
    read_actuator,
    read_run,
    write_section,
    write_sections,
)
from haselab.store.toml import validated

__all__ = [
    "load_actuator",
    "mark_sections",
    "save_section",
    "unknown_kind",
    "warn_misspelled",
    "warn_misspelled_in",
]

_WARNED = "haselab.misspelled"  # in the context of the command


def load_actuator(path: Path, *, to_write: bool = False) -> ActuatorTables:
    """Read the sections of an actuator file.

    Args:
        path: of the file.
        to_write: the command will write a section; refuse a file that cannot be written now.
    Returns:
        The checked sections.
    Raises:
        InputError: no such file, a read-only one, or an impossible value.
    """
    sections = read_actuator(path)
    if to_write:
        check_writable(path)
    warn_misspelled(sections, path)
    return validated(ActuatorTables, sections, path)


def warn_misspelled_in(path: Path) -> None:
    """Warn of misspelled keys in a file of models, if it is an actuator file that can be read.

    Args:
        path: of a model in any form, or of the folder of a run.
    """
    if path.suffix.lower() == ".toml" or path.is_dir():
        with contextlib.suppress(HaselabError):  # of a file that the command cannot read either
            warn_misspelled(read_run(path), path)


def warn_misspelled(sections: Mapping[str, Json], path: Path) -> None:
    """Warn of an unknown kind and of keys that look like misspelled ones, each once in a command.

    Args:
        sections: of an actuator file, unchecked.
        path: of the file.
    """
    context = click.get_current_context(silent=True)
    warned: set[str] = set() if context is None else context.meta.setdefault(_WARNED, set())
    kind = table_at(sections, "actuator").get("kind")
    for found in (*misspelled_keys(sections), *unknown_kind(kind)):
        line = f"haselab: warning: {found} {path}"
        if line not in warned:
            click.echo(line, err=True)
        warned.add(line)


def unknown_kind(kind: object) -> list[str]:
    """Doubts about a kind of actuator, which only a twin of it needs.

    Args:
        kind: of `[actuator]`.
    Returns:
        One sentence; nothing for a known kind.
    """
    known = ACTUATORS.packages()
    if not isinstance(kind, str) or kind in known:
        return []
    return [f"[actuator] kind {kind!r} is unknown; the known kinds are {', '.join(known)}."]


def save_section(
    path: Path,
    section: str,
    values: Mapping[str, object],
    inputs: Sequence[Path],
    owned: Collection[str] = (),
    status: str = "ok",
) -> None:
    """Write a section, with the running command as its provenance.

    Args:
        path: of the actuator file.
        section: its name, such as "model".
        values: its keys.
        inputs: files that the command read.
        owned: keys that are removed if `values` lacks them.
        status: of the result.
    Raises:
        InputError: the file cannot be read.
        DeviceError: the file cannot be written.
    """
    write_section(path, section, values, _origin(hashed(inputs), status), owned)


def mark_sections(
    path: Path, sections: Sequence[str], inputs: Mapping[str, str], *, simulated: bool = False
) -> None:
    """Write the running command as the provenance of sections.

    Args:
        path: of the actuator file.
        sections: their names.
        inputs: names and hashes of the files that were read.
        simulated: the numbers are those of a twin; written as `simulated = true`.
    """
    table = dict(_origin(inputs, "ok").table())
    if simulated:
        table["simulated"] = True
    write_sections(path, {f"provenance.{section}": table for section in sections})


def _origin(inputs: Mapping[str, str], status: str) -> Provenance:
    context = click.get_current_context(silent=True)
    call = None if context is None else context.find_object(Invocation)
    words = [] if call is None else list(call.arguments)
    command = shlex.join(["haselab", *words])
    return Provenance(command, inputs, datetime.now(UTC), __version__, status)
