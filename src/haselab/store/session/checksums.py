"""Checksums inside a session file, for files without a seal: being written, killed or truncated.

Each block, frame and event has a CRC-32, settings have one in their text. Everything that never
changes after the start (attributes, scales, layout) has one SHA-256.
"""

from __future__ import annotations

import hashlib
import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from haselab.base import JsonObject
from haselab.store.text_file import decode_json

__all__ = [
    "STATIC",
    "check_links",
    "compare",
    "condition_check",
    "event_check",
    "frame_checks",
    "read_settings",
    "static_digest",
    "write_settings",
]

STATIC = "static_sha256"
_SETTINGS_CHECK = "crc32"
# Written by HDF5's dimension scales as references: positions in this file, not data.
_REFERENCES = ("DIMENSION_LIST", "REFERENCE_LIST")
_CHANGING = ("settings", "tail")  # fixed in size, but written to while recording


def frame_checks(
    experiment: int, first: int, time_s: NDArray[Any], mass_kg: NDArray[Any], tracks: NDArray[Any]
) -> NDArray[np.uint32]:
    """CRC-32 of each frame: of its experiment, its row, its time, the mass, and all its points.

    Args:
        experiment: its number in the session, from 1.
        first: row of the first frame.
        time_s: shape `(F,)`.
        mass_kg: shape `(F,)`.
        tracks: shape `(F, P)`.
    Returns:
        Shape `(F,)`.
    """
    checks = np.empty(len(time_s), np.uint32)
    for k, (at_s, mass, points) in enumerate(
        zip(time_s.tolist(), mass_kg.tolist(), tracks, strict=True)
    ):
        head = zlib.crc32(struct.pack("<QQdd", experiment, first + k, at_s, mass))
        checks[k] = zlib.crc32(points.tobytes(), head)
    return checks


def compare(stated: NDArray[Any], found: NDArray[Any], first: int, what: str) -> None:
    """Refuse rows whose checksums differ from the stated ones.

    Args:
        stated: shape `(N,)`.
        found: shape `(N,)`.
        first: number of the first row.
        what: name of a row, for the message.
    Raises:
        ValueError: names the first wrong row.
    """
    wrong = np.flatnonzero(stated != found)
    if wrong.size:
        raise ValueError(f"{what} {first + int(wrong[0])} does not match its checksum")


def event_check(row: int, time_s: float, what: bytes) -> int:
    """CRC-32 of an event: of its row, its time and its text."""
    return zlib.crc32(what, zlib.crc32(struct.pack("<Qd", row, time_s)))


def condition_check(row: int, values: Sequence[float]) -> int:
    """CRC-32 of a condition: of its row and its values."""
    return zlib.crc32(struct.pack(f"<Q{len(values)}d", row, *values))


def write_settings(settings: Mapping[str, Any]) -> bytes:
    """Settings as JSON text, with the CRC-32 of the rest as the last entry."""
    text = json.dumps(settings)
    return json.dumps({**settings, _SETTINGS_CHECK: zlib.crc32(text.encode())}).encode()


def read_settings(text: bytes) -> tuple[JsonObject, bool]:
    """Settings from their text.

    Returns:
        The settings, and whether they match their checksum.
    Raises:
        ValueError: not JSON.
    """
    settings = decode_json(text.decode())
    stated = settings.pop(_SETTINGS_CHECK, None)
    return settings, stated == zlib.crc32(json.dumps(settings).encode())


def check_links(file: h5py.File) -> None:
    """Refuse a file that refers to another file, or to another place under a second name.

    Raises:
        ValueError: a soft or external link, a virtual dataset, or external storage.
    """

    def check(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            if item.is_virtual or item.external:
                raise ValueError(f"the values of {name!r} lie in another file, which is not read")
            return
        for key in item:
            if not isinstance(item.get(key, getlink=True), h5py.HardLink):
                raise ValueError(f"{name}/{key} is a link, which is not followed")

    check("", file)
    file.visititems(check)


def _bytes_of(value: Any) -> bytes:
    array = np.asarray(value)
    if array.dtype == object:
        return json.dumps(array.tolist(), default=str).encode()
    return repr((array.dtype.str, array.shape)).encode() + array.tobytes()


def static_digest(file: h5py.File) -> str:
    """SHA-256 of everything that is fixed when a recording starts: attributes, scales, layout.

    Args:
        file: open; without links, see `check_links`.
    """
    digest = hashlib.sha256()

    def add(name: str, item: h5py.Group | h5py.Dataset) -> None:
        digest.update(f"\n{name}\n".encode())
        for key in sorted(item.attrs):
            if key not in (*_REFERENCES, STATIC):
                digest.update(key.encode() + b"=" + _bytes_of(item.attrs[key]))
        if isinstance(item, h5py.Dataset):
            layout = (item.dtype.descr, item.shape[1:], item.chunks, item.maxshape)
            digest.update(repr(layout).encode())
            if (
                item.chunks is None
                and name not in _CHANGING
                and name.rpartition("/")[2] not in _CHANGING
            ):
                digest.update(_bytes_of(item[()]))

    add("", file)
    found: dict[str, h5py.Group | h5py.Dataset] = {}
    file.visititems(found.__setitem__)
    for name in sorted(found):
        add(name, found[name])
    return digest.hexdigest()
