"""The helping process: results, errors, its end; and a process that comes first."""

from __future__ import annotations

import math
import operator
import os
import signal
import subprocess
import sys
import textwrap
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from haselab.base import DeviceError
from haselab.runtime.helper_process import HelperProcess
from haselab.runtime.scheduling import with_priority

PATIENCE_S = 30.0  # with a loaded machine


def gone(pid: int) -> bool:
    """Whether a process that is no child of ours has ended; a zombie has."""
    until = time.monotonic() + PATIENCE_S
    while time.monotonic() < until:
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        except OSError:
            return True
        if state == "Z":
            return True
        time.sleep(0.01)
    return False


@pytest.fixture
def aside():
    process = HelperProcess(["math"])
    yield process
    process.close()
    process.close()


def test_arrays_go_there_and_back_and_errors_come_back_as_they_are(aside):
    image = np.arange(512 * 512.0).reshape(512, 512)
    np.testing.assert_array_equal(aside.call(np.negative, image), -image)
    with pytest.raises(ZeroDivisionError, match="division by zero"):
        aside.call(operator.truediv, 1, 0)
    assert aside.call(math.hypot, 3.0, 4.0) == 5.0


def test_it_is_another_process_and_what_is_printed_there_spoils_no_answer(aside):
    assert aside.call(os.getpid) not in (os.getpid(), 0)
    assert aside.call(print, "no answer") is None
    assert aside.call(math.hypot, 3.0, 4.0) == 5.0


def test_other_threads_run_while_it_computes(aside):
    aside.call(time.sleep, 0.0)  # it is there
    ticks, ended = [], threading.Event()

    def tick() -> None:
        while not ended.wait(0.001):
            ticks.append(time.monotonic())

    thread = threading.Thread(target=tick)
    thread.start()
    aside.call(time.sleep, 0.5)
    ended.set()
    thread.join()
    assert len(ticks) > 5


def test_a_process_that_dies_is_reported_in_one_line(aside):
    os.kill(aside.call(os.getpid), signal.SIGKILL)
    with pytest.raises(DeviceError, match=r"helper process of the .* loop has ended .*run again\."):
        aside.call(math.hypot, 3.0, 4.0)


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks into /proc")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_it_ends_with_the_program_however_that_ends(number):
    code = """
        import os, time
        from haselab.runtime.helper_process import HelperProcess
        aside = HelperProcess(["math"])
        print(aside.call(os.getpid), flush=True)
        time.sleep(60)
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program:
        pid = int(program.stdout.readline())
        program.send_signal(number)
    assert gone(pid)


def test_the_priority_is_restored_even_if_it_was_not_allowed(monkeypatch):
    switch_s, nice = sys.getswitchinterval(), os.getpriority(os.PRIO_PROCESS, 0)
    with pytest.raises(KeyError, match="ended"), with_priority() as allowed:
        assert sys.getswitchinterval() < 1e-3
        assert os.getpriority(os.PRIO_PROCESS, 0) == (min(nice, -10) if allowed else nice)
        raise KeyError("ended")
    assert (sys.getswitchinterval(), os.getpriority(os.PRIO_PROCESS, 0)) == (switch_s, nice)

    def refuse(*given):
        raise PermissionError

    monkeypatch.setattr(os, "setpriority", refuse)
    with with_priority() as allowed:
        assert not allowed
    assert sys.getswitchinterval() == switch_s


@pytest.mark.skipif(sys.platform == "win32", reason="sessions are POSIX's")
def test_the_process_yields_to_the_program_and_gets_no_ctrl_c() -> None:
    aside = HelperProcess(["math"], yields=True)
    helper = aside.call(os.getpid)
    assert os.getpriority(os.PRIO_PROCESS, helper) > os.getpriority(os.PRIO_PROCESS, 0)
    assert os.getsid(helper) == os.getsid(0)  # priorities count within a session
    assert os.getpgid(helper) != os.getpgrp()  # the terminal's Ctrl-C goes to a group
    aside.close()


@pytest.mark.skipif(sys.platform == "win32", reason="SIGSTOP is POSIX's")
def test_a_stopped_process_is_an_error_and_not_waited_for_forever() -> None:
    aside = HelperProcess(["math"])
    assert aside.call(math.hypot, 3.0, 4.0) == 5.0
    aside._patience_s = 0.2
    os.kill(aside._process.pid, signal.SIGSTOP)
    with pytest.raises(DeviceError, match=r"has not replied for 0\.2 s"):
        aside.call(math.hypot, 3.0, 4.0)
    with pytest.raises(DeviceError, match="has ended"):
        aside.call(math.hypot, 3.0, 4.0)
    aside.close()
