"""The files that a panel was started with."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

__all__ = ["PanelFiles"]


@dataclass(frozen=True)
class PanelFiles:
    """Files that a panel was started with.

    Args:
        rig: rig file.
        actuator: actuator file; None: there is none.
        runs: folder of recordings, for new ones too.
    """

    rig: Path
    actuator: Path | None
    runs: Path
