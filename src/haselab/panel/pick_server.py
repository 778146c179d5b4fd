"""The page Pick without a panel: one video, until its points are saved."""

from __future__ import annotations

import webbrowser
from collections.abc import Callable
from functools import partial
from pathlib import Path

import uvicorn
from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, Response
from starlette.routing import Route

from haselab.base import JsonObject
from haselab.panel.page_server import (
    STATIC,
    Access,
    OnlyOwnPages,
    WebServer,
    listening,
    routes_of,
    serve,
)
from haselab.panel.pages.pick import PICK_REQUESTS, Videos

__all__ = ["pick_points"]


def pick_points(
    video: Path, out: Path | None, port: int, *, browser: bool, announce: Callable[[str], None]
) -> JsonObject | int:
    """Serve the page until points are saved.

    Args:
        video: to pick points in.
        out: table of points; None: beside the video.
        port: TCP port of the page; 0: a free one.
        browser: open the page in a browser.
        announce: called with the address of the page.
    Returns:
        What was saved: `path`, `points`, `command`, `scale_mm_per_px`; or the number of the signal
        that ended the server.
    Raises:
        DeviceError: the port is in use.
        InputError: the video cannot be read.
    """
    videos = Videos(video.parent, video, out)
    PICK_REQUESTS["pick-frame"](videos, {"video": str(video), "frame": 0})
    saved: list[JsonObject] = []

    def save(values: JsonObject) -> JsonObject:
        found = PICK_REQUESTS["pick-save"](videos, values)
        saved.append(found)
        return found

    def page(request: Request) -> Response:
        return FileResponse(STATIC / "pick.html")

    def end_once_saved(name: str) -> None:
        server.should_exit = server.should_exit or bool(saved)

    with listening(port) as listeners:
        access = Access(listeners[0].getsockname()[1])
        requests = {name: partial(do, videos) for name, do in PICK_REQUESTS.items()}
        application = Starlette(
            routes=[
                Route("/", page),
                *routes_of(access, {**requests, "pick-save": save}, end_once_saved),
            ],
            middleware=[Middleware(OnlyOwnPages, access=access)],
        )
        server = WebServer(
            uvicorn.Config(application, log_level="warning", ws="none", timeout_graceful_shutdown=2)
        )
        announce(access.addresses[0])
        if browser:
            webbrowser.open(access.addresses[0])
        number = serve(server, listeners)
    return saved[-1] if saved else number
