"""When a capacitance was measured."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from haselab.rig.twin.bench import make_twin
from haselab.rig.twin.config import TwinConfig
from haselab.store.session import ExperimentRecord, SessionWriter
from haselab.study.definition import builtin_study
from haselab.study.observe import observe


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
