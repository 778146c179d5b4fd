"""The web server of the panel: its page, live signals and commands over one WebSocket a page.

It reads the shared memory of the bench process and never makes it wait. A page gets the next frame
only after it has acknowledged the last one, so a slow or frozen page gets fewer frames and no old
ones. Only pages of this server may connect: Host and Origin are checked, and the first message must
be the token that the panel printed.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import secrets
import struct
import time
from collections.abc import Coroutine
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import HTMLResponse, JSONResponse, Response
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect

from haselab.base import HaselabError
from haselab.panel.columns import SIGNALS, Columns, LiveReader
from haselab.panel.files import PanelFiles
from haselab.panel.page_server import (
    NO_TOKEN,
    STATIC,
    Access,
    OnlyOwnPages,
    hosts_of,
    routes_of,
)
from haselab.panel.pages.camera import CameraPicture
from haselab.panel.pages.recordings import analyse_recorded
from haselab.panel.pages.requests import REQUESTS
from haselab.safety.interlock import lease_clock_s

__all__ = ["SCHEMA", "WebSettings", "application"]

SCHEMA = 1  # of a binary frame
_FRAME_S = 1.0 / 30.0
_REPEAT_S = 0.15  # after which a frame is sent without new data, while the bench process answers
_ANSWERS_S = 0.3  # since its last state
_TOKEN_S = 3.0  # for the first message of a page
_MOST_PAGES, _MOST_UNKNOWN = 32, 64  # with the token; without it yet
_MOST_BYTES = 4096  # of a message of a page
_MOST_COLUMNS = 4000
_COLUMN_STEP = 100  # so that windows of almost the same width share their frames
_BENCH_S = 10.0  # longest wait for an answer of the bench process
_ARM_S = 30.0  # the same for `_SLOW_COMMANDS`; see `page_leases`
_SLOW_COMMANDS = ("request", "arm")  # start new guardians; check a study
_HEAD = struct.Struct("<HHIddddII")


@dataclass
class WebSettings:
    """What the web server needs.

    Args:
        folder: of the panel, with `live` and `bench.sock`.
        access: who may connect.
        stop_port: of the stop process, for the page.
        files: that the panel was started with.
    """

    folder: Path
    access: Access
    stop_port: int
    files: PanelFiles

    def stop_sources(self) -> str:
        """Addresses of the stop process, which pages may request."""
        hosts = hosts_of(self.access.lan, self.stop_port)
        return " ".join(f"http://{host} ws://{host}" for host in hosts)


class _Bench:
    """Connection to the bench process; it is opened again when it was lost."""

    def __init__(self, folder: Path, files: PanelFiles) -> None:
        self._folder, self._files = folder, files
        self._writer: asyncio.StreamWriter | None = None
        self._waiting: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._number = 0
        self.state: dict[str, Any] | None = None
        self.state_s = -math.inf  # when it arrived
        self.state_text = "{}"  # as JSON, made once for all pages
        self.clock_s = 0.0  # when the bench process sent it; see `page_leases`
        self.reader: LiveReader | None = None

    def age_s(self) -> float:
        """Time since the last block was read, in s; infinite before the first."""
        written_s = self.reader.written_s if self.reader else math.nan
        return math.inf if math.isnan(written_s) else max(time.monotonic() - written_s, 0.0)

    async def run(self) -> None:
        """Stay connected."""
        while True:
            with contextlib.suppress(OSError, ValueError):
                await self._connected()
            self._lost()
            await asyncio.sleep(0.1)

    async def _connected(self) -> None:
        path = str(self._folder / "bench.sock")
        reader, self._writer = await asyncio.open_unix_connection(path, limit=1 << 20)
        self.reader = LiveReader(self._folder / "live")
        while line := await reader.readline():
            message = json.loads(line)
            if "clock_s" in message:
                self.clock_s = float(message["clock_s"])
            if "state" in message:
                await self._take(message["state"])
            answer = self._waiting.pop(message.get("id", -1), None)
            if answer is not None and not answer.done():
                answer.set_result(message)

    async def _take(self, state: dict[str, Any]) -> None:
        """Keep the state of the bench; analyse a study that has just been recorded."""
        before = self.state
        self.state, self.state_s = state, time.monotonic()
        self.state_text = json.dumps(state)
        if before is not None and state["recorded"] != before["recorded"]:
            with contextlib.suppress(HaselabError, OSError):  # the page offers it again
                await run_in_threadpool(analyse_recorded, self._files, state["recorded"])

    def _lost(self) -> None:
        if self._writer is not None:
            self._writer.close()
        if self.reader is not None:
            self.reader.close()
        self._writer, self.reader = None, None
        for answer in self._waiting.values():
            if not answer.done():
                answer.set_result(
                    {
                        "error": "The bench process has ended. Check that the bench is at "
                        "0 V, then start the panel again."
                    }
                )
        self._waiting.clear()

    async def ask(
        self, what: str, holder: str, values: dict[str, Any], at_s: object
    ) -> dict[str, Any]:
        """Send a command and wait for its answer; the bench process refuses an old command."""
        if self._writer is None:
            return {
                "error": "There is no connection to the bench process. Check that the "
                "bench is at 0 V, then start the panel again."
            }
        self._number += 1
        number, wait_s = self._number, _ARM_S if what in _SLOW_COMMANDS else _BENCH_S
        answer = self._waiting[number] = asyncio.get_running_loop().create_future()
        command = {"id": number, "do": what, "holder": holder, "values": values, "at_s": at_s}
        self._writer.write(json.dumps(command).encode() + b"\n")
        try:
            return await asyncio.wait_for(answer, wait_s)
        except TimeoutError:
            self._waiting.pop(number, None)
            return {"error": f"No answer from the bench process for {wait_s:g} s. Press STOP."}


class _View(NamedTuple):
    """What a page shows: pages with the same view get the same frame."""

    span_s: float
    end_s: float | None  # None: the present
    columns: int


@dataclass
class _Page:
    """One connected page."""

    socket: WebSocket
    holder: str = field(default_factory=lambda: secrets.token_hex(8))
    view: _View = field(default_factory=lambda: _View(10.0, None, 600))
    unacknowledged: list[int] = field(default_factory=list)  # frames
    arms: int = 0  # commands to arm the bench that have no answer yet


class _Server:
    """Serves all pages of one bench."""

    def __init__(self, settings: WebSettings) -> None:
        self._settings = settings
        self._bench = _Bench(settings.folder, settings.files)
        self._picture = CameraPicture(settings.folder / "camera.jpg")
        self._pages: set[int] = set()
        self._unknown: dict[int, asyncio.Future[str]] = {}  # have not sent the token, oldest first
        self._tasks: set[asyncio.Task[None]] = set()  # so that none is collected while it runs
        self._made: tuple[int, dict[_View, bytes]] = (0, {})  # frames of one tick

    @contextlib.asynccontextmanager
    async def lifespan(self, app: Starlette) -> Any:
        task = asyncio.create_task(self._bench.run())
        try:
            yield
        finally:
            task.cancel()

    async def page(self, request: Request) -> Response:
        text = (STATIC / "index.html").read_text()
        return HTMLResponse(text.replace('data-port=""', f'data-port="{self._settings.stop_port}"'))

    async def about(self, request: Request) -> Response:
        return JSONResponse(
            {"stop_port": self._settings.stop_port, "signals": SIGNALS, "schema": SCHEMA}
        )

    async def camera(self, request: Request) -> Response:
        """The last frame with its age and its fiducials, for a page with the token."""
        if not self._settings.access.is_known(request):
            return Response(NO_TOKEN, 403)
        found = await run_in_threadpool(self._picture.read)
        if found is None:
            return Response(None, 204)  # no picture yet
        headers = {"x-age-s": f"{found.age_s:.3f}", "x-fiducials": found.fiducials}
        return Response(found.jpeg, 200, headers, "image/jpeg")

    async def live(self, socket: WebSocket) -> None:
        await socket.accept()
        page = _Page(socket)
        tasks: list[asyncio.Task[None]] = []
        try:
            if not await self._known(socket):
                await socket.close(1008, "wrong token")
                return
            if len(self._pages) >= _MOST_PAGES:
                await socket.close(1013, "too many pages")
                return
            self._pages.add(id(page))
            await socket.send_text(json.dumps({"holder": page.holder}))
            tasks = [asyncio.create_task(self._frames(page))]
            await self._messages(page)
        except (WebSocketDisconnect, RuntimeError, OSError):
            pass
        finally:
            self._pages.discard(id(page))
            for task in tasks:
                task.cancel()
            if tasks:
                self._start(self._leave(page))

    async def _known(self, socket: WebSocket) -> bool:
        """Whether a page sends the token; of too many that have not yet sent it, the oldest ends.

        So those who do not know the token cannot keep a page from connecting.
        """
        if len(self._unknown) >= _MOST_UNKNOWN:
            self._unknown.pop(next(iter(self._unknown))).cancel()
        receiving = asyncio.ensure_future(socket.receive_text())
        self._unknown[id(socket)] = receiving
        try:
            token = json.loads(await asyncio.wait_for(receiving, _TOKEN_S))["token"]
        except (TimeoutError, ValueError, KeyError, TypeError):
            return False
        except asyncio.CancelledError:
            if receiving.cancelled() and id(socket) not in self._unknown:
                return False
            raise
        finally:
            self._unknown.pop(id(socket), None)
        return isinstance(token, str) and self._settings.access.is_token(token)

    async def _messages(self, page: _Page) -> None:
        """Receive what a page sends: acknowledged frames, its view, commands."""
        while True:
            text = await page.socket.receive_text()
            try:
                message = json.loads(text) if len(text) <= _MOST_BYTES else None
                assert isinstance(message, dict)
                if "ack" in message:
                    last = int(message["ack"])
                    page.unacknowledged = [one for one in page.unacknowledged if one > last]
                elif "view" in message:
                    page.view = self._view(message["view"])
                elif "do" in message:
                    self._start(self._command(page, message))
                else:
                    raise ValueError
            except (ValueError, AssertionError, KeyError, TypeError, OverflowError):
                await page.socket.close(1003, "not a message of the panel")
                return

    @staticmethod
    def _view(view: dict[str, Any]) -> _View:
        span_s, end_s = float(view["span_s"]), view.get("end_s")
        if not (1e-5 <= span_s <= 1e5 and math.isfinite(float(end_s or 0.0))):
            raise ValueError
        columns = -(-int(view["columns"]) // _COLUMN_STEP) * _COLUMN_STEP
        return _View(
            span_s, None if end_s is None else float(end_s), min(max(columns, 16), _MOST_COLUMNS)
        )

    async def _command(self, page: _Page, message: dict[str, Any]) -> None:
        values = message.get("values")
        what, at_s = str(message["do"]), message.get("at_s")
        page.arms += what == "arm"
        try:
            answer = await self._bench.ask(
                what, page.holder, values if isinstance(values, dict) else {}, at_s
            )
        finally:
            page.arms -= what == "arm"
        answer["id"] = message.get("id")
        with contextlib.suppress(RuntimeError, OSError, WebSocketDisconnect):
            await page.socket.send_text(json.dumps(answer))

    async def _frames(self, page: _Page) -> None:
        """Send frames to one page, each after the last one was acknowledged.

        All pages send at the same ticks, so that those with the same view share a frame.
        """
        lease_s, tick, loop = 0.0, 0, asyncio.get_running_loop()
        last: tuple[object, ...] = ()
        with contextlib.suppress(RuntimeError, OSError, WebSocketDisconnect):
            while True:
                tick = max(tick, int(loop.time() / _FRAME_S)) + 1
                await asyncio.sleep(tick * _FRAME_S - loop.time())
                if len(page.unacknowledged) > 1:
                    continue
                state = self._bench.state or {}
                mine = page.arms > 0 or state.get("holder") == page.holder
                if mine and loop.time() > lease_s:
                    lease_s = loop.time() + 0.4
                    self._start(self._renew(page))
                blocks = self._bench.reader.blocks if self._bench.reader else -1
                age_s = self._bench.age_s()
                answers = time.monotonic() < self._bench.state_s + _ANSWERS_S
                repeats = int(age_s / _REPEAT_S) if answers and age_s < math.inf else 0
                now = (blocks, page.view, self._bench.state_text, repeats)
                if now == last:
                    continue
                last = now
                page.unacknowledged.append(tick)
                await page.socket.send_bytes(self._frame(tick, page.view))

    def _start(self, job: Coroutine[Any, Any, None]) -> None:
        task = asyncio.create_task(job)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _renew(self, page: _Page) -> None:
        await self._bench.ask("lease", page.holder, {}, lease_clock_s())

    async def _leave(self, page: _Page) -> None:
        """Cancel the arming request of a page that has disconnected, or disarm its bench."""
        await self._bench.ask("leave", page.holder, {}, lease_clock_s())

    def _frame(self, tick: int, view: _View) -> bytes:
        """The frame of a view at a tick, made once for all pages that show it."""
        if self._made[0] != tick:
            self._made = (tick, {})
        frames = self._made[1]
        if view not in frames:
            frames[view] = self._encode(tick, view)
        return frames[view]

    def _encode(self, tick: int, view: _View) -> bytes:
        """A binary frame: numbers, the state as JSON, then columns as 32-bit floats."""
        reader = self._bench.reader
        end_s = reader.end_s if reader is not None else math.nan
        shown_s = end_s if view.end_s is None else view.end_s
        empty = Columns(0.0, 1.0, np.empty((0, 2)), np.empty((0, 2)))
        monitors, signals = empty, Columns(0.0, 1.0, np.empty((0, 5)), np.empty((0, 5)))
        if reader is not None and not math.isnan(shown_s):
            monitors = reader.monitors(shown_s - view.span_s, shown_s, view.columns)
            signals = reader.signals(shown_s - view.span_s, shown_s, view.columns)
        gap_s = reader.gap_s if reader is not None else math.nan
        times = {
            "clock_s": self._bench.clock_s,
            "end_s": end_s,
            "gap_s": gap_s,
            "age_s": min(self._bench.age_s(), 1e9),
            "state_age_s": min(time.monotonic() - self._bench.state_s, 1e9),
            "written_s": reader.written_s if reader is not None else math.nan,
        }
        known = {name: None if math.isnan(at_s) else at_s for name, at_s in times.items()}
        text = f'{{"state": {self._bench.state_text}, {json.dumps(known)[1:]}'.encode()
        text += b" " * (-len(text) % 8)
        head = _HEAD.pack(
            SCHEMA, 0, tick, monitors.start_s, monitors.step_s, signals.start_s,
            signals.step_s, len(text), len(monitors.low),
        )  # fmt: skip
        arrays = [
            np.ascontiguousarray(part.T, dtype="<f4").tobytes()
            for part in (monitors.low, monitors.high, signals.low, signals.high)
        ]
        return b"".join((head, text, *arrays))


def application(settings: WebSettings) -> Starlette:
    """Make the web application.

    Args:
        settings: of the panel.
    Returns:
        For uvicorn.
    """
    server = _Server(settings)
    routes = [
        Route("/", server.page),
        Route("/about", server.about),
        Route("/camera", server.camera),
        WebSocketRoute("/live", server.live),
        *routes_of(
            settings.access, {name: partial(do, settings.files) for name, do in REQUESTS.items()}
        ),
    ]
    guard = Middleware(OnlyOwnPages, access=settings.access, sources=settings.stop_sources)
    return Starlette(routes=routes, middleware=[guard], lifespan=server.lifespan)
