"""A signal that comes up where Python drops exceptions is neither lost nor told twice."""

import signal
import subprocess
import sys

import pytest

SCRIPT = """
import os, signal, sys, weakref
from haselab.app.interrupt import Interruptible
from haselab.base import SilentProgress

class Thing: pass

progress = Interruptible(SilentProgress())
progress.start(1.0)
thing = Thing()
keep = weakref.ref(thing, lambda _: os.kill(os.getpid(), {number}))
del thing  # the callback runs here; what it raises is dropped
print("went on")
try:
    progress.advance(1.0, "step")
except KeyboardInterrupt:
    print("ended at the next step")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX's")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_inside_a_finaliser_ends_the_job_at_the_next_step_in_silence(number: int) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT.format(number=int(number))],
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    assert done.stdout.split("\n")[:2] == ["went on", "ended at the next step"]
    assert done.stderr == ""


def test_other_dropped_exceptions_are_still_told() -> None:
    script = SCRIPT.replace("os.kill(os.getpid(), {number})", "1 / 0")
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=60, check=True
    )
    assert "ZeroDivisionError" in done.stderr
