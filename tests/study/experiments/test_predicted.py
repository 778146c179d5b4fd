"""Steps that the identified plant predicts, and what the strain map explains of the played ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from haselab.base import Estimate
from haselab.control import LoopSetting, PidGains, Saturation, step_metrics
from haselab.control.stability.margins import loop_response
from haselab.models.plant import Plant, SlowMode
from haselab.study.definition import builtin_study
from haselab.study.experiments.chirp import _slow_notes
from haselab.study.experiments.predicted import map_errors, predicted_metrics
from haselab.study.fits.loops import Loops, _figure
from haselab.study.fits.trials import Trials

STEPS = builtin_study().steps
TIME_S = 0.003 + np.arange(0.0, 12.0, 0.01)
ZERO_S, STEP = 6.0, 0.04
WIDE = Saturation(-1.0, 1.0)
LOOP = LoopSetting(100.0, 0.0056, WIDE)


def trials(strain: NDArray[np.float64], sensed: NDArray[np.float64] | None = None) -> Trials:
    reference = np.where(TIME_S < ZERO_S, 0.0, STEP)
    rows = np.atleast_2d(strain)
    metrics = step_metrics(TIME_S, rows, reference)
    return Trials(TIME_S, rows, rows if sensed is None else np.atleast_2d(sensed), reference,
                  metrics)  # fmt: skip


def loops(pi: PidGains, pid: PidGains, setting: LoopSetting = LOOP) -> Loops:
    return Loops(pi, pid, setting, pi, {}, {}, {})


def exponential(tau_s: float) -> NDArray[np.float64]:
    after = np.maximum(TIME_S - ZERO_S, 0.0)
    return STEP * (1.0 - np.exp(-after / tau_s))


def test_an_integrator_and_a_fast_plant_rise_as_the_textbook_says() -> None:
    """A loop of gain ki has the time constant 1 / ki, hence a rise of ln 9 / ki."""
    seen = {"PI": trials(exponential(0.5))}
    plant = Plant(1.0, 300.0, 0.9)
    found = predicted_metrics(seen, plant, loops(PidGains(0.0, 2.0), PidGains(0.0, 1.0)))
    # the delay of 10.6 ms over the time constant is the relative error of the first order
    assert found["PI"]["rise_time_s"] == pytest.approx(np.log(9.0) / 2.0, rel=0.03)
    assert found["PI"]["overshoot"] == pytest.approx(0.0, abs=1e-3)
    assert found["PI"]["error"] == pytest.approx(0.0, abs=1e-3)
    assert set(found) == {"PI"}  # no prediction for what was not played


def test_the_open_loop_overshoots_as_its_damping_ratio_says() -> None:
    """exp(-pi zeta / sqrt(1 - zeta^2)) of the final value; a gain of 0.8 leaves 0.2 of the step."""
    zeta = 0.3
    seen = {"open loop": trials(exponential(0.1))}
    found = predicted_metrics(seen, Plant(0.8, 20.0, zeta), loops(PidGains(0, 1), PidGains(0, 1)))
    expected = np.exp(-np.pi * zeta / np.sqrt(1.0 - zeta**2))
    assert found["open loop"]["overshoot"] == pytest.approx(expected, abs=0.01)
    assert found["open loop"]["error"] == pytest.approx(0.2, abs=1e-3)


def test_feedthrough_of_the_sensed_strain_is_part_of_the_prediction() -> None:
    seen = {"PID": trials(exponential(0.1))}
    gains, plant = PidGains(0.0, 20.0, 0.01, 0.005), Plant(0.8, 69.0, 0.2)
    one, other = (
        predicted_metrics(seen, plant, loops(gains, gains, replace(LOOP, feedthrough=share)))
        for share in (0.0, 0.5)
    )
    assert one["PID"]["overshoot"] != pytest.approx(other["PID"]["overshoot"], abs=0.01)


def test_the_final_error_by_the_map_is_sensed_minus_measured_strain() -> None:
    """A controller that holds the sensed strain leaves the measured strain this much below."""
    camera = 0.95 * exponential(0.1)
    seen = trials(camera, exponential(0.1))
    assert map_errors({"PID": seen})["PID"] == pytest.approx(0.05, abs=1e-6)
    assert seen.metrics.steady_state_error.value == pytest.approx(0.05, abs=1e-6)
    down = Trials(TIME_S, -seen.strain, -seen.sensed, -seen.reference, seen.metrics)
    assert map_errors({"PID": down})["PID"] == pytest.approx(0.05, abs=1e-6)


def test_worst_margins_are_no_better_than_the_nominal_ones() -> None:
    plant = Plant(0.8, 69.0, 0.2, 0.0, (SlowMode(-0.04, 0.08),))
    pi, pid = PidGains(0.5, 1.0), PidGains(0.0, 30.0, 0.0114, 0.005)
    ends = (0.2, 0.35)
    setting = replace(LOOP, feedthrough=0.274, feedthrough_range=ends)
    figure = _figure(plant, pi, pid, setting, 0.1)
    for one in figure["controllers"].values():
        assert one["worst_phase_margin_deg"] <= one["phase_margin_deg"]
        assert one["worst_gain_margin_db"] < one["gain_margin_db"]
    assert figure["worst"]["feedthrough_range"] == ends
    alone = _figure(plant, pi, pid, replace(setting, feedthrough_range=None), 0.0)
    for one in alone["controllers"].values():
        assert one["worst_gain_margin_db"] == one["gain_margin_db"]


def test_the_bode_plot_of_a_loop_is_that_of_its_margins() -> None:
    """Before, it lacked the feedthrough, so curves and crossovers did not fit together."""
    plant = Plant(0.8, 69.0, 0.2, 0.002, (SlowMode(-0.04, 0.08),))
    pi, pid = PidGains(0.5, 1.0), PidGains(0.0, 30.0, 0.0114, 0.005)
    for share in (0.0, 0.274):
        figure = _figure(plant, pi, pid, replace(LOOP, feedthrough=share), 0.1)
        omega = figure["omega_rad_s"]
        low = omega < 60.0  # the continuous curve has the hold as a delay alone
        expected = np.abs(
            loop_response(
                plant, pid, omega[low], loop_delay_s=LOOP.measurement_delay_s,
                rate_hz=LOOP.rate_hz, feedthrough=share,
            )
        )  # fmt: skip
        drawn = figure["controllers"]["PID"]
        assert drawn["magnitude"][low] == pytest.approx(expected, rel=0.06)
        at = np.interp(drawn["crossover_rad_s"], omega, drawn["magnitude"])
        # the hold attenuates by sinc(omega T / 2): 2.5 % at 77 rad/s
        assert at == pytest.approx(1.0, abs=0.03)


def test_a_slow_branch_of_the_other_sign_has_a_note() -> None:
    def notes(slow: float) -> dict[str, str]:
        found = {"S20.gain": 0.8, "S20.slow_gain": slow}
        return _slow_notes({key: Estimate.normal(one, 0.01, "") for key, one in found.items()})

    assert notes(0.3) == {} and _slow_notes({}) == {}
    assert notes(-0.04)["S20.slow_gain"].startswith("no creep, but a slow partial return")
