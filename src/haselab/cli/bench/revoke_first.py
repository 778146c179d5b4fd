"""Revoke the permission for `haselab rig safe` before anything large is imported.

This module imports the standard library and the interlock only. Drivers take seconds to import on
a slow computer, and a program may energise the bench until its permission is revoked.
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
    if file.get("kind") in ("chip", "mega"):  # as load_rig_to_shut_down
        return f"chip {Path(file['port']).resolve()}"
    if file["daq"].get("kind", "nidaq") != "nidaq":
        raise ValueError("the key of another driver is not known without importing it")
    return f"NI {int(file['daq']['serial_number'], 16):08X}"


def revoke_first(arguments: list[str]) -> bool:
    """Revoke the permission of the bench that `rig safe RIG.toml` names.

    The command itself revokes it again and reports errors.

    Args:
        arguments: of the command line.
    Returns:
        Whether it was revoked. It is not for another command or --help, or if the rig file cannot
        be read, has neither `daq.serial_number` nor `port`, or has another kind of board.
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
        except Exception:  # the command that follows reports what is wrong
            continue
        revoked = True
    if revoked:
        print("Permission revoked. Commanding 0 V on the instruments ...", file=sys.stderr)
    return revoked
