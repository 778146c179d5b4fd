"""The built-in cameras keep what every camera driver promises."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.server import ServedTwin
from haselab.store.video.writer import write_png
from haselab.testing.conformance import CameraConformance

BENCH = """
kind = "bench"
[daq]
[amplifier]
name = "any"
[generator]
address = "TCPIP::127.0.0.1::5025::SOCKET"
[specimen]
shell_width_m = 0.03
shell_thickness_m = 0.002
mass_kg = 0.25
[camera]
"""


class TestFolder(CameraConformance):
    @pytest.fixture
    def rig_file(self, tmp_path: Path) -> Path:
        """Thirty pictures, again and again."""
        folder = tmp_path / "pictures"
        folder.mkdir()
        for k, frame in enumerate(
            np.random.default_rng(1).integers(0, 256, (30, 8, 12), dtype=np.uint8)
        ):
            write_png(folder / f"{k:02d}.png", frame)
        path = tmp_path / "rig.toml"
        path.write_text(f'{BENCH}kind = "folder"\npath = "{folder}"\nrepeat = true\n')
        return path


@pytest.mark.long
class TestServedTwin(CameraConformance):
    @pytest.fixture
    def rig_file(self, tmp_path: Path) -> Iterator[Path]:
        """The twin behind a socket, in the time of the wall."""
        pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")
        with ServedTwin(twin_of_reading("hz"), 1, pace=1.0) as served:
            path = tmp_path / "rig.toml"
            path.write_text(served.rig_file())
            yield path
