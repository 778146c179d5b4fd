"""manifest.json of a recording: provenance, state, and the hash of each file."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from haselab.base import InputError, JsonObject, described, table_at
from haselab.store.folder import json_text, read_json, write_json, write_new

__all__ = [
    "MANIFEST",
    "Manifest",
    "State",
    "changed_files",
    "check_recorded",
    "read_manifest",
    "recorded_when",
    "seal",
    "sha256_of",
]

MANIFEST = "manifest.json"
State = Literal["OPEN", "SEALED", "RECOVERED"]
_FORMAT = "haselab manifest 1"
_RECORDED = ("session.h5", "video/**/*")
_CHUNK_BYTES = 1 << 20


def _now() -> datetime:
    return datetime.now(UTC)


def sha256_of(path: Path) -> str:
    """Hash of a file, read chunk by chunk."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK_BYTES):
            digest.update(chunk)
    return digest.hexdigest()


def _recorded(folder: Path) -> dict[str, dict[str, Any]]:
    """Every file of a recording, by its path in the folder."""
    found = sorted({path for each in _RECORDED for path in folder.glob(each) if path.is_file()})
    return {
        path.relative_to(folder).as_posix(): {
            "bytes": path.stat().st_size,
            "sha256": sha256_of(path),
        }
        for path in found
    }


def read_manifest(folder: Path) -> JsonObject:
    """Read the manifest of a recording.

    Raises:
        InputError: there is no manifest, or it is damaged.
    """
    path = folder / MANIFEST
    data = read_json(path)
    if not (isinstance(data, dict) and data.get("format") == _FORMAT and "state" in data):
        raise InputError(
            "manifest.json is not a haselab manifest. Rename it, then run 'haselab recover' again. "
            f"{path}"
        )
    return data


def seal(
    folder: Path, state: State, details: Mapping[str, Any], *, clock: Callable[[], datetime] = _now
) -> JsonObject:
    """Hash the recorded files, and write how the recording ended.

    Args:
        folder: of the recording.
        state: SEALED by the recording program, RECOVERED later.
        details: further entries of the manifest.
        clock: returns the time of day.
    Returns:
        The manifest.
    Raises:
        DeviceError: the file cannot be written.
    """
    path = folder / MANIFEST
    earlier = read_manifest(folder) if path.exists() else {"format": _FORMAT}
    data = earlier | dict(details)
    data |= {"state": state, "closed": clock().isoformat(), "files": _recorded(folder)}
    write_json(path, data)
    return data


def recorded_when(manifest: Mapping[str, Any]) -> dict[str, object]:
    """When a recording was made, and how long it took.

    Args:
        manifest: of its folder.
    Returns:
        `date` of its beginning and `wall_time_s`, the time between its beginning and its end by the
        clock of the computer, each where the manifest says it. A simulated bench may be faster than
        the time of its bench.
    """
    found: dict[str, object] = {}
    try:
        opened = datetime.fromisoformat(str(manifest["opened"]))
        found["date"] = opened.isoformat(timespec="seconds")
        closed = datetime.fromisoformat(str(manifest["closed"]))
        found["wall_time_s"] = round((closed - opened).total_seconds(), 1)
    except (KeyError, ValueError, TypeError):
        pass  # an older recording, or one that was cut off
    return found


def changed_files(folder: Path, manifest: Mapping[str, Any]) -> list[str]:
    """Files that differ from those that were sealed: changed, missing, or new.

    Args:
        folder: of the recording.
        manifest: from `read_manifest`.
    """
    stated, there = manifest.get("files", {}), _recorded(folder)
    return sorted(name for name in stated.keys() | there if stated.get(name) != there.get(name))


def check_recorded(path: Path, *, unverified: bool = False) -> str:
    """Compare a video with the manifest of the run that recorded it, if there is one.

    Args:
        path: a file in the folder `video` of a run; others are not checked.
        unverified: return the doubt instead of raising an error.
    Returns:
        Why the video is not verified; empty if it is.
    Raises:
        InputError: the video was changed after the recording.
    """
    folder = path.absolute().parent
    if folder.name != "video" or not path.is_file() or not (folder.parent / MANIFEST).is_file():
        return ""
    stated = table_at(read_manifest(folder.parent), "files", f"video/{path.name}")
    if not stated or stated.get("sha256") == sha256_of(path):
        return ""
    doubt = "the SHA-256 of the video is not that in manifest.json"
    if unverified:
        return doubt
    raise InputError(
        f"The video was changed after the recording: {doubt}. Copy the original again, or add "
        f"--unverified to read it and mark the result. {path}"
    )


class Manifest:
    """The manifest of a recording: OPEN while it runs, and SEALED when it ends in any way.

    It stays OPEN only if the process is killed or the machine stops; see `haselab recover`.

    Args:
        folder: of the recording.
        record: configuration, versions, seed and calibrations as JSON types.
        clock: returns the time of day.
    Raises:
        InputError: there is a manifest already; it is not changed.
        DeviceError: the file cannot be written.
    """

    def __init__(
        self, folder: Path, record: Mapping[str, Any], *, clock: Callable[[], datetime] = _now
    ) -> None:
        self._folder, self._clock = folder, clock
        opened = {"format": _FORMAT, "state": "OPEN", "opened": clock().isoformat()}
        write_new(folder / MANIFEST, json_text(opened | dict(record)))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        ended = "complete" if error is None else described(error)
        try:
            seal(self._folder, "SEALED", {"ended": ended}, clock=self._clock)
        except OSError:  # a full disk must not hide the original error
            if error is None:
                raise
