"""Drivers that a lab has written: every way out is 0 V and checked, every request has a limit.

The oracle is the amplifier of `own_bench`, which knows what stands at the output.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest

from haselab.base import DeviceError, InputError, LimitError, SafetyError, SilentProgress
from haselab.cli.main import main
from haselab.runtime.runner import Runner
from haselab.safety.armed import armed
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.signals import OrderlyEnd
from haselab.safety.state_machine import Safety, SafetySettings, Stage
from tests.safety.own_bench import OwnBench

BROKEN = ("no effect", "raises")


def _armed_by_hand(bench: OwnBench) -> GuardedRig:
    guarded = guard(bench.rig)
    request = guarded.safety.request()
    guarded.safety.arm(request, acknowledged=request.reason)
    return guarded


# ---- every way out ends at 0 V, checked ----------------------------------------------------------


def test_the_context_ends_at_zero_and_off() -> None:
    bench = OwnBench(supply=True)
    with armed(bench.rig) as guarded:
        guarded.generator.sine(2000.0, 0.02)
        assert guarded.supply is not None
        guarded.supply.set_voltage(500.0)
        guarded.source.write(0.5)
        assert bench.amplifier.drive_v == 0.5
    a = bench.amplifier
    assert (a.drive_v, a.carrier, a.supply_v) == (0.0, (0.0, 0.0), 0.0)
    assert guarded.safety.stage is Stage.OFF
    with pytest.raises(SafetyError, match="Arm the bench"):
        guarded.source.write(0.5)


@pytest.mark.parametrize("tells_off", [False, True])
@pytest.mark.parametrize("fault", BROKEN)
@pytest.mark.parametrize("end", ["context", "safe", "end_run", "read_back"])
def test_a_zero_that_does_not_work_is_raised_and_latched(
    fault: str, end: str, tells_off: bool
) -> None:
    bench = OwnBench(tells_off=tells_off)
    with pytest.raises(SafetyError, match=r"Output not at 0 V: 25\d\d V.*by hand"):
        if end == "context":
            with armed(bench.rig) as guarded:
                guarded.source.write(0.5)
                bench.board.zero_fault = fault
        else:
            guarded = _armed_by_hand(bench)
            guarded.source.write(0.5)
            bench.board.zero_fault = fault
            {"safe": guarded.safe, "end_run": guarded.safety.end_run,
             "read_back": guarded.read_back}[end]()  # fmt: skip
    assert guarded.safety.stage is Stage.TRIPPED
    assert "not at 0 V" in guarded.safety.request().reason
    with pytest.raises(SafetyError, match="acknowledge"), armed(bench.rig):
        pass


@pytest.mark.parametrize("code", [0, None, 7])
def test_a_driver_that_exits_is_a_fault_of_the_bench_which_ends_at_zero(code: int | None) -> None:
    bench = OwnBench()
    said = rf"driver 'Board' called sys\.exit\({code}\) in 'write'\. Report the fault"
    with pytest.raises(DeviceError, match=said), armed(bench.rig) as guarded:
        guarded.source.write(0.5)
        bench.board.write = lambda voltage_v: sys.exit(code)  # type: ignore[method-assign]
        guarded.source.write(0.6)
    assert bench.amplifier.drive_v == 0.0
    assert guarded.safety.stage is Stage.TRIPPED


def test_a_driver_that_exits_during_the_shutdown_does_not_stop_it() -> None:
    bench = OwnBench(supply=True)
    left = pytest.raises(SafetyError, match=r"Output not at 0 V: 100\.1 V remain .* by hand")
    with left, armed(bench.rig) as guarded:  # the carrier remains, 20 mV times 5000
        guarded.generator.sine(2000.0, 0.02)
        guarded.source.write(0.5)
        bench.generator.off = lambda: sys.exit(0)  # type: ignore[method-assign]
    assert (bench.amplifier.drive_v, bench.amplifier.supply_v) == (0.0, 0.0)


class MuteError(Exception):
    """An exception of which no text can be made."""

    def __str__(self) -> str:
        raise KeyError("text")


def test_a_fault_without_a_text_during_the_shutdown_does_not_stop_it() -> None:
    """The text was made inside the shutdown: its exception skipped the steps that were left."""

    def fail() -> None:
        raise MuteError

    bench = OwnBench(supply=True)
    left = pytest.raises(SafetyError, match=r"Output not at 0 V: 100\.1 V remain .* by hand")
    with left, armed(bench.rig) as guarded:
        assert guarded.supply is not None
        guarded.generator.sine(2000.0, 0.02)
        guarded.supply.set_voltage(500.0)
        guarded.source.write(0.5)
        bench.generator.off = fail  # type: ignore[method-assign]
    assert (bench.amplifier.drive_v, bench.amplifier.supply_v) == (0.0, 0.0)


def test_an_output_that_cannot_be_read_is_not_taken_for_zero() -> None:
    bench = OwnBench()
    with pytest.raises(SafetyError, match="not confirmed at 0 V"), armed(bench.rig) as guarded:
        guarded.source.write(0.5)
        bench.board.dead = True
    assert guarded.safety.stage is Stage.TRIPPED


def test_an_error_in_the_block_is_not_hidden_unless_the_output_is_up() -> None:
    bench = OwnBench()
    with pytest.raises(ValueError, match="a bug"), armed(bench.rig) as guarded:
        guarded.source.write(0.5)
        raise ValueError("a bug")
    assert bench.amplifier.drive_v == 0.0
    with pytest.raises(SafetyError, match="0 V") as caught, armed(bench.rig) as guarded:
        guarded.source.write(0.5)
        bench.board.zero_fault = "no effect"
        raise ValueError("a bug")
    assert isinstance(caught.value.__context__, ValueError)


def test_what_was_read_back_is_out_of_date_after_a_new_request() -> None:
    """Also one that goes to the driver past the guarded source."""
    for request in (lambda g, r: g.source.write(0.5), lambda g, r: r.source.jump(0.5),
                    lambda g, r: r.camera.stop()):  # fmt: skip
        bench = OwnBench()
        guarded = _armed_by_hand(bench)
        guarded.source.write(0.4)
        guarded.safe()
        bench.board.zero_fault, bench.camera.writes = "no effect", 0.5
        request(guarded, bench.rig)
        with pytest.raises(SafetyError, match="not at 0 V"):
            guarded.safety.end_run()
        assert guarded.safety.stage is Stage.TRIPPED


def test_a_trip_is_ended_at_zero_as_well() -> None:
    bench = OwnBench()
    guarded = _armed_by_hand(bench)
    guarded.source.write(0.5)
    bench.board.zero_fault = "no effect"
    guarded.safety.trip("Something else.")
    with pytest.raises(SafetyError, match="not at 0 V"):
        guarded.safety.end_run()


# ---- camera and stand ----------------------------------------------------------------------------


def test_the_last_act_of_the_shutdown_is_zero() -> None:
    bench = OwnBench()
    bench.camera.writes = 0.4
    with armed(bench.rig) as guarded:
        guarded.source.write(0.5)
    assert 0.4 in bench.amplifier.history  # the camera did what it does
    assert bench.amplifier.drive_v == 0.0


def test_camera_and_stand_leave_no_voltage_on_a_bench_that_is_not_armed() -> None:
    bench = OwnBench()
    bench.camera.writes = bench.stand.writes = 0.4
    guarded = guard(bench.rig)
    for act in (guarded.camera.stop, bench.rig.camera.stop, lambda: guarded.stand.wait(1.0),
                lambda: bench.rig.stand.wait(1.0)):  # fmt: skip
        act()
        assert bench.amplifier.history.pop() == 0.0
        assert bench.amplifier.history.pop() == 0.4
        assert bench.amplifier.drive_v == 0.0


# ---- limits of what is requested -----------------------------------------------------------------

NO_NUMBERS: tuple[object, ...] = ("1", True, np.array([0.1, 0.2]), None)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -0.01, 50.0, *NO_NUMBERS])
def test_generator_and_supply_are_given_nothing_outside_their_limits(value: object) -> None:
    bench = OwnBench(supply=True)
    with armed(bench.rig) as guarded:
        assert guarded.supply is not None
        guarded.generator.sine(2000.0, 0.02)
        guarded.supply.set_voltage(500.0)
        volt = 1e6 if isinstance(value, float) and value == 50.0 else value
        for request in (
            lambda: guarded.generator.sine(2000.0, value),  # type: ignore[arg-type]
            lambda: guarded.supply.set_voltage(volt),  # type: ignore[arg-type, union-attr]
            lambda: guarded.source.write(value),  # type: ignore[arg-type]
        ):
            with pytest.raises((LimitError, InputError), match=r"is outside|must be"):
                request()
        assert bench.amplifier.carrier == (2000.0, 0.02)
        assert bench.amplifier.supply_v == 500.0
        assert bench.amplifier.drive_v == 0.0


@pytest.mark.parametrize("frequency_hz", [math.nan, math.inf, -2000.0, 0.0, 50.0, 1.2e6, "2000"])
def test_a_carrier_has_to_be_one_that_the_monitors_show(frequency_hz: float) -> None:
    """100 Hz is one period a block, 1 MHz the highest that is taken."""
    bench = OwnBench()
    with (
        armed(bench.rig) as guarded,
        pytest.raises((LimitError, InputError), match=r"is outside|must be"),
    ):
        guarded.generator.sine(frequency_hz, 0.02)
    assert bench.amplifier.carrier == (0.0, 0.0)


def test_limits_of_carrier_and_supply_may_be_stated() -> None:
    settings = SafetySettings(carrier_limit_v=0.5, supply_limit_v=800.0)
    bench = OwnBench(supply=True)
    with armed(bench.rig, settings) as guarded:
        assert guarded.supply is not None
        guarded.generator.sine(2000.0, 0.5)
        with pytest.raises(LimitError, match=r"0\.5"):
            guarded.generator.sine(2000.0, 0.51)
        with pytest.raises(LimitError, match="800"):
            guarded.supply.set_voltage(801.0)
        guarded.supply.set_voltage(800.0)
    for bad in (math.nan, math.inf, 0.0, -1.0):
        with pytest.raises(InputError, match="carrier_limit_v"):
            SafetySettings(carrier_limit_v=bad)


@pytest.mark.parametrize("carrier", [(2000.0, 0.02), (2000.0, 0.2), (1999.7, 1.0), (66_666.0, 1.0)])
@pytest.mark.parametrize("wrong_v", [0.5, 2.0])
def test_a_large_carrier_does_not_hide_an_output_that_does_not_follow(
    carrier: tuple[float, float], wrong_v: float
) -> None:
    """Half a volt where it is asked for passes for every carrier, 2 V never does."""
    bench = OwnBench()
    with armed(bench.rig, SafetySettings(carrier_limit_v=1.0)) as guarded:
        guarded.generator.sine(*carrier)
        guarded.source.write(0.5)
        for _ in range(20):
            guarded.acquisition.read()
        bench.amplifier.drive_v = wrong_v
        if wrong_v == 0.5:
            guarded.acquisition.read()
        else:
            with pytest.raises(SafetyError, match="does not follow"):
                for _ in range(2):
                    guarded.acquisition.read()


def test_a_setting_of_a_guarded_part_is_refused_and_not_lost() -> None:
    bench = OwnBench()
    guarded = guard(bench.rig)
    for part in (guarded.source, guarded.acquisition, guarded.generator, guarded.stand):
        with pytest.raises(AttributeError, match="Nothing was changed"):
            part.level = 1.0  # type: ignore[union-attr]
    with pytest.raises(AttributeError, match="'jump'"):
        guarded.source.jump(1.0)  # type: ignore[attr-defined]


class _FalseButOne:
    def __bool__(self) -> bool:
        return False

    def __float__(self) -> float:
        return 1.0


@pytest.mark.parametrize(
    "amount",
    [np.ma.array(1.0, mask=True), np.ma.array([1.0], mask=[True]), _FalseButOne(), [[]], {}, (),
     np.array([]), None, "", 0j, False, np.timedelta64(0), math.nan, [0.0, 1.0]],
    ids=lambda amount: f"{type(amount).__name__} {np.size(amount)}",
)  # fmt: skip
def test_only_plain_zeros_pass_without_a_permission(amount: Any) -> None:
    bench = OwnBench(supply=True)
    guard(bench.rig)
    for call in (bench.rig.source.write, bench.rig.supply.set_voltage):
        with pytest.raises(SafetyError, match="not armed"):
            call(amount)
    assert bench.amplifier.drive_v == 0.0
    for zero in (0, -0.0, np.float32(0), np.zeros((2, 1)), [0.0, 0]):
        bench.rig.source.write(zero)


def test_an_expired_permission_does_not_let_a_driver_pass() -> None:
    bench, now_s = OwnBench(), [0.0]
    safety = Safety(SafetySettings(permit_age_s=10.0), clock=lambda: now_s[0])
    guarded = guard(bench.rig, safety)
    safety.arm(safety.request())
    bench.rig.source.write(0.5)
    now_s[0] = 10.5
    with pytest.raises(SafetyError, match="Permit expired: armed for 10 s"):
        bench.rig.source.write(1.0)
    assert bench.amplifier.drive_v == 0.0
    with pytest.raises(SafetyError, match="Permit expired"):
        guarded.source.write(1.0)


def test_a_trip_binds_every_rig_over_the_same_drivers() -> None:
    bench = OwnBench()
    other = dataclasses.replace(bench.rig)
    first, second = guard(bench.rig), guard(other)
    for guarded in (first, second):
        guarded.safety.arm(guarded.safety.request())
    second.source.write(0.5)
    first.safety.trip("Bad.")
    assert bench.amplifier.drive_v == 0.0
    with pytest.raises(SafetyError, match="Bad"):
        second.source.write(0.5)
    second.safety.end_run()
    with pytest.raises(SafetyError, match="acknowledge"):
        second.safety.arm(second.safety.request())
    assert bench.amplifier.drive_v == 0.0


# ---- who may arm ---------------------------------------------------------------------------------


class _Nothing:
    """Recorder and observer."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_, **__: None


def _runner(rig: object) -> Runner:
    nothing = _Nothing()
    return Runner(rig, nothing, nothing, 2000.0, 0.02, SilentProgress())  # type: ignore[arg-type]


def test_a_runner_does_not_arm_a_bench_by_itself() -> None:
    bench = OwnBench()
    with pytest.raises(SafetyError, match="not armed"), _runner(bench.rig):
        pass
    assert bench.amplifier.history == []
    with armed(bench.rig) as guarded, _runner(guarded) as runner:
        runner.play("steps", np.full(5, 0.5), 20.0, 0.25)
        assert bench.amplifier.drive_v == 0.5
    assert bench.amplifier.drive_v == 0.0


# ---- signals -------------------------------------------------------------------------------------

PROGRAM = """
import sys
from pathlib import Path
from types import FrameType
from typing import Any
import numpy as np
from haselab.safety.armed import armed
from tests.safety.own_bench import Amplifier, OwnBench
from tests.safety.test_own_driver import _runner
bench, said = OwnBench(), []
def put(self, drive_v):
    self.drive_v = drive_v
    print(drive_v, flush=True)
Amplifier.put = put
with armed(bench.rig) as guarded:
    if sys.argv[1] == "runner":
        with _runner(guarded) as runner:
            runner.play("long", np.full(10**9, 0.5, np.float16), 20.0, 0.25)
    guarded.source.write(0.5)
    while True:
        guarded.acquisition.read()
"""


@contextlib.contextmanager
def _ended(program: subprocess.Popen[str]) -> Iterator[None]:
    """Kill the program where the test fails: it would never end."""
    try:
        yield
    finally:
        program.kill()


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
@pytest.mark.parametrize("user", ["driver", "runner"])
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGINT])
def test_a_signal_ends_an_armed_program_at_zero(number: signal.Signals, user: str) -> None:
    program = PROGRAM.replace("10**9", "10**4")
    with subprocess.Popen(
        [sys.executable, "-c", program, user], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, cwd=Path(__file__).parents[2],
    ) as running, _ended(running):  # fmt: skip
        assert running.stdout is not None
        while running.stdout.readline().strip() != "0.5":
            assert running.poll() is None
        running.send_signal(number)
        told, _ = running.communicate()
    assert told.split()[-1] == "0.0"
    assert running.returncode in (128 + number, -number)


def test_a_signal_during_the_way_to_zero_comes_after_it() -> None:
    steps: list[str] = []
    former = signal.getsignal(signal.SIGTERM)

    def end(_: BaseException | None) -> None:
        signal.raise_signal(signal.SIGTERM)
        steps.append("0 V")

    with pytest.raises(SystemExit), OrderlyEnd(end):
        pass
    assert steps == ["0 V"]
    assert signal.getsignal(signal.SIGTERM) is former


def _interrupted_at(place: int, first: int | None, nested: bool) -> list[float] | None:
    """Drive of the benches after a block that got SIGINT before its `place`-th instruction in the
    files that end it; None: it has fewer."""
    benches = [OwnBench(), OwnBench()]
    seen, kept = 0, list[BaseException]()

    def trace(frame: FrameType, what: str, _: object) -> Any:
        nonlocal seen
        if Path(frame.f_code.co_filename).name not in ("armed.py", "signals.py"):
            return trace
        frame.f_trace_opcodes = True
        if what == "opcode":
            seen += 1
            if seen == place:
                sys.settrace(None)
                signal.raise_signal(signal.SIGINT)
        return trace

    def block(guarded: Any) -> None:
        guarded.source.write(0.5)
        sys.settrace(trace)
        sys._getframe(1).f_trace = trace
        if first is not None:
            signal.raise_signal(first)

    former = sys.gettrace()
    try:
        if nested:
            with armed(benches[1].rig) as outer, armed(benches[0].rig) as inner:
                outer.source.write(0.5)
                block(inner)
        else:
            with armed(benches[0].rig) as inner:
                block(inner)
    except (KeyboardInterrupt, SystemExit) as stop:
        kept.append(stop)  # its frames live on
    finally:
        sys.settrace(former)
    return None if seen < place else [bench.amplifier.drive_v for bench in benches]


@pytest.mark.parametrize("nested", [False, True])
@pytest.mark.parametrize("first", [None, signal.SIGTERM])
def test_a_signal_at_any_instruction_of_the_end_leaves_no_voltage(first, nested) -> None:
    place = 1
    while (drives_v := _interrupted_at(place, first, nested)) is not None:
        assert drives_v == [0.0, 0.0], place
        place += 7 if nested or first else 1  # each takes 20 ms
    assert place > 100
    # Whatever was interrupted, the next block takes and restores the signals as ever.
    with armed(OwnBench().rig):
        assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_block_in_a_thread_ends_at_zero_with_the_program() -> None:
    program = (
        PROGRAM.partition("with armed")[0]
        + """
import threading
def work():
    with armed(bench.rig) as guarded:
        guarded.source.write(0.5)
        written.set()
        threading.Event().wait()
written = threading.Event()
threading.Thread(target=work, daemon=True).start()
written.wait()
"""
    )
    done = subprocess.run(
        [sys.executable, "-c", program, "thread"], capture_output=True, text=True,
        cwd=Path(__file__).parents[2], check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert "0.5" in done.stdout.split()
    assert done.stdout.split()[-1] == "0.0"


def test_rig_safe_stops_a_program_with_own_drivers_by_its_key(capsys) -> None:
    claim = """
from haselab.safety.gate import Gate
bench.rig.gate = Gate()
bench.rig.gate.claim("MyBoard 1234", call_s=0.1)
"""
    program = PROGRAM.replace("with armed", claim + "with armed", 1)
    with subprocess.Popen(
        [sys.executable, "-c", program, "driver"], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, cwd=Path(__file__).parents[2],
    ) as running, _ended(running):  # fmt: skip
        assert running.stdout is not None
        while running.stdout.readline().strip() != "0.5":
            assert running.poll() is None

        def rig_safe(key: str) -> int:
            with pytest.raises(SystemExit) as stop:
                main(["rig", "safe", "--bench", key])
            return int(stop.value.code or 0)

        assert rig_safe("MyBoard 4321") == 4
        assert "no running program has claimed the bench" in capsys.readouterr().out
        assert running.poll() is None
        assert rig_safe("MyBoard 1234") == 0
        assert "its program reported 0 V" in capsys.readouterr().out
        told, failed = running.communicate()
    assert told.split()[-1] == "0.0"
    assert "'haselab rig safe' was called" in failed


def test_handlers_of_the_program_and_other_threads_are_left_alone() -> None:
    def mine(number: int, frame: object) -> None:
        """Of the program."""

    former = signal.signal(signal.SIGTERM, mine)
    try:
        with OrderlyEnd(lambda _: None):
            assert signal.getsignal(signal.SIGTERM) is mine
    finally:
        signal.signal(signal.SIGTERM, former)
    seen: list[object] = []

    def aside() -> None:
        with OrderlyEnd(lambda _: None):
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=aside)
    thread.start()
    thread.join()
    assert seen == [former]


def test_after_a_wait_of_the_program_begin_says_that_blocks_may_be_missing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    own, missing = OwnBench(), [0, 100, 0, 100]
    read = own.board.read

    def read_after_wait() -> Any:
        own.board._blocks += missing.pop(0) if missing else 0
        return read()

    monkeypatch.setattr(own.board, "read", read_after_wait)
    with armed(own.rig) as guarded:
        guarded.source.write(0.5)
        guarded.acquisition.read()
        guarded.begin()
        for _ in range(2):
            guarded.source.write(0.6)
            guarded.acquisition.read()
        with pytest.raises(DeviceError, match=r"instead of 2000\. .* call begin\(\)"):
            guarded.acquisition.read()
    assert own.amplifier.drive_v == 0.0
