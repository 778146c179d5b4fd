"""Loops around rational plants against those around the plants that they equal, and designs."""

import numpy as np
import pytest

from haselab.base import ResultError
from haselab.control import DesignSpec, LoopSetting, PidGains, Saturation, design_pi, design_pid
from haselab.control.plants.general_loops import closed_loop_poles, trace_general
from haselab.control.plants.modes import SampledLoops
from haselab.control.simulate import simulate_loop
from haselab.identify.record import Record
from haselab.identify.transfer.fit import TransferStructure, fit_transfer
from haselab.models import Plant, SlowMode
from haselab.models.rational import RationalModel

RNG = np.random.default_rng


@pytest.mark.parametrize("delay_s", [0.0, 0.004, 0.031])
def test_a_rational_plant_loops_as_the_plant_that_it_is(delay_s):
    plant = Plant(0.8, 12.0, 0.2, delay_s, (SlowMode(0.3, 2.0),))
    gains, setting = PidGains(0.4, 2.0, 0.03, 0.02), LoopSetting(100.0, 0.005)
    reference = np.r_[np.full(300, 0.04), np.full(300, 0.3)]  # the second one saturates
    model = RationalModel.from_plant(plant)
    measured, u = trace_general(model, [gains], reference, setting)
    known = simulate_loop(plant, gains, reference, setting)
    # Rounding of a polynomial of order 3 against a modal form, over 600 steps.
    assert np.abs(measured[0] - known.measured).max() < 1e-10
    assert np.abs(u[0] - known.u).max() < 1e-9
    loops = SampledLoops.of([plant], [gains], period_s=0.01, measurement_delay_s=0.005)
    poles = closed_loop_poles(model, [gains], setting)[0]
    slowest = [np.sort(np.abs(p))[-4:] for p in (poles, loops.poles()[0])]
    assert slowest[0] == pytest.approx(slowest[1], rel=1e-6)


@pytest.mark.long
def test_an_identified_model_of_four_poles_is_designed_for():
    rng, t = RNG(3), np.arange(4000) / 200.0
    u = np.repeat(rng.choice([-1.0, 1.0], size=1000), 4)
    y = Plant(1.0, 8.0, 0.3, 0.02).simulate(u, 200.0, t)
    y = y + Plant(0.3, 40.0, 0.1, 0.02).simulate(u, 200.0, t) + 0.01 * rng.normal(size=t.size)
    fit = fit_transfer([Record.sampled(u, y, 200.0)], TransferStructure(4, 2))
    design = design_pid(fit.rational, DesignSpec(), LoopSetting(100.0, 0.005), rng=RNG(0))
    assert design.shortfalls == ()
    assert all(item.margins.phase_margin_deg >= 49.5 for item in design.spread)


def test_an_undamped_plant_is_designed_for():
    plant = Plant(1.0, 10.0, 0.0)
    design = design_pid(plant, DesignSpec(), LoopSetting(100.0, 0.01), rng=RNG(0))
    assert design.nominal.margins.stable


def test_light_damping_leaves_an_integral_loop():
    # kp = 0, ki = 0.045 has a gain margin of 7 dB.
    design = design_pi(Plant(1.0, 10.0, 0.01), DesignSpec(), LoopSetting(100.0, 0.01), rng=RNG(0))
    assert design.nominal.margins.gain_margin_db > 6.0


@pytest.mark.long
def test_a_slow_branch_of_a_thousand_does_not_hide_the_easy_loop():
    plant = Plant(1.0, 30.0, 0.3, slow_modes=(SlowMode(1000.0, 1000.0),))
    design = design_pi(plant, DesignSpec(), LoopSetting(100.0, 0.01), rng=RNG(0))
    assert design.nominal.margins.phase_margin_deg > 45.0


@pytest.mark.long
def test_a_step_beyond_the_limits_is_refused_with_what_can_be_reached():
    plant = Plant(1e-3, 30.0, 0.3)  # mm per volt, with the limits of a strain
    with pytest.raises(ResultError, match=r"saturates.*a step of -5e-05 to 0\.0001"):
        design_pid(plant, DesignSpec(step=0.04), LoopSetting(100.0, 0.005), rng=RNG(0))
    volts = LoopSetting(100.0, 0.01, Saturation(0.0, 5000.0))
    design = design_pid(plant, DesignSpec(step=1.0), volts, rng=RNG(0))
    assert design.nominal.margins.phase_margin_deg > 49.0


@pytest.mark.long
def test_a_contraction_is_designed_like_an_elongation_and_within_the_limits():
    plant = Plant(0.8, 60.0, 0.2)
    up, down = (
        LoopSetting(measurement_delay_s=0.005, saturation=Saturation(-0.02, 0.03)),
        Saturation(-0.03, 0.02),
    )
    longer = design_pid(plant, DesignSpec(), up, rng=RNG(0))
    shorter = design_pid(plant, DesignSpec(), LoopSetting(100.0, 0.005, down), rng=RNG(0))
    # Half of what the larger limit reaches: 0.04 is out of reach.
    assert longer.spec.step == pytest.approx(0.012)
    assert shorter.spec.step == pytest.approx(-0.012)
    assert shorter.gains == longer.gains
    steps = [design.nominal.step for design in (longer, shorter)]
    assert steps[0].rise_time_s == pytest.approx(steps[1].rise_time_s, rel=1e-6)
