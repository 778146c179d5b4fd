"""The boards that a firmware can be built for: a folder of firmware/board each."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from haselab.base import InputError
from haselab.firmware import FrontEnd

__all__ = ["Board", "board_names", "checkout", "load_board"]

_FILE = "board.toml"


@dataclass(frozen=True)
class Board:
    """How a board's firmware is made.

    Args:
        name: of its folder.
        prefix: of its compiler's programs, such as "avr-".
        package: that brings them, as `apt-get install` takes it.
        flags: for the compiler, ahead of the sources.
        link: for the linker, behind the sources.
        front_end: converter and stages that the board expects.
    """

    name: str
    prefix: str
    package: str
    flags: tuple[str, ...]
    link: tuple[str, ...]
    front_end: FrontEnd


def checkout() -> Path:
    """The folder of the sources.

    Returns:
        The root of the checkout that this package runs from.
    Raises:
        InputError: this package was installed without them.
    """
    root = Path(__file__).resolve().parents[4]
    if not (root / "firmware" / "app" / "main.c").is_file():
        raise InputError(
            "The firmware's sources are not part of an installed package; needed is a checkout. "
            f"Clone the project and run it from there. {root}"
        )
    return root


def board_names() -> list[str]:
    """Boards that there are.

    Returns:
        Names, in order; none where the sources are not there.
    Example:
        >>> board_names()
        ['atmega2560', 'stm32g071']
    """
    try:
        folder = checkout() / "firmware" / "board"
    except InputError:
        return []
    return sorted(path.parent.name for path in folder.glob(f"*/{_FILE}"))


def load_board(name: str) -> Board:
    """What a board's folder says about itself in board.toml.

    Args:
        name: of the folder.
    Returns:
        The board.
    Raises:
        InputError: no sources, no such board, or its file is unusable.
    Example:
        >>> load_board("stm32g071").front_end.converter_codes
        4096
    """
    path = checkout() / "firmware" / "board" / name / _FILE
    if name not in board_names():
        raise InputError(
            f"There is no board {name!r}; allowed are {', '.join(board_names())}. Choose one, or "
            f"write its folder. {path.parent}"
        )
    try:
        return _board(name, tomllib.loads(path.read_text(encoding="utf-8")), path.parent)
    except (tomllib.TOMLDecodeError, KeyError, TypeError) as error:
        raise InputError(
            f"board.toml lacks or misuses {error}; needed are prefix, package, flags, and allowed "
            f"are libraries, script, [front_end]. Correct it. {path}"
        ) from None


def _board(name: str, data: Mapping[str, Any], folder: Path) -> Board:
    strange = set(data) - {"prefix", "package", "flags", "libraries", "script", "front_end"}
    if strange:
        raise KeyError(*sorted(strange))
    link = list(data.get("libraries", ()))
    if "script" in data:
        link.append(f"-T{folder / data['script']}")
    return Board(
        name, data["prefix"], data["package"], tuple(data["flags"]), tuple(link),
        FrontEnd(**data.get("front_end", {})),
    )  # fmt: skip
