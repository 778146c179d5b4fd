"""A panel on the twin: arming, drive, loop, STOP, lost pages, and whoever may not connect."""

import asyncio
import contextlib
import io
import json
import os
import signal
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
import websockets
from PIL import Image

from tests.panel.running import WAIT_S, Page, RunningPanel, connected, ended, started

CLOSED = (websockets.InvalidStatus, websockets.ConnectionClosed)
# of HTTP, of the handshake, and of the web server's own closing frames
REFUSED = r"HTTP Error 40[34]|rejected WebSocket connection: HTTP 403|wrong token|not a message"


def test_a_page_arms_the_bench_and_drives_it_within_the_typed_limit(panel: RunningPanel) -> None:
    async def play() -> None:
        async with connected(panel) as page:
            assert "error" in await page.ask("drive", value_v=1.0)  # not armed
            assert "it must be at least 0.001 V and at most 2 V" in (await page.arm(2.5))["error"]
            assert "error" not in await page.arm(1.5)
            refused = await page.ask("drive", value_v=1.6)
            assert refused["error"].startswith("The requested drive is 1.6 V, but the bench was")
            assert "error" not in await page.ask("drive", value_v=1.2)
            await page.until(lambda state: state["drive_v"] == pytest.approx(1.2))
            assert page.state["stage"] == "running" and page.state["holder"] == page.holder
            assert "error" not in await page.ask("disarm")
            state = await page.until(lambda state: not state["holder"])
            assert state["stage"] == "off" and state["drive_v"] == 0.0

    asyncio.run(play())


def test_stop_latches_and_only_an_acknowledged_reason_arms_again(panel: RunningPanel) -> None:
    async def play() -> None:
        async with connected(panel) as page:
            await page.arm()
            await page.ask("drive", value_v=1.0)
            await page.until(lambda state: state["drive_v"] > 0.2)
            assert (await asyncio.to_thread(panel.stop))["commanded"] is True
            # The drive is that of the last block, which may have ended before STOP.
            state = await page.until(
                lambda state: state["stage"] == "tripped" and state["drive_v"] == 0.0
            )
            assert state["reason"].startswith("STOP was pressed")
            request = (await page.ask("request"))["answer"]
            assert request["reason"].startswith("STOP was pressed on the panel (on ")
            refused = await page.ask("arm", number=request["number"], limit_v=1.0)
            assert "acknowledge this reason" in refused["error"]
            assert "error" not in await page.arm()

    asyncio.run(play())


@pytest.mark.parametrize("frozen", ["web server", "bench process"])
def test_stop_works_while_another_process_is_frozen(panel: RunningPanel, frozen: str) -> None:
    async def armed() -> None:
        async with connected(panel) as page:
            await page.arm()
            await page.ask("drive", value_v=1.0)
            await page.until(lambda state: state["drive_v"] > 0.2)
            about = panel.about()
            victim = panel.process.pid if frozen == "web server" else panel.child("bench_process")
            os.kill(victim, signal.SIGSTOP)
            try:
                request = urllib.request.Request(
                    f"http://127.0.0.1:{about['stop_port']}/stop", b"", method="POST"
                )
                answer = await asyncio.to_thread(urllib.request.urlopen, request, timeout=WAIT_S)
                found = json.load(answer)
            finally:
                os.kill(victim, signal.SIGCONT)
            # A frozen bench process cannot answer, but its permission is gone.
            assert found["commanded"] is (frozen == "web server")
            state = await page.until(lambda state: state["stage"] == "tripped")
            assert state["reason"].startswith("STOP was pressed")

    asyncio.run(armed())


def test_a_page_that_goes_takes_the_bench_to_zero_and_nobody_else_drives_it(
    impatient_panel: RunningPanel,
) -> None:
    async def play() -> None:
        async with connected(impatient_panel) as second:
            async with connected(impatient_panel) as first:
                await first.arm()
                await first.ask("drive", value_v=1.0)
                await second.until(lambda state: state["drive_v"] > 0.1)
                for what, values in (("drive", {"value_v": 0.5}), ("request", {}), ("open", {})):
                    answer = await second.ask(what, **values)
                    assert answer["error"].startswith("Another page has armed the bench")
            state = await second.until(lambda state: not state["holder"])
            assert state["stage"] == "off" and state["drive_v"] == 0.0
            assert state["reason"] == "The page that armed the bench has disconnected."
            assert "error" not in await second.arm()

    asyncio.run(play())


def test_a_frozen_page_gets_no_more_frames_and_loses_its_lease(
    impatient_panel: RunningPanel,
) -> None:
    async def play() -> None:
        async with connected(impatient_panel) as watching, connected(impatient_panel) as frozen:
            await frozen.arm()
            frozen.acknowledges = False
            await watching.until(lambda state: state["holder"] == frozen.holder)
            await watching.until(lambda state: not state["holder"])
            begun, frames = time.monotonic(), 0
            while time.monotonic() - begun < 1.0:
                try:
                    message = await asyncio.wait_for(frozen._socket.recv(), 0.2)
                    frames += isinstance(message, bytes)
                except TimeoutError:
                    continue
            assert frames <= 2

    asyncio.run(play())


def test_pages_with_the_same_view_get_the_same_frames(shared_panel: RunningPanel) -> None:
    frames: list[dict[int, bytes]] = [{}, {}, {}]

    async def receive(page: Page, into: dict[int, bytes]) -> None:
        while len(into) < 20:
            message = await page._socket.recv()
            if isinstance(message, bytes):
                number = int.from_bytes(message[4:8], "little")
                into[number] = message
                await page.send({"ack": number})

    async def play() -> None:
        async with contextlib.AsyncExitStack() as opened:
            pages = [await opened.enter_async_context(connected(shared_panel)) for _ in frames]
            await pages[2].send({"view": {"span_s": 1.0, "end_s": None, "columns": 300}})
            async with asyncio.timeout(WAIT_S):
                await asyncio.gather(*map(receive, pages, frames))

    asyncio.run(play())
    first, second, other = frames
    both = first.keys() & second.keys()
    assert both and all(first[number] == second[number] for number in both)
    assert all(other[number] != first[number] for number in [*other][2:] if number in first)


def test_the_arming_request_of_a_page_that_has_gone_is_withdrawn(panel: RunningPanel) -> None:
    async def play() -> None:
        async with connected(panel) as staying:
            async with connected(panel) as leaving:
                await leaving.ask("request")
                await staying.until(lambda state: state["stage"] == "requested")
            await staying.until(lambda state: state["stage"] == "off")
            await asyncio.to_thread(panel.stop)
            number = (await staying.ask("request"))["answer"]["number"]
            async with connected(panel) as leaving:  # it has requested nothing
                await leaving.ask("lease")
            await staying.until(lambda state: state["stage"] == "requested")
            await staying.ask("cancel")
            state = await staying.until(lambda state: state["stage"] != "requested")
            assert state["stage"] == "tripped" and state["reason"].startswith("STOP was pressed")
            refused = await staying.ask("arm", number=number, limit_v=1.0)
            assert "no longer valid" in refused["error"]
            assert "error" not in await staying.arm()
            assert "error" not in await staying.ask("cancel")  # armed: there is no request
            assert (await staying.until(lambda state: state["holder"]))["stage"] == "running"

    asyncio.run(play())


def test_the_loop_of_an_actuator_file_follows_the_desired_strain(actuator_file: Path) -> None:
    panel = started("--actuator", str(actuator_file))

    async def play() -> None:
        async with connected(panel) as page:
            await page.until(lambda state: state["loop"] == [-0.04, 0.1])
            await page.arm(1.9)
            refused = await page.ask("loop", strain=0.2)
            assert "limits of the controller are -4 to 10 %" in refused["error"]
            assert "error" not in await page.ask("loop", strain=0.03)
            await page.until(lambda state: state["mode"] == "loop" and state["drive_v"] > 1.0)
            assert "error" not in await page.ask("open")
            state = await page.until(lambda state: state["mode"] == "drive")
            assert state["reference"] is None and state["target_v"] == state["drive_v"]

    try:
        asyncio.run(play())
    finally:
        assert ended(panel) == 0


def test_without_options_the_loop_can_be_closed_and_written_gains_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "out" / "twin-actuator.toml"

    async def play(panel: RunningPanel) -> None:
        async with connected(panel) as page:
            await page.until(lambda state: state["loop"] is not None)
            await page.arm(2.0)
            assert "error" not in await page.ask("loop", strain=0.04)
            await page.until(lambda state: state["mode"] == "loop" and state["drive_v"] > 1.0)

    for _ in range(2):
        panel = started()
        try:
            assert path.read_text().startswith(("# Findings", "# mine"))
            asyncio.run(play(panel))
        finally:
            assert ended(panel) == 0
        path.write_text(text := "# mine\n" + path.read_text().replace("ki = 11", "ki = 9"))
    assert path.read_text() == text


@pytest.mark.parametrize(
    "headers", [{"Origin": "http://evil.example"}, {"Host": "evil.example:80"}], ids=str
)
@pytest.mark.parametrize("port", ["web server", "stop process"])
def test_a_foreign_page_is_refused(
    shared_panel: RunningPanel, headers: dict[str, str], port: str
) -> None:
    stop_port = shared_panel.about()["stop_port"]
    where = f"{shared_panel.host}/about" if port == "web server" else f"127.0.0.1:{stop_port}/ready"
    with pytest.raises(urllib.error.HTTPError, match=REFUSED) as refused:
        urllib.request.urlopen(urllib.request.Request(f"http://{where}", headers=headers))
    with refused.value as answer:
        assert answer.code == 403


@pytest.mark.parametrize(
    "changes",
    [{"origin": "http://evil.example"}, {"token": "guess"}, {"token": ""}, {"token": "\ud800"}],
    ids=["origin", "wrong token", "no token", "half a character"],
)
def test_a_socket_without_origin_or_token_is_refused(
    shared_panel: RunningPanel, changes: dict[str, str]
) -> None:
    async def play() -> None:
        async with connected(shared_panel, **changes):
            pytest.fail("the page was accepted")

    with pytest.raises(CLOSED, match=REFUSED):
        asyncio.run(play())


def test_the_camera_picture_is_new_while_the_bench_is_armed(panel: RunningPanel) -> None:
    def picture(token: str) -> tuple[bytes, float]:
        """The picture and its age in s; nothing and nan before the first one."""
        request = urllib.request.Request(
            f"http://{panel.host}/camera", headers={"X-Panel-Token": token}
        )
        with urllib.request.urlopen(request, timeout=WAIT_S) as answer:
            return answer.read(), float(answer.headers.get("X-Age-S", "nan"))

    def fiducials() -> dict[str, list[list[float]]]:
        """Those of the first picture that shows the lower clamp lower than before."""
        end_s = time.monotonic() + WAIT_S
        while time.monotonic() < end_s:
            headers = {"X-Panel-Token": panel.token}
            request = urllib.request.Request(f"http://{panel.host}/camera", headers=headers)
            with urllib.request.urlopen(request, timeout=WAIT_S) as answer:
                found = json.loads(answer.headers["X-Fiducials"])
            if any(y - y0 > 3.0 for _, y, _, y0 in found["points"]):
                return found
            time.sleep(0.1)
        pytest.fail("no motion in the pictures")

    async def play() -> None:
        async with connected(panel) as page:
            assert (await asyncio.to_thread(picture, panel.token))[0] == b""
            await page.arm()
            seen: set[bytes] = set()
            async with asyncio.timeout(WAIT_S):
                while len(seen) < 3:
                    await page.receive()
                    seen |= {(await asyncio.to_thread(picture, panel.token))[0]} - {b""}
            image = Image.open(io.BytesIO(seen.pop()))
            assert image.format == "JPEG" and min(image.size) > 100
            await page.ask("drive", value_v=1.5)
            await page.until(lambda state: state["drive_v"] == 1.5)
            marks = await asyncio.to_thread(fiducials)
            points = np.array(marks["points"]).reshape(2, 3, 4)  # upper and lower row
            assert marks["size"] == list(image.size)
            motion = (points[:, :, :2] - points[:, :, 2:])[:, :, 1].mean(axis=1)
            assert motion[1] > 3.0 and abs(motion[0]) < 0.3  # the lower clamp has sunk
            await page.ask("disarm")
            begun_s = time.monotonic()
            while time.monotonic() < begun_s + 1.5:
                await page.receive()
            assert (await asyncio.to_thread(picture, panel.token))[1] > 1.0

    asyncio.run(play())
    with pytest.raises(urllib.error.HTTPError, match="HTTP Error 403") as refused:
        picture("guess")
    refused.value.close()


@pytest.mark.parametrize(
    "message",
    ["[]", "{", '{"ack": "x"}', '{"view": {"span_s": NaN}}', '{"view": {"span_s": 1e9}}', "{}",
     '{"view": {}}', "x" * 5000],
)  # fmt: skip
def test_a_malformed_message_ends_only_its_own_connection(
    shared_panel: RunningPanel, message: str
) -> None:
    async def play() -> None:
        async with connected(shared_panel) as good:
            async with connected(shared_panel) as bad:
                await bad._socket.send(message)
                with pytest.raises(CLOSED, match=REFUSED):
                    while True:
                        await bad.receive()
            seen = good.frames
            await good.ask("lease")
            async with asyncio.timeout(WAIT_S):
                while good.frames <= seen:
                    await good.receive()

    asyncio.run(play())


@pytest.mark.parametrize(
    "path", ["/static/../web.py", "/static/%2e%2e/web.py", "/static//etc/passwd"]
)
def test_no_file_outside_of_the_static_folder_is_served(
    shared_panel: RunningPanel, path: str
) -> None:
    with pytest.raises(urllib.error.HTTPError, match=REFUSED) as refused:
        urllib.request.urlopen(f"http://{shared_panel.host}{path}", timeout=WAIT_S)
    with refused.value as answer:
        assert answer.code == 404


def test_more_pages_than_can_be_served_are_refused(shared_panel: RunningPanel) -> None:
    async def play() -> None:
        async with contextlib.AsyncExitStack() as opened:
            for _ in range(40):
                await opened.enter_async_context(connected(shared_panel))

    with pytest.raises(websockets.ConnectionClosed, match="too many pages"):
        asyncio.run(play())


def test_pages_without_the_token_do_not_keep_one_with_it_from_connecting(
    shared_panel: RunningPanel,
) -> None:
    async def play() -> None:
        address, origin = f"ws://{shared_panel.host}/live", f"http://{shared_panel.host}"
        async with contextlib.AsyncExitStack() as opened:
            silent = [
                await opened.enter_async_context(websockets.connect(address, origin=origin))  # type: ignore[arg-type]
                for _ in range(70)
            ]
            async with connected(shared_panel) as page:
                assert page.holder
            for one in silent:  # the oldest at once, the others after 3 s
                with pytest.raises(websockets.ConnectionClosed, match="wrong token"):
                    await asyncio.wait_for(one.recv(), WAIT_S)

    asyncio.run(play())


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_the_panel_and_all_its_processes(number: signal.Signals) -> None:
    panel = started()
    children = [panel.child(name) for name in ("bench_process", "stop_process")]
    with urllib.request.urlopen(panel.address, timeout=WAIT_S) as page:
        assert page.status == 200  # it serves, and so it handles signals
    assert ended(panel, number) == 0
    for child in children:
        with pytest.raises(ProcessLookupError, match="No such process"):
            os.kill(child, 0)


@pytest.mark.parametrize("name", ["bench_process", "stop_process"])
def test_the_panel_ends_with_a_message_when_a_process_is_lost(name: str) -> None:
    panel = started()
    with panel.process:
        os.kill(panel.child(name), signal.SIGKILL)
        assert panel.process.wait(WAIT_S) == 4


def test_a_killed_panel_leaves_no_process_behind() -> None:
    panel = started()
    children = [panel.child(name) for name in ("bench_process", "stop_process")]
    with panel.process:
        panel.process.kill()
    end_s = time.monotonic() + WAIT_S
    for child in children:
        while time.monotonic() < end_s:
            try:
                os.kill(child, 0)
            except ProcessLookupError:
                break
            time.sleep(0.05)
        else:
            pytest.fail(f"process {child} still runs")
