"""`python -m haselab.app.stand_by RIG.toml`: waits to make a bench safe; the guardian's hand.

Everything is loaded, and the board reached, before it says `ready`. At the line `safe` on stdin it
acts over connections of its own and exits with 0, or with what is wrong; at the end of stdin it
leaves without.
"""

from __future__ import annotations

import contextlib
import importlib
import sys
from pathlib import Path

from haselab.base import HaselabError
from haselab.rig.bench_config import BenchConfig
from haselab.rig.nidaq_link import NidaqLink
from haselab.rig.rig_file import load_rig
from haselab.rig.safe import make_safe

__all__ = ["main"]

_DRIVERS = ("pyvisa", "pymeasure.instruments.agilent", "serial")  # slow to load


def main(path: Path) -> str:
    """Wait, then act.

    Args:
        path: of the rig file.
    Returns:
        What is wrong; empty where the bench is safe, or nobody asked.
    """
    try:
        file = load_rig(path)
    except HaselabError as error:
        return str(error)
    if not isinstance(file, BenchConfig):
        return f"kind = {file.kind!r}, allowed is 'bench'. {path}"
    for name in _DRIVERS:
        with contextlib.suppress(ImportError):  # the driver that needs it will say so
            importlib.import_module(name)
    try:
        link = NidaqLink(file.daq)
    except HaselabError as error:
        return str(error)
    with contextlib.closing(link):
        print("ready", flush=True)
        if sys.stdin.readline().strip() != "safe":
            return ""
        with contextlib.suppress(HaselabError):  # by a new connection, then
            link.reset()
        return "; ".join(f"{name}: {fault}" for name, fault in make_safe(file) if fault)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])) or 0)
