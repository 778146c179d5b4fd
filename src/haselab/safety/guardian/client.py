"""Start the two guardian processes from the program and notice when one of them is lost."""

from __future__ import annotations

import contextlib
import os
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Self

from haselab.base import DeviceError
from haselab.safety.guardian.heartbeat import SILENT_S, Heartbeat
from haselab.safety.interlock import HEARTBEATS, Interlock

__all__ = ["UNARMED_S", "Guardians", "guardian_command"]

UNARMED_S = 86400.0  # longest time until a person arms the bench
_START_S = 60.0  # drivers need seconds to load on a busy computer
_BYE_S = 2.0
_ACT_S = 12.0  # three instruments over a network, each tried twice
_EVERY_S = 0.05  # between two checks of their pipes


def guardian_command(path: Path) -> tuple[str, ...]:
    """Return the command that starts a guardian of a real bench, without slot and log.

    Args:
        path: of the rig file.
    """
    return (sys.executable, "-m", "haselab.safety.guardian.process", str(path.resolve()))


class _Process:
    """One guardian process."""

    def __init__(self, command: Sequence[str], slot: int) -> None:
        self.slot = slot
        self.name = f"Guardian {slot + 1}"
        self.result = ""  # what it did, once it has acted
        self.fault = ""
        self.acting = False
        self.first: str | None = None  # line of output, whether it watches the bench
        self.pid = 0  # known once it is ready
        self._program = os.getpid()
        self._heard = b""
        self._reading = threading.Lock()  # STOP may wait for the result while this one starts
        self._heartbeat = Heartbeat()
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            start_new_session=True,
        )  # fmt: skip

    def is_ready(self, key: str) -> bool:
        """Whether its first line confirms that it watches this bench."""
        verb, _, rest = (self.first or "").partition(" ")
        pid, _, named = rest.partition(" ")
        self.pid = int(pid) if pid.isdecimal() else 0
        return (verb, named) == ("ready", key)

    @property
    def out(self) -> int:
        """File descriptor of its output."""
        assert self.process.stdout is not None
        return self.process.stdout.fileno()

    def send(self, line: str) -> None:
        """Send it one line; if it has ended, `lost` reports it. A fork sends nothing."""
        if os.getpid() != self._program:
            return
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            os.write(self.process.stdin.fileno(), line.encode() + b"\n")

    def _next_line(self) -> str | None:
        """Return its next line of output, or None if there is none yet."""
        if b"\n" not in self._heard:
            ready, _, _ = select.select([self.out], [], [], 0.0)
            self._heard += os.read(self.out, 4096) if ready else b""
        if b"\n" not in self._heard:
            return None
        line, _, self._heard = self._heard.partition(b"\n")
        return line.decode(errors="replace")

    def receive(self) -> None:
        """Read its output so far."""
        with self._reading:
            while (word := self._next_line()) is not None:
                if self.first is None:
                    self.first = word
                    continue
                verb, _, rest = word.partition(" ")
                self.acting = True
                if verb == "acted":
                    self.result = f"{self.name} took the bench to 0 V: {rest}."
                elif verb == "tried":
                    self.result = f"{self.name} could not take the bench to 0 V ({rest})."
                    self.fault = rest

    def lost(self, beats: int, now_s: float) -> str:
        """Why it no longer watches the bench; empty while it does."""
        silent_s = self._heartbeat.silent_s(beats, now_s)
        if self.result:
            return self.result
        if silent_s > SILENT_S:
            return (
                f"{self.name} (process {self.pid}) has not responded for {silent_s:.2g} s. "
                "Close other programs, then run the command again."
            )
        return ""

    def works(self) -> bool:
        """Whether it may still report a result."""
        ended = self.process.poll() is not None
        self.receive()
        return not (self.result or ended)

    def close(self) -> None:
        """Wait until it ends after `bye`; kill it if it does not."""
        if os.getpid() != self._program:
            return
        try:
            self.process.wait(_BYE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):  # nothing reads what was left to write
                    pipe.close()


class Guardians:
    """Two independent processes that make the bench safe when this program or one of them dies.

    Use as a context: at its end they stop and leave the bench unchanged.

    Args:
        command: of one guardian; slot and log are appended.
        log: file to which they append what they did, one line of JSON each time.
        interlock: of the bench, owned by this program.
        clock: monotonic, in s.
    """

    def __init__(
        self,
        command: Sequence[str],
        log: Path,
        interlock: Interlock,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._command, self._log = list(command), log
        self._interlock, self._clock = interlock, clock
        self._processes: list[_Process] = []
        self._looked_s = -_EVERY_S
        self._lost = ""

    @property
    def pids(self) -> list[int]:
        """Process numbers of the guardians."""
        return [each.pid for each in self._processes]

    def start(self) -> None:
        """Start both and wait until they watch the bench.

        Raises:
            DeviceError: One does not start, or cannot connect to the bench.
        """
        self._log.parent.mkdir(parents=True, exist_ok=True)
        self._interlock.lease(UNARMED_S)
        self._lost = ""
        log = str(self._log.resolve())
        self._processes = [
            _Process([*self._command, str(slot), log], slot) for slot in range(HEARTBEATS)
        ]
        end_s = self._clock() + _START_S
        for each in self._processes:
            while each.first is None and self._clock() < end_s:
                ended = each.process.poll() is not None
                select.select([each.out], [], [], _EVERY_S)
                each.receive()
                if ended:
                    break
            if not each.is_ready(self._interlock.key):
                self.close()
                why = (each.first or "it did not respond").removeprefix("failed ")
                raise DeviceError(
                    f"{each.name} did not start: {why}. Nothing was energised. Run 'haselab rig "
                    "check' on this rig file."
                )

    def lost(self) -> str:
        """Why one of them no longer watches, or what it did; empty while both watch."""
        self._lost = self._lost or self._look()
        return self._lost

    def _look(self) -> str:
        if not self._processes:
            return "The guardians were not started."
        now_s = self._clock()
        if now_s - self._looked_s >= _EVERY_S:
            self._looked_s = now_s
            for each in self._processes:
                each.receive()
                code = each.process.poll()
                if code is not None and not each.result:
                    return (
                        f"{each.name} has ended (exit code {code}). Run the command again; if it "
                        "ends again, find out what ends it."
                    )
        count = self._interlock.heartbeat_count
        found = [each.lost(count(each.slot), now_s) for each in self._processes]
        return next((why for why in found if why), "")

    def make_safe(self, reason: str) -> None:
        """Request 0 V from both now; the second one finds what the first has done. Never raises.

        Args:
            reason: for the log.
        """
        for each in self._processes:
            each.send(f"safe {' '.join(reason.split())}")
            each.acting = True

    def outcome(self) -> str:
        """Wait for the result of `make_safe`. Never raises.

        Returns:
            Why the bench is not known to be safe; empty as soon as one guardian has confirmed it.
        """
        end_s = self._clock() + _ACT_S
        while self._clock() < end_s:
            working = [each for each in self._processes if each.works()]
            if any(each.result and not each.fault for each in self._processes):
                return ""
            if not working:
                break
            select.select([each.out for each in working], [], [], 0.05)
        faults = [
            f"{each.name}: {each.fault or 'no reply'}" for each in self._processes if each.acting
        ]
        return "; ".join(faults) or "no guardian was started"

    def close(self) -> None:
        """Stop the guardians without action; wait for one that is acting. Never raises.

        Safe to call twice.
        """
        for each in self._processes:
            each.receive()
        if any(each.acting and not each.result for each in self._processes):
            self.outcome()
        for each in self._processes:
            each.send("bye")
        for each in self._processes:
            each.close()
        self._processes = []

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
