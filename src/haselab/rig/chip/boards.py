"""The boards for which firmware can be built, each a folder in firmware/board."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from haselab.base import InputError
from haselab.firmware import FrontEnd

__all__ = ["Board", "board_names", "load_board", "source_folder"]

_FILE = "board.toml"


@dataclass(frozen=True)
class Board:
    """How to build the firmware of a board.

    Args:
        name: of its folder.
        prefix: of its compiler's programs, such as "avr-".
        package: package that contains them, for `apt-get install`.
        flags: compiler options, before the sources.
        link: linker options, after the sources.
        front_end: converter and stages that the board expects.
    """

    name: str
    prefix: str
    package: str
    flags: tuple[str, ...]
    link: tuple[str, ...]
    front_end: FrontEnd


def source_folder() -> Path:
    """Find the folder that contains the C sources: core, firmware and native.

    Returns:
        The checkout that this package runs from, or the copy in the installed package.
    Raises:
        InputError: This package was installed without them.
    """
    package = Path(__file__).resolve().parents[2]
    for root in (package.parents[1], package / "sources"):
        if (root / "firmware" / "app" / "main.c").is_file():
            return root
    raise InputError(
        "The C sources of the firmware are missing from this installation of haselab. Install it "
        f"again, from a wheel or from a checkout. {package / 'sources'}"
    )


def board_names() -> list[str]:
    """List the available boards.

    Returns:
        Names in alphabetical order; none if the sources are missing.
    Example:
        >>> board_names()
        ['atmega2560', 'stm32g071']
    """
    try:
        folder = source_folder() / "firmware" / "board"
    except InputError:
        return []
    return sorted(path.parent.name for path in folder.glob(f"*/{_FILE}"))


def load_board(name: str) -> Board:
    """Read the board.toml of a board.

    Args:
        name: of the folder.
    Returns:
        The board.
    Raises:
        InputError: The sources or the board are missing, or its file is not valid.
    Example:
        >>> load_board("stm32g071").front_end.converter_codes
        4096
    """
    path = source_folder() / "firmware" / "board" / name / _FILE
    if name not in board_names():
        raise InputError(
            f"There is no board {name!r}. Choose one of {', '.join(board_names())}, or add a "
            f"folder for it. {path.parent}"
        )
    try:
        return _board(name, tomllib.loads(path.read_text(encoding="utf-8")), path.parent)
    except (tomllib.TOMLDecodeError, KeyError, TypeError) as error:
        raise InputError(
            f"board.toml lacks or misuses {error}. It needs prefix, package and flags, and may "
            f"have libraries, script and [front_end]. {path}"
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
