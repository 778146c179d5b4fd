"""Find the user of this computer at the other end of a loopback connection.

Linux lists every TCP socket with its owner in /proc/net/tcp and tcp6. Other systems have no such
list, so there the servers cannot distinguish users.
"""

from __future__ import annotations

import os
import socket
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path

__all__ = ["LocalUserFilter", "can_tell_users", "uid_of_client"]

_TABLES = (Path("/proc/net/tcp"), Path("/proc/net/tcp6"))
_IDLE_S = 0.5
_MOST_KEPT = 64


def can_tell_users() -> bool:
    """Whether this system reports the owner of a connection."""
    return sys.platform == "linux"


def _entries(address: tuple[str, int]) -> set[str]:
    """An IPv4 address and port as both tables write it: in words of the machine's byte order."""
    (word,) = struct.unpack("=I", socket.inet_aton(address[0]))
    (mapped,) = struct.unpack("=I", b"\0\0\xff\xff")
    port = f"{address[1]:04X}"
    return {f"{word:08X}:{port}", f"{0:016X}{mapped:08X}{word:08X}:{port}"}


def uid_of_client(client: tuple[str, int], server: tuple[str, int]) -> int | None:
    """The user who owns the client's end of a TCP connection on this computer.

    Args:
        client: IPv4 address and port of the client's end.
        server: of the server's end.
    Returns:
        The user's number; None where the system does not say, or the client has closed its end.
    """
    ours, theirs = _entries(client), _entries(server)
    for table in _TABLES:
        try:
            lines = table.read_text(encoding="ascii").splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            fields = line.split()
            # A socket that its program has closed has no inode, and is listed under user 0.
            if fields[1] in ours and fields[2] in theirs and fields[9] != "0":
                return int(fields[7])
    return None


class LocalUserFilter:
    """Accepts only connections of the user who runs this program.

    The list is read once a connection. gRPC reports only the address of a client with each call, so
    an address is looked up again after half a second without a call: less than the second for which
    Linux keeps another program from taking over the port of a connection that was closed.

    Args:
        port: TCP port of the server on 127.0.0.1.
        allow_others: let every user in.
        lookup: as `uid_of_client`.
        clock: monotonic time, in s.
    """

    def __init__(
        self,
        port: int,
        *,
        allow_others: bool = False,
        lookup: Callable[[tuple[str, int], tuple[str, int]], int | None] = uid_of_client,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._server = ("127.0.0.1", port)
        self._open = allow_others or not can_tell_users()
        self._lookup = lookup
        self._clock = clock
        self._seen_s: dict[tuple[str, int], float] = {}

    def admits(self, client: tuple[str, int]) -> bool:
        """Whether a new connection from this address may be served."""
        return self._open or self._lookup(client, self._server) == os.getuid()

    def admits_call(self, client: tuple[str, int]) -> bool:
        """The same for one of many calls over a connection."""
        now_s = self._clock()
        if now_s - self._seen_s.get(client, -_IDLE_S) >= _IDLE_S and not self.admits(client):
            self._seen_s.pop(client, None)
            return False
        if len(self._seen_s) >= _MOST_KEPT and client not in self._seen_s:
            self._seen_s.clear()
        self._seen_s[client] = now_s
        return True
