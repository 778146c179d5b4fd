"""The processes of a panel: bench, STOP and web server, started and ended together."""

from __future__ import annotations

import contextlib
import http.client
import os
import socket
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import uvicorn

from haselab.base import DeviceError, InputError
from haselab.panel.files import PanelFiles
from haselab.panel.page_server import Access, WebServer, listening, served_ips
from haselab.panel.web import WebSettings, application
from haselab.rig.bench_config import BenchConfig
from haselab.rig.rig_file import load_rig

__all__ = ["Panel", "running_panel", "stop_answers"]

_START_S = 60.0  # for the drivers of a bench
_END_S = 10.0  # for the bench process to go to 0 V
_END_STOP_S = 1.0  # for the stop process, which controls no instrument


class Panel(NamedTuple):
    """A panel that runs.

    Args:
        addresses: to open in a browser on this computer, then on others; they hold the token.
        bench: its bench process.
        stop: its stop process.
        stop_port: TCP port of the stop process.
        ips: addresses on which page and STOP are served.
        server: its web server, to be run by the caller.
        listeners: sockets of the web server.
    """

    addresses: tuple[str, ...]
    bench: subprocess.Popen[str]
    stop: subprocess.Popen[str]
    stop_port: int
    ips: tuple[str, ...]
    server: uvicorn.Server
    listeners: list[socket.socket]


def stop_answers(port: int, within_s: float, ip: str = "127.0.0.1") -> bool:
    """Whether the stop process answers.

    Args:
        port: TCP port of STOP.
        within_s: longest wait, in s.
        ip: address of this computer on which it is asked.
    """
    connection = http.client.HTTPConnection(ip, port, timeout=within_s)
    with contextlib.closing(connection):
        try:
            connection.request("GET", "/ready")
            return connection.getresponse().status == 200
        except (OSError, http.client.HTTPException):
            return False


def _started(words: list[str], what: str) -> tuple[subprocess.Popen[str], str]:
    """Start a process of this package and read what it is ready with.

    Raises:
        DeviceError: It did not start.
        InputError: A file keeps it from starting.
    """
    command = [sys.executable, "-m", *words]
    process = subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    late = threading.Timer(_START_S, process.kill)
    late.start()
    assert process.stdout is not None
    line = process.stdout.readline().strip()
    late.cancel()
    word, _, rest = line.partition(" ")
    if word != "ready":
        _end(process)
        process.stdout.close()
        if word == "refused":
            raise InputError(rest)
        raise DeviceError(
            rest
            or f"The {what} ended, or was not ready within {_START_S:g} s. Its messages are above."
        )
    return process, rest


def _end(process: subprocess.Popen[str], within_s: float = _END_S) -> None:
    """End a process by its stdin; kill it if it does not end. Safe to call twice."""
    with contextlib.suppress(OSError):
        assert process.stdin is not None
        process.stdin.close()
    try:
        process.wait(within_s)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


@contextlib.contextmanager
def running_panel(
    files: PanelFiles, port: int = 0, lease_s: float = 1.5, lan: str = ""
) -> Iterator[Panel]:
    """Start the bench process and the stop process; on exit, go to 0 V and end them.

    Args:
        files: rig, actuator and recordings.
        port: of the web server; 0: a free one.
        lease_s: longest time without a message from the page that armed the bench, in s.
        lan: IPv4 address of this computer in its network, to serve on as well; empty: this
            computer only.
    Yields:
        The panel; the caller runs its server.
    Raises:
        DeviceError: A process does not start, or the port is in use.
        InputError: A file is wrong, or this computer does not have the address.
    """
    is_real = isinstance(load_rig(files.rig), BenchConfig)
    in_memory = Path("/dev/shm")
    place = in_memory if in_memory.is_dir() and os.access(in_memory, os.W_OK) else None
    with contextlib.ExitStack() as opened:
        folder = Path(
            opened.enter_context(tempfile.TemporaryDirectory(prefix="haselab-panel-", dir=place))
        )
        listeners = opened.enter_context(listening(port, lan))
        access = Access(listeners[0].getsockname()[1], lan)
        words = [str(files.rig), str(folder), str(files.runs), str(lease_s)]
        words += [] if files.actuator is None else [str(files.actuator)]
        bench, key = _started(["haselab.panel.bench_process", *words], "bench process")
        opened.callback(_end, bench)
        settings = WebSettings(folder, access, 0, files)
        real = [str(files.rig)] if is_real else []
        words = [",".join(served_ips(lan)), str(folder), key, ",".join(access.origins), *real]
        stop, stop_port = _started(["haselab.panel.stop_process", *words], "stop process")
        opened.callback(_end, stop, _END_STOP_S)
        opened.callback(_end, bench)  # ends before STOP, which works until the bench is at 0 V
        settings.stop_port = int(stop_port)
        server = WebServer(
            uvicorn.Config(
                application(settings), log_level="warning", ws_max_size=65536, ws_ping_interval=5.0,
                ws_per_message_deflate=False, timeout_graceful_shutdown=1,
            )
        )  # fmt: skip
        ips = served_ips(lan)
        yield Panel(access.addresses, bench, stop, settings.stop_port, ips, server, listeners)
