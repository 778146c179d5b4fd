"""`python -m haselab.safety.guardian.process RIG.toml SLOT LOG`: one of a bench's two guardians.

It loads the drivers, opens its own connection to the board, and prints `ready PROCESS KEY`. Then it
checks every 20 ms and makes the bench safe when

- its stdin ends or its parent changes: the program has ended;
- the program's lease in the interlock has expired: the program is stopped or hangs;
- the other guardian's counter has stopped while the bench is live;
- it receives SIGTERM, or reads `safe REASON` on stdin.

It revokes the permission first, so that no program can energise the bench without arming again.
It appends what it did to LOG, as one line of JSON, and prints `acting`, then `acted REASON`, or
`tried REASON: FAULTS` if an instrument did not confirm that it is off. The line `bye` ends it.
"""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import sys
import time
from pathlib import Path
from types import FrameType

from haselab.base import HaselabError
from haselab.base.exits import no_exit
from haselab.rig.bench_config import BenchConfig
from haselab.rig.instruments.devices import DaqConnection
from haselab.rig.instruments.registry import daq_of, reported_faults
from haselab.rig.rig_file import load_rig
from haselab.safety.guardian.heartbeat import SILENT_S, Heartbeat
from haselab.safety.guardian.make_safe import make_safe
from haselab.safety.interlock import HEARTBEATS, Interlock, lease_clock_s

__all__ = ["main"]

_TICK_S = 0.02
_WAIT_S = 0.15  # for a running call, or for the other guardian
_REAL_TIME, _NICENESS = 1, -10


class _Guardian:
    """Watches one program and its bench."""

    def __init__(self, config: BenchConfig, link: DaqConnection, slot: int, log: Path) -> None:
        self._config, self._link, self._log = config, link, log
        self._slot = slot
        self.interlock = Interlock(link.key)
        self._parent = os.getppid()
        self._others = {k: Heartbeat() for k in range(HEARTBEATS) if k != slot}
        self._ended = ""
        self._text = b""

    def watch(self) -> None:
        """Watch until the program sends `bye` or the bench had to be made safe."""
        self.interlock.count_heartbeat(self._slot)
        _say(f"ready {os.getpid()} {self.interlock.key}")
        while True:
            ready, _, _ = select.select([0], [], [], _TICK_S)
            self.interlock.count_heartbeat(self._slot)
            word = self._word() if ready else ""
            if word == "bye":
                self.interlock.stop_heartbeat(self._slot)
                return
            reason = word or self._ended or self._silence()
            if reason:
                self._act(reason)
                self.interlock.stop_heartbeat(self._slot)
                return

    def ended(self, number: int, frame: FrameType | None) -> None:
        """Handle SIGTERM: make the bench safe before this guardian ends."""
        del frame
        self._ended = f"the guardian received {signal.Signals(number).name}"

    def _word(self) -> str:
        """Read a line from the program: `bye`, or why to act."""
        data = os.read(0, 4096)
        if not data:
            return "the program has ended"
        self._text += data
        line, end, rest = self._text.partition(b"\n")
        if not end:
            return ""
        self._text = rest
        verb, _, reason = line.decode(errors="replace").partition(" ")
        return "bye" if verb == "bye" else reason or "the program requested 0 V"

    def _silence(self) -> str:
        if os.getppid() != self._parent:
            return "the program has ended"
        now_s = time.monotonic()
        if not self.interlock.live:
            return ""
        if lease_clock_s() > self.interlock.lease_end_s:
            return "no heartbeat from the program before its lease (lease_s) ended"
        for slot, heartbeat in self._others.items():
            count = self.interlock.heartbeat_count(slot)
            if heartbeat.silent_s(count, now_s) > SILENT_S and count >= 0:
                return f"guardian {slot + 1} has not responded for {SILENT_S:g} s"
        return ""

    def _act(self, reason: str) -> None:
        _say("acting")
        begun_s = time.monotonic()
        with contextlib.suppress(OSError):  # 0 V comes first
            if self.interlock.live or not self.interlock.reason:
                self.interlock.revoke(f"{reason[:1].upper()}{reason[1:]}")
        found: list[tuple[str, str]] = []

        def act() -> bool:
            revision = self.interlock.revision
            if self.interlock.confirmed_safe:  # the other guardian was faster
                return True
            found[:] = make_safe(self._config, self._link)
            safe = not any(fault for _, fault in found)
            if safe:
                self.interlock.confirm_safe(revision)
            return safe

        self.interlock.make_safe(act, _WAIT_S)
        if found:
            self._record(reason, begun_s, found)
        faults = [f"{name}: {fault}" for name, fault in found if fault]
        reported = f"tried {reason}: {'; '.join(faults)}" if faults else f"acted {reason}"
        _say(" ".join(reported.split()))

    def _record(self, reason: str, begun_s: float, found: list[tuple[str, str]]) -> None:
        record = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
            "guardian": self._slot + 1,
            "reason": reason,
            "duration_s": round(time.monotonic() - begun_s, 4),
            "instruments": [
                {"name": name, **_confirmation(name, fault), "fault": fault}
                for name, fault in found
            ],
        }
        with contextlib.suppress(OSError):  # a full disk must not delay 0 V
            log = os.open(self._log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
            os.write(log, (json.dumps(record) + "\n").encode())
            os.close(log)


def _confirmation(name: str, fault: str) -> dict[str, bool]:
    """Log entry of an instrument; the board's output is commanded, not measured."""
    if name == "daq":
        return {"commanded_0_v": not fault, "measured": False}
    return {"confirmed_off": not fault}


def _say(word: str) -> None:
    """Print one line for the program, which may have ended."""
    with contextlib.suppress(OSError):
        os.write(1, word.encode() + b"\n")


def _raise_priority() -> None:
    """Raise this process's priority if the system allows it; it needs little processor time."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(_REAL_TIME))
    except (AttributeError, OSError):
        with contextlib.suppress(AttributeError, OSError):
            os.setpriority(os.PRIO_PROCESS, 0, _NICENESS)


def main(words: list[str]) -> str:
    """Run one guardian.

    Args:
        words: rig file, slot of the heartbeat, log file.
    Returns:
        Why it could not watch; empty after `bye` or after it has acted.
    """
    for name in ("SIGINT", "SIGHUP", "SIGPIPE"):  # these are for the program
        if hasattr(signal, name):
            signal.signal(getattr(signal, name), signal.SIG_IGN)
    path, slot, log = Path(words[0]), int(words[1]), Path(words[2])
    try:
        file = load_rig(path)
        if not isinstance(file, BenchConfig):
            raise ValueError(f"kind is {file.kind!r}, but a guardian needs kind = 'bench'. {path}")
        for each in file.instruments():  # drivers load slowly
            with contextlib.suppress(Exception), no_exit():  # `shut_down` reports what is missing
                each.instrument.check_driver()
        with reported_faults(file.daq):
            link = daq_of(file.daq).connect(file.daq)
    except (HaselabError, ValueError) as error:
        _say(f"failed {' '.join(str(error).split())}")
        return str(error)
    with contextlib.closing(link):
        try:
            guardian = _Guardian(file, link, slot, log)
        except OSError as error:
            _say(f"failed the software interlock cannot be used: {error}")
            return str(error)
        signal.signal(signal.SIGTERM, guardian.ended)
        _raise_priority()
        with contextlib.closing(guardian.interlock):
            guardian.watch()
    return ""


if __name__ == "__main__":
    sys.exit(1 if main(sys.argv[1:]) else 0)
