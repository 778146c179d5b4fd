"""Keep code of other packages from ending this program, by `sys.exit()` for example."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Iterator

__all__ = ["SignalExit", "TooLongError", "exit_code_text", "no_exit"]


class SignalExit(SystemExit):
    """A signal ends the program. It may be raised while code of another package runs."""


class TooLongError(BaseException):
    """A call took longer than its limit. Not an `Exception`, so that few handlers catch it."""


@contextlib.contextmanager
def no_exit() -> Iterator[None]:
    """Turn `sys.exit()` in code of another package into an error, like any other one there.

    Exceptions that do not derive from `Exception` become an error, too, such as
    `asyncio.CancelledError` or a panic in an extension written in Rust. Ctrl-C still ends the
    program. Where it cannot be Ctrl-C, in another thread than the main one or in a program that
    ignores SIGINT, a `KeyboardInterrupt` becomes an error as well.

    Raises:
        RuntimeError: The code called `sys.exit()` or raised such an exception.
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
    except (SignalExit, TooLongError):
        raise
    except SystemExit as stop:
        raise RuntimeError(f"it called sys.exit({exit_code_text(stop)})") from stop
    except (Exception, GeneratorExit):
        raise
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt) and _may_be_signal():
            raise
        raise RuntimeError(f"it raised {type(error).__name__}") from error


def _may_be_signal() -> bool:
    is_main = threading.current_thread() is threading.main_thread()
    return is_main and signal.getsignal(signal.SIGINT) is not signal.SIG_IGN


def exit_code_text(stop: SystemExit) -> str:
    """Return the argument of `sys.exit()` as it was written, or its type if it is an object."""
    plain = stop.code is None or type(stop.code) in (int, str)
    return repr(stop.code) if plain else type(stop.code).__name__
