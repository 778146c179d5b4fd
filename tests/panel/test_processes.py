"""What ends a panel, and what does not."""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from haselab.base import DeviceError
from haselab.cli.bench import panel as command
from haselab.cli.main import main
from haselab.panel import bench_process, processes, stop_process
from haselab.panel.files import PanelFiles
from haselab.panel.processes import stop_answers
from haselab.panel.stop_process import StopServer
from tests.panel.running import WAIT_S


class Process:
    """A process that runs."""

    def wait(self) -> None:
        """It does not end."""
        threading.Event().wait()


def test_a_panel_whose_stop_hangs_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    """The connection of a stopped process can still be opened, but nothing answers."""
    monkeypatch.setattr(command, "_STOP_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as hangs:
        port = hangs.getsockname()[1]
        server = SimpleNamespace(should_exit=False)

        def until_exit(*_: Any) -> int:
            end_s = time.monotonic() + WAIT_S
            while not server.should_exit and time.monotonic() < end_s:
                time.sleep(0.01)
            return 0

        monkeypatch.setattr(command, "serve", until_exit)
        panel: Any = SimpleNamespace(
            bench=Process(),
            stop=Process(),
            stop_port=port,
            ips=("127.0.0.1",),
            server=server,
            listeners=[],
        )
        with pytest.raises(DeviceError, match="The stop process does not answer, so the panel"):
            command._serve(panel)


def test_stop_that_works_answers() -> None:
    server = StopServer(0, dict, ())
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    assert stop_answers(server.port, WAIT_S)
    server.shutdown()
    server.server_close()
    assert not stop_answers(server.port, WAIT_S)


def test_a_fault_while_stopping_keeps_no_later_stop_from_working(tmp_path: Path) -> None:
    stopped: list[str] = []

    def stop(reason: str) -> str:
        stopped.append(reason)
        if len(stopped) == 1:
            raise RuntimeError("a driver that haselab does not know")
        return ""

    bench: Any = SimpleNamespace(stop=stop)
    job = threading.Thread(target=bench_process._stops, args=(tmp_path, bench), daemon=True)
    job.start()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as box:
        box.bind(str(tmp_path / "own"))
        box.settimeout(WAIT_S)
        while not (tmp_path / "stop.sock").exists():
            time.sleep(0.01)
        for reason in (b"first", b"second"):
            box.sendto(reason, str(tmp_path / "stop.sock"))
        assert box.recv(64) == b"0 V commanded"
    assert stopped == ["first", "second"]


def test_the_bench_process_ends_when_its_parent_has_gone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Even if another process still has the pipe to its stdin."""
    ended, parents = threading.Event(), [7, 7, 1]
    monkeypatch.setattr(bench_process.os, "getppid", lambda: parents.pop(0) if parents else 1)
    monkeypatch.setattr(bench_process.select, "select", lambda *_: ([], [], []))
    bench_process._watch_parent(7, ended)
    assert ended.is_set()


def test_the_bench_is_at_zero_before_stop_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends: list[str] = []
    rig = tmp_path / "rig.toml"
    rig.write_text('kind = "twin"\n')

    def start(words: list[str], what: str) -> tuple[Any, str]:
        return what, "1"

    monkeypatch.setattr(processes, "_started", start)
    monkeypatch.setattr(processes, "_end", lambda process, within_s=0.0: ends.append(process))
    with processes.running_panel(PanelFiles(rig, None, tmp_path)):
        assert not ends
    assert ends[0] == "bench process" and "stop process" in ends


def test_a_rig_safe_that_hangs_does_not_keep_the_bench_from_being_armed(tmp_path: Path) -> None:
    assert not stop_process.rig_safe_runs(tmp_path)
    path = tmp_path / stop_process._RIG_SAFE
    with path.open("wb") as held_by_rig_safe:
        fcntl.flock(held_by_rig_safe, fcntl.LOCK_SH)
        assert stop_process.rig_safe_runs(tmp_path)
        os.utime(path, (0.0, time.time() - stop_process._LONGEST_S - 1.0))
        assert not stop_process.rig_safe_runs(tmp_path)
        os.utime(path)
        assert stop_process.rig_safe_runs(tmp_path)
    assert not stop_process.rig_safe_runs(tmp_path)  # it has ended
    path.unlink()
    path.mkdir()
    assert not stop_process.rig_safe_runs(tmp_path)


@pytest.mark.parametrize("held", [False, True])
def test_stop_starts_rig_safe_whoever_holds_its_lock(tmp_path: Path, held: bool) -> None:
    path = tmp_path / stop_process._RIG_SAFE
    with path.open("wb") as foreign:
        if held:
            fcntl.flock(foreign, fcntl.LOCK_EX)
        stop = stop_process._Stop(tmp_path, "", str(tmp_path / "missing.toml"))
        stop._rig_safe()
        first = stop._safe
        assert first is not None
        assert held or stop_process.rig_safe_runs(tmp_path)
        stop._rig_safe()
        assert stop._safe is first, "one at a time"
        assert first.wait(WAIT_S) == 2  # there is no such file
        stop._rig_safe()
        assert stop._safe is not first
        assert stop._safe is not None and stop._safe.wait(WAIT_S) == 2


def test_a_stop_process_that_hangs_is_killed() -> None:
    hangs = [sys.executable, "-c", "import time; time.sleep(600)"]
    process = subprocess.Popen(hangs, stdin=subprocess.PIPE, text=True)
    processes._end(process, 0.1)
    processes._end(process, 0.1)
    assert process.returncode == -signal.SIGKILL


@pytest.mark.parametrize("fault", ["", "a driver failed during shutdown: no link"])
def test_stop_says_whether_0_v_was_commanded(fault: str, tmp_path: Path) -> None:
    bench: Any = SimpleNamespace(stop=lambda reason: fault)
    job = threading.Thread(target=bench_process._stops, args=(tmp_path, bench), daemon=True)
    job.start()
    while not (tmp_path / "stop.sock").exists():
        time.sleep(0.01)
    stop = stop_process._Stop(tmp_path, f"test-stop-{tmp_path.name}", "")
    with contextlib.closing(stop._interlock) as interlock:
        found = stop()
        assert interlock.reason.startswith("STOP was pressed")
    assert (found["commanded"], found["fault"]) == (not fault, fault)


@pytest.mark.parametrize(
    ("text", "said"),
    [("kind = 'bench", "TOML"), ("kind = 'toaster'\n", "toaster"), (None, "r.toml")],
)
def test_a_wrong_rig_file_is_bad_input(
    text: str | None, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    if text is not None:
        (tmp_path / "r.toml").write_text(text)
    with pytest.raises(SystemExit) as raised:
        main(["panel", "--no-browser", "--rig", str(tmp_path / "r.toml")])
    found = capsys.readouterr().err
    assert raised.value.code == 2 and found.count("\n") == 1 and said in found


def test_what_only_the_bench_process_finds_wrong_is_bad_input(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "r.toml").write_text("kind = 'twin'\ntwin = 'none.toml'\n")
    with pytest.raises(SystemExit) as raised:
        main(["panel", "--no-browser", "--rig", str(tmp_path / "r.toml")])
    assert raised.value.code == 2 and "none.toml" in capsys.readouterr().err
