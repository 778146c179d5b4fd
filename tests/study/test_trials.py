"""Step trials: one interval for a number wherever it stands, and what one trial does not know."""

from __future__ import annotations

import numpy as np
import pytest

from haselab.base import Estimate
from haselab.control import step_metrics
from haselab.control.step_metrics import over_trials
from haselab.study.definition import Steps, builtin_study
from haselab.study.fits.further import _scatter_note
from haselab.study.fits.trials import (
    ONE_TRIAL,
    Trials,
    make_comparison,
    normal_equivalent,
    with_camera_resolution,
)

STEPS = builtin_study().steps
PX = 5e-3  # strain per pixel


def trials(count: int, rate_per_s: float) -> Trials:
    rng = np.random.default_rng(5)
    time_s = np.arange(0.0, STEPS.zero_s + STEPS.step_s - 0.1, 1.0 / STEPS.frame_rate_hz)
    rise = np.where(
        time_s < STEPS.zero_s,
        0.0,
        STEPS.step * (1.0 - np.exp(-rate_per_s * np.maximum(time_s - STEPS.zero_s, 0.0))),
    )
    strain = rise + 1e-5 * rng.standard_normal((count, time_s.size))
    reference = np.where(time_s < STEPS.zero_s, 0.0, STEPS.step)
    return Trials(time_s, strain, strain, reference, step_metrics(time_s, strain, reference))


@pytest.mark.parametrize("count", [1, 4])
def test_a_figures_table_has_the_intervals_of_the_rows(count: int) -> None:
    """Before, the table had the scatter alone, narrower by ten than the camera can see."""
    group = trials(count, 1.2)
    metrics = group.metrics
    quantities = {"rise": metrics.rise_time_s, "error": metrics.steady_state_error}
    found = make_comparison({"PI": group}, quantities, STEPS, PX, "PI", 0.0)
    table = found.figures["steps"]["metrics"]["PI"]
    assert table["rise_time_s"] == found.quantities["rise"]
    assert table["error"] == found.quantities["error"]
    for estimate in (table["rise_time_s"], table["overshoot"], table["settling_time_s"]):
        assert np.isfinite(estimate.ci95).all()  # of one trial, too: no "[open, open]"


def test_an_error_includes_the_zero_strain_of_another_session() -> None:
    group = trials(4, 1.2)
    metrics = group.metrics
    rows = {"S24.rise_open": metrics.rise_time_s, "S24.error_open": metrics.steady_state_error,
            "S25.overshoot_own": metrics.overshoot}  # fmt: skip
    own, other = (make_comparison({"PI": group}, rows, STEPS, PX, "PI", zero_px).quantities
                  for zero_px in (0.0, 0.02))  # fmt: skip
    more = np.sqrt(other["S24.error_open"].std ** 2 - own["S24.error_open"].std ** 2)
    assert more == pytest.approx(0.02 * PX / STEPS.step)
    for key in ("S24.rise_open", "S25.overshoot_own"):  # relative to the time before the step
        assert own[key] == other[key]


def test_the_interval_of_two_rise_times_does_not_begin_below_zero() -> None:
    rise = over_trials(np.array([0.2, 0.6]), "s")  # Student's factor of two trials is 12.7
    found = with_camera_resolution(normal_equivalent(rise), STEPS, PX)
    assert rise.ci95[0] < 0.0 == found.ci95[0]
    assert found.ci95[1] >= rise.ci95[1]


def test_a_number_that_is_missing_has_no_deviation() -> None:
    group = trials(2, 1.2)
    nothing = Estimate(np.nan, np.nan, (np.nan, np.nan), "s")
    found = make_comparison({"PI": group}, {"settling": nothing}, STEPS, PX, "PI", 0.0)
    assert np.isnan(found.quantities["settling"].std)


def test_a_few_trials_say_whose_scatter_they_have() -> None:
    assert _scatter_note(1, 4) == "one trial; scatter taken from the 4 PI trials"
    assert _scatter_note(2, 4) == "2 trials; scatter taken from the 4 PI trials"
    assert _scatter_note(1, 1) == ONE_TRIAL
    assert isinstance(STEPS, Steps)
