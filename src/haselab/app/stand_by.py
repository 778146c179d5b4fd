"""`python -m haselab.app.stand_by RIG.toml`: waits to make a bench safe; the guardian's hand.

Everything is loaded, and the board reached, before it says `ready`. At the line `safe` on stdin it
acts over connections of its own and exits with 0, or with what is wrong. The end of stdin without a
word means that the guardian itself was killed, perhaps together with the program: it acts too. A
guardian that is not needed any more ends it by a signal.
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
from haselab.safety.make_safe import make_safe

__all__ = ["main"]

_DRIVERS = ("pyvisa", "pyvisa_py", "pymeasure.instruments.agilent", "serial")  # slow to load


def main(path: Path) -> str:
    """Wait, then act.

    Args:
        path: of the rig file.
    Returns:
        What is wrong; empty where the bench is safe.
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
        sys.stdin.readline()
        return "; ".join(f"{name}: {fault}" for name, fault in make_safe(file, link) if fault)


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])) or 0)
