"""A loop in real time comes first: before other programs where that is allowed, and in Python."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator

__all__ = ["favoured", "step_back"]

_NICENESS = -10
_SWITCH_S = 0.5e-3  # Python's own 5 ms are half a block


@contextlib.contextmanager
def favoured() -> Iterator[bool]:
    """This process before others, and a thread that wakes up soon in it.

    Yields:
        Whether the system allowed the first; on Linux that takes root or CAP_SYS_NICE.
    Example:
        >>> with favoured():
        ...     sys.getswitchinterval()
        0.0005
    """
    switch_s, before = sys.getswitchinterval(), _niceness()
    sys.setswitchinterval(_SWITCH_S)
    try:
        yield _set_niceness(min(before, _NICENESS))
    finally:
        sys.setswitchinterval(switch_s)
        _set_niceness(before)


def step_back() -> None:
    """This process after others."""
    _set_niceness(max(_niceness(), -_NICENESS))


def _niceness() -> int:
    return os.getpriority(os.PRIO_PROCESS, 0) if hasattr(os, "getpriority") else 0


def _set_niceness(value: int) -> bool:
    """Of this thread, and of those that it starts."""
    try:
        os.setpriority(os.PRIO_PROCESS, 0, value)
    except (AttributeError, OSError):
        return False
    return True
