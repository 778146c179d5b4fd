"""Encode and decode frames: COBS, CRC-16 and the messages inside."""

from __future__ import annotations

import binascii
import struct
from dataclasses import astuple, fields
from typing import Any

from haselab.base import InputError
from haselab.firmware.messages import COMMANDS, TELEMETRY

__all__ = ["FrameReader", "decode_message", "encode_message", "stuff", "unstuff"]

_HEADER = struct.Struct("<BH")
_CRC = struct.Struct("<H")
_LONGEST_RUN = 254  # longest run of bytes without a 0 for one COBS code
_KINDS = {kind.CODE: kind for kind in (*COMMANDS, *TELEMETRY)}
_MOST_WAITING = 4096  # bytes without an end of frame before they are dropped


def stuff(data: bytes) -> bytes:
    """Encode bytes without a 0: consistent overhead byte stuffing (COBS).

    Args:
        data: any bytes.
    Returns:
        One byte more for each 254, without a 0; the end of the frame is not appended.
    Source: Cheshire and Baker, IEEE/ACM Transactions on Networking 7 (1999), section 4.
    Example:
        >>> stuff(bytes([0x11, 0x22, 0x00, 0x33])).hex(" ")
        '03 11 22 02 33'
    """
    out = bytearray()
    for piece in data.split(b"\0"):
        rest = piece
        while len(rest) >= _LONGEST_RUN:
            out += bytes([_LONGEST_RUN + 1]) + rest[:_LONGEST_RUN]
            rest = rest[_LONGEST_RUN:]
        out += bytes([len(rest) + 1]) + rest
    return bytes(out)


def unstuff(data: bytes) -> bytes | None:
    """Decode what `stuff` encoded.

    Args:
        data: bytes of one frame, before its 0.
    Returns:
        The bytes, or None if `stuff` cannot have encoded them.
    Example:
        >>> unstuff(bytes([3, 0x11, 0x22, 2, 0x33])).hex(" ")
        '11 22 00 33'
    """
    if 0 in data:
        return None
    out, at = bytearray(), 0
    while at < len(data):
        code = data[at]
        run = data[at + 1 : at + code]
        if len(run) != code - 1:
            return None
        out += run
        at += code
        if at < len(data) and code <= _LONGEST_RUN:
            out.append(0)
    return bytes(out)


def encode_message(message: Any, sequence: int) -> bytes:
    """Encode a message as a frame with its end.

    Args:
        message: one of `haselab.firmware.messages`.
        sequence: its number; counted modulo 65536.
    Returns:
        COBS(code, sequence, fields, CRC) and a 0.
    Raises:
        InputError: A field does not fit its type.
    Example:
        >>> from haselab.firmware.messages import Hello
        >>> encode_message(Hello(1), 1).hex(" ")
        '03 01 01 02 01 03 d8 fe 00'
    """
    try:
        values: list[Any] = []
        for value in astuple(message):
            values.extend(value if isinstance(value, tuple) else (value,))
        body = struct.pack(message.LAYOUT, *values)
    except (struct.error, OverflowError) as error:
        raise InputError(
            f"A field of {type(message).__name__} does not fit its type ({error}). Change its "
            "value."
        ) from None
    data = _HEADER.pack(message.CODE, sequence & 0xFFFF) + body
    return stuff(data + _CRC.pack(binascii.crc_hqx(data, 0xFFFF))) + b"\0"


def decode_message(frame: bytes) -> tuple[Any, int] | None:
    """Decode the message of a frame.

    Args:
        frame: its bytes before the 0.
    Returns:
        `(message, sequence)`, or None if the frame is damaged or the message unknown.
    """
    data = unstuff(frame)
    if data is None or len(data) < _HEADER.size + _CRC.size:
        return None
    data, crc = data[: -_CRC.size], _CRC.unpack(data[-_CRC.size :])[0]
    kind = _KINDS.get(data[0])
    if binascii.crc_hqx(data, 0xFFFF) != crc or kind is None:
        return None
    code, sequence = _HEADER.unpack_from(data)
    del code
    if len(data) != _HEADER.size + struct.calcsize(kind.LAYOUT):
        return None
    return _build(kind, struct.unpack(kind.LAYOUT, data[_HEADER.size :])), sequence


def _array_field(kind: type[Any]) -> tuple[int, int]:
    """Index of a message's array field, past the end if there is none, and the number of fields."""
    arrays = [str(field.type).startswith("tuple") for field in fields(kind)]
    return [*arrays, True].index(True), len(arrays)


_ARRAY_FIELDS = {kind.CODE: _array_field(kind) for kind in _KINDS.values()}


def _build(kind: type[Any], values: tuple[Any, ...]) -> Any:
    """Assign values to fields; an array field takes those that the others leave."""
    at, count = _ARRAY_FIELDS[kind.CODE]
    if at == count:
        return kind(*values)
    end = at + 1 + len(values) - count
    return kind(*values[:at], values[at:end], *values[end:])


class FrameReader:
    """Decodes messages from received bytes; damaged frames are counted and dropped."""

    def __init__(self) -> None:
        self._waiting = bytearray()
        self.bad_frames = 0

    def feed(self, data: bytes) -> list[tuple[Any, int]]:
        """Decode received bytes.

        Args:
            data: received bytes.
        Returns:
            `(message, sequence)` of each frame that they complete.
        """
        self._waiting += data
        *whole, rest = bytes(self._waiting).split(b"\0")
        self._waiting = bytearray(rest)
        if len(rest) > _MOST_WAITING:
            self._waiting.clear()
            self.bad_frames += 1
        found = []
        for frame in whole:
            message = decode_message(frame) if frame else None
            if message is not None:
                found.append(message)
            elif frame:
                self.bad_frames += 1
        return found
