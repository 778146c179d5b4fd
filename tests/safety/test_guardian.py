"""The guardian's hands on real sockets, ptys and files, and what it does when it is left alone."""

from __future__ import annotations

import json
import os
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from haselab.base import DeviceError
from haselab.safety.guardian import CommandHand, FileHand, Guardian, Hand, SerialHand, TcpHand
from haselab.safety.guardian_process import OutputFile

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="ptys and pipes are POSIX's")


def until(true: Callable[[], object], limit_s: float = 30.0) -> None:
    end_s = time.monotonic() + limit_s
    while not true():
        assert time.monotonic() < end_s
        time.sleep(0.002)


def acts(log: Path) -> list[dict[str, object]]:
    return [json.loads(line) for line in log.read_text().splitlines()] if log.exists() else []


@contextmanager
def generator(answers: dict[str, str]) -> Iterator[tuple[int, list[str]]]:
    """An instrument on a socket: its port, the lines that it got."""
    lines: list[str] = []
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            try:
                link, _ = server.accept()
            except OSError:
                return
            with link, link.makefile("rw", newline="\n") as file:
                for line in file:
                    lines.append(line.strip())
                    if line.strip() in answers:
                        file.write(answers[line.strip()] + "\n")
                        file.flush()

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield server.getsockname()[1], lines
        finally:
            server.close()
            thread.join(5.0)


def act_once(hands: list[Hand], log: Path) -> dict[str, object]:
    with Guardian(hands, log) as guardian:
        guardian.make_safe("the test asks")
        told: list[str] = []
        until(lambda: told.append(guardian.lost()) or told[-1])
        record = acts(log)[0]
        safe = all(hand["safe"] for hand in record["hands"])  # type: ignore[attr-defined]
        start = "The guardian made the bench safe: " if safe else "The guardian could not make"
        assert told[-1].startswith(start) and "the test asks" in told[-1]
        assert guardian.lost() == told[-1] and (guardian.outcome() == "") is safe
    return record


def test_a_socket_is_sent_its_lines_and_asked_for_an_answer(tmp_path: Path) -> None:
    with generator({"OUTP1?": "0"}) as (port, lines):
        hand = TcpHand("127.0.0.1", port, ("OUTP1 OFF", "ABOR"), "OUTP1?", "0")
        record = act_once([hand], tmp_path / "log")
    assert lines == ["OUTP1 OFF", "ABOR", "OUTP1?"]
    assert record["reason"] == "the test asks"
    assert record["hands"] == [{"hand": "tcp", "answer": "0", "safe": True}]


def test_a_wrong_answer_is_recorded_and_the_next_hand_acts(tmp_path: Path) -> None:
    with generator({"OUTP1?": "1"}) as (port, _), closing(OutputFile(str(tmp_path / "o"))) as out:
        out.write(1.5)
        hands = [
            TcpHand("127.0.0.1", port, ("OUTP1 OFF",), "OUTP1?", "0"), FileHand(str(tmp_path / "o"))
        ]  # fmt: skip
        record = act_once(hands, tmp_path / "log")
        assert out.read() == 0.0
    assert [hand["safe"] for hand in record["hands"]] == [False, True]  # type: ignore[attr-defined]


def test_a_serial_line_is_sent_its_lines_and_asked_for_an_answer(tmp_path: Path) -> None:
    main, end = os.openpty()
    got = b""

    def supply() -> None:
        nonlocal got
        while not got.endswith(b"QVnow\r"):
            got += os.read(main, 100)
        os.write(main, b"0\r\n0\r\n")

    thread = threading.Thread(target=supply)
    thread.start()
    try:
        hand = SerialHand(os.ttyname(end), ("SVset 0",), "QVnow", "0")
        record = act_once([hand], tmp_path / "log")
    finally:
        thread.join(5.0)
        os.close(main)
        os.close(end)
    assert got == b"SVset 0\rQVnow\r"
    assert record["hands"] == [{"hand": "serial", "answer": "0", "safe": True}]


def test_a_command_is_run_and_its_failure_recorded(tmp_path: Path) -> None:
    touch = (sys.executable, "-c", f"open({str(tmp_path / 'touched')!r}, 'w')")
    fail = (sys.executable, "-c", "raise SystemExit('no such rig')")
    record = act_once([CommandHand(fail), CommandHand(touch)], tmp_path / "log")
    assert (tmp_path / "touched").exists()
    first, second = record["hands"]  # type: ignore[misc]
    assert "exit code 1: no such rig" in first["answer"] and second["safe"]


def test_a_command_that_waits_acts_at_once_and_ends_at_a_good_bye(tmp_path: Path) -> None:
    out = tmp_path / "touched"
    code = f"""
import os, sys
print("ready", flush=True)
open({str(tmp_path / "pid")!r}, "w").write(str(os.getpid()))
if sys.stdin.readline() == "safe\\n":
    open({str(out)!r}, "w")
"""
    hand = CommandHand((sys.executable, "-I", "-S", "-c", code), waits=True)
    with Guardian([hand], tmp_path / "log"):
        until(lambda: (tmp_path / "pid").exists() and (tmp_path / "pid").read_text())
    with pytest.raises(ProcessLookupError, match="No such process"):
        os.kill(int((tmp_path / "pid").read_text()), 0)
    assert not out.exists()
    assert act_once([hand], tmp_path / "log")["hands"] == [
        {"hand": "command", "answer": "done", "safe": True}
    ]
    assert out.exists()


def test_a_hand_that_reaches_nothing_is_told_before_anything_is_armed(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    guardian = Guardian([TcpHand("127.0.0.1", port, ("OUTP1 OFF",))], tmp_path / "log")
    with pytest.raises(DeviceError, match=r"The guardian is not ready .*refused.*nothing is ener"):
        guardian.start()
    assert guardian.pid == 0


def test_leases_keep_it_quiet_and_their_end_does_not(tmp_path: Path) -> None:
    log, path = tmp_path / "log", tmp_path / "o"
    with closing(OutputFile(str(path))) as out, Guardian([FileHand(str(path))], log) as guardian:
        out.write(1.5)
        for _ in range(20):
            guardian.renew(5.0)
            time.sleep(0.02)
            assert guardian.lost() == ""
        guardian.renew(0.1)
        until(lambda: out.read() == 0.0)
        until(lambda: "no sign of life" in guardian.lost())
    assert "no sign of life" in str(acts(log)[0]["reason"])


def test_a_good_bye_is_no_reason_to_act(tmp_path: Path) -> None:
    with closing(OutputFile(str(tmp_path / "o"))) as out:
        out.write(1.5)
        with Guardian([FileHand(str(tmp_path / "o"))], tmp_path / "log") as guardian:
            pid = guardian.pid
        assert out.read() == 1.5
    assert not (tmp_path / "log").exists()
    with pytest.raises(ProcessLookupError, match="No such process"):
        os.kill(pid, 0)


def test_one_that_is_ended_by_someone_makes_safe_first(tmp_path: Path) -> None:
    with closing(OutputFile(str(tmp_path / "o"))) as out:
        out.write(1.5)
        with Guardian([FileHand(str(tmp_path / "o"))], tmp_path / "log") as guardian:
            os.kill(guardian.pid, 15)
            until(lambda: out.read() == 0.0)
            until(guardian.lost)
    assert acts(tmp_path / "log")[0]["reason"] == "the guardian got SIGTERM"
