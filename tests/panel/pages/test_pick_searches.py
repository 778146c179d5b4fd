"""Searches of the page Pick: equal requests share one, and the program ends while one runs."""

import contextlib
import http.client
import json
import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import tifffile

from haselab.panel.pages import pick
from haselab.tracking.particles.detect import DotProfile, find_profile
from tests.panel.running import WAIT_S, RunningPanel

PLACE = {"place": [40.0, 41.0], "reach": 12.0}
ENDLESS = """
import sys, threading
from haselab.panel.pages import pick

def search(*_):
    print("searching", file=sys.stderr, flush=True)
    threading.Event().wait()

pick.find_profile = search
from haselab.cli.entry import main
sys.argv[:] = ["haselab", "track", "--pick", "--no-browser", "--json", sys.argv[1]]
main()
"""


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """One dot on an even ground."""
    y, x = np.mgrid[:96, :96]
    image = 200 - 90 * np.exp(-((x - 42.3) ** 2 + (y - 39.8) ** 2) / 8)
    path = tmp_path / "dot.tif"
    tifffile.imwrite(path, np.rint(image).astype(np.uint8)[None], photometric="minisblack")
    return path


def test_equal_requests_share_one_search(video: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, may_end, searches = threading.Event(), threading.Event(), []

    def search(frame: np.ndarray) -> DotProfile:
        searches.append(frame.shape)
        begun.set()
        assert may_end.wait(WAIT_S)
        return find_profile(frame)

    monkeypatch.setattr(pick, "find_profile", search)

    def snap() -> object:
        videos = pick.Videos(video.parent)
        return pick.PICK_REQUESTS["pick-snap"](videos, {"video": video.name, "frame": 0, **PLACE})

    with ThreadPoolExecutor(4) as pool:
        asked = [pool.submit(snap) for _ in range(4)]
        assert begun.wait(WAIT_S)
        may_end.set()
        found = [each.result(WAIT_S) for each in asked]
    assert len(searches) == 1 and all(each == found[0] for each in found)
    assert found[0]["snapped"]  # type: ignore[index]
    # white noise of 12**-0.5 grey levels (rounding) moves the centre by less than 0.02 px
    np.testing.assert_allclose(found[0]["place"], [42.3, 39.8], atol=0.1)  # type: ignore[index]


def test_a_search_that_fails_is_made_again(video: Path) -> None:
    videos = pick.Videos(video.parent)
    asked = {"video": "dot.tif", "frame": 7, **PLACE}
    for _ in range(2):
        with pytest.raises(pick.InputError, match="frame"):
            pick.PICK_REQUESTS["pick-snap"](videos, asked)


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_ctrl_c_ends_the_program_while_a_search_runs(video: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", ENDLESS, str(video)], stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    try:
        assert process.stderr is not None
        lines = [process.stderr.readline(), process.stderr.readline()]
        assert "searching\n" in lines  # for the first frame, before anybody has clicked
        address = next(line for line in lines if line.startswith("http"))
        panel, sent = RunningPanel(process, address.strip()), threading.Event()
        body = json.dumps({"video": str(video), "frame": 0, **PLACE})
        request = threading.Thread(target=_post, args=(panel, body, sent), daemon=True)
        request.start()
        assert sent.wait(WAIT_S)
        process.send_signal(signal.SIGINT)
        assert process.wait(WAIT_S) == 130
        request.join(WAIT_S)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def _post(panel: RunningPanel, body: str, sent: threading.Event) -> None:
    host, _, port = panel.host.partition(":")
    connection = http.client.HTTPConnection(host, int(port), timeout=WAIT_S)
    headers = {"X-Panel-Token": panel.token, "Content-Type": "application/json"}
    with contextlib.closing(connection), contextlib.suppress(OSError, http.client.HTTPException):
        connection.request("POST", "/request/pick-snap", body, headers)
        sent.set()
        connection.getresponse().read()
