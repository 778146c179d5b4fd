"""manifest.json of a recording: provenance, state, and the hash of each file."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

from haselab.base import InputError
from haselab.store.claim import create_exclusively
from haselab.store.folder import read_json, write_json

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
_PIECE_BYTES = 1 << 20


def _now() -> datetime:
    return datetime.now(UTC)


def sha256_of(path: Path) -> str:
    """Hash of a file, read piece by piece."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while piece := file.read(_PIECE_BYTES):
            digest.update(piece)
    return digest.hexdigest()


def _recorded(folder: Path) -> dict[str, dict[str, Any]]:
    """Every file that a recording makes, by its path in the folder."""
    found = sorted({path for each in _RECORDED for path in folder.glob(each) if path.is_file()})
    return {
        path.relative_to(folder).as_posix(): {
            "bytes": path.stat().st_size,
            "sha256": sha256_of(path),
        }
        for path in found
    }


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a recording.

    Raises:
        InputError: there is none, or it is damaged.
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
    folder: Path, state: State, told: Mapping[str, Any], *, clock: Callable[[], datetime] = _now
) -> dict[str, Any]:
    """Hash what was recorded and state how it ended.

    Args:
        folder: of the recording.
        state: SEALED by the one who recorded, RECOVERED later.
        told: what else the manifest is to say.
        clock: tells the time of day.
    Returns:
        The manifest.
    Raises:
        DeviceError: the disk refuses.
    """
    path = folder / MANIFEST
    earlier = read_manifest(folder) if path.exists() else {"format": _FORMAT}
    data = earlier | dict(told)
    data |= {"state": state, "closed": clock().isoformat(), "files": _recorded(folder)}
    write_json(path, data)
    return data


def recorded_when(manifest: Mapping[str, Any]) -> dict[str, object]:
    """When a recording was made, and how long it took.

    Args:
        manifest: of its folder.
    Returns:
        `date` of its beginning and `duration_s`, each where the manifest says it.
    """
    found: dict[str, object] = {}
    try:
        opened = datetime.fromisoformat(str(manifest["opened"]))
        found["date"] = opened.isoformat(timespec="seconds")
        closed = datetime.fromisoformat(str(manifest["closed"]))
        found["duration_s"] = round((closed - opened).total_seconds(), 1)
    except (KeyError, ValueError, TypeError):
        pass  # an older recording, or one that was cut off
    return found


def changed_files(folder: Path, manifest: Mapping[str, Any]) -> list[str]:
    """Files that are not those that were sealed: changed, gone, or new.

    Args:
        folder: of the recording.
        manifest: as `read_manifest` gives it.
    """
    stated, there = manifest.get("files", {}), _recorded(folder)
    return sorted(name for name in stated.keys() | there if stated.get(name) != there.get(name))


def check_recorded(path: Path, *, unverified: bool = False) -> str:
    """Compare a video with the manifest of the run that recorded it, where there is one.

    Args:
        path: a file in the folder `video` of a run; any other is not looked at.
        unverified: answer with the doubt instead of an error.
    Returns:
        Why the video is doubtful; empty: no reason.
    Raises:
        InputError: the video is not the one that was recorded.
    """
    folder = path.absolute().parent
    if folder.name != "video" or not path.is_file() or not (folder.parent / MANIFEST).is_file():
        return ""
    stated = read_manifest(folder.parent).get("files", {}).get(f"video/{path.name}")
    if stated is None or stated.get("sha256") == sha256_of(path):
        return ""
    doubt = "the SHA-256 of the video is not that in manifest.json"
    if unverified:
        return doubt
    raise InputError(
        f"The video was changed after the recording: {doubt}. Copy the original again, or add "
        f"--unverified to read it and mark the result. {path}"
    )


class Manifest:
    """Stands OPEN beside a recording, and is SEALED whatever way the recording ends.

    Only a process that is killed, or a machine that stops, leaves it OPEN: `haselab recover`.

    Args:
        folder: of the recording.
        record: configuration, versions, seed, calibrations, as JSON holds them.
        clock: tells the time of day.
    Raises:
        InputError: there is a manifest already; nothing in it was changed.
        DeviceError: the disk refuses.
    """

    def __init__(
        self, folder: Path, record: Mapping[str, Any], *, clock: Callable[[], datetime] = _now
    ) -> None:
        self._folder, self._clock = folder, clock
        create_exclusively(folder / MANIFEST)
        write_json(
            folder / MANIFEST,
            {"format": _FORMAT, "state": "OPEN", "opened": clock().isoformat()} | dict(record),
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        ended = "complete" if kind is None else f"{kind.__name__}: {' '.join(str(error).split())}"
        try:
            seal(self._folder, "SEALED", {"ended": ended}, clock=self._clock)
        except OSError:  # a full disk must not hide what led here
            if error is None:
                raise
