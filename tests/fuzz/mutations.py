"""Changes that turn valid files and arguments into invalid ones, each from a seeded generator."""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from random import Random

__all__ = ["SPECIAL", "Case", "mutated"]

# What stands in place of a regular file.
SPECIAL = ("missing", "folder", "fifo", "/dev/zero", "/dev/null", "loop", "dangling")
_NUMBERS = (
    "0", "-1", "1", "2", "-0.0", "0.5", "-0.5", "1e-308", "5e-324", "1e308", "-1e308", "1e400",
    "inf", "-inf", "nan", "1e12", "1e6", "-1e6", "1000000", "65535", "2147483648", "-2147483649",
    "9223372036854775807", "9223372036854775808", "18446744073709551616", "1" + "0" * 400,
    "1" + "0" * 5000, "0.1", "1e-9", "1e-30", "3",
)  # fmt: skip
_VALUES = (
    *_NUMBERS, '""', '"nan"', '"a"', '"\\u0000"', "true", "false", "null", "[]", "{}", "[[]]",
    "[1, 2]",
    "[1e308, 1e308]", '["a", 1]', '{"a": 1}', "{a = 1}", "1979-05-27", "'''", "[" * 3000,
    "[" * 200_000,
    '{"a":' * 3000, "NaN", "Infinity", "-Infinity", "0x7fffffffffffffff", "1_0", '"\\ud800"',
    "{value = 1}",
    '{"value": null}', '{"value": "a", "std": 1}',
)  # fmt: skip
_TOKENS = (
    b"\0",
    b"\xef\xbb\xbf",
    b"\xff\xfe",
    b"\n",
    b",",
    b";",
    b"\t",
    b'"',
    b"#",
    b"[",
    b"]",
    b"=",
    b"\r",
    b"1e400",
    b"nan",
    b"inf",
    b"%s",
    b"../" * 8,
    b"\xc3\x28",
    b"\xf0\x9f\x98\x80",
    b"-",
    b"1" * 500,
)
_WORDS = (
    0,
    1,
    2,
    3,
    8,
    127,
    128,
    255,
    256,
    32767,
    32768,
    65535,
    65536,
    2**31 - 1,
    2**31,
    2**32 - 1,
    2**40,
    2**63 - 1,
    2**63,
    2**64 - 1,
)
_LITERAL = re.compile(
    rb'(?<![\w.])(?:[-+]?\d[\d_]*(?:\.\d*)?(?:[eE][-+]?\d+)?|"[^"\n]*"|true|false|null|\[[^\[\]\n]*\])'
)
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_TEXT = (".json", ".toml", ".csv", ".cih", ".cihx", ".xml")


@dataclass(frozen=True)
class Case:
    """One call of the command line.

    Args:
        target: name of what is called.
        argv: arguments; names of files are relative to the case's own folder.
        files: content by name.
        special: what stands in place of a regular file, by name; one of `SPECIAL`.
    """

    target: str
    argv: tuple[str, ...]
    files: Mapping[str, bytes]
    special: Mapping[str, str]


def mutated(case: Case, rng: Random, others: Sequence[bytes]) -> Case:
    """The case with one to four changes.

    Args:
        case: a valid one.
        rng: chooses the changes.
        others: content of other files, for splices.
    """
    names = sorted(case.files)
    if names and rng.random() < 0.04:
        name = rng.choice(names)
        files = {key: data for key, data in case.files.items() if key != name}
        return replace(case, files=files, special={name: rng.choice(SPECIAL)})
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if not names or rng.random() < 0.12:
            case = replace(case, argv=_argument(case.argv, rng))
            continue
        name = rng.choice(names)
        text = name.endswith(_TEXT) and rng.random() < 0.9
        change = rng.choice(_OF_TEXT if text else _OF_BYTES)
        data = change(case.files[name], rng, others)
        case = replace(case, files={**case.files, name: data})
    return case


def _argument(argv: tuple[str, ...], rng: Random) -> tuple[str, ...]:
    """Another number in place of one, or one argument twice, or none."""
    places = [k for k, word in enumerate(argv) if _NUMBER.search(word) and "." not in word[-5:-1]]
    numeric = [k for k in places if re.fullmatch(r"[-+.,\deE:x]+", argv[k])]
    words = list(argv)
    if numeric and rng.random() < 0.9:
        at = rng.choice(numeric)
        parts = list(_NUMBER.finditer(words[at]))
        part = rng.choice(parts)
        words[at] = words[at][: part.start()] + rng.choice(_NUMBERS[:-3]) + words[at][part.end() :]
        return tuple(words)
    at = rng.randrange(1, len(words)) if len(words) > 1 else 0
    words[at] = rng.choice(("", "a", "-", "\udcff", "nan", "é", "a/b", "x" * 300, words[at] * 2))
    return tuple(words)


# ---- text -------------------------------------------------------------------------------------


def _swap_literal(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    found = list(_LITERAL.finditer(data))
    if not found:
        return _flip(data, rng, others)
    at = rng.choice(found)
    value = rng.choice(_VALUES if rng.random() < 0.6 else _NUMBERS).encode()
    return data[: at.start()] + value + data[at.end() :]


def _lines(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    """A line less, twice, or elsewhere."""
    lines = data.split(b"\n")
    at, to = rng.randrange(len(lines)), rng.randrange(len(lines))
    line = lines.pop(at)
    lines[to:to] = rng.choice(([], [line, line], [line], [line[: rng.randrange(len(line) + 1)]]))
    return b"\n".join(lines)


def _keep_lines(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    """The first lines alone."""
    lines = data.split(b"\n")
    return b"\n".join(lines[: rng.randrange(min(6, len(lines)) + 1)])


def _encoded(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    text = data.decode("utf-8", errors="replace")
    return text.encode(rng.choice(("utf-16", "utf-8-sig", "utf-32", "utf-16-be")), "replace")


# ---- bytes ------------------------------------------------------------------------------------


def _place(data: bytes, rng: Random) -> int:
    """Anywhere, but often in the head or the tail, where formats keep their tables."""
    size = len(data)
    if size == 0:
        return 0
    head = rng.choice((16, 64, 512, size))
    return (
        rng.randrange(min(head, size))
        if rng.random() < 0.8
        else size - 1 - rng.randrange(min(head, size))
    )


def _flip(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    changed = bytearray(data or b"\0")
    for _ in range(rng.choice((1, 1, 2, 8))):
        changed[_place(changed, rng)] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _word(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    form = rng.choice(["<B", "<H", ">H", "<I", ">I", "<Q", ">Q", "<d", "<f"])
    if form[1] in "df":
        raw = struct.pack(form, rng.choice((0.0, -1.0, 3e38, float("nan"), float("inf"), 1e-30)))
    else:
        raw = struct.pack(form, rng.choice(_WORDS) % (1 << 8 * struct.calcsize(form)))
    at = _place(data, rng)
    return data[:at] + raw + data[at + len(raw) :]


def _truncate(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    return data[: _place(data, rng)]


def _insert(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    at = _place(data, rng)
    return data[:at] + (rng.choice(_TOKENS) if rng.random() < 0.7 else rng.randbytes(8)) + data[at:]


def _delete(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    at = _place(data, rng)
    return data[:at] + data[at + rng.choice((1, 4, 64, 1024)) :]


def _splice(data: bytes, rng: Random, others: Sequence[bytes]) -> bytes:
    other = rng.choice(others)
    return data[: _place(data, rng)] + other[_place(other, rng) :]


_OF_BYTES = (_flip, _flip, _word, _word, _word, _truncate, _insert, _delete, _splice)
_OF_TEXT = (
    *[_swap_literal] * 6,
    _lines,
    _lines,
    _keep_lines,
    _insert,
    _flip,
    _truncate,
    _encoded,
    _splice,
)
