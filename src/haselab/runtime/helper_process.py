"""A helper process that does long computations for a real-time loop.

A call that holds Python's interpreter lock for some milliseconds delays every thread of its
process, including one that communicates with a board. So long, rare computations run elsewhere.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import pickle
import select
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from typing import IO, Any, BinaryIO, TypeVar

from haselab.base import DeviceError
from haselab.runtime.scheduling import lower_priority

__all__ = ["HelperProcess"]

_T = TypeVar("_T")
_END_S = 5.0
_PATIENCE_S = 30.0  # a search of one image takes a second; loading the modules takes a few more
_YIELDS = "--yields"


class HelperProcess:
    """Calls functions of modules in another process, one after the other.

    That process ends with this one, however this one ends.

    Args:
        modules: modules to load at once, so that the first call need not wait for them.
        patience_s: longest time of a call.
        yields: give it a lower priority than this process.
    Raises:
        DeviceError: The process cannot be started.
    Example:
        >>> import math
        >>> helper = HelperProcess(["math"])
        >>> helper.call(math.hypot, 3.0, 4.0)
        5.0
        >>> helper.close()
    """

    def __init__(
        self, modules: Sequence[str], patience_s: float = _PATIENCE_S, *, yields: bool = False
    ) -> None:
        self._patience_s = patience_s
        priority = [_YIELDS] if yields else []
        command = [sys.executable, "-m", __name__, *priority, *modules]
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0
            )
        except OSError as error:
            raise self._gone(error) from None

    def call(self, function: Callable[..., _T], *arguments: Any) -> _T:
        """Call a function there; return its result or raise its error. Other threads keep running.

        Args:
            function: of a module, not of a class or a function.
            arguments: anything that pickle supports, such as arrays.
        Raises:
            DeviceError: The process has ended or does not reply.
        """
        there, back = self._process.stdin, self._process.stdout
        assert there is not None and back is not None
        try:
            pickle.dump((function, arguments), there, pickle.HIGHEST_PROTOCOL)
            there.flush()
            self._wait_for(back)
            good, answer = pickle.load(back)
        except DeviceError:
            raise
        except (OSError, EOFError, ValueError, pickle.UnpicklingError) as error:
            raise self._gone(error) from None
        if not good:
            raise answer
        return answer  # type: ignore[no-any-return]

    def _wait_for(self, back: IO[bytes]) -> None:
        """Wait until a reply begins; none in time, as from a stopped process, is an error."""
        ready, _, _ = select.select([back], [], [], self._patience_s)
        if not ready:
            self._process.kill()
            raise DeviceError(
                f"The helper process that searches images has not replied for {self._patience_s:g} "
                "s and was ended. Close other programs, then run again."
            )

    @staticmethod
    def _gone(error: BaseException) -> DeviceError:
        return DeviceError(
            "The helper process of the real-time loop has ended "
            f"({error or type(error).__name__}). Free memory, then run again."
        )

    def close(self) -> None:
        """End the process. Never raises; safe to call twice."""
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                with contextlib.suppress(OSError):
                    stream.close()
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def _serve(come: BinaryIO, go: BinaryIO) -> None:
    while True:
        try:
            function, arguments = pickle.load(come)
        except EOFError:
            return
        try:
            answer = (True, function(*arguments))
        except Exception as error:
            answer = (False, error)
        pickle.dump(answer, go, pickle.HIGHEST_PROTOCOL)
        go.flush()


def _main(words: Sequence[str]) -> None:
    if yields := words[:1] == [_YIELDS]:
        lower_priority()
    # Ctrl-C is for the program, which ends this process
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    come, go = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # printed text must not get between two replies
    gc.disable()  # imports leave hardly anything to collect
    for name in words[yields:]:
        importlib.import_module(name)
    gc.freeze()  # the garbage collector need not look at them again
    gc.enable()
    with contextlib.suppress(BrokenPipeError):
        _serve(come, go)


if __name__ == "__main__":
    _main(sys.argv[1:])
