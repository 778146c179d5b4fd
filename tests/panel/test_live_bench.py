"""The bench of the panel in this process, on the twin."""

import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from haselab.base import SafetyError
from haselab.panel import study_player
from haselab.panel.columns import LiveWriter
from haselab.panel.files import PanelFiles
from haselab.panel.live_bench import LiveBench
from haselab.panel.pages.study_job import StudyJob
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.safety.guarded import GuardedRig, guard

LIMIT_V = 2.0


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[tuple[LiveBench, GuardedRig]]:
    """The twin behind the panel, armed for the reference study by the page "page"."""
    path = tmp_path / "rig.toml"
    path.write_text('kind = "twin"\n')
    files = PanelFiles(path, None, tmp_path / "out")
    rig = guard(make_twin(twin_of_reading("hz"), 1))
    about = rig.description
    with LiveWriter(tmp_path / "live", about.rate_hz, about.block_samples, (1.0, 1.0)) as writer:
        found = LiveBench(
            rig, writer, prepare=lambda chosen: StudyJob.of(files, load_rig(path), chosen)
        )
        number = found.do("request", "page", {})["number"]
        study = {"study": "reference study", "experiments": ["triangle"]}
        found.do("arm", "page", {"number": number, "limit_v": LIMIT_V, "study": study})
        yield found, rig
        found.close()


@pytest.mark.parametrize("how", ["lost page", "ended"])
def test_a_study_that_computes_with_an_output_is_taken_to_zero_when_it_must_end(
    bench: tuple[LiveBench, GuardedRig], monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    live, _ = bench
    seen: list[float] = []

    def computing(study: Any, rig: GuardedRig, options: Any, progress: Any) -> None:
        """A fit between two experiments, at 1.5 V: no block is read meanwhile."""
        rig.safety.run()
        rig.source.write(1.5)
        rig.acquisition.read()
        end_s = time.monotonic() + 30.0
        while rig.safety.live and time.monotonic() < end_s:
            if how == "ended":
                live.do("lease", "page", {})  # the page is there
            time.sleep(0.05)
        seen.append(rig.bench.requested_v)
        rig.source.write(1.5)  # refused

    monkeypatch.setattr(study_player, "run_study", computing)
    if how == "ended":
        threading.Timer(0.5, live.do, ("disarm", "page", {})).start()
    live.step()
    said = {"ended": "The study was ended", "lost page": "No message from the page"}[how]
    assert live.state.stage == "tripped" and live.state.drive_v == 0.0
    assert said in live.state.reason
    assert seen == [0.0]


def test_the_typed_limit_is_that_of_every_output_of_a_study(
    bench: tuple[LiveBench, GuardedRig], monkeypatch: pytest.MonkeyPatch
) -> None:
    live, _ = bench
    high = []

    def playing(study: Any, rig: GuardedRig, options: Any, progress: Any) -> None:
        high.append((rig.description.drive_limits.high, rig.plain.description.drive_limits.high))
        raise SafetyError("enough")

    monkeypatch.setattr(study_player, "run_study", playing)
    monkeypatch.setattr(live, "_limit_v", 1.25)
    live.step()
    assert high == [(1.25, 1.25)]
    assert live.state.high_v == 2.0, "the next run has the limits of the rig"
    assert "enough" in live.state.reason
