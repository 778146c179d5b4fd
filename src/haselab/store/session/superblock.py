"""The first 48 bytes of an HDF5 file: the size that it states, and whether a writer has it open."""

from __future__ import annotations

from pathlib import Path

__all__ = [
    "check_superblock",
    "closed_superblock",
    "is_marked_open",
    "mark_closed",
    "superblock_checksum",
]

_SIGNATURE = b"\x89HDF\r\n\x1a\n"
_LENGTH = 48  # of versions 2 and 3 with addresses of eight bytes
_FLAGS = 11  # byte with the consistency flags: bit 0 open for writing, bit 2 by SWMR
_END = slice(28, 36)  # address of the end of the file
_MARKS = 0b101
_MASK = 0xFFFFFFFF


def _rotate(x: int, bits: int) -> int:
    return ((x << bits) | (x >> (32 - bits))) & _MASK


def superblock_checksum(data: bytes) -> int:
    """Checksum of HDF5's metadata over these bytes.

    Source: R. Jenkins, lookup3, `hashlittle` with initial value 0; HDF5 File Format Specification
        3.0, section III, names it for all metadata.
    Example:
        >>> superblock_checksum(b"Four score and seven years ago") == 0x17770551
        True
    """
    a = b = c = (0xDEADBEEF + len(data)) & _MASK
    if not data:
        return c
    while len(data) > 12:
        a, b, c = (
            (x + int.from_bytes(data[k : k + 4], "little")) & _MASK
            for x, k in ((a, 0), (b, 4), (c, 8))
        )
        for bits in (4, 6, 8):
            a = ((a - c) & _MASK) ^ _rotate(c, bits)
            c = (c + b) & _MASK
            a, b, c = b, c, a
        for bits in (16, 19, 4):
            a = ((a - c) & _MASK) ^ _rotate(c, bits)
            c = (c + b) & _MASK
            a, b, c = b, c, a
        data = data[12:]
    data = data.ljust(12, b"\0")
    a, b, c = (
        (x + int.from_bytes(data[k : k + 4], "little")) & _MASK for x, k in ((a, 0), (b, 4), (c, 8))
    )
    for bits in (14, 11, 25, 16, 4, 14, 24):
        c = ((c ^ b) - _rotate(b, bits)) & _MASK
        a, b, c = b, c, a
    return b


def _head(path: Path) -> bytes:
    with path.open("rb") as file:
        head = file.read(_LENGTH)
    if len(head) < _LENGTH or head[:8] != _SIGNATURE or head[8] not in (2, 3) or head[9] != 8:
        raise ValueError("no HDF5 superblock of this format")
    if superblock_checksum(head[:-4]) != int.from_bytes(head[-4:], "little"):
        raise ValueError("the checksum of the superblock does not match")
    return head


def check_superblock(path: Path) -> None:
    """Refuse a file whose length contradicts its superblock: HDF5 would search it for hours.

    A file that its writer closed has exactly the stated length, one that is still marked open has
    at least the length that it had at the start.

    Raises:
        ValueError: truncated, extended, or no valid superblock of version 2 or 3.
    """
    head = _head(path)
    stated, size = int.from_bytes(head[_END], "little"), path.stat().st_size
    if size < stated:
        raise ValueError(f"truncated: {size} bytes of {stated}")
    if size > stated and not head[_FLAGS] & _MARKS:
        raise ValueError(f"its end is damaged: {size - stated} unknown bytes follow the data")


def is_marked_open(path: Path) -> bool:
    """Whether a writer has the file open, or ended without closing it.

    Raises:
        ValueError: no valid superblock of version 2 or 3.
    """
    return bool(_head(path)[_FLAGS] & _MARKS)


def closed_superblock(path: Path) -> bytes:
    """The superblock without the writer's mark, and with the actual size of the file.

    While blocks are appended the superblock in the file keeps the size of the start.

    Returns:
        The first 48 bytes of the file as they would be if the writer had closed it.
    Raises:
        ValueError: no valid superblock of version 2 or 3.
    """
    head = bytearray(_head(path))
    size = max(path.stat().st_size, int.from_bytes(head[_END], "little"))
    head[_FLAGS] = 0
    head[_END] = size.to_bytes(8, "little")
    head[-4:] = superblock_checksum(bytes(head[:-4])).to_bytes(4, "little")
    return bytes(head)


def mark_closed(path: Path) -> None:
    """Write `closed_superblock` to the file.

    Raises:
        ValueError: no valid superblock of version 2 or 3.
    """
    head = closed_superblock(path)
    with path.open("r+b") as file:
        file.write(head)
