"""Priorities of processes, and the number of their threads for linear algebra."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator

__all__ = ["lower_priority", "one_thread", "with_priority"]

_NICENESS = -10
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMEXPR_NUM_THREADS")
_SWITCH_S = 0.5e-3  # Python's default of 5 ms is half a block


@contextlib.contextmanager
def with_priority() -> Iterator[bool]:
    """Raise the priority of this process, and let its threads switch faster.

    Yields:
        Whether the system allowed the higher priority; on Linux this needs root or CAP_SYS_NICE.
    Example:
        >>> with with_priority():
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


def lower_priority() -> None:
    """Lower the priority of this process below that of the other processes of its session.

    Linux shares the processor among sessions first (autogroup), whatever their priorities, so a
    process that lowers its own must not be started in a session of its own.
    """
    _set_niceness(max(_niceness(), -_NICENESS))


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Give the processes that are started here one thread for linear algebra.

    The number is fixed when numpy is imported, so it has to be in their environment.
    """
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _niceness() -> int:
    return os.getpriority(os.PRIO_PROCESS, 0) if hasattr(os, "getpriority") else 0


def _set_niceness(value: int) -> bool:
    """Set the niceness of this thread and of those that it starts; return whether it worked."""
    try:
        os.setpriority(os.PRIO_PROCESS, 0, value)
    except (AttributeError, OSError):
        return False
    return True
