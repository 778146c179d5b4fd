"""Designs are judged by what does not design: the exact margins and the simulated loop."""

import dataclasses

import numpy as np
import pytest

from haselab.base import InputError, ResultError
from haselab.control.candidates import Task, score
from haselab.control.gains import PidGains, Saturation
from haselab.control.loop_shaping import design_pi, design_pid, predict
from haselab.control.simulate import LoopSetting, simulate_loop
from haselab.control.spec import DesignSpec
from haselab.control.stability.margins import margins
from haselab.control.step_metrics import step_metrics
from haselab.models.plant import Plant, SlowMode

RAD = Plant(1.0, 5.11, 0.09, slow_modes=(SlowMode(0.5, 6.0),))
HZ = Plant(1.0, 32.1, 0.12, slow_modes=(SlowMode(0.5, 6.0),))
LATE = LoopSetting(100.0, measurement_delay_s=0.010)  # with half the hold 15 ms
DEMAND = DesignSpec(rise_time_s=0.75, overshoot=0.07)


@pytest.mark.long
@pytest.mark.parametrize("plant", [RAD, HZ], ids=["rad", "hz"])
def test_pid_reaches_its_demands_over_the_spread_and_at_both_delays(plant):
    design = design_pid(plant, DEMAND, LATE, rng=np.random.default_rng(1))
    assert design.shortfalls == ()
    for factor in (0.85, 0.93, 1.0, 1.08, 1.15):
        wn = plant.natural_frequency_rad_s * factor
        off = dataclasses.replace(plant, natural_frequency_rad_s=wn)
        for delay_s in (0.005, 0.010):
            found = margins(off, design.gains, loop_delay_s=delay_s, rate_hz=100.0)
            assert found.stable and found.phase_margin_deg > 49.5
            setting = LoopSetting(100.0, measurement_delay_s=delay_s)
            reference = np.r_[np.zeros(100), np.full(2400, 0.04)]
            trace = simulate_loop(off, design.gains, reference, setting)
            step = step_metrics(trace.time_s, trace.y, np.repeat(reference, 4))
            assert step.rise_time_s.value < 0.8
            assert step.overshoot.value < 0.08


@pytest.mark.long
@pytest.mark.parametrize("plant", [RAD, HZ], ids=["rad", "hz"])
def test_pi_hits_a_rise_time(plant):
    spec = DesignSpec(
        rise_time_s=2.75, rise_time_tolerance=0.01, overshoot=None, frequency_spread=0.0
    )
    design = design_pi(plant, spec, LATE, rng=np.random.default_rng(1))
    assert design.gains.kd == 0.0
    assert design.nominal.step.rise_time_s == pytest.approx(2.75, rel=0.02)
    assert not any("rise" in text for text in design.shortfalls)


@pytest.mark.long
def test_no_other_integral_gain_nearby_meets_the_demands_better():
    """More of the gain that is maximised breaks a demand, whatever the proportional gain."""
    spec = DesignSpec(overshoot=0.08)
    design = design_pi(HZ, spec, LATE, rng=np.random.default_rng(1))
    assert design.shortfalls == ()
    kp = np.linspace(0.0, 1.0, 101)
    more = score([PidGains(value, 1.05 * design.gains.ki) for value in kp], Task(HZ, LATE, spec))
    assert np.all(more.miss > 0.0)


def test_a_demand_out_of_reach_is_said_in_words():
    spec = DesignSpec(rise_time_s=0.2, overshoot=0.05)
    design = design_pi(RAD, spec, LATE, rng=np.random.default_rng(1))
    assert design.nominal.margins.stable
    assert any("demanded" in text for text in design.shortfalls)
    assert str(design) == design.summary()
    assert str(design).splitlines()[-1].startswith("Demands not met: ")
    assert len(str(design).splitlines()) <= 13


def test_grid_scores_agree_with_the_exact_margins():
    gains = [PidGains(0.85, 1.5), PidGains(1.2, 3.7, 0.34, 0.018), PidGains(0.0, 0.6)]
    for plant in (RAD, HZ):
        task = Task(plant, LATE, DesignSpec(frequency_spread=0.0))
        found = score(gains, task).peak_sensitivity
        for one, peak in zip(gains, found, strict=True):
            exact = margins(plant, one, loop_delay_s=0.010, rate_hz=100.0)
            # 600 points over five decades: a peak of width zeta is met within (2 % / zeta)^2 / 2.
            if exact.stable:
                assert peak == pytest.approx(exact.peak_sensitivity, rel=0.03)


@pytest.mark.long
def test_a_plant_in_other_units_gets_the_same_loop():
    """From volts to metres instead of from strain to strain: gains and limits are divided by it."""
    scale, loops = 1.7e-3, []
    for factor in (1.0, scale):
        limits = Saturation(-0.1 / factor, 0.1 / factor)
        scaled = Plant(0.9 * factor, 21.0, 0.22, 0.015)
        setting = LoopSetting(saturation=limits)
        found = design_pid(scaled, DesignSpec(step=0.04), setting, rng=np.random.default_rng(3))
        assert not found.shortfalls
        loops.append((found.nominal.step.rise_time_s, found.gains.jump_gain(100.0) * factor))
        expected = 15.0 / (0.9 * factor) if factor < 0.1 else 15.0
        assert found.spec.noise_gain == pytest.approx(expected, rel=1e-12)
    assert loops[1] == pytest.approx(loops[0], rel=0.1)  # the search ends within that


def test_same_seed_same_gains():
    first = design_pi(HZ, DesignSpec(), LATE, rng=np.random.default_rng(3))
    again = design_pi(HZ, DesignSpec(), LATE, rng=np.random.default_rng(3))
    assert first.gains == again.gains


def test_prediction_of_an_unstable_loop_has_no_step_metrics():
    found = predict(HZ, PidGains(5.0, 5.0), LATE, step=0.04)
    assert not found.margins.stable and np.isnan(found.step.rise_time_s)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"rise": 1.0}, "specification has the unknown key 'rise'"),
        ({"rise_time_s": "fast"}, "rise_time_s = 'fast'"),
        ({"phase_margin_deg": 120}, "phase_margin_deg = 120"),
        ({"rise_time_tolerance": 0.1}, "without rise_time_s"),
        ({"keep_crossover": 1}, "true or false"),
    ],
)
def test_an_unusable_specification_is_refused(data, message):
    with pytest.raises(InputError, match=message):
        DesignSpec.from_mapping(data)


def test_a_plant_that_pushes_back_is_refused():
    with pytest.raises(InputError, match=r"plant gain = -0\.5"):
        design_pi(Plant(-0.5, 5.0, 0.1), DesignSpec(), LATE, rng=np.random.default_rng(0))


def test_a_step_beyond_the_limits_is_refused_as_a_demand_with_what_is_reachable():
    setting = LoopSetting(measurement_delay_s=0.005, saturation=Saturation(-0.02, 0.06))
    said = r"step of 0\.04 needs .* of 0\.08, .* State a step of -0\.01 to 0\.03 in the demands"
    with pytest.raises(ResultError, match=said):
        design_pi(
            Plant(0.5, 32.0, 0.3), DesignSpec(step=0.04), setting, rng=np.random.default_rng(0)
        )
