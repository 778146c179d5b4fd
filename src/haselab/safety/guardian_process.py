"""The guardian: a small process of its own that makes a bench safe when its program is gone.

Run as a script (`python -I -S guardian_process.py`): the standard library only, so that it starts
in a moment and nothing of the program can take it down. One line of JSON on stdin says which hands
it has; then come `renew SECONDS`, `safe REASON` or `bye`. The end of stdin, another parent, or a
lease that has run out means that the program is gone: every hand acts, what it did goes to the log.
On stdout: `ready`; `ok` for each lease; `lost WHY` when a hand has gone; `acting` before the hands,
after them `acted REASON`, or `tried REASON: FAULTS` where one does not confirm that its part is
safe.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import queue
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Any, Protocol

__all__ = ["OutputFile", "main", "tell"]

_TICK_S = 0.05  # between two looks at the parent
_TRIALS = 3
_ANSWER_S = 0.3
_LETTERS = 400  # of what a command says


class OutputFile:
    """An output that outlives its program: a file of one number, in V, shared by all who open it.

    Args:
        path: of the file; made if it is not there.
    """

    def __init__(self, path: str) -> None:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        try:
            if os.fstat(handle).st_size < 8:
                os.ftruncate(handle, 8)
            self._map = mmap.mmap(handle, 8)
        finally:
            os.close(handle)

    def write(self, voltage_v: float) -> None:
        """Put out a voltage."""
        self._map[:] = struct.pack("<d", voltage_v)

    def read(self) -> float:
        """What is put out, in V."""
        return float(struct.unpack("<d", self._map[:])[0])

    def close(self) -> None:
        """Let go of the file; the output stays."""
        self._map.close()


class _Hand(Protocol):
    def act(self) -> str:
        """Make safe; what the instrument answered."""


class _FileHand:
    """0 V into an output file."""

    def __init__(self, given: dict[str, Any]) -> None:
        self._file = OutputFile(given["path"])

    def act(self) -> str:
        """0 V."""
        self._file.write(0.0)
        return f"{self._file.read():g}"


class _TextHand:
    """Lines of text to an instrument, then a question whose answer tells that it is off."""

    def __init__(self, given: dict[str, Any]) -> None:
        self._given = given
        self._end = given["end"].encode()
        self._open()

    def act(self) -> str:
        """All lines, then the question."""
        for trial in range(_TRIALS):
            try:
                if trial:
                    self._open()
                for line in self._given["send"]:
                    self._put(line.encode() + self._end)
                answer = self._ask()
            except OSError as error:
                answer = f"{type(error).__name__}: {error}"
            if not self._given["query"] or answer == self._given["expect"]:
                return answer
        raise OSError(f"answered {answer!r}, expected {self._given['expect']!r}")

    def _ask(self) -> str:
        """The answer to the question; lines that were meant for the program come before it."""
        if not self._given["query"]:
            return "sent"
        self._put(self._given["query"].encode() + self._end)
        until, text = time.monotonic() + _ANSWER_S, b""
        lines: list[str] = []
        while time.monotonic() < until and self._given["expect"] not in lines:
            text += self._get()
            lines = [line.strip() for line in text.decode(errors="replace").splitlines()]
        kept = [line for line in lines if line]
        return self._given["expect"] if self._given["expect"] in kept else "".join(kept[-1:])

    def _open(self) -> None:
        raise NotImplementedError

    def _put(self, data: bytes) -> None:
        raise NotImplementedError

    def _get(self) -> bytes:
        raise NotImplementedError


class _TcpHand(_TextHand):
    """An instrument on a socket."""

    def _open(self) -> None:
        address = (self._given["host"], self._given["port"])
        self._socket = socket.create_connection(address, timeout=_ANSWER_S)

    def _put(self, data: bytes) -> None:
        self._socket.sendall(data)

    def _get(self) -> bytes:
        data = self._socket.recv(4096)
        if not data:
            raise ConnectionResetError("closed by the instrument")
        return data


class _SerialHand(_TextHand):
    """An instrument on a serial line, 8N1."""

    def _open(self) -> None:
        import termios  # not on Windows

        self._line = os.open(self._given["port"], os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        mode = termios.tcgetattr(self._line)
        speed = getattr(termios, f"B{self._given['baud']}")
        mode[0], mode[1], mode[3] = 0, 0, 0
        mode[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
        mode[4] = mode[5] = speed
        termios.tcsetattr(self._line, termios.TCSANOW, mode)

    def _put(self, data: bytes) -> None:
        while data:
            data = data[os.write(self._line, data) :]

    def _get(self) -> bytes:
        try:
            return os.read(self._line, 4096)
        except BlockingIOError:
            time.sleep(0.002)
            return b""


class _CommandHand:
    """A command that makes the bench safe and exits with 0.

    One that waits is started at once, says `ready` when its connections stand, and acts at the next
    line: what takes it seconds to load is over by then. If it has gone meanwhile, or fails, another
    one is run from the start.
    """

    def __init__(self, given: dict[str, Any]) -> None:
        self._command = list(given["command"])
        self._timeout_s = float(given["timeout_s"])
        self._waiting: subprocess.Popen[str] | None = None
        if given["waits"]:
            self._waiting = self._start()
            assert self._waiting.stdout is not None
            word = self._waiting.stdout.readline().strip()
            if word != "ready":
                raise OSError(f"{self._command[0]} said {word!r}, expected 'ready'")

    def act(self) -> str:
        """Tell the one that waits; if it is gone, run it from the start."""
        process = self._waiting
        if process is not None:
            try:
                return self._tell(process)
            except OSError:
                acted = process.returncode is not None and process.returncode >= 0
                if acted:  # and it has said what is wrong
                    raise
        return self._tell(self._start())

    def _tell(self, process: subprocess.Popen[str]) -> str:
        try:
            told = process.communicate("safe\n", timeout=self._timeout_s)[0]
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            raise OSError(f"no end within {self._timeout_s:g} s") from None
        if process.returncode:
            words = told.strip().splitlines()[-1:]
            raise OSError(f"exit code {process.returncode}: {' '.join(words)[:_LETTERS]}")
        return "done"

    def lost(self) -> str:
        """Why the one that waits is not there any more; empty while it waits."""
        if self._waiting is None or self._waiting.poll() is None:
            return ""
        return f"{self._command[0]} ended with exit code {self._waiting.returncode}"

    def leave(self) -> None:
        """End the one that waits."""
        if self._waiting is not None:
            self._waiting.kill()
            self._waiting.wait()

    def _start(self) -> subprocess.Popen[str]:
        return subprocess.Popen(
            self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip


_HANDS: dict[str, Callable[[dict[str, Any]], _Hand]] = {
    "file": _FileHand,
    "tcp": _TcpHand,
    "serial": _SerialHand,
    "command": _CommandHand,
}


class _Guardian:
    """Waits for words from the program, or for their end."""

    def __init__(self, order: dict[str, Any]) -> None:
        self._log = order["log"]
        self._parent = os.getppid()
        self._hands = [(hand["kind"], _HANDS[hand["kind"]](hand)) for hand in order["hands"]]
        self._words: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._until_s = time.monotonic() + float(order["lease_s"])
        self._lease_s = float(order["lease_s"])

    def watch(self) -> None:
        """Until the program says good-bye, or is gone."""
        threading.Thread(target=self._listen, daemon=True).start()
        tell("ready")
        reason = lost = ""
        while not reason:
            if not lost and (lost := self._lost()):
                tell(f"lost {lost}")
            try:
                word = self._words.get(timeout=_TICK_S)
            except queue.Empty:
                reason = self._silence()
                continue
            if word == "bye":
                self._leave()
                return
            reason = self._heard(word)
        self._act(reason)

    def ended(self, number: int, frame: FrameType | None) -> None:
        """Someone ends the guardian: the bench is not left alone."""
        del frame
        self._words.put(f"safe the guardian got {signal.Signals(number).name}")

    def _listen(self) -> None:
        for line in sys.stdin:
            self._words.put(line.strip())
        self._words.put(None)

    def _silence(self) -> str:
        if os.getppid() != self._parent:
            return "the program is gone"
        late_s = time.monotonic() - self._until_s
        return f"no sign of life for {late_s + self._lease_s:.2g} s" if late_s > 0.0 else ""

    def _heard(self, word: str | None) -> str:
        if word is None:
            return "the program is gone"
        verb, _, rest = word.partition(" ")
        if verb == "renew":
            self._lease_s = float(rest)
            self._until_s = time.monotonic() + self._lease_s
            tell("ok")
            return ""
        return rest or "asked"

    def _lost(self) -> str:
        """A hand that has gone; the program is told, and goes to 0 V while it still can."""
        told = (hand.lost() for _, hand in self._hands if isinstance(hand, _CommandHand))
        return next((why for why in told if why), "")

    def _leave(self) -> None:
        """Whoever waits to act ends without."""
        for _, hand in self._hands:
            if isinstance(hand, _CommandHand):
                hand.leave()

    def _act(self, reason: str) -> None:
        tell("acting")
        begun_s, acts = time.monotonic(), []
        for kind, hand in self._hands:
            try:
                acts.append({"hand": kind, "answer": hand.act(), "safe": True})
            except Exception as error:  # the next hand has to act, whatever this one did
                acts.append({"hand": kind, "answer": f"{error}", "safe": False})
        record = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "reason": reason,
            "duration_s": round(time.monotonic() - begun_s, 4),
            "hands": acts,
        }
        log = os.open(self._log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        os.write(log, (json.dumps(record) + "\n").encode())
        os.close(log)
        faults = [f"{act['hand']}: {act['answer']}" for act in acts if not act["safe"]]
        told = f"tried {reason}: {'; '.join(faults)}" if faults else f"acted {reason}"
        tell(" ".join(told.split()))


def tell(word: str) -> None:
    """One line to the program, which may be gone."""
    with contextlib.suppress(OSError):
        print(word, flush=True)


def main() -> None:
    """Take the order, then watch."""
    for name in ("SIGINT", "SIGHUP", "SIGPIPE"):  # they are meant for the program
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    try:
        guardian = _Guardian(json.loads(sys.stdin.readline()))
    except (OSError, ValueError, KeyError, ImportError) as error:
        tell(f"failed {' '.join(str(error).split())}")
        return
    signal.signal(signal.SIGTERM, guardian.ended)
    guardian.watch()


if __name__ == "__main__":
    main()
