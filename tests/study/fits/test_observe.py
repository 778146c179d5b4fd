"""When a capacitance was measured, and where the traces of step trials are read."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from haselab.models.actuator.strain_map import StrainMap
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import make_twin
from haselab.store.session.writer import ExperimentRecord, SessionWriter
from haselab.study.definition import builtin_study
from haselab.study.fits.observe import observe
from haselab.study.fits.trials import collect_trials


def test_a_block_with_a_model_of_its_own_keeps_its_own_middle() -> None:
    """Blocks after a pause as well: the lock-in counts time without it."""
    study, rig = builtin_study(), make_twin(TwinConfig(), seed=1).description
    middle = np.array([6.40e-3, 6.25e-3, 6.40e-3, 6.25e-3])
    start = np.array([5.0, 5.01, 7.0, 7.01])
    one, tracks = np.ones(4), np.zeros((1, 6), dtype=SessionWriter.track_dtype())
    tracks["valid"] = True
    sensed: Any = SimpleNamespace(
        time_s=0.01 * np.arange(4) + middle,
        valid=one > 0.0, capacitance_f=one, phase_rad=one, v_pp=one, i_pp=one,
    )  # fmt: skip
    record = ExperimentRecord(
        "pi-1", "PI step", {}, np.zeros((4, 2000, 2), dtype=np.int16), 0.0 * one, 0.0 * one, start,
        start[:1], tracks, one[:1],
    )  # fmt: skip
    lockin: Any = SimpleNamespace(sense=lambda codes: sensed)
    seen = observe(record, [], lockin, study.sensing, rig)
    np.testing.assert_allclose(seen.sensed_s, start + middle, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("first_s", [0.0005, 0.02, 0.049])
def test_a_ringing_keeps_its_height_wherever_the_frames_lie(first_s: float) -> None:
    """Four frames a period: read half-way between them it would lose a third."""
    steps = builtin_study().steps
    frames = first_s + np.arange(round(40 * steps.frame_rate_hz) - 1) / steps.frame_rate_hz
    since = np.maximum(frames - steps.zero_s, 0.0)
    strain = steps.step * (1.0 - np.exp(-4.0 * since) * np.cos(33.0 * since))
    blocks = 100.0 + 0.01 * np.arange(4000)
    trial: Any = SimpleNamespace(
        block_start_s=blocks, frame_time_s=100.0 + frames, length_m=0.05 * (1.0 + strain),
        sensed_s=blocks + 0.0064, capacitance_f=np.ones(4000),
    )  # fmt: skip
    found = collect_trials([trial], 0.05, StrainMap(1.0, 0.0), steps)
    np.testing.assert_allclose(found.strain[0], strain[: found.time_s.size], rtol=0.0, atol=1e-12)
    assert found.metrics.trials[0].raw_rise_time_s < 0.1
