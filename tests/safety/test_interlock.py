"""The latch and the locks of a bench, seen from several processes."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import shutil
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.base import SafetyError
from haselab.safety import interlock as interlock_module
from haselab.safety.gate import Gate
from haselab.safety.guardian.heartbeat import SILENT_S, Heartbeat
from haselab.safety.interlock import Interlock, InterlockBusyError, lease_clock_s
from haselab.safety.state_machine import Safety, SafetySettings

POSIX = pytest.mark.skipif(sys.platform == "win32", reason="forks and signals are POSIX's")
KEY = "NI 01A2B3C4"


def chain_of(gate: Gate) -> Safety:
    safety = Safety(SafetySettings())
    safety.attach(gate, lambda: None)
    return safety


def test_a_revocation_is_seen_by_another_process_with_its_first_reason(tmp_path: Path) -> None:
    ours, theirs = Interlock(KEY, tmp_path), Interlock(KEY, tmp_path)
    before = ours.revision
    assert (ours.reason, theirs.reason) == ("", "")
    theirs.revoke("Smoke.")
    theirs.revoke("Fire.")
    assert ours.revision == theirs.revision != before
    assert ours.reason.startswith("Smoke (on ")
    for each in (ours, theirs):
        each.close()
    assert Interlock(KEY, tmp_path).reason.startswith("Smoke (on "), "it outlives the programs"


def test_what_was_revoked_after_a_look_is_not_acknowledged_with_it(tmp_path: Path) -> None:
    interlock = Interlock(KEY, tmp_path)
    interlock.revoke("Smoke.")
    seen = interlock.revision
    interlock.revoke("Fire.")
    interlock.acknowledge(seen)
    assert interlock.reason
    interlock.acknowledge(interlock.revision)
    assert interlock.reason == ""
    interlock.revoke("Water.")
    assert interlock.reason.startswith("Water (on ")


@given(st.lists(st.sampled_from(["revoke", "acknowledge"]), max_size=30))
def test_a_permission_for_a_revision_is_never_valid_again_once_it_was_revoked(
    events: list[str],
) -> None:
    interlock = Interlock()
    given_for, revoked = interlock.revision, False
    for event in events:
        if event == "revoke":
            interlock.revoke("Smoke.")
            revoked = True
        else:
            interlock.acknowledge(interlock.revision)
        assert (interlock.revision == given_for) is not revoked


def test_one_program_owns_a_bench_and_another_bench_is_free(tmp_path: Path) -> None:
    first, second = Interlock(KEY, tmp_path), Interlock(KEY, tmp_path)
    first.own("haselab run")
    with pytest.raises(InterlockBusyError, match=rf"haselab run, process {os.getpid()}"):
        second.own("haselab run")
    other = Interlock("NI 00000001", tmp_path)
    other.own("haselab run")
    first.close()
    assert not second.own("haselab run"), "the first one has left in good order"
    assert second.owner_pid == os.getpid()


def _owns_and_is_killed(folder: Path, reported: Any, armed: bool) -> None:
    interlock = Interlock(KEY, folder)
    interlock.own("a run")
    if armed:
        interlock.set_live(True)
    reported.set()
    signal.pause()


@POSIX
@pytest.mark.parametrize("armed", [True, False])
def test_a_program_that_vanishes_while_armed_leaves_a_latch(tmp_path: Path, armed: bool) -> None:
    fork = multiprocessing.get_context("fork")
    reported = fork.Event()
    process = fork.Process(target=_owns_and_is_killed, args=(tmp_path, reported, armed))
    process.start()
    assert reported.wait(60.0)
    process.kill()
    process.join()
    interlock = Interlock(KEY, tmp_path)
    assert interlock.own("the next run")
    assert ("a run" in interlock.reason and "ended while armed" in interlock.reason) is armed
    assert not interlock.live


def _is_inside(folder: Path, reported: Any) -> None:
    interlock = Interlock(KEY, folder)
    interlock.own("a run", call_s=0.2)

    def pause(acquired: bool) -> None:
        assert acquired
        reported.set()
        signal.pause()

    interlock.holding_output(pause, 0.0)


@POSIX
def test_a_program_that_hangs_in_a_driver_is_killed_and_the_act_done_twice(tmp_path: Path) -> None:
    fork = multiprocessing.get_context("fork")
    reported = fork.Event()
    process = fork.Process(target=_is_inside, args=(tmp_path, reported))
    process.start()
    assert reported.wait(60.0)
    os.kill(process.pid or 0, signal.SIGSTOP)  # as one that hangs in a driver, it holds its lock
    interlock = Interlock(KEY, tmp_path)
    acts: list[int] = []
    interlock.revoke("Smoke.")
    assert interlock.make_safe(lambda: not acts.append(interlock.revision), wait_s=0.01)
    process.join(60.0)
    assert process.exitcode == -signal.SIGKILL
    assert len(acts) == 2, "at once, and when nothing can follow any more"


def test_a_call_under_way_in_another_thread_is_waited_for() -> None:
    interlock, inside, leave = Interlock(), threading.Event(), threading.Event()

    def call(acquired: bool) -> None:
        assert acquired
        inside.set()
        leave.wait(60.0)

    thread = threading.Thread(target=interlock.holding_output, args=(call, 0.0))
    thread.start()
    assert inside.wait(60.0)
    acts: list[bool] = []

    def act() -> bool:
        acts.append(leave.is_set())
        leave.set()
        return True

    assert interlock.make_safe(act, wait_s=0.01)
    thread.join(60.0)
    assert acts == [False, True], "once at once, once after the call"


def test_the_holder_of_the_output_lock_may_take_it_again() -> None:
    interlock = Interlock()
    assert interlock.holding_output(
        lambda first: first and interlock.holding_output(lambda again: again, 0.0), 0.0
    )


def test_only_what_was_confirmed_after_the_last_revocation_counts(tmp_path: Path) -> None:
    interlock = Interlock(KEY, tmp_path)
    assert not interlock.confirmed_safe
    interlock.set_live(True)
    interlock.confirm_safe(interlock.revoke("Smoke."))
    assert interlock.confirmed_safe and not interlock.live
    interlock.revoke("Fire.")
    assert not interlock.confirmed_safe


@pytest.mark.parametrize("text", ["", "a" * 5000, "ü" * 500, "two\nlines", "nul\0inside"])
def test_any_reason_fits(tmp_path: Path, text: str) -> None:
    interlock = Interlock(KEY, tmp_path)
    interlock.revoke(text)
    assert (interlock.reason and interlock.reason.isprintable()) or "\n" in text
    assert Interlock(KEY, tmp_path).reason == interlock.reason


@POSIX
def test_a_link_in_the_shared_folder_is_not_followed(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    (tmp_path / "NI_01A2B3C4.state").symlink_to(victim)
    with pytest.raises(OSError, match=r"Too many levels|symbolic|loop"):
        Interlock(KEY, tmp_path)
    assert victim.read_text() == "precious"


def test_a_counter_that_goes_on_is_alive_and_one_that_stops_is_silent() -> None:
    heartbeat, now_s = Heartbeat(), 0.0
    for count in range(100):
        now_s += 0.02
        assert heartbeat.silent_s(count, now_s) == 0.0
    looks = 0
    while heartbeat.silent_s(99, now_s) <= SILENT_S:
        now_s += 0.02
        looks += 1
    assert looks * 0.02 == pytest.approx(SILENT_S, abs=0.04)


def test_a_pause_of_the_whole_computer_is_not_silence() -> None:
    heartbeat = Heartbeat()
    heartbeat.silent_s(1, 0.0)
    for k in range(1, 4):  # three pauses of ten seconds, one look after each
        assert heartbeat.silent_s(1, 10.0 * k) < SILENT_S


@POSIX
@pytest.mark.parametrize("damage", ["emptied", "removed", "garbage", "folder removed"])
def test_a_damaged_file_ends_every_permission_and_nothing_else(tmp_path: Path, damage: str) -> None:
    interlock = Interlock(KEY, tmp_path / "shared")
    interlock.own("a run")
    interlock.set_live(True)
    permitted = interlock.revision
    state = next((tmp_path / "shared").glob("*.state"))
    if damage == "emptied":
        os.truncate(state, 0)
    elif damage == "removed":
        state.unlink()
    elif damage == "garbage":
        state.write_bytes(b"\xff" * 1024)
    else:
        shutil.rmtree(state.parent)
    assert interlock.revision != permitted and interlock.live
    assert "damaged or removed" in interlock.reason
    assert interlock.make_safe(lambda: True, 0.0)
    other = Interlock(KEY, tmp_path / "shared")  # as 'haselab rig safe' opens it
    other.revoke("Smoke.")
    assert other.reason and interlock.revision != permitted
    for each in (interlock, other):
        each.close()


@pytest.mark.parametrize("at", range(8, 128, 8))
@pytest.mark.parametrize("value", [-1, 1, 2**63 - 1, -(2**63), 0x7FF0000000000000])
def test_any_number_in_the_file_is_survived(tmp_path: Path, at: int, value: int) -> None:
    interlock = Interlock(KEY, tmp_path)
    interlock._put(at, value)
    before = interlock.revision
    interlock.revoke("Smoke.")
    assert interlock.reason
    assert interlock.revision not in (before, -1)
    assert interlock.make_safe(lambda: True, 0.0)
    interlock.close()


@POSIX
def test_a_fork_of_the_program_has_no_permission_and_ends_nothing(tmp_path: Path) -> None:
    gate = Gate(Interlock(KEY, tmp_path))
    gate.interlock.own("a run")
    gate.permit(gate.interlock.revision)
    fork = multiprocessing.get_context("fork")
    reported = fork.Queue()

    def child() -> None:
        reported.put(gate.permitted)
        gate.release()

    process = fork.Process(target=child)
    process.start()
    assert reported.get(timeout=60.0) is False
    process.join(60.0)
    assert gate.permitted and gate.interlock.live
    with pytest.raises(InterlockBusyError, match="a run"):
        Interlock(KEY, tmp_path).own("another")


def test_a_confirmation_that_comes_late_leaves_a_new_permission_live() -> None:
    interlock = Interlock()
    revision = interlock.revoke("Smoke.")
    interlock.acknowledge(revision)
    interlock.set_live(True)  # armed while the act was still under way
    interlock.confirm_safe(revision)
    assert interlock.live


def test_a_folder_that_is_not_absolute_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HASELAB_INTERLOCKS", "here")
    with pytest.raises(OSError, match="must be an absolute path"):
        Interlock(KEY)


@pytest.mark.parametrize("part", ["state", "owner", "output"])
def test_a_file_that_was_removed_ends_every_permission(tmp_path: Path, part: str) -> None:
    gate = Gate(Interlock(KEY, tmp_path))
    gate.interlock.own("a run")
    gate.permit(gate.interlock.revision)
    assert gate.permitted
    (tmp_path / f"NI_01A2B3C4.{part}").unlink()
    assert not gate.permitted
    other = Interlock(KEY, tmp_path)  # writes the file anew
    assert not gate.permitted and gate.interlock.reason
    other.close()
    with pytest.raises(SafetyError, match=r"files were removed"):
        chain_of(gate).request()


@pytest.mark.parametrize("content", [b"", b"HASELAB4", b"garbage" * 1000])
def test_a_file_written_anew_gives_no_permission_back(tmp_path: Path, content: bytes) -> None:
    gate = Gate(Interlock(KEY, tmp_path))
    gate.interlock.own("a run")
    gate.permit(gate.interlock.revision)
    (tmp_path / "NI_01A2B3C4.state").write_bytes(content)
    assert not gate.permitted
    Interlock(KEY, tmp_path).close()
    assert not gate.permitted
    assert "damaged" in gate.interlock.reason


def test_a_closed_interlock_permits_nothing_and_reports_its_reason(tmp_path: Path) -> None:
    interlock = Interlock(KEY, tmp_path)
    interlock.own("a run")
    interlock.revoke("Smoke.")
    gate = Gate(interlock)
    gate.release()
    assert interlock.reason.startswith("Smoke (")
    gate.permit(interlock.revision)
    assert not gate.permitted
    with pytest.raises(SafetyError, match=r"the rig was closed"):
        chain_of(gate).request()


@POSIX
def test_an_interrupt_at_any_place_leaves_no_lock_behind(tmp_path: Path) -> None:
    ours, theirs = Interlock(KEY, tmp_path), Interlock(KEY, tmp_path)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        for k in range(400):
            with contextlib.suppress(KeyboardInterrupt):
                signal.setitimer(signal.ITIMER_REAL, 2e-5 + 7e-7 * k)
                while True:
                    ours.holding_output(lambda acquired: None, 0.0)
            assert theirs.holding_output(lambda acquired: acquired, 0.0), f"after {k} interrupts"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


@pytest.mark.skipif(not Path("/proc/locks").exists(), reason="needs Linux's list of locks")
def test_a_process_that_only_the_file_names_is_not_killed(tmp_path: Path) -> None:
    """Every user may write the file; the system knows who has the lock."""
    fork = multiprocessing.get_context("fork")
    reported = fork.Event()
    holder = fork.Process(target=_is_inside, args=(tmp_path, reported))
    innocent = fork.Process(target=signal.pause)
    for process in (holder, innocent):
        process.start()
    assert reported.wait(60.0)
    interlock = Interlock(KEY, tmp_path)
    interlock._put(interlock_module._HOLDER, innocent.pid or 0)
    assert interlock.make_safe(lambda: True, wait_s=0.01)
    holder.join(60.0)
    assert holder.exitcode == -signal.SIGKILL
    assert innocent.is_alive()
    innocent.kill()


@POSIX
def test_a_folder_that_was_there_keeps_its_mode(tmp_path: Path) -> None:
    place = tmp_path / "private"
    place.mkdir(mode=0o700)
    Interlock(KEY, place).close()
    assert place.stat().st_mode & 0o7777 == 0o700
    Interlock(KEY, tmp_path / "new").close()
    assert (tmp_path / "new").stat().st_mode & 0o7777 == 0o1777


def test_a_program_that_shares_an_instrument_is_refused_and_reached(tmp_path: Path) -> None:
    ours, theirs = Interlock(KEY, tmp_path), Interlock("NI 00000001", tmp_path)
    ours.own("a run", shared=("TCPIP::a::SOCKET", "/dev/ttyACM0"))
    with pytest.raises(InterlockBusyError, match=r"a run, process .* board NI_01A2B3C4"):
        theirs.own("another", shared=("TCPIP::b::SOCKET", "/dev/ttyACM0"))
    assert not theirs.own("another", shared=("TCPIP::b::SOCKET",))
    assert [each.key for each in theirs.sharing(("/dev/ttyACM0",))] == ["NI_01A2B3C4"]
    ours.close()
    assert theirs.sharing(("/dev/ttyACM0",)) == []


@pytest.mark.skipif(not hasattr(time, "CLOCK_BOOTTIME"), reason="a clock of Linux")
def test_a_lease_counts_while_the_computer_sleeps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A suspended computer stops all its programs, but the output of a board stays."""
    found, slept_s = Interlock(KEY, tmp_path), [0.0]
    clock = time.clock_gettime

    def sleeping(which: int) -> float:
        return clock(which) + slept_s[0] * (which == time.CLOCK_BOOTTIME)

    monkeypatch.setattr(time, "clock_gettime", sleeping)
    found.lease(600.0)
    assert lease_clock_s() < found.lease_end_s
    slept_s[0] = 3600.0
    assert lease_clock_s() > found.lease_end_s
    found.close()
