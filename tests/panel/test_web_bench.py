"""The web server's connection to a bench process that does not answer."""

from __future__ import annotations

import asyncio
import contextlib
import json
from pathlib import Path
from typing import Any

import pytest

from haselab.panel import web
from haselab.panel.columns import LiveWriter
from haselab.panel.files import PanelFiles
from tests.panel.running import WAIT_S


@pytest.mark.parametrize(("what", "sent"), [("arm", ["arm", "disarm"]), ("request", ["request"])])
def test_a_command_that_was_not_answered_cannot_energise_the_bench_later(
    what: str, sent: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(web, "_BENCH_S", 0.2)
    received: list[dict[str, Any]] = []
    ended = asyncio.Event()

    async def silent(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while line := await reader.readline():
            received.append(json.loads(line))
        writer.close()
        ended.set()

    async def play() -> dict[str, Any]:
        server = await asyncio.start_unix_server(silent, str(tmp_path / "bench.sock"))
        bench = web._Bench(tmp_path, PanelFiles(tmp_path / "rig.toml", None, tmp_path))
        running = asyncio.create_task(bench.run())
        while bench._writer is None:
            await asyncio.sleep(0.01)
        answer = await bench.ask(what, "page", {"limit_v": 1.0})
        while len(received) < len(sent):
            await asyncio.sleep(0.01)
        running.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await running
        bench._lost()
        await ended.wait()
        server.close()
        await server.wait_closed()
        return answer

    with LiveWriter(tmp_path / "live", 200e3, 2000, (1.0, 1.0)):
        answer = asyncio.run(asyncio.wait_for(play(), WAIT_S))
    assert answer["error"].startswith("No answer from the bench process")
    assert [command["do"] for command in received] == sent
    assert all(command["holder"] == "page" for command in received)
