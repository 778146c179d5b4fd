"""A signal that comes up where Python drops exceptions is neither lost nor told twice."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

if sys.platform != "win32":
    import fcntl
    import termios

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


CLOSED = """
import signal, sys, time
from haselab.app.interrupt import Interruptible
from haselab.base import SilentProgress

progress = Interruptible(SilentProgress())
try:
    print("there", flush=True)
    time.sleep(300.0)
except KeyboardInterrupt:
    print("told", "to nobody", file=sys.stderr, flush=True)
    open(sys.argv[1], "w").write("cleaned up")
    sys.exit(130)
"""


@pytest.mark.skipif(sys.platform == "win32", reason="ptys are POSIX's")
def test_a_closed_terminal_does_not_stop_the_clean_up(tmp_path: Path) -> None:
    main, end = os.openpty()
    program = subprocess.Popen(
        [sys.executable, "-c", CLOSED, str(tmp_path / "done")], stdin=end, stdout=end, stderr=end,
        start_new_session=True, preexec_fn=lambda: fcntl.ioctl(0, termios.TIOCSCTTY, 0),
    )  # fmt: skip
    os.close(end)
    assert os.read(main, 100).startswith(b"there")
    os.close(main)
    assert program.wait(timeout=200) == 130
    assert (tmp_path / "done").read_text() == "cleaned up"
