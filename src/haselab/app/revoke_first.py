"""`haselab rig safe` revokes the permission before it imports anything large.

Standard library and the interlock only: drivers and their libraries take seconds to import on a
slow computer, and until the permission is revoked a program may go on energising the bench.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

from haselab.safety.interlock import Interlock

__all__ = ["REASON", "revoke_first"]

REASON = "'haselab rig safe' was called"


def revoke_first(arguments: list[str]) -> bool:
    """Revoke the permission of the bench that `rig safe RIG.toml` names, if its file tells enough.

    The command itself does it again, and reports what is wrong.

    Args:
        arguments: of the command line.
    Returns:
        Whether it was revoked: not for another command or a call for help, nor where the rig file
        cannot be read or has no `daq.serial_number`.
    """
    if arguments[:2] != ["rig", "safe"] or {"--help", "-h"} & set(arguments):
        return False
    revoked = False
    for name in arguments[2:]:
        path = Path(name)
        if path.suffix != ".toml" or not path.is_file():
            continue
        try:
            serial = tomllib.loads(path.read_text())["daq"]["serial_number"]
            interlock = Interlock(f"NI {int(serial, 16):08X}")
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
