"""Frames and messages: known vectors, an independent decoder, round trips, and one table."""

from __future__ import annotations

import binascii
import importlib.util
import struct
import sys
from dataclasses import fields
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.base import InputError
from haselab.firmware import FrameReader, decode_message, encode_message, stuff, unstuff
from haselab.firmware.messages import COMMANDS, TELEMETRY, Hello, SetReference, Trace
from haselab.rig.chip import source_folder

# Cheshire and Baker 1999 give the rules; these are the usual examples of them.
VECTORS = [
    ("00", "01 01"),
    ("00 00", "01 01 01"),
    ("00 11 00", "01 02 11 01"),
    ("11 22 00 33", "03 11 22 02 33"),
    ("11 22 33 44", "05 11 22 33 44"),
    ("11 00 00 00", "02 11 01 01 01"),
]


@pytest.mark.parametrize(("plain", "stuffed"), VECTORS)
def test_stuffing_gives_the_published_bytes(plain: str, stuffed: str) -> None:
    assert stuff(bytes.fromhex(plain)) == bytes.fromhex(stuffed)
    assert unstuff(bytes.fromhex(stuffed)) == bytes.fromhex(plain)


def hops(data: bytes) -> bytes:
    """Another way to take bytes out: hop from code to code, each of which stood for a 0."""
    out, at, full = bytearray(data), 0, True
    gone = set()
    while at < len(data):
        code = data[at]
        out[at] = 0
        if full:
            gone.add(at)
        full = code == 255
        at += code
    return bytes(byte for k, byte in enumerate(out) if k not in gone)


@given(st.binary(max_size=700))
def test_stuffed_bytes_hold_no_zero_and_come_back(data: bytes) -> None:
    stuffed = stuff(data)
    assert 0 not in stuffed
    assert len(data) < len(stuffed) <= len(data) + 1 + len(data) // 254
    assert unstuff(stuffed) == hops(stuffed) == data


@given(st.binary(max_size=60))
def test_whatever_comes_is_decoded_or_refused(data: bytes) -> None:
    plain = unstuff(data)
    if plain is not None and 255 not in data:
        assert stuff(plain) == data or not data
    decode_message(data)


def test_the_checksum_is_the_published_one() -> None:
    assert binascii.crc_hqx(b"123456789", 0xFFFF) == 0x29B1  # CRC-16/CCITT-FALSE, check value
    frame = encode_message(Hello(1), 7)
    assert frame.endswith(b"\0")
    assert frame.count(0) == 1
    plain = unstuff(frame[:-1])
    assert plain is not None
    assert plain[:5] == bytes([1, 7, 0, 1, 0])
    assert struct.unpack("<H", plain[5:])[0] == binascii.crc_hqx(plain[:5], 0xFFFF)


NUMBERS = {
    "B": st.integers(0, 255),
    "H": st.integers(0, 65535),
    "I": st.integers(0, 2**32 - 1),
    "h": st.integers(-32768, 32767),
    "f": st.floats(width=32, allow_nan=False),
}


@st.composite
def messages(draw: st.DrawFn) -> Any:
    kind = draw(st.sampled_from([*COMMANDS, *TELEMETRY]))
    values = []
    letters = kind.LAYOUT[1:]
    for field in fields(kind):
        count = "".join(c for c in letters[: letters.find(letters.lstrip("0123456789")[0])])
        letters = letters.lstrip("0123456789")
        letter, letters = letters[0], letters[1:]
        if str(field.type).startswith("tuple"):
            values.append(tuple(draw(NUMBERS[letter]) for _ in range(int(count))))
        else:
            values.append(draw(NUMBERS[letter]))
    return kind(*values)


@given(st.lists(st.tuples(messages(), st.integers(0, 65535)), max_size=5), st.integers(1, 7))
def test_messages_come_back_from_a_stream_cut_anywhere(
    sent: list[tuple[Any, int]], piece: int
) -> None:
    stream = b"".join(encode_message(message, number) for message, number in sent)
    reader = FrameReader()
    got = []
    for at in range(0, len(stream), piece):
        got += reader.feed(stream[at : at + piece])
    assert got == sent
    assert reader.bad_frames == 0


@given(messages(), st.data())
def test_one_changed_bit_is_never_taken(message: Any, data: st.DataObject) -> None:
    frame = bytearray(encode_message(message, 3)[:-1])
    at = data.draw(st.integers(0, len(frame) - 1))
    frame[at] ^= 1 << data.draw(st.integers(0, 7))
    reader = FrameReader()
    assert reader.feed(bytes(frame) + b"\0") == []
    assert reader.bad_frames >= 1


def test_a_stream_without_an_end_does_not_grow_for_ever() -> None:
    reader = FrameReader()
    for _ in range(3):
        assert reader.feed(b"\x55" * 5000) == []
    assert reader.bad_frames == 3
    assert reader.feed(b"\0" + encode_message(Hello(1), 1)) == [(Hello(1), 1)]


@pytest.mark.parametrize("message", [Hello(70000), SetReference(1e39), Hello(-1)])
def test_values_beyond_their_type_are_refused(message: Any) -> None:
    with pytest.raises(InputError, match="does not fit its type"):
        encode_message(message, 1)


def test_c_python_and_the_page_are_what_the_table_makes_of_them() -> None:
    path = source_folder() / "firmware" / "protocol" / "generate.py"
    spec = importlib.util.spec_from_file_location("generate_protocol", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    for target, text in module.outputs().items():
        assert Path(target).read_text(encoding="utf-8") == text, f"run {path.name}: {target.name}"


def test_codes_of_all_messages_differ_and_sizes_fit_a_frame() -> None:
    kinds = [*COMMANDS, *TELEMETRY]
    assert len({kind.CODE for kind in kinds}) == len(kinds)
    assert struct.calcsize(Trace.LAYOUT) + 3 + 2 <= 64  # FRAME_LONGEST of frame.h
