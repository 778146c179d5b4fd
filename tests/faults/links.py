"""Links of a bench that can be cut, hushed and garbled; programs that start in a moment."""

from __future__ import annotations

import contextlib
import functools
import json
import mmap
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import threading
import traceback
import tty
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Self

GARBAGE = b"\xff#\x00?\xb1!"


class Relay:
    """A cable between a client and a server on a TCP port. Use as a context.

    Args:
        target: host:port of the server.
    """

    def __init__(self, target: str) -> None:
        host, _, port = target.rpartition(":")
        self._target = (host, int(port))
        self._links: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self._flows = threading.Event()
        self._flows.set()
        self.garbles = False
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.address = f"127.0.0.1:{self.port}"
        self._begin(self._accept)

    def _begin(self, act: Callable[[], None]) -> None:
        thread = threading.Thread(target=act, name="relay")
        self._threads.append(thread)
        thread.start()

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._listener.accept()
                server = socket.create_connection(self._target)
            except OSError:
                return
            for link in (client, server):
                link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._links.append(link)
            self._begin(functools.partial(self._pass, client, server, False))
            self._begin(functools.partial(self._pass, server, client, True))

    def _pass(self, source: socket.socket, target: socket.socket, answers: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                self._flows.wait()
                if answers and self.garbles:
                    data = (GARBAGE * (len(data) // len(GARBAGE) + 1))[: len(data) - 1] + b"\n"
                target.sendall(data)
        for link in (source, target):
            _end(link)

    def cut(self) -> None:
        """The cable is out: connections end, new ones are refused."""
        _end(self._listener)
        self._listener.close()
        for link in self._links:
            _end(link)

    def hush(self, for_s: float) -> None:
        """Nothing passes any more, for a time, and nobody is told."""
        self._flows.clear()
        timer = threading.Timer(for_s, self._flows.set)
        timer.name = "relay"
        self._threads.append(timer)
        timer.start()

    def close(self) -> None:
        """Let go of everything."""
        self._flows.set()
        self.cut()
        for thread in self._threads:
            if isinstance(thread, threading.Timer):
                thread.cancel()
            thread.join()
        for link in self._links:
            link.close()


def _end(link: socket.socket) -> None:
    with contextlib.suppress(OSError):
        link.shutdown(socket.SHUT_RDWR)


class SerialCable:
    """A serial line to an instrument that answers lines. Use as a context.

    Args:
        answer: of the instrument.
    """

    def __init__(self, answer: Callable[[str], str]) -> None:
        self._answer = answer
        self.hushed = self.garbles = False
        self._main, side = os.openpty()
        tty.setraw(side)
        self.port = os.ttyname(side)
        self._side = side
        self._wake, self._waker = os.pipe()
        self._thread = threading.Thread(target=self._serve, name="serial cable")
        self._thread.start()

    def _serve(self) -> None:
        pending = b""
        while True:
            ready, _, _ = select.select([self._main, self._wake], [], [])
            if self._wake in ready:
                break
            pending += os.read(self._main, 4096)
            *lines, pending = pending.split(b"\r")
            for line in lines:
                if self.hushed:
                    continue
                reply = self._answer(line.decode("ascii", errors="replace").strip()).encode()
                os.write(self._main, (GARBAGE if self.garbles else reply) + b"\r\n")
        os.close(self._side)
        os.close(self._main)

    def cut(self) -> None:
        """The plug is out: the port is gone."""
        if self._thread.is_alive():
            os.write(self._waker, b".")
            self._thread.join()

    def close(self) -> None:
        """Let go of everything."""
        self.cut()
        os.close(self._wake)
        os.close(self._waker)


class SharedNumber:
    """A number in a file, seen by all processes that have it open; it outlives them.

    Args:
        path: of the file; made if it is not there.
    """

    def __init__(self, path: Path) -> None:
        with path.open("a+b") as file:
            if file.tell() < 8:
                file.truncate(8)
            self._map = mmap.mmap(file.fileno(), 8)

    def write(self, value: float) -> None:
        self._map[:] = struct.pack("<d", value)

    def read(self) -> float:
        return float(struct.unpack("<d", self._map[:])[0])

    def close(self) -> None:
        self._map.close()


# ---- programs ----------------------------------------------------------------------------------


class Forks:
    """Programs as forks of one process that has imported everything. Use as a context.

    Args:
        script: run as `python SCRIPT SOCKET`; calls `serve_forks`.
        path: of its socket.
    """

    def __init__(self, script: Path, path: Path) -> None:
        self.path = path
        self._process = subprocess.Popen(
            [sys.executable, str(script), str(path)], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
        )  # fmt: skip
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == b"ready\n"

    def command(self, *words: str) -> tuple[str, ...]:
        """A command that does the same as the words would, in a fork."""
        return (sys.executable, "-I", "-S", str(Path(__file__)), str(self.path), *words)

    def start(self, words: Sequence[str], stdout: int, stderr: int) -> Program:
        """A program of its own."""
        with Path(os.devnull).open() as nothing:
            return Program(_ask(self.path, words, [nothing.fileno(), stdout, stderr]))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        self._process.wait(30)
        self._process.stdout.close()


class Program:
    """A fork: its process number and, at its end, its exit code."""

    def __init__(self, link: socket.socket) -> None:
        self._words = link.makefile("r")
        link.close()
        self.pid = int(self._words.readline())

    def ended(self) -> int:
        """Its exit code, once it has ended; -1 when a signal did it."""
        with self._words:
            return int(self._words.readline() or -1)


def _ask(path: Path, words: Sequence[str], handles: list[int]) -> socket.socket:
    link = socket.socket(socket.AF_UNIX)
    link.connect(str(path))
    socket.send_fds(link, [json.dumps(list(words)).encode()], handles)
    return link


def serve_forks(path: Path, run: Callable[[list[str]], Any]) -> None:
    """Fork for each request; ends with stdin.

    Args:
        path: of the socket.
        run: what a fork does with its words; its answer is the exit code as for `sys.exit`.
    """
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # nobody waits for forks
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(path))
        listener.listen()
        print("ready", flush=True)
        while True:
            ready, _, _ = select.select([listener, sys.stdin], [], [])
            if sys.stdin in ready:
                return
            link, _ = listener.accept()
            text, handles, _, _ = socket.recv_fds(link, 65536, 3)
            if os.fork() == 0:
                listener.close()
                _child(link, json.loads(text), handles, run)
            link.close()
            for handle in handles:
                os.close(handle)


def _child(
    link: socket.socket, words: list[str], handles: list[int], run: Callable[[list[str]], Any]
) -> None:
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.signal(signal.SIGQUIT, signal.SIG_DFL)  # a shell ignores it for jobs behind itself
    for number, handle in enumerate(handles):
        os.dup2(handle, number)
        os.close(handle)
    sys.stdin = os.fdopen(0)
    link.sendall(f"{os.getpid()}\n".encode())
    code: Any = 1
    try:
        threading.Thread(target=_end_with, args=(link,), daemon=True).start()
        code = run(words)
    except KeyboardInterrupt:
        code = 130
    except BaseException:
        traceback.print_exc()
    finally:
        if isinstance(code, str) and code:
            print(code, file=sys.stderr)
        with contextlib.suppress(OSError):
            link.sendall(f"{1 if isinstance(code, str) and code else int(code or 0)}\n".encode())
        sys.stdout.flush()
        os._exit(0)


def _end_with(link: socket.socket) -> None:
    """Whoever asked is gone."""
    with contextlib.suppress(OSError):
        link.recv(1)
    os._exit(1)


if __name__ == "__main__":
    asked = Program(_ask(Path(sys.argv[1]), sys.argv[2:], [0, 1, 2]))
    sys.exit(asked.ended() & 0xFF)
