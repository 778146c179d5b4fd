"""Commands, faults and safe acts in random order, on the twin and on the wire.

Two programs share one bench by its interlock. The invariant: an output above 50 V implies that the
program which energised it has a valid permission, and after any safe act the output stays below
50 V until somebody has armed the bench in both steps.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule
from numpy.typing import NDArray

from haselab.base import DeviceError, HaselabError
from haselab.rig import Rig
from haselab.rig.bench_config import BenchConfig
from haselab.rig.real_bench import RealBench
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.server import ServedTwin
from haselab.rig.twin.twin_bench import TwinBench, rig_of
from haselab.safety.gate import Gate
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.guardian.make_safe import revoke_and_make_safe
from haselab.safety.interlock import Interlock
from haselab.safety.state_machine import Safety, SafetySettings

SAFE_V = 50.0
_SETTLES = 2000  # samples in which the amplifier settles after its last command
_NUMBERS = itertools.count()
_TWINS: list[TwinBench] = []  # one for all cases: it takes a while to hang its weight
COUNTS: Counter[str] = Counter()  # of what the interleavings have done, for the table


class StickyBoard:
    """The twin's board as drivers are: a request is kept, and put out again by other calls."""

    def __init__(self, twin: TwinBench) -> None:
        self.twin = twin
        self.requested_v = 0.0
        self.fails: set[str] = set()

    def _put_out(self) -> None:
        self.twin.write(self.requested_v)
        self.twin.read()

    def _fail(self, name: str) -> None:
        if name in self.fails:
            self.fails.discard(name)
            raise DeviceError(f"The board does not reply ({name}).")

    def write(self, voltage_v: float) -> None:
        self._fail("write")
        self.requested_v = voltage_v

    def zero(self) -> None:
        self._fail("zero")
        self.requested_v = 0.0
        self.twin.zero()

    def read(self) -> NDArray[np.int16]:
        self._fail("read")
        self.twin.write(self.requested_v)
        return self.twin.read()

    def keep(self, on: bool) -> None:
        self._put_out()

    def pause(self) -> None:
        self._put_out()

    @property
    def time_s(self) -> float:
        return self.twin.time_s


class Bench(Protocol):
    """One bench that programs open, lose and take over."""

    def open(self) -> Rig:
        """As a program does: the interlock is claimed."""

    def close(self, rig: Rig, vanishes: bool) -> None:
        """A program ends in good order, or vanishes."""

    def make_safe(self, reason: str) -> None:
        """From another program."""

    def output_v(self) -> float:
        """After the amplifier, without letting time pass."""

    def fail(self, name: str) -> None:
        """The next such call of the board fails."""


class TwinUnderTest:
    """The twin in this process, with an interlock as benches have one."""

    def __init__(self) -> None:
        self._key = f"twin {os.getpid()} {next(_NUMBERS)}"
        if not _TWINS:
            _TWINS.append(TwinBench(twin_of_reading("hz"), 3))
        self.twin = _TWINS[0]
        self.twin.zero()
        self.twin.off()
        self.board = StickyBoard(self.twin)
        self._opened: list[Gate] = []

    def _interlock(self) -> Interlock:
        return Interlock(self._key)

    def open(self) -> Rig:
        interlock = self._interlock()
        with contextlib.ExitStack() as undo:
            undo.callback(interlock.close)
            interlock.own("a program")
            undo.pop_all()
        gate = Gate(interlock)
        self.board = StickyBoard(self.twin)
        config = twin_of_reading("hz")
        rig = rig_of(self.twin, config)
        rig.source = rig.acquisition = gate.instrument(self.board)
        rig.gate = gate
        return rig

    def close(self, rig: Rig, vanishes: bool) -> None:
        assert isinstance(rig.gate, Gate)
        if vanishes:  # the system takes the locks back, nobody says good-bye
            rig.gate.interlock._owns = False
            rig.gate.interlock.close()
        else:
            for _ in range(3):  # a board that has failed once is asked again
                with contextlib.suppress(HaselabError):
                    rig.safe()
            rig.gate.release()

    def make_safe(self, reason: str) -> None:
        with contextlib.closing(self._interlock()) as interlock:
            revision = interlock.revoke(reason)

            def act() -> bool:
                self.twin.zero()
                self.twin.off()
                interlock.confirm_safe(revision)
                return True

            interlock.make_safe(act, 0.0)

    def output_v(self) -> float:
        return abs(self.twin.output_v)

    def fail(self, name: str) -> None:
        self.board.fails.add(name)

    def end(self) -> None:
        """Nothing is left to close."""


class WireUnderTest:
    """A served twin behind the drivers of the real instruments."""

    _served: ServedTwin | None = None

    def __init__(self) -> None:
        if WireUnderTest._served is None:
            WireUnderTest._served = ServedTwin(twin_of_reading("hz"), 1, pace=0.0)
        self._twin = WireUnderTest._served
        self.config = BenchConfig.model_validate(tomllib.loads(self._twin.rig_file()))
        self._benches: dict[int, RealBench] = {}
        self.make_safe("The last interleaving has ended.")

    def open(self) -> Rig:
        bench = RealBench(self.config, Gate())
        self._benches[id(bench.rig)] = bench
        return bench.rig

    def close(self, rig: Rig, vanishes: bool) -> None:
        bench = self._benches.pop(id(rig))
        assert isinstance(rig.gate, Gate)
        if vanishes:
            rig.gate.interlock._owns = False
            rig.gate.interlock.close()
            self.make_safe("The program has ended.")  # the guardians do this
        bench.close()

    def make_safe(self, reason: str) -> None:
        faults = [fault for _, fault in revoke_and_make_safe(self.config, reason) if fault]
        assert not faults
        self._twin.hub.spend(_SETTLES)

    def output_v(self) -> float:
        hub = self._twin.hub
        return abs(hub.output_v) if not hub.bench.native.carrier_v else abs(hub._drive_v) * 5000.0

    def fail(self, name: str) -> None:
        del name  # tests/faults has them

    def end(self) -> None:
        for bench in self._benches.values():
            bench.close()

    @classmethod
    def stop(cls) -> None:
        if cls._served is not None:
            cls._served.close()
            cls._served = None


class Interleavings(RuleBasedStateMachine):
    """Two programs, a third one that makes safe, and faults."""

    bench_of: Callable[[], Any] = TwinUnderTest

    def __init__(self) -> None:
        super().__init__()
        self.bench = type(self).bench_of()
        self.rig: GuardedRig | None = None
        self.plain: Rig | None = None
        self.request: Any = None
        self.now_s = 0.0
        self.made_safe = True  # since the last arming
        COUNTS["interleavings"] += 1

    @contextlib.contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Whatever a program is refused: it goes on."""
        COUNTS[name] += 1
        try:
            yield
        except HaselabError as error:
            COUNTS[f"refused: {type(error).__name__}"] += 1

    @property
    def armed(self) -> bool:
        return self.rig is not None and self.rig.safety.live

    # ---- programs ----

    @precondition(lambda self: self.rig is None)
    @rule()
    def opens(self) -> None:
        with self.step("open"):
            self.plain = self.bench.open()
            self.rig = guard(self.plain, Safety(SafetySettings(), clock=lambda: self.now_s))

    @precondition(lambda self: self.rig is not None)
    @rule()
    def a_second_program_is_refused(self) -> None:
        COUNTS["second program"] += 1
        try:
            rig = self.bench.open()
        except (DeviceError, OSError):
            return
        self.bench.close(rig, vanishes=False)
        raise AssertionError("two programs own the bench")

    @precondition(lambda self: self.rig is not None)
    @rule(vanishes=st.booleans())
    def ends(self, vanishes: bool) -> None:
        assert self.rig is not None and self.plain is not None
        COUNTS["vanish" if vanishes else "end"] += 1
        if vanishes:
            if self.bench.output_v() >= SAFE_V or self.armed:
                self.bench.make_safe("The program has ended")  # its guardians
            self.made_safe = True
        else:
            with self.step("safe"):
                self.rig.safe()
            self.rig.safety.end_run()
        self.bench.close(self.plain, vanishes)
        self.rig = self.plain = self.request = None

    @precondition(lambda self: self.rig is not None)
    @rule()
    def requests(self) -> None:
        assert self.rig is not None
        with self.step("request"):
            self.request = self.rig.safety.request()

    @precondition(lambda self: self.request is not None)
    @rule(acknowledges=st.booleans())
    def arms(self, acknowledges: bool) -> None:
        assert self.rig is not None
        if self.request is None:
            return
        with self.step("arm"):
            reason = self.request.reason if acknowledges else ""
            self.rig.safety.arm(self.request, reason)
            assert not self.request.reason or acknowledges
            COUNTS["armed"] += 1
            self.made_safe = False

    @rule(drive_v=st.sampled_from([0.5, 1.9]), carrier=st.booleans())
    def does_what_a_run_does(self, drive_v: float, carrier: bool) -> None:
        """All steps in their order, so that the other rules meet a bench at high voltage."""
        if self.rig is None:
            self.opens()
        assert self.rig is not None
        self.requests()
        self.arms(acknowledges=True)
        self.runs()
        with self.step("sine"):
            if carrier:
                self.rig.generator.sine(2000.0, 0.02)
        self.writes(drive_v, guarded=True)
        self.reads(guarded=True, blocks=2)

    @precondition(lambda self: self.rig is not None)
    @rule()
    def runs(self) -> None:
        assert self.rig is not None
        with self.step("run"):
            self.rig.safety.run()

    @precondition(lambda self: self.rig is not None)
    @rule()
    def rests(self) -> None:
        assert self.rig is not None
        with self.step("rest"):
            self.rig.safe()
        self.rig.safety.end_run()
        self.made_safe = True

    @precondition(lambda self: self.rig is not None)
    @rule(drive_v=st.sampled_from([0.0, 0.02, 0.5, 1.0, 1.9]), guarded=st.booleans())
    def writes(self, drive_v: float, guarded: bool) -> None:
        assert self.rig is not None and self.plain is not None
        with self.step("write"):
            (self.rig if guarded else self.plain).source.write(drive_v)

    @precondition(lambda self: self.rig is not None)
    @rule(guarded=st.booleans(), blocks=st.integers(1, 3))
    def reads(self, guarded: bool, blocks: int) -> None:
        assert self.rig is not None and self.plain is not None
        with self.step("read"):
            for _ in range(blocks):
                (self.rig if guarded else self.plain).acquisition.read()

    @precondition(lambda self: self.rig is not None)
    @rule(on=st.booleans())
    def camera_keeps_the_clock(self, on: bool) -> None:
        assert self.plain is not None
        with self.step("keep"):
            self.plain.acquisition.keep(on)  # type: ignore[attr-defined]

    @precondition(lambda self: self.rig is not None)
    @rule()
    def pauses(self) -> None:
        assert self.plain is not None
        with self.step("pause"):
            self.plain.acquisition.pause()  # type: ignore[attr-defined]

    @precondition(lambda self: self.rig is not None)
    @rule()
    def trips(self) -> None:
        assert self.rig is not None
        with self.step("trip"):
            self.rig.safety.trip("Smoke.")
        self.made_safe = True

    @precondition(lambda self: self.rig is not None)
    @rule()
    def gets_old(self) -> None:
        assert self.rig is not None
        self.now_s += 2.0 * SafetySettings().permit_age_s
        with self.step("permission expires"):
            self.rig.safety.heartbeat(0.0)

    # ---- others ----

    @rule(who=st.sampled_from(["Made safe by 'haselab rig safe'", "Guardian 2 is lost"]))
    def others_make_safe(self, who: str) -> None:
        COUNTS["made safe by others"] += 1
        self.bench.make_safe(who)
        self.made_safe = True

    @rule(name=st.sampled_from(["write", "read", "zero"]))
    def board_fails_once(self, name: str) -> None:
        COUNTS["board fails"] += 1
        self.bench.fail(name)

    # ---- what must hold ----

    @invariant()
    def energised_implies_a_permission(self) -> None:
        output_v = self.bench.output_v()
        COUNTS["checks"] += 1
        COUNTS["checks while energised"] += output_v >= SAFE_V
        if output_v >= SAFE_V:
            assert self.armed, f"{output_v:.0f} V without a permission"
            assert not self.made_safe, f"{output_v:.0f} V after the bench was made safe"

    def teardown(self) -> None:
        if self.plain is not None:
            self.bench.close(self.plain, vanishes=False)
        self.bench.end()


class WireInterleavings(Interleavings):
    """The same over the wire."""

    bench_of = WireUnderTest
