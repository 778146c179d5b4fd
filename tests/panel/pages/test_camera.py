"""The camera picture of the page: an old one never looks new."""

import math
import time
from pathlib import Path

import numpy as np
import pytest

from haselab.panel.pages.camera import CameraPicture
from haselab.panel.study_player import PictureFile
from haselab.rig import Frames
from haselab.safety.interlock import lease_clock_s
from tests.panel.running import WAIT_S


def test_the_age_of_a_picture_does_not_follow_the_wall_clock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, begun_s = tmp_path / "camera.jpg", lease_clock_s()
    PictureFile(path).save(Frames(np.zeros((1, 120, 160), np.uint8), np.zeros(1)))
    while not path.exists():
        assert lease_clock_s() < begun_s + WAIT_S
        time.sleep(0.01)
    saved_s, real = lease_clock_s(), time.time
    for shift_s in (-3600.0, 3600.0):  # the clock of the computer is set
        monkeypatch.setattr(time, "time", lambda shift_s=shift_s: real() + shift_s)
        before_s = lease_clock_s()
        found = CameraPicture(path).read()
        assert found is not None
        # 1 us for the resolution of the time of a file, in s as a float
        assert before_s - saved_s - 1e-6 <= found.age_s <= lease_clock_s() - begun_s + 1e-6


def test_a_picture_of_an_unknown_time_is_old(tmp_path: Path) -> None:
    """Its file has the time of the wall clock, which is later than that since the start."""
    path = tmp_path / "written.jpg"
    PictureFile(path)._save(np.zeros((120, 160), np.uint8), lease_clock_s() + 60.0)
    found = CameraPicture(path).read()
    assert found is not None and found.age_s == math.inf
