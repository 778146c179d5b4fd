"""A signal during an exception that Python drops is neither lost nor reported twice."""

import os
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from haselab.cli import entry as start

if sys.platform != "win32":
    import fcntl
    import termios

SCRIPT = """
import os, signal, sys, weakref
from haselab.cli.interrupt import Interruptible
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
        capture_output=True, text=True, timeout=300, check=True,
    )  # fmt: skip
    assert done.stdout.split("\n")[:2] == ["went on", "ended at the next step"]
    assert done.stderr == ""


def test_other_dropped_exceptions_are_still_printed() -> None:
    script = SCRIPT.replace("os.kill(os.getpid(), {number})", "1 / 0")
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=True
    )
    assert "ZeroDivisionError" in done.stderr


CLOSED = """
import signal, sys, time
from haselab.cli.interrupt import Interruptible
from haselab.base import SilentProgress

progress = Interruptible(SilentProgress())
try:
    print("there", flush=True)
    time.sleep(300.0)
except KeyboardInterrupt:
    print("printed", "to no one", file=sys.stderr, flush=True)
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
    assert program.wait(timeout=300) == 130
    assert (tmp_path / "done").read_text() == "cleaned up"


# ---- from the first line of the entry point on --------------------------------------------------

# Import number {at} sends Ctrl-C to its own process, the next ones do so {more} more times.
IMPORTING = """
import builtins, os, signal, sys
from haselab.cli import entry

real, left, sent = builtins.__import__, [{at}], [0]

def counted(*args, **kwargs):
    left[0] -= 1
    if left[0] <= 0 and sent[0] <= {more}:
        sent[0] += 1
        os.kill(os.getpid(), signal.SIGINT)
    return real(*args, **kwargs)

signal.signal(signal.SIGINT, signal.default_int_handler)
builtins.__import__ = counted
sys.argv = ["haselab", {command}, "none.csv"]
entry.main()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX's")
@pytest.mark.parametrize(
    ("at", "command"),
    [*((at, '"sense"') for at in (1, 5, 60, 300, 1000, 1800)), (1800, '"identify", "transfer"')],
)
@pytest.mark.parametrize("more", [0, 1])
def test_ctrl_c_while_modules_are_imported_ends_with_130_and_one_line(
    at: int, command: str, more: int
) -> None:
    script = IMPORTING.format(at=at, command=command, more=more)
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 130, done.stderr
    assert done.stderr.split() == ["haselab:", "Interrupted."]


# A command that is asked to end, {twice} while it cleans up, and by a finaliser.
CLEANING = """
import os, signal, sys, time
import click
from haselab.cli import entry, main as line

class Dropped:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        for _ in range(100): pass

@click.command("design")
def command():
    try:
        if {dropped}:
            Dropped()
        else:
            os.kill(os.getpid(), signal.SIGINT)
        time.sleep(600.0)
    finally:
        for _ in range({later}):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.01)
        print("cleaned up", flush=True)

line._Root.get_command = lambda self, context, name: command
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.argv = ["haselab", "design"]
entry.main()
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX's")
@pytest.mark.parametrize(("dropped", "later"), [(False, 0), (False, 5), (True, 0)])
def test_ctrl_c_lets_a_command_clean_up_and_ends_with_130(dropped: bool, later: int) -> None:
    script = CLEANING.format(dropped=dropped, later=later)
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 130, done.stderr
    assert done.stdout == "cleaned up\n"
    assert done.stderr.strip() == "haselab: Interrupted."


def test_the_console_script_and_the_module_start_in_the_same_place() -> None:
    settings = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    assert settings["project"]["scripts"]["haselab"] == "haselab.cli.entry:main"
    assert "from haselab.cli.entry import main" in Path(start.__file__).with_name(
        "__main__.py"
    ).read_text()  # fmt: skip


def test_an_interrupted_program_ends_without_the_destructors_of_libraries(tmp_path: Path) -> None:
    """But after its threads, its exit functions and its output; another exit code ends as usual."""
    text = (
        "import atexit, ctypes, sys, threading, time\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "from haselab.cli.main import end_despite_threads\n"
        "libc = ctypes.CDLL(None)\n"
        "libc.__cxa_atexit(libc.abort, None, None)\n"  # as the destructor of a library
        "atexit.register(lambda: print('exit function'))\n"
        "threading.Thread(target=lambda: (time.sleep(0.3), print('thread'))).start()\n"
        "ThreadPoolExecutor(1).submit(int)\n"  # its thread ends only if it is asked to
        "stop = SystemExit(int(sys.argv[1]))\n"
        "end_despite_threads(stop)\n"
        "raise stop\n"
    )
    ends = []
    for code in ("130", "3"):
        done = subprocess.run([sys.executable, "-c", text, code], capture_output=True, text=True,
                              timeout=100.0, check=False)  # fmt: skip
        ends.append((done.returncode, done.stdout.split("\n")[:2]))
    assert ends[0] == (130, ["thread", "exit function"])
    assert ends[1] == (-6, ["thread", "exit function"]), "the destructor runs"
