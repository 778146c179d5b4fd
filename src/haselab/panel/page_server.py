"""What the web servers of the panel share: who may connect, requests in JSON, and serving."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import hmac
import json
import secrets
import signal
import socket
import sys
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import uvicorn
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import JSONResponse, Response
from starlette.routing import BaseRoute, Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Receive, Scope, Send

from haselab.base import DeviceError, HaselabError, InputError, JsonObject, to_plain

__all__ = [
    "NO_TOKEN",
    "STATIC",
    "Access",
    "OnlyOwnPages",
    "Requests",
    "WebServer",
    "hosts_of",
    "listening",
    "routes_of",
    "serve",
    "served_ips",
]

STATIC = Path(__file__).parent / "static"
_NO_OBJECT = "The request must be one JSON object of at most 1 MB, sent as application/json."
NO_TOKEN = "The token is missing or wrong. Open the address that haselab printed."
_MOST_BODY_BYTES = 1 << 20  # of a request
_TRIALS = 20  # to find a port that is free on all addresses

Requests = Mapping[str, Callable[[JsonObject], JsonObject]]
"""By name: called in a thread of the web server. A `HaselabError` becomes the page's message."""


@dataclass(frozen=True)
class Access:
    """Who may use a web server.

    Args:
        port: of the server.
        lan: IPv4 address of this computer in its network, for pages on other computers; empty:
            only pages on this computer.
        token: that a page must send.
    """

    port: int
    lan: str = ""
    token: str = field(default_factory=lambda: secrets.token_urlsafe(24))

    @property
    def addresses(self) -> tuple[str, ...]:
        """Addresses for a browser, with the token: on this computer, then on others."""
        return tuple(f"http://{ip}:{self.port}/?token={self.token}" for ip in served_ips(self.lan))

    @property
    def hosts(self) -> tuple[str, ...]:
        """Values of Host that are accepted."""
        return hosts_of(self.lan, self.port)

    @property
    def origins(self) -> tuple[str, ...]:
        """Values of Origin that are accepted."""
        return tuple(f"http://{host}" for host in self.hosts)

    def is_token(self, text: str) -> bool:
        """Whether a page knows the token."""
        given = text.encode(errors="replace")  # JSON may hold half of a character
        return hmac.compare_digest(given, self.token.encode())

    def is_known(self, request: Request) -> bool:
        """Whether a request has the token."""
        return self.is_token(request.headers.get("x-panel-token", ""))


def served_ips(lan: str) -> tuple[str, ...]:
    """IP addresses to serve on.

    Args:
        lan: IPv4 address of this computer in its network, or empty.
    Returns:
        The loopback address, then the other one.
    """
    return ("127.0.0.1", lan) if lan else ("127.0.0.1",)


def hosts_of(lan: str, port: int) -> tuple[str, ...]:
    """Host and port, as pages name a server of this computer.

    Args:
        lan: IPv4 address of this computer in its network, or empty.
        port: of the server.
    """
    return tuple(f"{name}:{port}" for name in ("localhost", *served_ips(lan)))


class OnlyOwnPages:
    """Refuses requests with a foreign Host or Origin, and adds headers against embedding.

    Args:
        app: the application.
        access: to it.
        sources: addresses of other servers that its pages may request.
    """

    def __init__(
        self, app: ASGIApp, access: Access, sources: Callable[[], str] = lambda: ""
    ) -> None:
        self._app, self._access, self._sources = app, access, sources

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass a request on, or refuse it."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {k.decode("latin-1"): v.decode("latin-1") for k, v in scope["headers"]}
        origin = headers.get("origin")
        mine = headers.get("host") in self._access.hosts
        mine = mine and (origin is None or origin in self._access.origins)
        if scope["type"] == "websocket":
            if not (mine and origin):
                await send({"type": "websocket.close", "code": 1008})
            else:
                await self._app(scope, receive, send)
            return
        if not mine:
            await Response("Only the panel's own page may use this server.", 403)(
                scope, receive, send
            )
            return

        async def with_headers(message: Any) -> None:
            if message["type"] == "http.response.start":
                policy = (
                    f"default-src 'self'; connect-src 'self' {self._sources()}; "
                    "img-src 'self' blob: data:; style-src 'self' 'unsafe-inline'; "
                    "frame-src blob:; frame-ancestors 'none'"
                )
                message["headers"] += [
                    (b"content-security-policy", policy.encode()),
                    (b"x-content-type-options", b"nosniff"),
                    (b"referrer-policy", b"no-referrer"),
                    (b"cache-control", b"no-store"),
                ]
            await send(message)

        await self._app(scope, receive, with_headers)


async def _body(request: Request) -> JsonObject:
    """The JSON object of a request.

    Raises:
        ValueError: It is too long, of another type, or no JSON object.
    """
    if request.headers.get("content-type", "").partition(";")[0].strip() != "application/json":
        raise ValueError
    data = bytearray()
    async for chunk in request.stream():
        data += chunk
        if len(data) > _MOST_BODY_BYTES:
            raise ValueError
    try:
        values = json.loads(data)
    except RecursionError:
        raise ValueError from None
    if not isinstance(values, dict):
        raise ValueError
    return values


def routes_of(
    access: Access, requests: Requests, after: Callable[[str], None] = lambda name: None
) -> list[BaseRoute]:
    """Make the routes of the static files and of requests.

    Args:
        access: to the server.
        requests: that are carried out in a thread and answered in JSON.
        after: called with the name of a request that succeeded, once it has been answered.
    Returns:
        For Starlette.
    """

    async def answer(request: Request) -> Response:
        if not access.is_known(request):
            return JSONResponse({"error": NO_TOKEN}, 403)
        name = request.path_params["name"]
        carry_out = requests.get(name)
        if carry_out is None:
            return JSONResponse({"error": "There is no such request."}, 404)
        try:
            values = await _body(request)
        except ValueError:
            return JSONResponse({"error": _NO_OBJECT}, 400)
        try:
            found = await run_in_threadpool(carry_out, values)
        except HaselabError as error:
            return JSONResponse({"error": str(error)}, 422)
        except OSError as error:  # a disk that is full or read-only, a name that is too long
            text = f"{error.strerror or error}: {str(error.filename or '')[:200]}".rstrip(": ")
            return JSONResponse({"error": f"{text}. Check the folder."}, 422)
        except asyncio.CancelledError:
            return JSONResponse({"error": "The panel has ended."}, 503)
        return JSONResponse(to_plain(found), background=BackgroundTask(after, name))

    return [
        Route("/request/{name}", answer, methods=["POST"]),
        Mount("/static", StaticFiles(directory=STATIC)),
    ]


class WebServer(uvicorn.Server):
    """A web server that leaves signals to its command."""

    @contextlib.contextmanager
    def capture_signals(self) -> Generator[None, None, None]:
        """Change no signal handler."""
        yield


@contextlib.contextmanager
def listening(port: int, lan: str = "") -> Iterator[list[socket.socket]]:
    """Listen on the loopback address and, if there is one, on the address in the network.

    Args:
        port: TCP port; 0: a free one.
        lan: IPv4 address of this computer in its network, or empty.
    Yields:
        The sockets of a web server, all with one port.
    Raises:
        DeviceError: the port is in use.
        InputError: this computer does not have the address.
    """
    with contextlib.ExitStack() as opened:
        for trial in range(_TRIALS):
            try:
                listeners = _bound(port, served_ips(lan))
                break
            except OSError as error:
                if error.errno == errno.EADDRNOTAVAIL:
                    raise InputError(
                        f"--lan is {lan}, but this computer does not have this address. Use one "
                        "that its network settings show."
                    ) from None
                if port or trial == _TRIALS - 1:
                    raise DeviceError(
                        f"Port {port} cannot be used ({error.strerror}). Choose another one with "
                        "--page-port, or leave it out for a free one."
                    ) from None
        for listener in listeners:
            opened.enter_context(listener)
        yield listeners


def _bound(port: int, ips: tuple[str, ...]) -> list[socket.socket]:
    """Sockets that listen on all addresses with one port.

    Raises:
        OSError: The port is in use on one of them, or the computer does not have the address.
    """
    with contextlib.ExitStack() as opened:
        listeners: list[socket.socket] = []
        for ip in ips:
            listener = opened.enter_context(socket.socket())
            if sys.platform != "win32":  # where it would share the port with another program
                # A port can be used again at once after a panel ended with a page open.
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((ip, port))
            listener.listen(128)  # a browser that is early waits
            port = listener.getsockname()[1]
            listeners.append(listener)
        opened.pop_all()
    return listeners


def serve(server: uvicorn.Server, listeners: list[socket.socket]) -> int:
    """Serve until the server should exit, or until Ctrl-C, SIGTERM or a closed terminal.

    Args:
        server: to run.
        listeners: its sockets.
    Returns:
        Number of the signal; 0: there was none.
    """
    received: list[int] = []

    def end(number: int, frame: FrameType | None) -> None:
        received.append(number)
        server.should_exit = True

    with contextlib.ExitStack() as restored:
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):
            if hasattr(signal, name):
                number = getattr(signal, name)
                restored.callback(signal.signal, number, signal.signal(number, end))
        server.run(listeners)
    return received[0] if received else 0
