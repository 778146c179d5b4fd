"""Unpack a source distribution so that only changed files are compiled again."""

from __future__ import annotations

import shutil
import tarfile
from pathlib import Path

__all__ = ["unpack"]


def unpack(archive: Path, folder: Path) -> Path:
    """Update a folder to the contents of an archive, and leave equal files untouched.

    Args:
        archive: source distribution.
        folder: for the files, without the archive's top folder.
    Returns:
        The folder.
    """
    fresh = folder.with_name(folder.name + "-new")
    shutil.rmtree(fresh, ignore_errors=True)
    with tarfile.open(archive) as opened:
        opened.extractall(fresh, filter="data")
    top = next(fresh.iterdir())
    new = {path.relative_to(top): path for path in top.rglob("*") if path.is_file()}
    for old in [path for path in folder.rglob("*") if path.is_file()]:
        if old.relative_to(folder) not in new:
            old.unlink()
    for name, path in new.items():
        target = folder / name
        if not target.is_file() or target.read_bytes() != path.read_bytes():
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)  # with the current time, so that it is compiled again
    shutil.rmtree(fresh)
    return folder
