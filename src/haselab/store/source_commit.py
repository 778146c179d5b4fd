"""The commit that runs, where haselab is used from a checkout of its repository."""

from __future__ import annotations

import functools
import subprocess
from pathlib import Path

__all__ = ["source_commit"]

_WITHIN_S = 5.0


@functools.cache
def source_commit() -> str:
    """The commit of the source, with "-dirty" where files were changed since.

    Returns:
        Its abbreviated hash; empty for an installed package, or without git.
    """
    root = Path(__file__).resolve().parents[3]
    if not (root / ".git").exists():
        return ""
    line = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        done = subprocess.run(
            line, capture_output=True, text=True, check=False, timeout=_WITHIN_S,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
