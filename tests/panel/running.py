"""A panel on the twin, with a client that speaks its WebSocket as a page does."""

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import urllib.request
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from typing import Any

import websockets

# How long a test may hang: a busy machine must not fail it.
TRIANGLE = """
name = "one triangle"

[triangle]
low_v = 0.0
high_v = 1.8
frequency_hz = 0.5
cycles = 4
skipped_cycles = 1
frame_rate_hz = 200.0
"""
WAIT_S = float(os.environ.get("HASELAB_PANEL_WAIT_S", "300"))


@dataclass
class RunningPanel:
    """`haselab panel` with the address that it printed."""

    process: subprocess.Popen[str]
    address: str

    @property
    def host(self) -> str:
        return self.address.split("/")[2]

    @property
    def token(self) -> str:
        return self.address.partition("token=")[2]

    def about(self) -> dict[str, Any]:
        with urllib.request.urlopen(f"http://{self.host}/about", timeout=WAIT_S) as answer:
            return json.load(answer)

    def stop(self, **headers: str) -> dict[str, Any]:
        """Press STOP as a page does."""
        request = urllib.request.Request(
            f"http://127.0.0.1:{self.about()['stop_port']}/stop", b"", headers, method="POST"
        )
        with urllib.request.urlopen(request, timeout=WAIT_S) as answer:
            return json.load(answer)

    def child(self, name: str) -> int:
        """Process number of a child by its module."""
        listed = subprocess.run(
            ["ps", "-o", "pid=,args=", "--ppid", str(self.process.pid)],
            capture_output=True, text=True, check=True,
        ).stdout  # fmt: skip
        return next(int(line.split()[0]) for line in listed.splitlines() if name in line)


class Page:
    """One connected page without a browser."""

    def __init__(self, socket: websockets.ClientConnection) -> None:
        self._socket, self._number = socket, 0
        self.holder, self.state, self.end_s = "", {}, None
        self.frames, self.clock_s = 0, 0.0
        self.acknowledges = True

    async def receive(self) -> dict[str, Any] | None:
        """One message: an answer, or None for a frame."""
        message = await asyncio.wait_for(self._socket.recv(), WAIT_S)
        if isinstance(message, str):
            return json.loads(message)
        if self.acknowledges:
            await self.send({"ack": int.from_bytes(message[4:8], "little")})
        size = int.from_bytes(message[40:44], "little")
        about = json.loads(message[48 : 48 + size])
        self.frames += 1
        self.state, self.end_s, self.clock_s = about["state"], about["end_s"], about["clock_s"]
        return None

    async def send(self, message: object) -> None:
        await self._socket.send(json.dumps(message))

    async def ask(self, what: str, **values: object) -> dict[str, Any]:
        self._number += 1
        while not self.clock_s:  # as a page, which shows no button before its first frame
            await self.receive()
        at_s = values.pop("at_s", self.clock_s)
        await self.send({"id": self._number, "do": what, "values": values, "at_s": at_s})
        while True:
            answer = await self.receive()
            if answer is not None and answer.get("id") == self._number:
                return answer

    async def until(self, ready: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """Wait for a state."""
        async with asyncio.timeout(WAIT_S):
            while not (self.state and ready(self.state)):
                await self.receive()
        return self.state

    async def arm(self, limit_v: float = 1.5) -> dict[str, Any]:
        request = (await self.ask("request"))["answer"]
        return await self.ask(
            "arm", number=request["number"], limit_v=limit_v, acknowledged=request["reason"]
        )


@contextlib.asynccontextmanager
async def connected(panel: RunningPanel, **changes: str) -> AsyncIterator[Page]:
    """Connect a page."""
    origin = changes.get("origin", f"http://{panel.host}")
    async with websockets.connect(f"ws://{panel.host}/live", origin=origin) as socket:  # type: ignore[arg-type]
        page = Page(socket)
        await page.send({"token": changes.get("token", panel.token)})
        answer = await page.receive()
        assert answer is not None
        page.holder = answer["holder"]
        yield page


def started(*words: str, lease_s: float = 10.0) -> RunningPanel:
    """Start a panel that opens no browser; a page on a busy machine may be late."""
    command = [sys.executable, "-m", "haselab.cli", "panel", "--no-browser", *words]
    command += ["--lease-s", str(lease_s)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
    assert process.stdout is not None
    return RunningPanel(process, process.stdout.readline().strip())


def ended(panel: RunningPanel, number: signal.Signals = signal.SIGINT) -> int:
    """End a panel; its exit status."""
    with contextlib.suppress(ProcessLookupError):
        panel.process.send_signal(number)
    try:
        with panel.process:
            return panel.process.wait(WAIT_S)
    except subprocess.TimeoutExpired:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(panel.process.pid, signal.SIGKILL)
        raise
