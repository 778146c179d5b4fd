"""Read and write actuator.toml by section, keeping comments, order and other keys."""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import Array, Item, Table

from haselab.base import InputError, JsonObject, to_plain
from haselab.store.folder import read_json, write_text
from haselab.store.manifest import sha256_of
from haselab.store.text_file import read_text
from haselab.store.toml import read_toml

if sys.platform != "win32":
    import fcntl

__all__ = [
    "ACTUATOR",
    "Provenance",
    "check_writable",
    "hashed",
    "read_actuator",
    "read_run",
    "write_section",
    "write_sections",
]

ACTUATOR = "actuator.toml"
_writing = threading.Lock()
_WAIT_S, _POLL_S = 10.0, 0.01  # for another program that writes the file
_WIDEST = 100  # characters of a list on one line


@dataclass(frozen=True)
class Provenance:
    """Provenance of the values of a section.

    Args:
        command: as it was typed.
        inputs: names and hashes of the files that were read, see `hashed`.
        date: of the command.
        version: of haselab.
        status: of the result, "ok" or what is wrong.
    """

    command: str
    inputs: Mapping[str, str]
    date: datetime
    version: str
    status: str = "ok"

    def table(self) -> Mapping[str, object]:
        """The keys of `[provenance.SECTION]`."""
        return {
            "command": self.command,
            "input": list(self.inputs),
            "sha256": list(self.inputs.values()),
            "date": self.date.astimezone(UTC).isoformat(timespec="seconds"),
            "version": self.version,
            "status": self.status,
        }


def hashed(paths: Sequence[Path]) -> Mapping[str, str]:
    """Name and SHA-256 of each file; paths that are not files are left out.

    Files of one name, such as the session.h5 of several runs, are named by their whole path.
    """
    names = [path.name for path in paths]
    return {
        path.name if names.count(path.name) == 1 else path.as_posix(): sha256_of(path)
        for path in paths
        if path.is_file()
    }


def read_actuator(path: Path) -> JsonObject:
    """Read the sections of an actuator file, unchecked.

    Args:
        path: of the file.
    Returns:
        Its tables.
    Raises:
        InputError: no such file, or not TOML.
    """
    if not path.exists():
        raise InputError(
            f"There is no such actuator file: {path}. Create it with: haselab init NAME --out "
            f"{path.name}"
        )
    return read_toml(path, "actuator file")


def check_writable(path: Path) -> None:
    """Refuse a file that must not be written, before the work whose result it would hold.

    Args:
        path: of the file, or a link to it.
    Raises:
        InputError: the file or its folder is read-only.
    """
    file = path.resolve()
    for place, what in ((file, "file"), (file.parent, "folder of this file")):
        # The superuser may write everywhere, but a file without any write bit is not to be changed.
        if not (os.access(place, os.W_OK) and place.stat().st_mode & 0o222):
            raise InputError(
                f"The {what} is read-only. Make it writable with chmod u+w, or write to a copy. "
                f"{path}"
            )


def read_run(path: Path) -> JsonObject:
    """Read the sections of an actuator file, or of the folder of a run.

    Args:
        path: an actuator.toml, a folder with one, or a folder of an older run with model.json and
            controller.toml.
    Returns:
        The tables of an actuator file.
    Raises:
        InputError: none of these, or a damaged file.
    """
    if not path.is_dir():
        return read_actuator(path)
    model_file = path / "model.json"
    if (path / ACTUATOR).exists() or not model_file.exists():
        return read_actuator(path / ACTUATOR)
    model = read_json(model_file)
    if not isinstance(model, dict):
        raise InputError(f"model.json is not a JSON object. Run the study again. {model_file}")
    return _of_older_run(model, read_toml(path / "controller.toml", "controller file"))


def _of_older_run(model: Mapping[str, Any], controller: Mapping[str, Any]) -> dict[str, Any]:
    """Sections from model.json and controller.toml."""
    loop = {key: model[key] for key in ("rate_hz", "loop_delay_s") if key in model}
    sections: dict[str, Any] = {
        "actuator": {"geometry": {"zero_length_m": model.get("zero_strain_length_m")}},
        "sensing": {"strain_map": model.get("strain_map")},
        "drive": {"voltage_map": model.get("voltage_map")},
    }
    if isinstance(model.get("plant"), dict):
        sections["model"] = {**model["plant"], **loop}
    kinds = [kind for kind in ("pid", "pi") if isinstance(controller.get(kind), dict)]
    if kinds:
        tables = [_older_controller(kind, controller) for kind in kinds]
        sections["controller"] = tables[0] | {"alternatives": tables[1:]}
    return sections


def _older_controller(kind: str, controller: Mapping[str, Any]) -> dict[str, Any]:
    names = ("kp", "ki", "kd", "derivative_filter_s")
    return {
        "kind": kind,
        "parameters": {name: controller[kind][name] for name in names if name in controller[kind]},
        "limits": controller.get("saturation"),
        "loop": controller.get("loop"),
    }


def write_section(
    path: Path,
    section: str,
    values: Mapping[str, object],
    provenance: Provenance | None,
    owned: Collection[str] = (),
    sha256: str = "",
) -> None:
    """Write one section of an actuator file, and keep everything else.

    Args:
        path: of an existing file; the target of a link is written, and the link stays.
        section: name of the section: "model", "sensing.strain_map".
        values: its keys; nested mappings become tables; a value of None is left out.
        provenance: written to `[provenance.SECTION]`; None: not written.
        owned: keys that are removed from the section if `values` lacks them. Other keys and all
            comments are kept.
        sha256: of the file from which the values were computed; empty: it is not checked.
    Raises:
        InputError: the file cannot be read, is read-only, has changed, or a section is not a table.
        DeviceError: the file cannot be written.
    """
    read_actuator(path)  # TOML of a bounded depth
    check_writable(path)
    changes: dict[str, tuple[Mapping[str, object], Collection[str]]] = {section: (values, owned)}
    if provenance is not None:
        origin = provenance.table()
        changes[f"provenance.{section}"] = (origin, list(origin))
    with _sole_writer(path):
        read_actuator(path)  # it may have changed meanwhile
        text = _changed(read_text(path, "actuator file"), changes, path)
        if sha256 and sha256_of(path) != sha256:
            raise InputError(
                f"Not written: the actuator file has changed since [{section}] was computed from "
                f"it. Check what has changed, then write again. {path}"
            )
        write_text(path.resolve(), text)


@contextlib.contextmanager
def _sole_writer(path: Path) -> Iterator[None]:
    """Keep other threads and programs from writing a file that is read, changed and replaced.

    On Windows, only other threads: a file that is open cannot be replaced there.

    Raises:
        InputError: another program keeps the file.
    """
    end_s = time.monotonic() + _WAIT_S
    with _writing, contextlib.ExitStack() as held:
        while not _locked(path, held):
            if time.monotonic() > end_s:
                raise InputError(
                    f"Not written: another program has locked this file for {_WAIT_S:g} s. End "
                    f"that program, then write again. {path}"
                )
            time.sleep(_POLL_S)
        yield


def _locked(path: Path, held: contextlib.ExitStack) -> bool:
    """Lock a file until the context ends; False while another program has locked it."""
    if sys.platform == "win32":
        return True
    with contextlib.ExitStack() as opened:
        file = opened.enter_context(path.open("rb"))
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:  # a file system without locks
            return True
        if not os.path.samestat(os.fstat(file.fileno()), path.stat()):
            return False  # it was replaced before it was locked
        held.push(opened.pop_all())
        return True


def write_sections(
    path: Path, sections: Mapping[str, Mapping[str, object]], start: str = ""
) -> None:
    """Write several sections at once; create the file if it does not exist.

    Args:
        path: of the file.
        sections: keys of each section; None removes a section.
        start: text of a new file.
    Raises:
        InputError: the file cannot be read, or a section is not a table.
        DeviceError: the file cannot be written.
    """
    changes = {name: (values, list(values)) for name, values in sections.items()}
    with _sole_writer(path) if path.is_file() else contextlib.nullcontext():
        if path.exists():
            read_actuator(path)
            start = read_text(path, "actuator file")
        write_text(path, _changed(start, changes, path))


def _changed(
    text: str, changes: Mapping[str, tuple[Mapping[str, object], Collection[str]]], path: Path
) -> str:
    """Change sections in the text of a file; for each, its keys and those that may be removed."""
    document = tomlkit.parse(text)
    for section, (values, owned) in changes.items():
        try:
            table, is_new = _table_at(document, section.split("."))
            _merge(table, values, owned)
            if is_new and "." in section:
                table.add(tomlkit.nl())  # before the next header
        except (TOMLKitError, TypeError, AttributeError) as error:
            raise InputError(
                f"[{section}] cannot be written: {error}. Change it to a table under its own "
                f"header. {path}"
            ) from None
    return document.as_string()


def _table_at(document: tomlkit.TOMLDocument, names: Sequence[str]) -> tuple[Any, bool]:
    """Return the table of a dotted name, and whether it was created."""
    place: Any = document
    is_new = False
    for k, name in enumerate(names):
        is_new = name not in place
        if is_new:
            last = k == len(names) - 1
            text = document.as_string()
            if place is document and text.strip() and not text.endswith("\n\n"):
                document.add(tomlkit.nl())
            place.add(name, tomlkit.table(is_super_table=not last))
        place = place[name]
        if not isinstance(place, Mapping):
            raise TypeError(f"{'.'.join(names[: k + 1])} is not a table")
    return place, is_new


def _merge(table: Any, values: Mapping[str, object], owned: Collection[str]) -> None:
    """Change the keys of a table in place, add new ones, remove owned ones."""
    plain = {name: value for name, value in to_plain(values).items() if value is not None}
    for name in [name for name in table if name in owned and name not in plain]:
        table.remove(name)
    for name, value in plain.items():
        old = table.get(name)
        if isinstance(value, Mapping) and isinstance(old, Table):
            _merge(old, value, list(old))
        elif old is None or to_plain(_unwrapped(old)) != value:
            table[name] = _item(value)


def _unwrapped(item: Any) -> Any:
    """Return the plain value; tomlkit returns booleans as such."""
    return item.unwrap() if isinstance(item, Item) else item


def _item(value: Any, *, last: bool = True) -> Item:
    """Convert a value to TOML; long lists with one entry per line, tables as `[[name]]`."""
    if isinstance(value, Mapping):
        table = tomlkit.table()
        for name, part in value.items():
            if part is not None:
                table.add(name, _item(part))
        if last:
            table.add(tomlkit.nl())  # before the next header
        return table
    if isinstance(value, list) and value and all(isinstance(part, Mapping) for part in value):
        tables = tomlkit.aot()
        for k, part in enumerate(value):
            tables.append(_item(part, last=k == len(value) - 1))
        return tables
    if isinstance(value, list):
        return _array(value)
    scalar: Item = tomlkit.item(value)
    return scalar


def _array(value: list[Any]) -> Array:
    array = tomlkit.array()
    for part in value:
        array.append(_array(part) if isinstance(part, list) else part)
    nested = any(isinstance(part, list) for part in value)
    return array.multiline(nested and len(json.dumps(value)) > _WIDEST)
