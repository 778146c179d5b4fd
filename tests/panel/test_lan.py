"""`haselab panel --lan`: the same panel on a second address of this computer."""

from __future__ import annotations

import asyncio
import json
import socket
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from typing import Any

import pytest

from haselab.cli.main import main
from haselab.panel import stop_process
from haselab.panel.stop_process import StopServer
from tests.panel.running import WAIT_S, RunningPanel, connected, ended, started

LAN = "127.0.0.2"  # Linux has all of 127.0.0.0/8; a network is not needed
pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="needs the address 127.0.0.2")


@pytest.fixture(scope="module")
def panels() -> Iterator[tuple[RunningPanel, RunningPanel]]:
    """One panel by its local address and by that of the network."""
    local = started("--lan", LAN)
    try:
        assert local.process.stdout is not None
        yield local, RunningPanel(local.process, local.process.stdout.readline().strip())
    finally:
        ended(local)


def test_the_second_printed_address_is_that_of_the_network_with_the_same_token(
    panels: tuple[RunningPanel, RunningPanel],
) -> None:
    local, lan = panels
    port = local.host.partition(":")[2]
    assert local.host == f"127.0.0.1:{port}" and lan.host == f"{LAN}:{port}"
    assert lan.token == local.token and len(lan.token) >= 32


def _status(url: str, data: bytes | None = None, **headers: str) -> int:
    request = urllib.request.Request(url, data, headers)
    try:
        with urllib.request.urlopen(request, timeout=WAIT_S) as answer:
            return int(answer.status)
    except urllib.error.HTTPError as error:
        return error.code


def test_foreign_names_and_missing_tokens_are_refused_there_too(
    panels: tuple[RunningPanel, RunningPanel],
) -> None:
    local, lan = panels
    stop = f"http://{LAN}:{lan.about()['stop_port']}"
    assert _status(f"http://{lan.host}/") == 200
    port = lan.host.partition(":")[2]
    assert _status(f"http://{lan.host}/", Host=f"other.example:{port}") == 403
    assert _status(f"http://{lan.host}/", Origin="http://other.example") == 403
    body = {"Content-Type": "application/json"}
    assert _status(f"http://{lan.host}/request/doctor", b"{}", **body) == 403
    assert _status(f"{stop}/ready", Host="other.example:1") == 403
    assert _status(f"{stop}/ready", Origin="http://other.example") == 403
    assert _status(f"{stop}/ready", Origin=f"http://{lan.host}") == 200
    assert _status(f"{stop}/ready", Origin=f"http://{local.host}") == 200


def test_the_page_may_reach_its_stop(panels: tuple[RunningPanel, RunningPanel]) -> None:
    _, lan = panels
    with urllib.request.urlopen(f"http://{lan.host}/", timeout=WAIT_S) as answer:
        policy = answer.headers["content-security-policy"]
    assert f"http://{LAN}:{lan.about()['stop_port']}" in policy


def test_stop_from_the_network_trips_the_bench_that_the_local_page_armed(
    panels: tuple[RunningPanel, RunningPanel],
) -> None:
    local, lan = panels

    async def play() -> None:
        async with connected(local) as page, connected(lan) as watching:
            await page.arm()
            await watching.until(lambda state: bool(state["stage"] == "running"))
            url = f"http://{LAN}:{lan.about()['stop_port']}/stop"
            request = urllib.request.Request(url, b"", {"Origin": f"http://{lan.host}"})
            with urllib.request.urlopen(request, timeout=WAIT_S) as answer:
                assert json.load(answer)["commanded"]
            await watching.until(lambda state: bool(state["stage"] == "tripped"))

    asyncio.run(play())


def test_stop_takes_a_port_that_is_free_on_both_addresses(monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[socket.socket] = []

    def made(port: int, stop: Any, origins: Any, ip: str) -> StopServer:
        server = StopServer(port, stop, origins, ip)
        if not taken:  # another program has this port on the second address
            taken.append(socket.create_server((LAN, server.port)))
        return server

    monkeypatch.setattr(stop_process, "StopServer", made)
    servers = stop_process._on_one_port(["127.0.0.1", LAN], dict, ())
    try:
        assert [server.server_address[0] for server in servers] == ["127.0.0.1", LAN]
        assert servers[0].port == servers[1].port != taken[0].getsockname()[1]
    finally:
        taken[0].close()
        for server in servers:
            server.server_close()


@pytest.mark.parametrize("bad", ["0.0.0.0", "127.0.0.1", "::1", "lab-pc", "224.0.0.1", "1.2.3"])
def test_anything_but_one_address_of_the_network_is_refused(
    bad: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as raised:
        main(["panel", "--no-browser", "--lan", bad])
    said = capsys.readouterr().err
    assert raised.value.code == 2 and said.count("\n") == 1
    assert bad in said and "192.168.1.20" in said


def test_an_address_of_another_computer_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as raised:
        main(["panel", "--no-browser", "--lan", "198.51.100.7"])  # for documentation, RFC 5737
    said = capsys.readouterr().err
    assert raised.value.code == 2 and said.count("\n") == 1
    assert "this computer does not have this address" in said
