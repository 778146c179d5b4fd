"""A server for text lines on a loopback port, with one thread per client."""

from __future__ import annotations

import contextlib
import select
import socket
import sys
import threading
import traceback
from typing import Protocol

from haselab.rig.twin.serve.local_user import LocalUserFilter

__all__ = ["LineProtocol", "LineServer"]

_LONGEST = 65536  # bytes of a line
_MOST_CLIENTS = 16
_NO_WAIT = getattr(socket, "MSG_DONTWAIT", 0)


class LineProtocol(Protocol):
    """An instrument that replies to lines."""

    def answer(self, line: str) -> bytes:
        """The reply to a line without its end; `b""`: none. Must never raise."""

    def refuse_line(self, longest: int) -> bytes:
        """The reply to a line that is longer than this many bytes."""

    def fail(self) -> bytes:
        """The reply after a defect of this program."""


class LineServer:
    """Serves a protocol on a loopback port; what one client sends cannot end the server.

    Args:
        protocol: what to answer.
        port: 0: any free one.
        name: of the threads.
        allow_others: also serve clients of other users of this computer.
        most_clients: connections at once; a further one is closed as soon as it is made.
    """

    def __init__(
        self,
        protocol: LineProtocol,
        port: int = 0,
        name: str = "lines",
        *,
        allow_others: bool = False,
        most_clients: int = _MOST_CLIENTS,
    ) -> None:
        self._most_clients = most_clients
        self._protocol = protocol
        self._name = name
        self._closed = False
        self.refused = 0  # connections
        self._clients: list[tuple[socket.socket, threading.Thread]] = []
        self._listener = socket.create_server(("127.0.0.1", port))
        self.port: int = self._listener.getsockname()[1]
        self._gate = LocalUserFilter(self.port, allow_others=allow_others)
        self._thread = threading.Thread(target=self._accept, name=f"{name} listener")
        self._thread.start()

    def _accept(self) -> None:
        while not self._closed:
            try:
                client, address = self._listener.accept()
            except ConnectionError:  # the client has disconnected
                continue
            except OSError:
                return
            self._clients = [(c, t) for c, t in self._clients if t.is_alive()]
            connected = sum(not _has_left(each) for each, _ in self._clients)
            if connected >= self._most_clients or not self._gate.admits(address):
                client.close()
                self.refused += 1
                continue
            thread = threading.Thread(target=self._serve, args=(client,), name=self._name)
            self._clients.append((client, thread))
            thread.start()

    def _serve(self, client: socket.socket) -> None:
        pending, too_long = b"", False
        with client, contextlib.suppress(OSError):
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            while not self._closed:
                data = client.recv(4096)
                if not data:
                    return
                *lines, pending = (pending + data).split(b"\n")
                for line in lines:
                    reply = self._protocol.refuse_line(_LONGEST) if too_long else self._reply(line)
                    too_long = False
                    if reply:
                        client.sendall(reply)
                if len(pending) > _LONGEST:  # wait for its end, but discard it
                    pending, too_long = b"", True

    def _reply(self, line: bytes) -> bytes:
        try:
            return self._protocol.answer(line.decode("ascii", errors="replace").strip())
        except Exception:  # a defect: print it, and keep serving the client
            traceback.print_exc(file=sys.stderr)
            return self._protocol.fail()

    def close(self) -> None:
        """Close the port and every connection."""
        self._closed = True
        _wake(self._listener)
        self._listener.close()
        self._thread.join()
        for client, thread in self._clients:
            _wake(client)
            thread.join()


def _has_left(client: socket.socket) -> bool:
    """Whether a client has closed its end, and its thread has only not seen it yet."""
    try:
        ready, _, _ = select.select([client], [], [], 0.0)
        return bool(ready) and not client.recv(1, socket.MSG_PEEK | _NO_WAIT)
    except BlockingIOError:  # its thread has read it meanwhile
        return False
    except (OSError, ValueError):  # its thread has closed it meanwhile
        return True


def _wake(waiting: socket.socket) -> None:
    """End a wait on a socket in another thread, which closing it would not."""
    with contextlib.suppress(OSError):
        waiting.shutdown(socket.SHUT_RDWR)
