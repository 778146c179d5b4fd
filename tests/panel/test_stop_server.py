"""The server of STOP by itself: whatever a request looks like, it acts and lives on."""

from __future__ import annotations

import http.client
import socket
import threading
import time
from collections.abc import Iterator

import pytest
import websockets.sync.client

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


STOP = b"\x81\x84\x01\x02\x03\x04stop"  # a frame: text, masked, 4 bytes


def wait_for(pressed: list[int], count: int) -> None:
    """Wait until STOP has come as often as this; only a hang ends the wait."""
    end_s = time.monotonic() + WAIT_S
    while len(pressed) < count:
        assert time.monotonic() < end_s
        time.sleep(0.01)


def upgrade(port: int, origin: str = "") -> socket.socket:
    """A WebSocket to STOP, with the example key of RFC 6455."""
    link = socket.create_connection(("127.0.0.1", port), WAIT_S)
    link.sendall(
        (
            f"GET /socket HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nUpgrade: websocket\r\n"
            "Connection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
            f"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n{origin}\r\n"
        ).encode()
    )
    return link


def test_each_message_of_a_web_socket_stops(
    server: tuple[StopServer, list[int], list[object]],
) -> None:
    found, pressed, faults = server
    with websockets.sync.client.connect(f"ws://127.0.0.1:{found.port}/socket") as page:
        page.send("stop")
        page.send("")
        connected = upgrade(found.port)  # while another one is open
        head = connected.recv(4096).decode()
        assert head.startswith("HTTP/1.1 101 ")
        assert "Sec-WebSocket-Accept: s3pPLMBiTxaQ9kYGzzhZRbK+xOo=" in head  # RFC 6455, 1.3
        connected.sendall(STOP)
        wait_for(pressed, 3)
        connected.close()
    assert pressed == [1, 1, 1] and not faults


@pytest.mark.parametrize(
    "sent",
    [
        b"\x88\x80\x01\x02\x03\x04",  # the end of the connection
        b"\x82\x84\x01\x02\x03\x04stop",  # binary
        b"\x81\xfe\xff\xff\x01\x02\x03\x04",  # longer than any message of the page
        b"\x81",
    ],
)
def test_other_frames_end_only_their_connection(
    server: tuple[StopServer, list[int], list[object]], sent: bytes
) -> None:
    found, pressed, faults = server
    with upgrade(found.port) as link:
        assert link.recv(4096).startswith(b"HTTP/1.1 101 ")
        link.sendall(sent)
        link.shutdown(socket.SHUT_WR)
        assert link.recv(4096) == b""
    with upgrade(found.port) as link:
        link.recv(4096)
        link.sendall(STOP)
        wait_for(pressed, 1)
    assert pressed == [1] and not faults


def test_a_foreign_page_gets_no_web_socket(
    server: tuple[StopServer, list[int], list[object]],
) -> None:
    found, pressed, _ = server
    with upgrade(found.port, "Origin: http://other.example\r\n") as link:
        link.sendall(STOP)
        assert link.recv(4096).startswith(b"HTTP/1.1 403 ")
    assert pressed == []
