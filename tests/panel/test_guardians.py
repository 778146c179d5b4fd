"""STOP on a bench with guardians: the served twin, over the drivers of a real bench."""

import asyncio
import contextlib
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest

from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.server import ServedTwin
from haselab.safety.interlock import Interlock, lease_clock_s
from tests.panel.running import WAIT_S, Page, RunningPanel, connected, ended, started

pytest.importorskip("grpc")


def interlock_of(panel: RunningPanel) -> Interlock:
    """The interlock of its bench, whose key is an argument of the stop process."""
    words = ["ps", "-ww", "-o", "args=", "-p", str(panel.child("stop_process"))]
    listed = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    return Interlock(listed.partition("/haselab-panel-")[2].split(" http")[0].partition(" ")[2])


def test_the_guardians_act_when_the_bench_process_does_not_answer_stop(tmp_path: Path) -> None:
    rig = tmp_path / "served.toml"
    with ServedTwin(twin_of_reading("hz"), 1, 0.0) as served:
        rig.write_text(served.rig_file(ahead_blocks=1))
        panel = started("--rig", str(rig))
        bench, interlock = panel.child("bench_process"), interlock_of(panel)

        async def play() -> None:
            async with connected(panel) as page:
                assert "answer" in await page.arm(1.5)
                await page.ask("drive", value_v=1.0)
                await page.until(lambda state: state["drive_v"] == 1.0)
                assert abs(served.hub.output_v) > 4000.0 and interlock.live
                rig.unlink()  # so that `haselab rig safe` cannot help
                os.kill(bench, signal.SIGSTOP)
                found = await asyncio.to_thread(panel.stop)
                assert found["commanded"] is False
                assert interlock.lease_end_s <= lease_clock_s()
                assert interlock.reason.startswith("STOP was pressed")

        try:
            asyncio.run(play())
            end_s = time.monotonic() + WAIT_S
            while abs(served.hub.output_v) > 50.0 and time.monotonic() < end_s:
                time.sleep(0.02)
                # In lock-step only a request lets the amplifier fall; a commanded output stays.
                served.hub.spend(round(0.02 * served.hub.rate_hz))
            assert abs(served.hub.output_v) < 50.0
        finally:
            interlock.close()
            with contextlib.suppress(ProcessLookupError):  # a guardian kills one that is in a call
                os.kill(bench, signal.SIGCONT)
            ended(panel)


def children_of_stop(panel: RunningPanel) -> str:
    """Command lines of the processes that STOP has started."""
    words = ["ps", "-o", "args=", "--ppid", str(panel.child("stop_process"))]
    return subprocess.run(words, capture_output=True, text=True).stdout


async def count_refusals(page: Page) -> int:
    """How often arming is refused until the `haselab rig safe` of STOP has ended."""
    count = 0
    async with asyncio.timeout(WAIT_S):
        while "error" in (asked := await page.ask("request")):
            assert "rig safe" in asked["error"], asked
            count += 1
    return count


def test_a_bench_can_be_armed_again_after_stop_has_reset_its_board(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As docs/bench/panel.md says in "Reset after STOP"."""
    rig = tmp_path / "served.toml"
    with ServedTwin(twin_of_reading("hz"), 1, PACE) as served:
        rig.write_text(served.rig_file(ahead_blocks=5) + PATIENT)
        put_out, is_stopped = [], False
        set_output = served.hub.set_output

        def noted(drive_v: float) -> None:
            if is_stopped:
                put_out.append(drive_v)
            set_output(drive_v)

        monkeypatch.setattr(served.hub, "set_output", noted)
        panel = started("--rig", str(rig))

        async def play() -> None:
            nonlocal is_stopped
            async with connected(panel) as page:
                for _ in range(3):
                    armed = await page.arm(1.5)
                    assert "answer" in armed, armed
                    await page.ask("drive", value_v=0.2)
                    await page.until(lambda state: state["drive_v"] == 0.2)
                    await asyncio.to_thread(panel.stop)
                    await page.until(lambda state: state["stage"] == "tripped")
                    is_stopped = True
                    await count_refusals(page)
                    assert "answer" in await page.ask("cancel")
                    shown_s = page.end_s
                    async with asyncio.timeout(WAIT_S):
                        while page.end_s == shown_s:  # frozen
                            await page.receive()
                    assert page.state["stage"] == "tripped" and page.state["mode"] == "idle"
                    reason = page.state["reason"]
                    # `rig safe` may be first, or reset the board while its output is read back.
                    causes = ("STOP was pressed", "took the bench to 0 V", "reserved by a program")
                    assert any(cause in reason for cause in causes), reason
                    assert abs(served.hub.output_v) < 50.0
                    assert "error" in await page.ask("drive", value_v=1.0)
                    asked = await page.ask("request")
                    assert "answer" in asked, asked
                    number = asked["answer"]["number"]
                    refused = await page.ask("arm", number=number, limit_v=1.5, acknowledged="")
                    assert "error" in refused
                    assert abs(served.hub.output_v) < 50.0
                    assert set(put_out) == {0.0}, "reopening puts out nothing else"
                    is_stopped = False
                    put_out.clear()

        try:
            asyncio.run(play())
        finally:
            ended(panel)


def test_a_bench_armed_as_soon_as_possible_after_stop_stays_armed(tmp_path: Path) -> None:
    """Arming is refused until `rig safe`, which would trip the bench, has ended."""
    rig = tmp_path / "served.toml"
    with ServedTwin(twin_of_reading("hz"), 1, PACE) as served:
        rig.write_text(served.rig_file(ahead_blocks=5) + PATIENT)
        panel = started("--rig", str(rig))

        async def play() -> None:
            async with connected(panel) as page:
                assert "answer" in await page.arm(1.5)
                await asyncio.to_thread(panel.stop)
                await page.until(lambda state: state["stage"] == "tripped")
                await count_refusals(page)  # none if `rig safe` has ended already
                assert "rig safe" not in await asyncio.to_thread(children_of_stop, panel)
                armed = await page.arm(1.5)
                assert "answer" in armed, armed
                await page.until(lambda state: state["stage"] == "running")
                shown_s = page.end_s
                while page.end_s < shown_s + 2.0 and page.state["stage"] == "running":
                    await page.receive()
                # A busy machine may be late for another reason.
                assert "rig safe" not in page.state["reason"], page.state

        try:
            asyncio.run(play())
        finally:
            ended(panel)


STUDY = """name = "one triangle"

[triangle]
low_v = 0.0
high_v = 1.0
frequency_hz = 0.5
cycles = 3
skipped_cycles = 1
frame_rate_hz = 200.0
"""
PACE = 0.2  # of the wall clock, so that a busy machine queues its outputs in time
# These limits count wall-clock time, and a busy machine is late.
PATIENT = "\n[safety]\nlease_s = 10.0\nmissed_limit = 1000\nlate_limit = 1000\n"


def test_blocks_that_pass_while_a_bench_is_armed_are_not_a_gap(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a pace, as on a real bench, blocks pass while the instruments are set."""
    monkeypatch.chdir(tmp_path)
    Path("triangle.toml").write_text(STUDY)
    with ServedTwin(twin_of_reading("hz"), 1, PACE) as served:
        set_carrier = served.hub.carrier

        def slowly(frequency_hz: float, amplitude_v: float, offset_v: float = 0.0) -> None:
            time.sleep(0.1 / PACE if amplitude_v else 0.0)
            set_carrier(frequency_hz, amplitude_v, offset_v)

        monkeypatch.setattr(served.hub, "carrier", slowly)
        limits = "\n[safety]\nmissed_limit = 1000\nlate_limit = 1000\n"  # their clock is the wall's
        Path("served.toml").write_text(served.rig_file(ahead_blocks=5) + limits)
        panel = started("--rig", "served.toml")

        async def play() -> None:
            async with connected(panel) as page:
                assert "answer" in await page.arm(1.5)
                await page.ask("drive", value_v=1.0)
                await page.until(lambda state: state["drive_v"] == 1.0 or not state["holder"])
                assert page.state["reason"] == ""
                await page.ask("disarm")
                asked = (await page.ask("request"))["answer"]
                study = {"study": "triangle.toml", "keep_video": "none"}
                arming = {"number": asked["number"], "acknowledged": asked["reason"]}
                assert "answer" in await page.ask("arm", limit_v=1.5, study=study, **arming)
                await page.until(lambda state: state["mode"] == "study")
                await page.until(lambda state: state["task"] or not state["holder"])
                assert page.state["reason"] == ""
                await page.ask("disarm")

        try:
            asyncio.run(play())
        finally:
            ended(panel)


def test_new_guardians_watch_after_the_first_ones_have_acted(tmp_path: Path) -> None:
    """Guardians end when they have acted; the bench could then not be armed again."""
    rig = tmp_path / "served.toml"
    with ServedTwin(twin_of_reading("hz"), 1, PACE) as served:
        rig.write_text(served.rig_file(ahead_blocks=5) + PATIENT)
        panel = started("--rig", str(rig))
        bench = panel.child("bench_process")

        async def play() -> None:
            async with connected(panel) as page:
                assert "answer" in await page.arm(1.5)
                os.kill(bench, signal.SIGSTOP)
                found = await asyncio.to_thread(panel.stop)
                assert found["commanded"] is False
                os.kill(bench, signal.SIGCONT)
                await page.until(lambda state: state["stage"] == "tripped")
                await count_refusals(page)
                assert "answer" in await page.arm(1.5)

        try:
            asyncio.run(play())
            assert abs(served.hub.output_v) < 100.0 + 50.0  # the sensing signal of 20 mV alone
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.kill(bench, signal.SIGCONT)
            ended(panel)


def test_a_bench_that_no_longer_responds_is_not_called_safe(tmp_path: Path) -> None:
    """The board and the instruments have lost their connections while the drive is at 5 kV."""
    rig = tmp_path / "served.toml"
    with contextlib.ExitStack() as connected_bench:
        served = connected_bench.enter_context(ServedTwin(twin_of_reading("hz"), 1, PACE))
        rig.write_text(served.rig_file(ahead_blocks=5) + PATIENT)
        panel = started("--rig", str(rig))

        async def play() -> None:
            async with connected(panel) as page:
                assert "answer" in await page.arm(1.5)
                await page.ask("drive", value_v=1.0)
                await page.until(lambda state: state["drive_v"] == 1.0)
                rig.unlink()  # so that `haselab rig safe` cannot help
                connected_bench.close()
                await page.until(lambda state: state["stage"] != "running")
                await page.until(lambda state: "by hand" in state["reason"])
                found = await asyncio.to_thread(panel.stop)
                assert found["commanded"] is False and found["fault"]
                await page.until(lambda state: "by hand" in state["reason"])

        try:
            asyncio.run(play())
        finally:
            ended(panel)
