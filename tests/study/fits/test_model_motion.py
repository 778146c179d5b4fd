"""The model's capacitances at the blocks of a recording, of which some have none."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from haselab.identify.physical.misfit import ModelledRecord
from haselab.pipelines.model_results import _Motion
from haselab.study.fits.observe import Observation

pytestmark = pytest.mark.unit

BLOCKS = 40
TIME_S = 0.01 * np.arange(BLOCKS)
MODEL_F = 5e-10 + 1e-10 * TIME_S  # a straight line, which interpolation keeps
NONE = np.zeros(0)


def seen(lost: list[int]) -> Observation:
    measured = MODEL_F + 1e-13 * np.random.default_rng(1).standard_normal(BLOCKS)
    measured[lost] = np.nan
    return Observation(
        "triangle", {}, TIME_S, 0.0 * TIME_S, np.nan * TIME_S, TIME_S, measured, 100.0 * measured,
        NONE, NONE, NONE, NONE, np.nan, NONE,
    )  # fmt: skip


def modelled(lost: list[int]) -> Observation:
    used = np.setdiff1d(np.arange(BLOCKS), lost)
    record: Any = SimpleNamespace(
        experiments=["triangle"], length_experiment=np.zeros(0, int), length_time_s=NONE,
        capacitance_experiment=np.zeros(used.size, int), block=used,
    )  # fmt: skip
    no_changes = np.zeros((0, 0))
    model = ModelledRecord(NONE, MODEL_F[used], no_changes, no_changes)
    return _Motion(lambda name: seen(lost), record, model)("triangle")


@pytest.mark.parametrize("lost", [[], [7], [7, 8, 9], [7, 20, 21]])
def test_a_few_lost_blocks_have_the_capacitance_of_the_model(lost: list[int]) -> None:
    found = modelled(lost)
    np.testing.assert_allclose(found.capacitance_f, MODEL_F, rtol=1e-12)
    np.testing.assert_allclose(found.relative_capacitance, 100.0 * MODEL_F, rtol=1e-12)


@pytest.mark.parametrize("lost", [[0], [0, 1], [39], [7, 8, 9, 10], list(range(BLOCKS))])
def test_blocks_without_a_carrier_stay_without_a_capacitance(lost: list[int]) -> None:
    if len(lost) == BLOCKS:
        record: Any = SimpleNamespace(
            experiments=["triangle"], length_experiment=np.zeros(0, int), length_time_s=NONE,
            capacitance_experiment=np.zeros(0, int), block=np.zeros(0, int),
        )  # fmt: skip
        model = ModelledRecord(NONE, NONE, np.zeros((0, 0)), np.zeros((0, 0)))
        found = _Motion(lambda name: seen(lost), record, model)("triangle")
    else:
        found = modelled(lost)
    assert np.flatnonzero(np.isnan(found.capacitance_f)).tolist() == lost
    assert np.flatnonzero(np.isnan(found.relative_capacitance)).tolist() == lost
