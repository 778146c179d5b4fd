"""The program's side of the guardian: starts it, gives signs of life, hears when it is lost."""

from __future__ import annotations

import contextlib
import json
import os
import select
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import ClassVar, Self

from haselab.base import DeviceError
from haselab.safety import guardian_process

__all__ = ["UNARMED_S", "CommandHand", "FileHand", "Guardian", "Hand", "SerialHand", "TcpHand"]

UNARMED_S = 86400.0  # a person may take so long until the bench is armed
_START_S = 20.0  # a loaded machine takes seconds to start a process and its waiting command
_BYE_S = 2.0
_TEXT_HAND_S = 2.0  # longest that a hand of lines of text takes
_EVERY_S = 0.05  # between two leases
_ANSWER_S = 2.0  # a guardian that is silent for longer is lost


@dataclass(frozen=True)
class FileHand:
    """0 V into an output file (`OutputFile`), which stands for the output of the twin.

    Args:
        path: of the file.
    """

    kind: ClassVar[str] = "file"
    path: str


@dataclass(frozen=True)
class TcpHand:
    """Lines of text to an instrument on a socket.

    Args:
        host: its address.
        port: its port.
        send: what makes it safe.
        query: asked afterwards; none if empty.
        expect: the answer that tells that it is safe.
        end: of each line.
    """

    kind: ClassVar[str] = "tcp"
    host: str
    port: int
    send: tuple[str, ...]
    query: str = ""
    expect: str = ""
    end: str = "\n"


@dataclass(frozen=True)
class SerialHand:
    """Lines of text to an instrument on a serial line.

    Args:
        port: its device file.
        send: what makes it safe.
        query: asked afterwards; none if empty.
        expect: the answer that tells that it is safe.
        baud: of the line.
        end: of each line.
    """

    kind: ClassVar[str] = "serial"
    port: str
    send: tuple[str, ...]
    query: str = ""
    expect: str = ""
    baud: int = 115200
    end: str = "\r"


@dataclass(frozen=True)
class CommandHand:
    """A command that makes the bench safe and exits with 0.

    Args:
        command: with its arguments.
        timeout_s: after which it counts as failed.
        waits: it is started at once, prints `ready` and acts at the first line on stdin.
    """

    kind: ClassVar[str] = "command"
    command: tuple[str, ...]
    timeout_s: float = 5.0
    waits: bool = False


Hand = FileHand | TcpHand | SerialHand | CommandHand


class Guardian:
    """An independent process that makes the bench safe when this one is gone.

    It acts within 50 ms of the end of this process, whatever ended it, and when a lease runs out.
    Use as a context: the end of the context is a good-bye, upon which it does nothing.

    Args:
        hands: its own ways to make the bench safe, used in this order.
        log: what it did is added to this file, one line of JSON each time.
        lease_s: how long this process may be silent at first; its end is seen at once in any case.
        clock: monotonic, in s.
    """

    def __init__(
        self,
        hands: Sequence[Hand],
        log: Path,
        *,
        lease_s: float = UNARMED_S,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._order = {
            "hands": [{"kind": hand.kind, **asdict(hand)} for hand in hands],
            "log": str(log),
            "lease_s": lease_s,
        }
        self._log, self._clock = log, clock
        self._process: subprocess.Popen[bytes] | None = None
        self._heard = b""
        self._asked_s = self._until_s = -_EVERY_S
        self._open = 0  # leases that were not answered yet
        self._open_s = 0.0  # since when
        self._acting = self._done = False  # its hands are at work; were at work
        self._acted = ""  # why it does not watch any more; empty while it does
        self._fault = ""  # of what it did
        self._acts_s = 1.0 + sum(getattr(hand, "timeout_s", _TEXT_HAND_S) for hand in hands)

    @property
    def pid(self) -> int:
        """Of the process; 0 when there is none."""
        return self._process.pid if self._process is not None else 0

    def start(self) -> None:
        """Start the process and wait until its hands are ready.

        Raises:
            DeviceError: it does not start, or a hand does not reach its instrument.
        """
        self._log.parent.mkdir(parents=True, exist_ok=True)
        script = str(Path(guardian_process.__file__))
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
        self._say(json.dumps(self._order))
        until_s = self._clock() + _START_S
        while (word := self._next(until_s - self._clock())) is None and self._clock() < until_s:
            pass
        if word != "ready":
            self.close()
            why = (word or "no answer").removeprefix("failed ")
            raise DeviceError(
                f"The guardian is not ready ({why}); nothing is energised without it. Check the "
                "hands in the rig file."
            )
        os.set_blocking(self._out, False)

    def renew(self, for_s: float) -> None:
        """A sign of life, and how long the next one may take.

        Leases are sent every 50 ms at most, unless the new one ends at quite another time.

        Args:
            for_s: until the next sign, in s.
        """
        now_s = self._clock()
        other = abs(now_s + for_s - self._until_s) > 1.0
        if now_s - self._asked_s < _EVERY_S and not other:
            return
        if self._say(f"renew {for_s:.3f}"):
            self._open_s = self._open_s if self._open else now_s
            self._open += 1
            self._asked_s, self._until_s = now_s, now_s + for_s

    def lost(self) -> str:
        """Why there is no guardian any more, or what it did; empty while it watches."""
        if self._process is None:
            return "The guardian was not started."
        while (word := self._next(0.0)) is not None:
            self._hear(word)
        if self._acted:
            return self._acted
        if self._process.poll() is not None:
            return f"The guardian is lost (exit code {self._process.returncode})."
        silent_s = self._clock() - self._open_s
        if self._open and silent_s > _ANSWER_S:
            return f"The guardian has not answered for {silent_s:.2g} s."
        return ""

    def _hear(self, word: str) -> None:
        verb, _, rest = word.partition(" ")
        if verb == "ok":
            self._open -= 1
            self._open_s = self._clock()
        elif verb == "acting":
            self._acting = True
        elif verb == "acted":
            self._done = True
            self._acted = f"The guardian made the bench safe: {rest}."
        elif verb == "tried":
            self._done, self._fault = True, rest
            self._acted = f"The guardian could not make the bench safe ({rest})."
        elif verb == "lost":
            self._acted = self._acted or f"A hand of the guardian is lost ({rest})."

    def make_safe(self, reason: str) -> None:
        """Ask it to act now. Never raises.

        Args:
            reason: for its log.
        """
        self._acting = self._say(f"safe {' '.join(reason.split())}") or self._acting

    def outcome(self) -> str:
        """Wait for what came of `make_safe`, for as long as its hands may take. Never raises.

        Returns:
            Why the bench is not known to be safe; empty if every hand has confirmed that it is.
        """
        if self._process is None:
            return "no guardian was started"
        until_s = self._clock() + self._acts_s
        while not self._done and self._clock() < until_s:
            word = self._next(until_s - self._clock())
            if word is not None:
                self._hear(word)
            elif self._process.poll() is not None:
                return f"the guardian is lost (exit code {self._process.returncode})"
        if not self._done:
            return f"the guardian did not say within {self._acts_s:g} s what it has done"
        return self._fault

    def close(self) -> None:
        """Good-bye: it ends and does nothing; hands at work are waited for. Never raises.

        Safe to call twice.
        """
        if self._process is None:
            return
        self.lost()  # hears what it has said
        if self._acting:
            self.outcome()
        process, self._process = self._process, None
        assert process.stdin is not None and process.stdout is not None
        with contextlib.suppress(OSError):  # it is gone already
            process.stdin.write(b"bye\n")
            process.stdin.flush()
        try:
            process.wait(_BYE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        for pipe in (process.stdin, process.stdout):
            with contextlib.suppress(OSError):  # what was left to write had no reader
                pipe.close()

    @property
    def _out(self) -> int:
        assert self._process is not None and self._process.stdout is not None
        return self._process.stdout.fileno()

    def _say(self, line: str) -> bool:
        if self._process is None or self._process.stdin is None:
            return False
        try:
            self._process.stdin.write(line.encode() + b"\n")
            self._process.stdin.flush()
        except OSError:
            return False  # `lost` tells
        return True

    def _next(self, wait_s: float) -> str | None:
        """The next word of the guardian; None where there is none in time."""
        if b"\n" not in self._heard:
            ready, _, _ = select.select([self._out], [], [], max(0.0, wait_s))
            self._heard += os.read(self._out, 4096) if ready else b""
        if b"\n" not in self._heard:
            return None
        line, _, self._heard = self._heard.partition(b"\n")
        return line.decode()

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
