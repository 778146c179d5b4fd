"""Small text files: what is no regular file is refused unopened, and nothing is endless."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest
from pydantic import Field

from haselab.base import InputError
from haselab.store import text_file
from haselab.store.text_file import parse_json, read_text
from haselab.store.toml import Section, read_toml, validated

POSIX = pytest.mark.skipif(sys.platform == "win32", reason="named pipes, devices and links")


@POSIX
@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ("pipe", "The path is a named pipe. Name a regular file"),
        ("device", "The path is a device"),
        ("folder", "The path is a folder"),
        ("loop", "Too many levels of symbolic links"),
        ("dangling", "No such rig file"),
    ],
)
def test_what_is_no_regular_file_is_refused_by_its_kind(
    tmp_path: Path, kind: str, words: str
) -> None:
    path = tmp_path / "given"
    make = {
        "pipe": lambda: os.mkfifo(path),
        "device": lambda: path.symlink_to("/dev/zero"),
        "folder": path.mkdir,
        "loop": lambda: path.symlink_to(path),
        "dangling": lambda: path.symlink_to(tmp_path / "nowhere"),
    }
    make[kind]()
    with pytest.raises(InputError, match=rf"{words}.*given$"):
        read_text(path, "rig file")


def test_a_byte_order_mark_is_no_part_of_the_text(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    path.write_bytes(b"\xef\xbb\xbfa = 1\n")
    assert read_toml(path, "file") == {"a": 1}


def test_another_encoding_is_named_with_the_first_byte_that_is_none(tmp_path: Path) -> None:
    path = tmp_path / "a.txt"
    path.write_bytes(b"ab\xff")
    with pytest.raises(InputError, match=r"not a text in UTF-8 \(byte 2\)"):
        read_text(path)


def test_a_file_beyond_the_limit_is_not_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(text_file, "_MOST_BYTES", 3)
    path = tmp_path / "a.txt"
    path.write_text("abcd")
    with pytest.raises(InputError, match="has 4 bytes, more than the 3 of"):
        read_text(path)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("[" * 100_000, "nested too deeply"),
        ('{"a":' * 100_000, "nested too deeply"),
        ("1" * 5000, "too many digits"),
        ("{", "line 1: Expecting property name"),
        (r'{"\ud800": 1}', r"half of a character, '\\ud800'"),
    ],
)
def test_json_that_python_cannot_hold_is_an_input_error(text: str, why: str) -> None:
    with pytest.raises(InputError, match=rf"m\.json is not a JSON document \(.*{why}"):
        parse_json(text, Path("m.json"))


def test_both_halves_of_a_character_are_one() -> None:
    assert parse_json(r'"\ud83d\ude00"', Path("m.json")) == chr(0x1F600)


@pytest.mark.parametrize("text", ["a = " + "1" * 5000, "a = " + "[" * 5000, "a = 2024-13-45"])
def test_toml_that_python_cannot_hold_is_an_input_error(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.toml"
    path.write_text(text)
    with pytest.raises(InputError, match="Not a TOML file that can be read"):
        read_toml(path, "file")


class _Table(Section):
    length_m: float = Field(gt=0)
    times_s: tuple[float, ...] = ()


@pytest.mark.parametrize("value", [5e-324, 1e300, float("inf"), float("nan"), 10**400])
def test_every_number_of_a_section_is_finite_and_of_moderate_size(value: float) -> None:
    with pytest.raises(InputError, match=r"length_m: must be"):
        validated(_Table, {"length_m": value}, "a.toml")
    with pytest.raises(InputError, match=r"times_s.*: must be"):
        validated(_Table, {"length_m": 1.0, "times_s": [0.0, value]}, "a.toml")


def test_zero_is_a_moderate_number() -> None:
    assert validated(_Table, {"length_m": 1.0, "times_s": [0.0]}, "a.toml").times_s == (0.0,)


def test_a_message_stays_short_whatever_is_in_the_file() -> None:
    many = {f"key{k}": "x" * 1000 for k in range(1000)}
    with pytest.raises(InputError, match="1001 error") as caught:
        validated(_Table, {"length_m": "y" * 10_000, **many}, "a.toml")
    assert str(caught.value).startswith("1001 errors: length_m: ")
    assert "and 993 more" in str(caught.value)
    assert len(str(caught.value)) < 2000
