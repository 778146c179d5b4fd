"""The web server's connection to a bench process that does not answer."""

from __future__ import annotations

import asyncio
import contextlib
import json
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from haselab.panel import web
from haselab.panel.columns import Columns, LiveWriter
from haselab.panel.files import PanelFiles
from haselab.panel.page_server import Access
from tests.panel.running import WAIT_S


def test_a_command_that_is_not_answered_is_reported_with_the_age_of_its_data(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bench process refuses it later by this age, see test_old_commands."""
    monkeypatch.setattr(web, "_ARM_S", 0.2)
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
        answer = await bench.ask("arm", "page", {"limit_v": 1.0}, 12.5)
        while not received:
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
    assert answer == {"error": "No answer from the bench process for 0.2 s. Press STOP."}
    sent = {"id": 1, "do": "arm", "holder": "page", "values": {"limit_v": 1.0}, "at_s": 12.5}
    assert received == [sent]


def test_a_frame_is_valid_json_if_the_bench_process_ends_meanwhile(tmp_path: Path) -> None:
    class Reader:
        end_s, gap_s, written_s = 1.0, float("nan"), float("nan")

        def monitors(self, *_: object) -> Columns:
            return Columns(0.0, 1.0, np.empty((0, 2)), np.empty((0, 2)))

        def signals(self, *_: object) -> Columns:
            return Columns(0.0, 1.0, np.empty((0, 5)), np.empty((0, 5)))

    files = PanelFiles(tmp_path / "rig.toml", None, tmp_path)
    server = web._Server(web.WebSettings(tmp_path, Access(1), 2, files))
    server._bench.reader = cast(Any, Reader())
    frame = server._encode(1, web._View(10.0, None, 600))
    size = int.from_bytes(frame[40:44], "little")

    def refuse(word: str) -> None:
        raise AssertionError(f"{word} is not JSON")

    about = json.loads(frame[48 : 48 + size], parse_constant=refuse)
    assert (about["end_s"], about["gap_s"], about["written_s"]) == (1.0, None, None)
