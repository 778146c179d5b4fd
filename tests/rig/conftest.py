"""What the tests of rigs share: a small recorded session."""

import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest

from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench, rig_of
from haselab.store.session.writer import ExperimentPlan, SessionWriter
from haselab.store.video.writer import VideoWriter

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


@pytest.fixture(scope="session")
def fake_v4l2(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], dict[str, str]]:
    """Environment of a process to which a file is a camera that has this fault."""
    if sys.platform != "linux":
        pytest.skip("V4L2 is Linux's")
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("cc is not installed. Run:  sudo apt-get install -y gcc libc6-dev")
    folder = tmp_path_factory.mktemp("v4l2")
    source, library = Path(__file__).with_name("fake_v4l2.c"), folder / "fake.so"
    flags = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC"]
    subprocess.run([compiler, *flags, "-o", library, source, "-ldl"], check=True)
    device = folder / "video7"
    device.touch()

    def environment(fault: str) -> dict[str, str]:
        ours = {"LD_PRELOAD": str(library), "FAKE_V4L2": str(device), "FAKE_V4L2_FAULT": fault}
        return os.environ | ours

    return environment
