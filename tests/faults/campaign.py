"""Faults, moments and what became of them: shared by the tests and benchmarks/fault_table.py."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from haselab.app.interrupt import Interruptible
from haselab.base import DeviceError, HaselabError, SilentProgress
from haselab.control import PidGains, Saturation
from haselab.models.maps import VoltageMap
from haselab.rig import Rig
from haselab.rig.twin.bench import TwinBench, rig_of
from haselab.rig.twin.config import twin_of_reading
from haselab.runtime.runner import LoopSettings, Runner, StrainMap
from haselab.safety.guarded import guard
from haselab.safety.guardian import FileHand, Guardian
from haselab.safety.guardian_process import OutputFile
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.store.session import ExperimentPlan, SessionReader, SessionWriter

SAFE_V = 50.0
GAIN = 5000.0
MOMENTS = ("before arming", "in ramp", "in step", "in closing")
RAMP_BLOCKS, STRIKE_RAMP, STRIKE_STEP = 60, 40, 20  # the ramp has 5 kV at its 40th block
EQ4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
LOOP = LoopSettings(PidGains(0.1, 0.2), Saturation(-0.02, 0.06), EQ4, StrainMap(4.9e8, -0.27))


@dataclass
class Outcome:
    """What became of one fault.

    Args:
        after_s: from the fault to an output below 50 V: on the wall clock, and on the rig's clock
            where that one runs by itself.
        output_v: at the end, after the amplifier.
        told: the error that came out; empty without one.
        recorded: events of the session, lines of the guardian's log.
        acknowledged: blocks that the recorder had accepted.
        readable: blocks that can be read afterwards.
        highest_v: output that the fault met.
    """

    after_s: float
    output_v: float
    told: str
    recorded: str
    acknowledged: int
    readable: int
    highest_v: float


class NoCamera:
    """Nobody watches the actuator."""

    def start(self, *given: object, **named: object) -> None: ...

    def look(self) -> None: ...

    def finish(self) -> None: ...


# ---- the bench that faults are injected into ---------------------------------------------------


@dataclass
class Trouble:
    """Stands between the twin and its user; strikes at a moment."""

    twin: TwinBench
    strike: Callable[[Trouble], None]
    codes: Callable[[NDArray[np.int16]], NDArray[np.int16]] | None = None
    reading: BaseException | None = None
    writing: BaseException | None = None
    zeroing: BaseException | None = None
    refusing: BaseException | None = None
    gap_s: float = 0.0
    lag_s: float = 0.0  # added to the wall clock at each tick
    pace_s: float = 0.0
    struck_s: float = -1.0
    struck_rig_s: float = 0.0
    safe_s: float = -1.0
    safe_rig_s: float = 0.0
    late_s: float = 0.0
    jumped_s: float = 0.0
    highest_v: float = 0.0
    on: Callable[[str], None] = lambda what: None
    guardian: Guardian | None = None
    actions: list[Callable[[], None]] = field(default_factory=list)

    def now(self) -> None:
        """The fault happens."""
        self.struck_s, self.struck_rig_s = time.monotonic(), self.twin.time_s
        self.highest_v = abs(self.twin.output_v)
        self.strike(self)

    def watch(self) -> None:
        """A voltmeter at the output: since when it is below 50 V for good."""
        if abs(self.twin.output_v) >= SAFE_V:
            self.safe_s = -1.0
        elif self.safe_s < 0.0:
            self.safe_s, self.safe_rig_s = time.monotonic(), self.twin.time_s

    # VoltageSource
    def write(self, voltage_v: float) -> None:
        if self.writing is not None:
            raise self.writing
        self.twin.write(voltage_v)

    def zero(self) -> None:
        self.on("closing")
        error, self.zeroing = self.zeroing, None
        if error is not None:
            raise error
        self.twin.zero()
        self.watch()

    # Acquisition
    def read(self) -> NDArray[np.int16]:
        if self.reading is not None:
            raise self.reading
        if self.pace_s:
            time.sleep(self.pace_s)
        self.late_s += self.lag_s
        codes = self.twin.read()
        self.watch()
        if self.struck_s >= 0.0:
            self.jumped_s += self.gap_s
            codes = codes if self.codes is None else self.codes(codes)
        self.on("block")
        return codes

    @property
    def time_s(self) -> float:
        return self.twin.time_s + self.jumped_s

    def clock(self) -> float:
        """A wall clock that runs with the rig, and late where the fault says so."""
        return self.twin.time_s + self.late_s

    # FunctionGenerator
    def sine(self, frequency_hz: float, amplitude_v: float) -> None:
        if self.refusing is not None:
            raise self.refusing
        self.twin.sine(frequency_hz, amplitude_v)

    def off(self) -> None:
        error, self.refusing = self.refusing, None
        if error is not None:
            raise error
        self.twin.off()
        self.watch()


class Count:
    """A recorder that counts what it has accepted."""

    def __init__(self, session: SessionWriter, shown: OutputFile | None = None) -> None:
        self._session, self._shown = session, shown
        self.blocks = 0

    def append_block(self, *given: Any) -> None:
        self._session.append_block(*given)
        self.blocks += 1
        if self._shown is not None:
            self._shown.write(float(self.blocks))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)


def play(
    folder: Path, trouble: Trouble, moment: str, settings: SafetySettings, count: list[int]
) -> None:
    """Arm, ramp, close the loop on a step, close; the trouble strikes at its moment."""
    config = twin_of_reading("hz")
    plain: Rig = rig_of(trouble.twin, config)
    plain = dataclasses.replace(plain, source=trouble, acquisition=trouble, generator=trouble)
    blocks = 0

    def on(what: str) -> None:
        nonlocal blocks
        blocks += what == "block"
        # One block is read at rest, before anything is energised.
        at = {"in ramp": 1 + STRIKE_RAMP, "in step": 1 + RAMP_BLOCKS + STRIKE_STEP}.get(moment)
        if what == "block" and blocks == at:
            trouble.now()

    trouble.on = on
    plans = [ExperimentPlan(name, "test", 6, {}) for name in ("ramp", "step")]
    carrier = {"carrier_hz": 2000.0, "carrier_v": 0.02}
    header = {"rig": dataclasses.asdict(plain.description), "study": {"sensing": carrier}}
    guardian = Guardian([FileHand(str(folder / "output"))], folder / "guardian.log")
    with (
        contextlib.closing(OutputFile(str(folder / "output"))) as mirror,
        SessionWriter(folder / "session.h5", plans, 2000, header) as session,
        guardian,
    ):
        trouble.guardian = guardian
        safety = Safety(settings, guardian)
        safety.tells(lambda what: session.event(plain.acquisition.time_s, what))
        rig = guard(plain, safety, mirror=mirror, clock=trouble.clock)
        recorder = Count(session)
        runner = Runner(rig, recorder, NoCamera(), 2000.0, 0.02, SilentProgress())
        try:
            if moment == "before arming":
                trouble.now()
            safety.arm(safety.request())
            with runner:
                runner.play("ramp", np.linspace(0.0, 1.5, RAMP_BLOCKS), 50.0, 0.25)
                runner.close_loop("step", np.full(STRIKE_STEP + 40, 0.02), LOOP, 50.0, 0.25)
                if moment == "in closing":
                    trouble.now()
        finally:
            count.append(recorder.blocks)


# ---- faults ------------------------------------------------------------------------------------


def _read_fails(trouble: Trouble) -> None:
    trouble.reading = DeviceError("No block within 1 s. Check the link.")


def _overrun(trouble: Trouble) -> None:
    trouble.reading = DeviceError("Overrun: the buffer was not read in time (-200279).")


def _write_fails(trouble: Trouble) -> None:
    trouble.writing = trouble.zeroing = DeviceError("The drive output does not answer.")


def _refused(trouble: Trouble) -> None:
    trouble.refusing = DeviceError("The generator does not answer.")


def _monitor_wrong(trouble: Trouble) -> None:
    # 2 kV more than there are: more than a tenth of the range, the limit of `follow`.
    def wrong(codes: NDArray[np.int16]) -> NDArray[np.int16]:
        out = codes.copy()
        out[:, 0] += np.int16(round(0.4 / (20.0 / 65536)))
        return out

    trouble.codes = wrong


def _garbage(trouble: Trouble) -> None:
    rng = np.random.default_rng(3)
    trouble.codes = lambda codes: rng.integers(-32768, 32767, codes.shape, dtype=np.int16)


def _cut_block(trouble: Trouble) -> None:
    trouble.codes = lambda codes: codes[:1000]


def _gap(trouble: Trouble) -> None:
    trouble.gap_s = 0.003


def _carrier_lost(trouble: Trouble) -> None:
    trouble.twin.off()
    trouble.sine = lambda *given: None  # type: ignore[method-assign]


def _nan(trouble: Trouble) -> None:
    """Sensing that gives NaN: the monitors of the current are pinned to one code."""

    def flat(codes: NDArray[np.int16]) -> NDArray[np.int16]:
        out = codes.copy()
        out[:, 1] = 7
        return out

    trouble.codes = flat


def _breakdown(trouble: Trouble) -> None:
    def arc(codes: NDArray[np.int16]) -> NDArray[np.int16]:
        out = codes.copy()
        out[:, 0] //= 10
        out[:, 1] = round(6.0 / (20.0 / 65536))  # 12 mA: the amplifier's limit
        return out

    trouble.codes = arc


def _leak(trouble: Trouble) -> None:
    def leak(codes: NDArray[np.int16]) -> NDArray[np.int16]:
        out = codes.copy()
        out[:, 1] += np.int16(round(1.0 / (20.0 / 65536)))  # 2 mA
        return out

    trouble.codes = leak


def _late(trouble: Trouble) -> None:
    trouble.lag_s = 0.011


def _disk_full(trouble: Trouble) -> None:
    full = mock.patch.object(shutil, "disk_usage", lambda path: mock.Mock(free=1000))
    full.start()
    trouble.actions.append(full.stop)


def _guardian_killed(trouble: Trouble) -> None:
    assert trouble.guardian is not None
    os.kill(trouble.guardian.pid, signal.SIGKILL)
    time.sleep(0.06)  # leases go out every 50 ms, and a kill takes a moment


# fault: what happens, words of its reason, moments
FAULTS: dict[str, tuple[Callable[[Trouble], None], str, tuple[str, ...]]] = {
    "device timeout, acquisition": (_read_fails, "No block within 1 s", MOMENTS),
    "device timeout, drive": (_write_fails, "does not answer", MOMENTS[:3]),
    "drive refuses 0 V once": (_write_fails, "", MOMENTS[3:]),
    "device timeout, generator": (_refused, "does not answer", MOMENTS[:1]),
    "generator refuses off once": (_refused, "", MOMENTS[3:]),
    "wrong read-back": (_monitor_wrong, "Output", MOMENTS),
    "garbage on the wire": (_garbage, "Output", MOMENTS),
    "cut block": (_cut_block, r"Block of shape", MOMENTS),
    "gap in acquisition": (_gap, "a gap in the recording", MOMENTS[:3]),
    "overrun": (_overrun, "Overrun", MOMENTS),
    "NaN from sensing": (_nan, "No strain in 5 blocks", MOMENTS[2:3]),
    "lost carrier": (_carrier_lost, "No strain in 5 blocks", MOMENTS[2:3]),
    "breakdown": (_breakdown, "Breakdown", MOMENTS[1:3]),
    "over-current": (_leak, "Over-current", MOMENTS[1:3]),
    "lost deadline": (_late, "Lost deadline", MOMENTS[1:3]),
    "full disk": (_disk_full, "disk is full", MOMENTS[1:3]),
    "lost guardian": (_guardian_killed, "guardian", MOMENTS[:3]),
}
PUT_RIGHT = {"drive refuses 0 V once", "generator refuses off once"}  # put right without a word


def inside(folder: Path, fault: str, moment: str) -> Outcome:
    """One fault on the twin in this process."""
    folder.mkdir(parents=True, exist_ok=True)
    twin = TwinBench(twin_of_reading("hz"), 3)
    trouble = Trouble(twin, FAULTS[fault][0])
    settings = SafetySettings(real_time=fault == "lost deadline")
    told, count = "", [0]
    try:
        play(folder, trouble, moment, settings, count)
    except HaselabError as error:
        told = str(error)
    finally:
        for action in trouble.actions:
            action()
    trouble.watch()
    recorded, readable = left(folder)
    after_s = max(trouble.safe_s - trouble.struck_s, 0.0)
    after_s += max(trouble.safe_rig_s - trouble.struck_rig_s, 0.0)
    if trouble.safe_s < 0.0:
        after_s = float("inf")
    return Outcome(after_s, twin.output_v, told, recorded, count[-1], readable, trouble.highest_v)


def wait_for_log(folder: Path, lines: int = 1) -> None:
    """The guardian writes when it has acted; a line may be under way."""
    log, until_s = folder / "guardian.log", time.monotonic() + 10.0
    while time.monotonic() < until_s:
        if log.exists() and log.read_text().count("\n") >= lines:
            return
        time.sleep(0.005)


def left(folder: Path) -> tuple[str, int]:
    """What the folder holds afterwards: reasons, blocks."""
    log = folder / "guardian.log"
    lines = log.read_text() if log.exists() else ""
    with SessionReader(folder / "session.h5") as session:
        blocks = sum(len(session.experiment(name).codes) for name in session.names)
        return "\n".join([*(what for _, what in session.events()), lines]), blocks


# ---- signals: the program is a process of its own ----------------------------------------------

SIGNALS = {
    "SIGINT": ("ended by KeyboardInterrupt", 0.1),
    "SIGTERM": ("ended by KeyboardInterrupt", 0.1),
    "SIGHUP": ("ended by KeyboardInterrupt", 0.1),
    "SIGKILL": ("the program is gone", 0.5),
    "SIGSTOP": ("no sign of life", 1.5),  # the lease and 0.5 s
    "hanging driver": ("no sign of life", 1.5),
}
LEASE_S = 1.0  # what stops without an end is found when it has run out


def _child(twin: TwinBench, folder: Path, moment: str, hangs: bool) -> None:
    """Plays without an end at one moment, in the wall clock's own time; says when it is there."""
    progress = Interruptible(SilentProgress())
    trouble = Trouble(twin, lambda trouble: None, pace_s=0.002)
    config = twin_of_reading("hz")
    plain = dataclasses.replace(
        rig_of(trouble.twin, config), source=trouble, acquisition=trouble, generator=trouble
    )
    blocks = 0

    def there() -> None:
        print("there", flush=True)
        if hangs:
            time.sleep(60.0)

    def on(what: str) -> None:
        nonlocal blocks
        blocks += what == "block"
        if moment == "in ramp" and what == "block" and blocks == 60:
            there()
        if moment == "in step" and what == "block" and blocks == RAMP_BLOCKS + STRIKE_STEP:
            there()
        if moment == "in closing" and what == "closing" and blocks > RAMP_BLOCKS:
            blocks = 0
            there()
            time.sleep(5.0)  # a driver that takes its time to go to 0 V

    trouble.on = on
    plans = [ExperimentPlan(name, "test", 6, {}) for name in ("ramp", "step")]
    hands = [FileHand(str(folder / "output"))]
    mirror, shown = OutputFile(str(folder / "output")), OutputFile(str(folder / "count"))
    with (
        SessionWriter(folder / "session.h5", plans, 2000, {}) as session,
        Guardian(hands, folder / "guardian.log") as guardian,
    ):
        safety = Safety(SafetySettings(lease_s=LEASE_S, idle_s=30.0), guardian)
        rig = guard(plain, safety, mirror=mirror)
        runner = Runner(rig, Count(session, shown), NoCamera(), 2000.0, 0.02, progress)
        permit = safety.request()
        if moment == "before arming":
            there()
            time.sleep(30.0)
        safety.arm(permit)
        with runner:
            ramp = np.linspace(0.0, 1.5, 20_000 if moment == "in ramp" else RAMP_BLOCKS)
            ramp = np.maximum(ramp, 0.5) if moment == "in ramp" else ramp
            runner.play("ramp", ramp, 50.0, 0.25)
            ending = STRIKE_STEP if moment == "in closing" else 100_000
            runner.close_loop("step", np.full(ending, 0.02), LOOP, 50.0, 0.25)


class Programs:
    """Starts a program for each signal: forks of one process that has imported everything.

    Use as a context, one program at a time.
    """

    def __enter__(self) -> Programs:
        self._server = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        return self

    def __exit__(self, *_: object) -> None:
        self._server.communicate(timeout=30)

    def start(self, folder: Path, name: str, moment: str) -> int:
        """Its process number, once it has reached the moment."""
        assert self._server.stdin is not None
        print(folder, name, moment, sep="\t", file=self._server.stdin, flush=True)
        words = sorted(self._word() for _ in range(2))
        assert words[1] == "there", (words, (folder / "stderr").read_text())
        return int(words[0])

    def _word(self) -> str:
        assert self._server.stdout is not None
        return self._server.stdout.readline().strip()

    def ended(self) -> int:
        """The exit code of the last one."""
        return int(self._word())

    def outside(self, folder: Path, name: str, moment: str) -> Outcome:
        """One signal to a program that plays on the twin; a guardian stands by."""
        folder.mkdir(parents=True, exist_ok=True)
        with (
            contextlib.closing(OutputFile(str(folder / "output"))) as output,
            contextlib.closing(OutputFile(str(folder / "count"))) as count,
        ):
            pid = self.start(folder, name, moment)
            highest_v, acknowledged = output.read() * GAIN, round(count.read())
            begun_s = time.monotonic()
            if name in signal.Signals.__members__:
                os.kill(pid, signal.Signals[name])
            after_s = _until_safe(output, begun_s)
            if name in ("SIGSTOP", "hanging driver"):
                os.kill(pid, signal.SIGKILL)
            code = self.ended()
            left_v = output.read() * GAIN
        if code < 0:
            wait_for_log(folder)
        recorded, readable = left(folder)
        told = (folder / "stderr").read_text() or f"exit code {code}"
        return Outcome(after_s, left_v, told, recorded, acknowledged, readable, highest_v)


def serve() -> None:
    """One fork for each line on stdin: folder, fault, moment."""
    twin = TwinBench(twin_of_reading("hz"), 3)
    for line in sys.stdin:
        folder, name, moment = line.rstrip("\n").split("\t")
        pid = os.fork()
        if pid == 0:
            code = 1
            os.dup2(os.open(Path(folder) / "stderr", os.O_WRONLY | os.O_CREAT), 2)
            try:
                _child(twin, Path(folder), moment, name == "hanging driver")
            except KeyboardInterrupt:
                code = 130
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        print(pid, flush=True)
        print(os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]), flush=True)


def _until_safe(output: OutputFile, begun_s: float) -> float:
    while abs(output.read()) * GAIN >= SAFE_V:
        if time.monotonic() > begun_s + 10.0:
            return float("inf")
        time.sleep(0.0005)
    return time.monotonic() - begun_s


def cases() -> Iterator[tuple[str, str]]:
    """All faults at all their moments."""
    for fault, (_, _, moments) in FAULTS.items():
        yield from ((fault, moment) for moment in moments)
    for name in SIGNALS:
        # A program that stands still before arming has put nothing out, and has no lease.
        stands = name in ("SIGSTOP", "hanging driver")
        yield from ((name, moment) for moment in (MOMENTS[1:] if stands else MOMENTS))


if __name__ == "__main__":
    serve()
