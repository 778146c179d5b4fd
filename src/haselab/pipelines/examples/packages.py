"""Example packages, which extend haselab: copies to start one's own from."""

from __future__ import annotations

import shutil
from pathlib import Path

from haselab.base import InputError

__all__ = ["PACKAGES", "write_package"]

#: Titles by the name of the package.
PACKAGES = {
    "haselab-mysupply": "Package of a driver: a high-voltage supply, with an emulator",
    "haselab-mycontroller": "Package of a controller, in Python and C",
    "haselab-myactuator": "Package of an actuator's law: a strip of elastomer",
    "haselab-myexperiment": "Package of an experiment with its fit: creep",
}


def write_package(name: str, folder: Path) -> list[Path]:
    """Copy an example package.

    Args:
        name: of `PACKAGES`.
        folder: an existing, empty folder.
    Returns:
        The files.
    Raises:
        InputError: This installation of haselab does not contain it.
    """
    from haselab.rig.chip import source_folder  # the import takes half a second

    source = source_folder() / "examples" / "plugins" / name
    if not source.is_dir():
        raise InputError(
            "This installation of haselab does not contain the example package. Install haselab "
            f"again. {source}"
        )
    unwanted = shutil.ignore_patterns("__pycache__", "build", "*.egg-info", ".*")
    shutil.copytree(source, folder, ignore=unwanted, dirs_exist_ok=True)
    return sorted(path for path in folder.rglob("*") if path.is_file())
