"""The server of STOP by itself: whatever a request looks like, it acts and lives on."""

from __future__ import annotations

import http.client
import socket
import threading
from collections.abc import Iterator

import pytest

from haselab.panel.stop_process import StopServer
from tests.panel.running import WAIT_S


@pytest.fixture
def server() -> Iterator[tuple[StopServer, list[int], list[object]]]:
    """A server, how often STOP came, and errors of its handlers."""
    pressed: list[int] = []
    faults: list[object] = []

    def stop() -> dict[str, object]:
        pressed.append(1)
        return {"commanded": True}

    found = StopServer(0, stop, ())
    found.handle_error = lambda request, address: faults.append(address)  # type: ignore[method-assign]
    thread = threading.Thread(target=found.serve_forever, daemon=True)
    thread.start()
    yield found, pressed, faults
    found.shutdown()
    found.server_close()


@pytest.mark.parametrize("size", ["", "many", "-5", "0x10", "²", "3"])
def test_a_length_that_is_no_number_stops_too(
    server: tuple[StopServer, list[int], list[object]], size: str
) -> None:
    found, pressed, faults = server
    connection = http.client.HTTPConnection("127.0.0.1", found.port, timeout=WAIT_S)
    for _ in range(2):  # the same connection goes on
        connection.putrequest("POST", "/stop")
        connection.putheader("Content-Length", size)
        connection.endheaders(b"abc" if size == "3" else None)
        with connection.getresponse() as answer:
            assert answer.status == 200 and answer.read() == b'{"commanded": true}'
    connection.close()
    assert pressed == [1, 1] and not faults


def test_idle_connections_of_others_do_not_keep_stop_from_being_pressed(
    server: tuple[StopServer, list[int], list[object]],
) -> None:
    found, pressed, faults = server
    idle = [socket.create_connection(("127.0.0.1", found.port), WAIT_S) for _ in range(300)]
    connection = http.client.HTTPConnection("127.0.0.1", found.port, timeout=WAIT_S)
    connection.request("POST", "/stop")
    assert connection.getresponse().status == 200
    assert pressed == [1] and not faults
    assert len(found._open) <= 128
    connection.close()
    for each in idle:
        each.close()


def test_what_a_foreign_page_sends_besides_is_no_further_request(
    server: tuple[StopServer, list[int], list[object]],
) -> None:
    found, pressed, _ = server
    hidden = b"POST /stop HTTP/1.1\r\nHost: 127.0.0.1:1\r\n\r\n"
    head = "POST /stop HTTP/1.1\r\nHost: 127.0.0.1:1\r\nOrigin: http://other.example\r\n"
    with socket.create_connection(("127.0.0.1", found.port), WAIT_S) as foreign:
        foreign.sendall(f"{head}Content-Length: {len(hidden)}\r\n\r\n".encode() + hidden)
        with foreign.makefile("rb") as received:
            assert received.read().count(b"HTTP/1.1 403") == 1
    assert pressed == []
