"""`python -m haselab.panel.stop_process IPS FOLDER KEY ORIGINS [RIG.toml]`: STOP, and nothing else.

A small process with a port of its own, so that STOP waits for nothing: not for the web server, a
plot, a command or a blocking call. `POST /stop` revokes the permission in the interlock KEY, so
that no haselab program can energise the bench, and then makes the bench process command 0 V
(`stop.sock` in FOLDER). On a real bench it also starts `haselab rig safe RIG.toml`, which uses
connections of its own; and if the bench process does not answer, it ends the lease in the
interlock, so that the guardians act at once. STOP needs no token; pages of other origins are
refused. `GET /ready` keeps the connection of a page open. A text message on the WebSocket
`/socket` does the same as `POST /stop`, and leaves a browser sooner; the page sends both.

This module uses only the standard library and the interlock, so it starts quickly.
"""

from __future__ import annotations

import base64
import contextlib
import fcntl
import hashlib
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from haselab.safety.interlock import Interlock

__all__ = ["COMMANDED", "REASON", "StopServer", "main", "rig_safe_runs"]

COMMANDED = b"0 V commanded"  # answer of the bench process; any other one is a fault
REASON = "STOP was pressed on the panel"
_RIG_SAFE = "rig-safe.lock"  # in FOLDER, locked while `haselab rig safe` runs
_NICENESS = -10
_ANSWER_S = 2.0  # longest wait for the bench process
_LONGEST_S = 60.0  # of `rig safe`, which waits for instruments for 5 s
_PROMPT_S = 0.5  # after which the guardians are called
_TRIALS = 20  # to find a port that is free on all addresses
_SOCKET_ID = b"258EAFA5-E914-47DA-95CA-C5AB0DC85B11"  # RFC 6455, section 1.3
_TEXT, _MOST_BYTES = 1, 125  # of a WebSocket frame: opcode; longest payload after 2 bytes
_MOST_CONNECTIONS = 128  # at the same time; more than the pages need


class StopServer(ThreadingHTTPServer):
    """Serves STOP.

    Args:
        port: TCP port; 0: a free one.
        stop: called for each STOP; returns what to answer.
        origins: of the pages that may call it.
        ip: address of this computer on which it serves.
    """

    allow_reuse_address = sys.platform != "win32"
    daemon_threads = True
    request_queue_size = 128

    def __init__(
        self,
        port: int,
        stop: Callable[[], dict[str, object]],
        origins: tuple[str, ...],
        ip: str = "127.0.0.1",
    ) -> None:
        self.stop, self.origins = stop, origins
        self.names = (ip, "localhost") if ip == "127.0.0.1" else (ip,)
        self._open: dict[int, socket.socket] = {}  # connections, the oldest first
        self._turn = threading.Lock()
        super().__init__((ip, port), _Handler)

    @property
    def port(self) -> int:
        """TCP port."""
        return int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection; if there are too many, close the oldest, so that STOP can connect."""
        with self._turn:
            self._open[id(request)] = request
            excess = list(self._open)[: max(len(self._open) - _MOST_CONNECTIONS, 0)]
            for old in [self._open.pop(number) for number in excess]:
                with contextlib.suppress(OSError):
                    old.shutdown(socket.SHUT_RDWR)  # its thread then closes it
        super().process_request(request, client_address)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Print the error, unless the other side only closed the connection."""
        if not isinstance(sys.exc_info()[1], OSError):
            super().handle_error(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection."""
        with self._turn:
            self._open.pop(id(request), None)
        super().shutdown_request(request)


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    timeout = 60.0
    server: StopServer

    def setup(self) -> None:
        self.request.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        super().setup()

    def do_GET(self) -> None:
        if not self._allowed():
            return
        if self.path == "/socket" and "Sec-WebSocket-Key" in self.headers:
            self._serve_socket(self.headers["Sec-WebSocket-Key"])
        else:
            self._reply(200 if self.path == "/ready" else 404, {"ready": self.path == "/ready"})

    def do_POST(self) -> None:
        if not self._allowed():
            return
        if self.path != "/stop":
            self._reply(404, {"error": "There is only /stop."})
            return
        self._reply(200, self.server.stop())
        size = self.headers.get("Content-Length") or ""
        with contextlib.suppress(OSError):  # what the page sent has no meaning
            self.rfile.read(min(int(size), 4096) if size.isdecimal() else 0)

    def _serve_socket(self, key: str) -> None:
        """Call STOP for each text frame. Source: RFC 6455, sections 4.2.2 and 5.2."""
        accepted = hashlib.sha1(key.encode() + _SOCKET_ID, usedforsecurity=False).digest()
        self.send_response(101)
        self.send_header("Upgrade", "websocket")
        self.send_header("Connection", "Upgrade")
        self.send_header("Sec-WebSocket-Accept", base64.b64encode(accepted).decode())
        self.end_headers()
        self.close_connection = True
        self.connection.settimeout(None)
        while len(head := self.rfile.read(2)) == 2 and head[1] & 0x7F <= _MOST_BYTES:
            self.rfile.read(4 + (head[1] & 0x7F))  # mask and payload are ignored
            if head[0] & 0x0F != _TEXT:
                return
            self.server.stop()

    def _allowed(self) -> bool:
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        name = host.rpartition(":")[0]
        mine = name in self.server.names and (origin is None or origin in self.server.origins)
        if not mine:
            self.close_connection = True  # ignore the rest of what it sent
            self._reply(403, {"error": "Only the panel's own page may use this port."})
        return mine

    def _reply(self, status: int, content: dict[str, object]) -> None:
        body = json.dumps(content).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        origin = self.headers.get("Origin")
        if origin in self.server.origins:
            self.send_header("Access-Control-Allow-Origin", str(origin))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""


class _Stop:
    """What STOP does."""

    def __init__(self, folder: Path, key: str, rig: str) -> None:
        self._folder, self._rig = folder, rig
        self._interlock = Interlock(key)
        self._safe: subprocess.Popen[bytes] | None = None
        self._begun_s = 0.0
        self._mutex = threading.Lock()

    def __call__(self) -> dict[str, object]:
        begun_s = time.perf_counter()
        self._interlock.revoke(REASON)
        revoked_s = time.perf_counter() - begun_s
        thread = threading.Thread(target=self._rig_safe, daemon=True)
        thread.start()
        answer = self._tell_bench(_PROMPT_S)
        if answer != COMMANDED:
            self._interlock.lease(0.0)  # a guardian looks every 20 ms
        if not answer:
            answer = self._tell_bench(_ANSWER_S - _PROMPT_S)
        commanded_s = time.perf_counter() - begun_s
        thread.join(_PROMPT_S)  # after this answer, `rig_safe_runs` is true
        return {"revoked_ms": 1e3 * revoked_s, "commanded": answer == COMMANDED,
                "fault": "" if answer == COMMANDED else answer.decode(errors="replace"),
                "commanded_ms": 1e3 * commanded_s}  # fmt: skip

    def _tell_bench(self, wait_s: float) -> bytes:
        """Send the bench process to 0 V; its answer, empty if there was none in time."""
        own = self._folder / f"stop-{os.getpid()}-{threading.get_ident()}"
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as box:
            try:
                box.bind(str(own))
                box.settimeout(wait_s)
                box.sendto(REASON.encode(), str(self._folder / "stop.sock"))
                return box.recv(512)
            finally:
                own.unlink(missing_ok=True)
        return b""

    def _rig_safe(self) -> None:
        """Start `haselab rig safe` on a real bench, unless it is running and does not hang."""
        if not self._rig:
            return
        with self._mutex:
            hangs = time.monotonic() > self._begun_s + _LONGEST_S
            if self._safe is None or self._safe.poll() is not None or hangs:
                self._begun_s = time.monotonic()
                command = [sys.executable, "-m", "haselab.cli", "rig", "safe", self._rig]
                with contextlib.ExitStack() as opened:
                    locks: list[int] = []
                    with contextlib.suppress(OSError):  # a full disk must not prevent `rig safe`
                        lock = opened.enter_context((self._folder / _RIG_SAFE).open("wb"))
                        os.utime(lock.fileno())
                        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
                        locks.append(lock.fileno())
                    self._safe = subprocess.Popen(command, stdin=subprocess.DEVNULL, pass_fds=locks)


def rig_safe_runs(folder: Path) -> bool:
    """Whether the `haselab rig safe` that STOP has started still runs, and does not hang.

    Args:
        folder: of the panel.
    """
    with contextlib.suppress(OSError), (folder / _RIG_SAFE).open("rb") as lock:
        if time.time() > os.fstat(lock.fileno()).st_mtime + _LONGEST_S:
            return False
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _on_one_port(
    ips: list[str],
    stop: Callable[[], dict[str, object]],
    origins: tuple[str, ...],
    trials: int = _TRIALS,
) -> list[StopServer]:
    """Serve on all addresses with one port, which is free on each of them."""
    servers: list[StopServer] = []
    try:
        for ip in ips:
            servers.append(StopServer(servers[0].port if servers else 0, stop, origins, ip))
    except OSError:  # another program uses the port on one of the addresses
        for server in servers:
            server.server_close()
        if trials == 1:
            raise
        return _on_one_port(ips, stop, origins, trials - 1)
    return servers


def main(words: list[str]) -> None:
    """Serve STOP until stdin ends.

    Args:
        words: IP addresses to serve on, separated by commas; folder; key of the interlock; origins
            of the page, separated by commas; and optionally the rig file of a real bench.
    """
    folder, key, origins = Path(words[1]), words[2], tuple(words[3].split(","))
    with contextlib.suppress(AttributeError, OSError):  # it needs little processor time
        os.setpriority(os.PRIO_PROCESS, 0, _NICENESS)
    stop = _Stop(folder, key, words[4] if len(words) > 4 else "")
    servers = _on_one_port(words[0].split(","), stop, origins)
    for server in servers:
        threading.Thread(target=server.serve_forever, daemon=True).start()
    print(f"ready {servers[0].port}", flush=True)
    sys.stdin.read()


if __name__ == "__main__":
    main(sys.argv[1:])
