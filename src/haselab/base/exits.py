"""`sys.exit()` in code of other packages, which must not end a run or a check of this program."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

__all__ = ["SignalExit", "no_exit"]


class SignalExit(SystemExit):
    """A signal ends the program. It may be raised while code of another package runs."""


@contextlib.contextmanager
def no_exit() -> Iterator[None]:
    """Turn `sys.exit()` in code of another package into an error, like any other one there.

    Raises:
        RuntimeError: The code called `sys.exit()`.
    Example:
        >>> import sys
        >>> with no_exit():
        ...     sys.exit(0)
        Traceback (most recent call last):
            ...
        RuntimeError: it called sys.exit(0)
    """
    try:
        yield
    except SignalExit:
        raise
    except SystemExit as stop:
        raise RuntimeError(f"it called sys.exit({stop.code!r})") from stop
