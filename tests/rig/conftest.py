"""What the tests of rigs share: a small recorded session."""

from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from haselab.rig.twin.bench import TwinBench, rig_of
from haselab.rig.twin.config import twin_of_reading
from haselab.store.session import ExperimentPlan, SessionWriter
from haselab.store.video_writer import VideoWriter

DRIVES = {"rest": np.zeros(30), "steps": np.repeat([0.5, 1.0, 0.2], 6)}
SENSING = {"carrier_hz": 2000.0, "carrier_v": 0.02}


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """session.h5 of two experiments on the twin, with all frames of the second kept."""
    folder = tmp_path_factory.mktemp("recording")
    config = twin_of_reading("hz")
    bench = TwinBench(config, 5)
    rig = rig_of(bench, config)
    plans = [ExperimentPlan(name, "test", 6, {}) for name in DRIVES]
    header = {"rig": asdict(rig.description), "study": {"sensing": SENSING}}
    rig.generator.sine(SENSING["carrier_hz"], SENSING["carrier_v"])
    with SessionWriter(folder / "session.h5", plans, 2000, header) as session:
        for name, drives in DRIVES.items():
            rig.camera.start(100.0)
            for value in drives:
                rig.source.write(float(value))
                start_s = rig.acquisition.time_s
                codes = rig.acquisition.read()
                session.append_block(name, codes, start_s, float(value), float("nan"))
            session.flush(name)
            if name == "steps":
                frames = rig.camera.take()
                video = VideoWriter(folder / "video" / "steps.mkv", 100.0)
                video.append(frames.images, frames.time_s)
                video.close()
                np.savez(folder / "frames.npz", images=frames.images, time_s=frames.time_s)
            rig.camera.stop()
            rig.stand.wait(0.5)
    yield folder / "session.h5"
