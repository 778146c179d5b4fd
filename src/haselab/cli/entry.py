"""Entry point of the console script: Ctrl-C ends it with code 130 and at most one line."""

from __future__ import annotations

try:
    import gc
    import os
    import signal
    import sys
    import threading
    import time
    from types import FrameType
except KeyboardInterrupt:
    raise SystemExit(130) from None

# The matrices of a command are small: more threads in the linear algebra would only cost time.
for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

__all__ = ["StartUp", "main"]

_INTERRUPTED = 130
_REPEAT_S = 1.0  # a signal this soon after another one does not interrupt the clean-up
_AGAIN_S = 0.05
_COLLECT_AFTER = 50_000  # new objects


def _leave() -> None:
    """End at once: nothing has been opened or written yet."""
    try:
        os.write(2, b"haselab: Interrupted.\n")
    finally:
        os._exit(_INTERRUPTED)


def _ask_main_thread() -> None:
    """Send the main thread SIGINT, which also ends a system call in which it waits."""
    if sys.platform == "win32":
        signal.raise_signal(signal.SIGINT)
    else:
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)


class StartUp:
    """Handles Ctrl-C before, during and after a command.

    While modules are imported it ends the process at once: an interrupted import can fail with any
    error, or not at all. Once a command runs it raises `KeyboardInterrupt`, but not again within
    1 s, so that a second Ctrl-C does not interrupt the clean-up of the first. Python drops an
    exception that is raised inside a finaliser; it is then raised again a little later.
    """

    def __init__(self) -> None:
        gc.disable()  # imports leave hardly anything to collect: an eighth of their time
        self._importing = True
        self._last_s = float("-inf")
        self._unraisable = sys.unraisablehook
        # nohup, and a shell that starts a command in the background, ignore the signal.
        if signal.getsignal(signal.SIGINT) is not signal.SIG_IGN:
            signal.signal(signal.SIGINT, self._ask)
            sys.unraisablehook = self._dropped

    def _ask(self, number: int, frame: FrameType | None) -> None:
        if self._importing:
            _leave()
        now_s = time.monotonic()
        if now_s - self._last_s >= _REPEAT_S:
            self._last_s = now_s
            raise KeyboardInterrupt

    def _dropped(self, what: sys.UnraisableHookArgs) -> None:
        if not issubclass(what.exc_type, KeyboardInterrupt):
            self._unraisable(what)
            return
        self._last_s = float("-inf")
        again = threading.Timer(_AGAIN_S, _ask_main_thread)
        again.daemon = True
        again.start()

    def imported(self) -> None:
        """Note that all modules are imported: from now on there may be something to clean up."""
        gc.freeze()  # the garbage collector need not look at what the imports left, again and again
        gc.set_threshold(_COLLECT_AFTER)  # reference counts free nearly everything
        gc.enable()
        self._importing = False

    def finished(self) -> None:
        """Note that the command is over: ignore further signals."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def main() -> None:
    """Run the command line; the entry point of the console script."""
    try:
        start_up = StartUp()
        from haselab.cli.main import end_despite_threads
        from haselab.cli.main import main as run_command

        try:
            run_command(on_command=start_up.imported)
        except SystemExit as stop:
            start_up.finished()
            end_despite_threads(stop)
            raise
        finally:
            start_up.finished()
    except KeyboardInterrupt:
        _leave()
