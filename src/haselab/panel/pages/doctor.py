"""The examination of this computer and its bench for the panel: `haselab doctor` in a process."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

from haselab.base import DeviceError, JsonObject
from haselab.rig.rig_file import TwinFile, load_rig

__all__ = ["examine"]

_LONGEST_S = 60.0


def examine(rig: Path) -> JsonObject:
    """Run `haselab doctor`; a driver that hangs cannot hold up the panel.

    The instruments of a real bench are in use by the panel, so they are not opened again.

    Args:
        rig: rig file of the panel.
    Returns:
        The JSON document of `haselab doctor`, and `in_use`: whether instruments were left out.
    Raises:
        DeviceError: It did not end in time, or printed no result.
    """
    in_use = not isinstance(load_rig(rig), TwinFile)
    words = ["doctor", "--json", *([] if in_use else ["--rig", str(rig)])]
    command = [sys.executable, "-m", "haselab.cli", *words]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=_LONGEST_S, check=False
        )
        return {**json.loads(done.stdout), "in_use": in_use}
    except subprocess.TimeoutExpired:
        reason = f"it did not end within {_LONGEST_S:g} s"
    except ValueError:
        reason = " ".join(done.stderr.split()) or f"exit code {done.returncode}"
    raise DeviceError(f"haselab doctor failed: {reason}. Run it in a terminal.")
