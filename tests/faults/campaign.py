"""Faults, moments and results, shared by the tests and benchmarks/rig/fault_table.py."""

from __future__ import annotations

import contextlib
import dataclasses
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, HaselabError, SilentProgress
from haselab.control import Saturation
from haselab.controllers import pid_controller
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.rig import Rig
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench, rig_of
from haselab.runtime.loop import LoopSettings
from haselab.runtime.runner import Runner
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.interlock import Interlock
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.store.session.writer import ExperimentPlan, SessionReader, SessionWriter

SAFE_V = 50.0
GAIN = 5000.0
MOMENTS = ("before arming", "in ramp", "in step", "in closing")
# Of the safety chain: requested, armed, running (in and between experiments, at their ends), off.
STAGES = ("requested", "armed", *MOMENTS[1:2], "at its end", "in the gap", *MOMENTS[2:], "at rest")
RAMP_BLOCKS, STRIKE_RAMP, STRIKE_STEP = 60, 40, 20  # the ramp has 5 kV at its 40th block
EQ4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
LOOP = LoopSettings(pid_controller(0.1, 0.2), Saturation(-0.02, 0.06), EQ4, StrainMap(4.9e8, -0.27))


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
    """Nobody watches the actuator.

    Args:
        on: is told of the end of an experiment.
    """

    def __init__(self, on: Callable[[str], None] = lambda what: None) -> None:
        self._on = on

    def start(self, *given: object, **named: object) -> None: ...

    def look(self) -> None: ...

    def finish(self) -> None:
        self._on("at its end")


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
    interlock: Interlock = field(default_factory=Interlock)
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

    def __init__(self, session: SessionWriter, shown: Any = None) -> None:
        self._session, self._shown = session, shown
        self.blocks = 0

    def append_block(self, *given: Any) -> None:
        self._session.append_block(*given)
        self.blocks += 1
        if self._shown is not None:
            self._shown.write(float(self.blocks))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._session, name)


def after(rig: GuardedRig, trouble: Trouble) -> None:
    """What a program may still do with its instruments; nothing of it may energise the bench."""
    acts: list[Callable[[], object]] = [
        lambda: rig.plain.acquisition.read(), lambda: rig.source.write(1.5),
        lambda: rig.plain.source.write(1.5), lambda: rig.generator.sine(2000.0, 0.02),
        lambda: rig.plain.generator.sine(2000.0, 0.02), lambda: rig.stand.wait(0.02),
        lambda: rig.acquisition.read(),
    ]  # fmt: skip
    for act in acts:
        with contextlib.suppress(HaselabError):
            act()
        trouble.twin.read()
        trouble.watch()


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
        if (what == "block" and blocks == at) or (what == moment and trouble.struck_s < 0.0):
            trouble.now()

    trouble.on = on
    plans = [ExperimentPlan(name, "test", 6, {}) for name in ("ramp", "step")]
    carrier = {"carrier_hz": 2000.0, "carrier_v": 0.02}
    header = {"rig": dataclasses.asdict(plain.description), "study": {"sensing": carrier}}
    with SessionWriter(folder / "session.h5", plans, 2000, header) as session:
        safety = Safety(settings)
        safety.record_with(lambda what: session.event(plain.acquisition.time_s, what))
        rig = guard(plain, safety, clock=trouble.clock)
        trouble.interlock = safety.gate.interlock
        recorder = Count(session)
        runner = Runner(rig, recorder, NoCamera(on), 2000.0, 0.02, SilentProgress())
        try:
            on("before arming")
            request = safety.request()
            on("requested")
            safety.arm(request)
            on("armed")
            with runner:
                runner.play("ramp", np.linspace(0.0, 1.5, RAMP_BLOCKS), 50.0, 0.25)
                on("in the gap")
                runner.close_loop("step", np.full(STRIKE_STEP + 40, 0.02), LOOP, 50.0, 0.25)
                on("in closing")
            on("at rest")
        finally:
            count.append(recorder.blocks)
            trouble.reading = trouble.writing = trouble.refusing = trouble.codes = None
            after(rig, trouble)


# ---- faults ------------------------------------------------------------------------------------


def _read_fails(trouble: Trouble) -> None:
    trouble.reading = DeviceError("No block within 1 s. Check the link.")


def _overrun(trouble: Trouble) -> None:
    trouble.reading = DeviceError("Overrun: the buffer was not read in time (-200279).")


def _write_fails(trouble: Trouble) -> None:
    trouble.writing = trouble.zeroing = DeviceError("The drive output does not reply.")


def _refused(trouble: Trouble) -> None:
    trouble.refusing = DeviceError("The generator does not reply.")


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


def _made_safe(trouble: Trouble) -> None:
    """As `haselab rig safe` in another program: the latch, then 0 V over another connection."""
    trouble.interlock.revoke("Made safe by another program.")
    trouble.twin.zero()
    trouble.twin.off()
    trouble.watch()


# fault: what happens, words of its reason, moments
FAULTS: dict[str, tuple[Callable[[Trouble], None], str, tuple[str, ...]]] = {
    "device timeout, acquisition": (_read_fails, "No block within 1 s", MOMENTS),
    "device timeout, drive": (_write_fails, "does not reply", MOMENTS[:3]),
    "drive refuses 0 V once": (_write_fails, "", MOMENTS[3:]),
    "device timeout, generator": (_refused, "does not reply", MOMENTS[:1]),
    "generator refuses off once": (_refused, "", MOMENTS[3:]),
    "wrong read-back": (_monitor_wrong, "Output", MOMENTS),
    "garbage on the wire": (_garbage, "Output", MOMENTS),
    "cut block": (_cut_block, r"block of shape", MOMENTS),
    "gap in acquisition": (_gap, "Gap in the recording", MOMENTS[:3]),
    "overrun": (_overrun, "Overrun", MOMENTS),
    "NaN from sensing": (_nan, "No strain in 5 blocks", MOMENTS[2:3]),
    "lost carrier": (_carrier_lost, "No strain in 5 blocks", MOMENTS[2:3]),
    "breakdown": (_breakdown, "Breakdown", MOMENTS[1:3]),
    "over-current": (_leak, "Over-current", MOMENTS[1:3]),
    "lost deadline": (_late, "Lost deadline", MOMENTS[1:3]),
    "full disk": (_disk_full, "disk is full", MOMENTS[1:3]),
    "made safe by another program": (_made_safe, "by another program", STAGES),
}
PUT_RIGHT = {"drive refuses 0 V once", "generator refuses off once"}  # put right without a word


def inside(folder: Path, fault: str, moment: str) -> Outcome:
    """One fault on the twin in this process."""
    folder.mkdir(parents=True, exist_ok=True)
    twin = TwinBench(twin_of_reading("hz"), 3)
    trouble = Trouble(twin, FAULTS[fault][0])
    settings = SafetySettings(real_time=fault == "lost deadline")
    told, count = "", [0]
    trouble.watch()
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


def cases() -> Iterator[tuple[str, str]]:
    """All faults at all their moments."""
    for fault, (_, _, moments) in FAULTS.items():
        yield from ((fault, moment) for moment in moments)
