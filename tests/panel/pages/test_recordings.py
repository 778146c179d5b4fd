"""The list of recordings, in a folder to which other programs write too."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from typing import Any

import pytest

from haselab.base import InputError
from haselab.panel.files import PanelFiles
from haselab.panel.pages.recordings import compare, listed, report


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_named_pipe_in_a_recording_keeps_no_page_waiting(tmp_path: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    (run / "session.h5").touch()
    for name in ("notes.txt", "report.html", "results.json", "manifest.json"):
        os.mkfifo(run / name)
    files = PanelFiles(rig=tmp_path / "rig.toml", actuator=None, runs=tmp_path)
    found: list[Any] = []

    def ask() -> None:
        recordings: Any = listed(files, {})["recordings"]
        found.extend(recordings)
        for page, values in ((report, {"name": "run"}), (compare, {"first": "run"})):
            try:
                page(files, {**values, "second": "run"})
            except InputError as error:
                found.append(str(error))

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(60.0)
    assert not thread.is_alive()
    one, no_report, no_results = found
    assert (one["note"], one["report"]) == ("", False)
    assert "named pipe" in one["state"]
    assert "no report of run yet" in no_report
    assert "named pipe" in no_results and "press Analyse" in no_results
