"""`haselab rig safe` revokes the permission before it imports anything large.

Standard library and the interlock only: drivers and their libraries take seconds to import on a
slow computer, and until the permission is revoked a program may go on energising the bench.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from typing import Any

from haselab.safety.interlock import Interlock

__all__ = ["REASON", "revoke_first"]

_MOST_DOTS = 2000  # a key of 20,000 parts would take the parser a minute
REASON = "'haselab rig safe' was called"


def _bench_key(file: dict[str, Any]) -> str:
    """The same as `DaqInstrument.key_of` and `chip.key_of_port`, without importing drivers."""
    if file.get("kind") == "mega":
        return f"chip {Path(file['port']).resolve()}"
    if file["daq"].get("kind", "nidaq") != "nidaq":
        raise ValueError("the key of another driver is not known without importing it")
    return f"NI {int(file['daq']['serial_number'], 16):08X}"


def revoke_first(arguments: list[str]) -> bool:
    """Revoke the permission of the bench that `rig safe RIG.toml` names.

    The command itself does it again, and reports what is wrong.

    Args:
        arguments: of the command line.
    Returns:
        Whether it was revoked: not for another command or a call for help, nor where the rig file
        cannot be read, has neither `daq.serial_number` nor `port`, or has another kind of board.
    """
    if arguments[:2] != ["rig", "safe"] or {"--help", "-h"} & set(arguments):
        return False
    revoked = False
    for name in arguments[2:]:
        path = Path(name)
        if path.suffix != ".toml" or not path.is_file():
            continue
        try:
            text = path.read_text()
            if text.count(".") > _MOST_DOTS:
                continue
            interlock = Interlock(_bench_key(tomllib.loads(text)))
            try:
                interlock.revoke(REASON)
            finally:
                interlock.close()
        except Exception:  # whatever is in the file: the command that follows says what is wrong
            continue
        revoked = True
    if revoked:
        print("Permission revoked. Now taking the instruments to 0 V ...", file=sys.stderr)
    return revoked
