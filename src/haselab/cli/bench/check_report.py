"""The report of `haselab rig check`: the results of all checks in one file to send."""

from __future__ import annotations

import datetime
import hashlib
import platform
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from haselab import __version__
from haselab.rig.checks import CheckResult
from haselab.store.folder import write_json

__all__ = ["write_check_report"]


def write_check_report(
    path: Path, rig: Path, checks: Sequence[CheckResult], *, finished: bool
) -> None:
    """Write the results of the checks, with all that a reader elsewhere needs.

    Args:
        path: of the JSON file.
        rig: the rig file that was checked.
        checks: in the order in which they were made.
        finished: all checks were made.
    Raises:
        DeviceError: the file cannot be written.
    """
    text = rig.read_bytes()
    write_json(
        path,
        {
            "haselab": __version__,
            "time": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "python": platform.python_version(),
            "system": platform.platform(),
            "rig": {"sha256": hashlib.sha256(text).hexdigest(), "text": text.decode()},
            "finished": finished,
            "passed": finished and all(each.passed for each in checks),
            "recommended": {k: v for each in checks for k, v in each.recommended.items()},
            "checks": [asdict(each) for each in checks],
        },
    )
