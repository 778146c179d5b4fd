"""Whole runs that end too soon, as processes: 0 V, one line, the recording kept."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from haselab.base import SilentProgress
from haselab.cli.interrupt import Interruptible
from haselab.store.session.writer import SessionReader
from haselab.store.video.opening import open_video
from haselab.study import definition

pty = pytest.importorskip("pty", reason="signals and terminals are POSIX's")

BUILTIN = Path(definition.__file__).parent / "studies" / "hasel-iros2018.toml"
# The smallest study that gets past its maps: a second or two of each test.
TINY: dict[str, dict[str, Any]] = {
    "triangle": {"frequency_hz": 1.0, "cycles": 3, "frame_rate_hz": 200.0},
    "static_load": {"masses_kg": [0.05 * k for k in range(14)], "settle_s": 30.0,
                    "frame_rate_hz": 100.0},
    "free_response": {"trials": 1, "settle_s": 0.5, "record_s": 1.5, "frame_rate_hz": 100.0},
    "chirp": {"duration_s": 4.0, "hold_s": 1.0, "frame_rate_hz": 50.0},
    "steps": {"zero_s": 2.0, "step_s": 3.0, "rest_s": 0.5, "open_trials": 1},
}  # fmt: skip
# Runs the command line on a bench that is watched from outside, and sends real signals to itself.
DRIVER = """
    import json, os, signal, sys
    from haselab.cli.study import run, study_run
    from haselab.cli.interrupt import Interruptible
    from haselab.cli.main import main
    from haselab.rig.twin.twin_bench import TwinBench
    from haselab.store.session.writer import SessionWriter
    from haselab.store.video.writer import VideoWriter
    meter, where, number, again = sys.argv[1:5]
    benches, sent, passed = [], [], []

    def watched(config, seed, real=run.twin_rig):
        benches.append(real(config, seed))
        return benches[0]

    def send():
        sent.append(benches[0].source.output_v)
        os.kill(os.getpid(), int(number))

    def advance(self, amount, what, real=Interruptible.advance):
        passed.append(what)
        if passed.count(where) == (3 if where == "triangle" else 1) and not sent:
            send()  # the third look at the triangle sees it rise
        real(self, amount, what)

    def insistent(real):
        def call(self, *arguments):
            if sent and again == "again":
                send()
            return real(self, *arguments)
        return call

    run.twin_rig = watched
    Interruptible.advance = advance
    TwinBench.zero = insistent(TwinBench.zero)
    TwinBench.off = insistent(TwinBench.off)
    VideoWriter.close = insistent(VideoWriter.close)
    SessionWriter.close = insistent(SessionWriter.close)
    try:
        main(sys.argv[5:])
    finally:
        bench = benches[0].source
        with open(meter, "w") as file:
            json.dump([bench.output_v, bench._native.carrier_v, sent], file)
"""


@dataclass(frozen=True)
class Ended:
    """What a run left: its process, its folder, and the meters on its bench."""

    code: int
    stdout: str
    line: str
    folder: Path
    output_v: float
    carrier_v: float
    sent_at_v: list[float]

    @property
    def events(self) -> list[str]:
        with SessionReader(self.folder / "session.h5") as session:
            return [what for _, what in session.events()]


def tiny_study(folder: Path) -> list[str]:
    """Arguments that run the built-in study, shrunk."""
    text = BUILTIN.read_text().partition("[quick.")[0]
    for table, values in TINY.items():
        rows = [f"{key} = {json.dumps(value)}" for key, value in values.items()]
        text += "\n".join(["", f"[quick.{table}]", *rows])
    folder.mkdir(exist_ok=True)
    (folder / "study.toml").write_text(text + "\n")
    (folder / "rig.toml").write_text('kind = "twin"\nseed = 4\n')
    return ["run", str(folder / "study.toml"), "--rig", str(folder / "rig.toml"), "--quick"]


def play(
    folder: Path, where: str, number: int = signal.SIGINT, again: bool = False,
    keep: str = "none", start: str = "",
) -> Ended:  # fmt: skip
    """Run the tiny study; where its progress has come to `where` it gets a signal."""
    out, meter = folder / "out", folder / "meter.json"
    arguments = [*tiny_study(folder), "--keep-video", keep, "--json", "--out", str(out)]
    printed = [str(meter), where, str(int(number)), "again" if again else "once"]
    command = [sys.executable, "-c", start + textwrap.dedent(DRIVER), *printed, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    output_v, carrier_v, sent = json.loads(meter.read_text())
    return Ended(done.returncode, done.stdout, lines[0], out, output_v, carrier_v, sent)


def analysed(folder: Path, code: int) -> str:
    command = [sys.executable, "-m", "haselab.cli", "analyse", str(folder), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (code, 1), done.stderr
    assert (done.stdout == "") == (code == 2)
    return done.stderr


def refused_by_analyse(folder: Path) -> str:
    return analysed(folder, 2)


INTERRUPTED = (  # and the folder
    r"haselab: Interrupted\. Output at 0 V; \S+ V read back\. "
    r"The data recorded so far are kept in \S+\.$"
)


@pytest.mark.parametrize(
    ("where", "number", "cut"),
    [
        ("triangle", signal.SIGINT, "triangle"),
        ("static", signal.SIGTERM, "static"),
        ("chirp", signal.SIGHUP, "chirp"),
        ("fit: Static load", signal.SIGINT, None),
    ],
)
def test_a_signal_anywhere_ends_at_zero_with_130_and_the_recording_is_kept(
    tmp_path: Path, where: str, number: int, cut: str | None
) -> None:
    run = play(tmp_path, where, number)
    assert (run.code, run.stdout) == (130, "")
    assert re.match(INTERRUPTED, run.line)
    assert (run.output_v, run.carrier_v) == (0.0, 0.0)
    assert run.events[-1] == "ended by KeyboardInterrupt; output at 0 V"
    if cut is None:
        assert run.events[-2] == "end hold-5"
        assert "The run ended before its last experiment: interr" in analysed(run.folder, 3)
    else:
        assert f"start {cut}" in run.events and f"end {cut}" not in run.events
        if any(what.startswith("end ") for what in run.events):  # the complete ones are analysed
            assert f"The run ended in {cut!r}: interrupted." in analysed(run.folder, 3)
        else:
            assert f"The recording of {cut} was cut short" in refused_by_analyse(run.folder)


def test_further_ctrl_c_in_the_clean_up_leave_it_alone(tmp_path: Path) -> None:
    run = play(tmp_path, "triangle", again=True, keep="all")
    assert (run.code, run.stdout) == (130, "")
    assert re.match(INTERRUPTED, run.line)
    assert (run.output_v, run.carrier_v) == (0.0, 0.0)
    # The first while the triangle rises, the others in zero(), off(), and both files' close().
    assert len(run.sent_at_v) >= 5
    assert run.sent_at_v[0] > 100.0
    assert run.events[-1] == "ended by KeyboardInterrupt; output at 0 V"
    with open_video(run.folder / "video" / "triangle.avi") as video:
        times_s = [time for time, _ in video.timed()]
    with SessionReader(run.folder / "session.h5") as session:
        frames = session.experiment("triangle").frame_time_s
    assert len(times_s) == len(frames) > 10
    assert (run.folder / "video" / "triangle.csv").exists()


def test_a_disk_that_fills_up_with_video_ends_at_zero_with_4(tmp_path: Path) -> None:
    limit = (
        "import resource, signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (14_000_000, 14_000_000))\n"
    )
    run = play(tmp_path, "nowhere", keep="all", start=limit)
    assert run.code == 4
    assert run.stdout == ""
    video = run.folder / "video" / "triangle.avi"
    assert run.line.startswith("haselab: The video cannot be written (File too large). Free disk")
    assert run.line.endswith(str(video))
    assert (run.output_v, run.carrier_v) == (0.0, 0.0)
    assert run.events[-1] == "ended by DeviceError; output at 0 V"
    with open_video(video) as frames:
        assert sum(1 for _ in frames) > 10
    assert "The recording of triangle was cut short" in refused_by_analyse(run.folder)


UNDER_WAY = 6_000_000  # bytes: the empty recording of the tiny study takes 3.8 MB, a block 8 kB


def started(path: Path, process: subprocess.Popen[Any], size: int) -> None:
    until = time.monotonic() + 300.0
    while not (path.exists() and path.stat().st_size > size):
        assert process.poll() is None and time.monotonic() < until
        time.sleep(0.02)


def test_a_killed_run_leaves_a_session_that_can_be_read(tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "haselab.cli", *tiny_study(tmp_path), "--out", str(out)]
    with subprocess.Popen(command, stderr=subprocess.PIPE) as process:
        started(out / "session.h5", process, UNDER_WAY)
        process.kill()
    with SessionReader(out / "session.h5") as session:
        assert len(session.experiment("triangle").codes) >= 10
        assert session.events()[-1][1].startswith(("start", "end"))
    assert "was cut short" in refused_by_analyse(out)


def test_ctrl_c_at_a_terminal_takes_the_bar_away_and_says_one_line(tmp_path: Path) -> None:
    out = tmp_path / "out"
    command = [sys.executable, "-m", "haselab.cli", *tiny_study(tmp_path), "--out", str(out)]
    leader, follower = pty.openpty()
    shown = b""
    with subprocess.Popen(
        command, stdin=follower, stdout=subprocess.PIPE, stderr=follower, start_new_session=True,
        preexec_fn=lambda: os.close(os.open(os.ttyname(0), os.O_RDWR)),
    ) as process:  # fmt: skip
        os.close(follower)
        with contextlib.suppress(OSError):  # the terminal's other end has closed
            while chunk := os.read(leader, 65536):
                if b"triangle" in chunk and b"\x03" not in shown:
                    os.write(leader, b"\x03")
                    shown += b"\x03"
                shown += chunk
        assert process.stdout.read() == b""
    os.close(leader)
    assert process.returncode == 130
    assert b"Traceback" not in shown
    assert re.match(INTERRUPTED, shown.decode().rstrip().splitlines()[-1])
    assert shown.count(b"haselab:") == 1
    assert b"\x1b[?25h" in shown  # the cursor is back


# ---- signals alone --------------------------------------------------------------------------


@pytest.fixture
def listener() -> Any:
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = {number: signal.getsignal(number) for number in numbers}
    signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    yield Interruptible(SilentProgress())
    for number, handler in before.items():
        signal.signal(number, handler)


def test_the_first_signal_interrupts_and_later_ones_do_not(listener: Interruptible) -> None:
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)
    signal.raise_signal(signal.SIGINT)
    signal.raise_signal(signal.SIGTERM)


def test_an_interrupt_that_was_swallowed_comes_again_at_the_next_step(
    listener: Interruptible,
) -> None:
    listener.start(1.0)
    with contextlib.suppress(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        listener.advance(0.5, "x")
    listener.stop()
    listener.advance(0.5, "x")  # the job is over: nothing is left to end


def test_what_nohup_ignores_stays_ignored(listener: Interruptible) -> None:
    signal.raise_signal(signal.SIGHUP)
    listener.advance(0.5, "x")  # nothing is raised
    assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
