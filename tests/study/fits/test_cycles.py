"""Drifts of the triangle test are found only where there are cycles to compare."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import describe
from haselab.study.fits.cycles import Cycles, repeatability

DRIFTS = {"S13.peak_drift", "S13.residual_drift"}


def cycles_of(count: int, left_out: int) -> Cycles:
    """Triangles of 10 % strain on a length of 1 m, each of which starts 1 mm later."""
    time_s = np.linspace(0.0, count, 100 * count + 1)
    length_m = 1.0 + 0.1 * (1.0 - np.abs(2.0 * (time_s % 1.0) - 1.0)) + 1e-3 * time_s
    seen: Any = SimpleNamespace(frame_time_s=time_s, length_m=length_m)
    return Cycles(seen, np.arange(count + 1.0), left_out, 0.06, describe(TwinConfig()))


def test_one_kept_cycle_has_no_drift():
    assert set(repeatability(cycles_of(2, 1), 1.0)) == {"S13.residual_first"}
    assert set(repeatability(cycles_of(5, 4), 1.0)) == {"S13.residual_first"}


def test_drifts_of_kept_cycles_are_last_minus_first():
    found = repeatability(cycles_of(5, 1), 1.0)
    assert set(found) == {"S13.residual_first", *DRIFTS}
    assert found["S13.residual_first"].value == pytest.approx(1e-3)
    assert [found[key].value for key in sorted(DRIFTS)] == pytest.approx([3e-3, 3e-3])
