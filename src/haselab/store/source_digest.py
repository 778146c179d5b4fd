"""Identify the code that computes a result, also in a checkout with changed files."""

from __future__ import annotations

import functools
import hashlib
from collections.abc import Iterator
from pathlib import Path

from haselab import __version__

__all__ = ["source_digest"]

_PACKAGE = Path(__file__).resolve().parents[1]
_ROOT = _PACKAGE.parents[1]
_NOT_COMPUTING = {"cli", "panel", "report", "__pycache__"}  # nothing that computes imports them
_COMPILED = {".so", ".pyd", ".dll", ".pyc"}  # differ between computers with the same source


@functools.cache
def source_digest() -> str:
    """Release of haselab and a hash of the source files that a result can depend on.

    In a checkout, the C and C++ sources of the compiled modules are included.

    Returns:
        Such as `0.1.0+3f1c9a20b7d4`; the same for the same files on every computer.
    """
    digest = hashlib.sha256()
    for path in sorted(_files()):
        digest.update(path.relative_to(_ROOT).as_posix().encode() + b"\0")
        digest.update(hashlib.sha256(path.read_bytes()).digest())
    release = __version__.partition(".dev")[0]
    return f"{release}+{digest.hexdigest()[:12]}"


def _files() -> Iterator[Path]:
    folders = [each for each in _PACKAGE.iterdir() if each.name not in _NOT_COMPUTING]
    if (_ROOT / "CMakeLists.txt").is_file():
        folders += [_ROOT / "core", _ROOT / "native"]
    for folder in folders:
        for path in [folder] if folder.is_file() else folder.rglob("*"):
            if path.is_file() and path.suffix not in _COMPILED:
                yield path
