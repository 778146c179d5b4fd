"""A server of text lines on a loopback port: one thread a client."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable

__all__ = ["LineServer"]

_LONGEST = 65536


class LineServer:
    """Answers each line by what `answer` says, `b""` being no answer.

    Args:
        answer: from a line without its end to the bytes to send.
        port: 0: any free one.
        name: of the threads.
    """

    def __init__(self, answer: Callable[[str], bytes], port: int = 0, name: str = "lines") -> None:
        self._answer = answer
        self._name = name
        self._closed = False
        self._clients: list[tuple[socket.socket, threading.Thread]] = []
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port: int = self._listener.getsockname()[1]
        self._thread = threading.Thread(target=self._accept, name=f"{name} listener")
        self._thread.start()

    def _accept(self) -> None:
        while not self._closed:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            thread = threading.Thread(target=self._serve, args=(client,), name=self._name)
            self._clients = [(c, t) for c, t in self._clients if t.is_alive()]
            self._clients.append((client, thread))
            thread.start()

    def _serve(self, client: socket.socket) -> None:
        pending = b""
        with client, contextlib.suppress(OSError):
            while not self._closed:
                data = client.recv(4096)
                if not data:
                    return
                pending += data
                *lines, pending = pending.split(b"\n")
                for line in lines:
                    reply = self._answer(line.decode("ascii", errors="replace").strip())
                    if reply:
                        client.sendall(reply)
                if len(pending) > _LONGEST:
                    return

    def close(self) -> None:
        """Close the port and every connection."""
        self._closed = True
        _wake(self._listener)
        self._listener.close()
        self._thread.join()
        for client, thread in self._clients:
            _wake(client)
            thread.join()


def _wake(waiting: socket.socket) -> None:
    """End a wait on a socket in another thread, which closing it would not."""
    with contextlib.suppress(OSError):
        waiting.shutdown(socket.SHUT_RDWR)
