"""A process that computes for a loop in real time: the loop keeps its interpreter to itself.

A call that holds Python's interpreter lock for some milliseconds holds up every thread of its
process, also one that talks to a board. So what is long and seldom is done elsewhere.
"""

from __future__ import annotations

import contextlib
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
from haselab.runtime.scheduling import step_back

__all__ = ["SideProcess"]

_T = TypeVar("_T")
_END_S = 5.0
_PATIENCE_S = 30.0  # a search of one picture takes a second; loading the modules some more


class SideProcess:
    """Calls functions of modules in a process of its own, one after the other.

    It ends with this process, however that ends.

    Args:
        modules: that it loads at once, so that the first call need not wait for that.
    Raises:
        DeviceError: it cannot be started.
    Example:
        >>> import math
        >>> aside = SideProcess(["math"])
        >>> aside.call(math.hypot, 3.0, 4.0)
        5.0
        >>> aside.close()
    """

    def __init__(self, modules: Sequence[str]) -> None:
        self._patience_s = _PATIENCE_S
        command = [sys.executable, "-m", __name__, *modules]
        try:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
            )
        except OSError as error:
            raise self._gone(error) from None

    def call(self, function: Callable[..., _T], *arguments: Any) -> _T:
        """Its result, or what it raised. Other threads run meanwhile.

        Args:
            function: of a module, not of a class or a function.
            arguments: that pickle can carry, arrays among them.
        Raises:
            DeviceError: the process is gone.
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
        """Until an answer begins; one that never comes, as from a stopped process, is an error."""
        ready, _, _ = select.select([back], [], [], self._patience_s)
        if not ready:
            self._process.kill()
            raise DeviceError(
                f"The process that searches pictures has not answered for {self._patience_s:g} s "
                "and was ended. Free memory and processor time, then run again."
            )

    @staticmethod
    def _gone(error: BaseException) -> DeviceError:
        return DeviceError(
            "The process that helps a loop in real time is gone "
            f"({error or type(error).__name__}). Free memory and run again."
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


def _main() -> None:
    step_back()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the program, which ends this one
    come, go = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever prints must not come between two answers
    for name in sys.argv[1:]:
        importlib.import_module(name)
    with contextlib.suppress(BrokenPipeError):
        _serve(come, go)


if __name__ == "__main__":
    _main()
