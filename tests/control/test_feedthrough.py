"""A share of the measured strain that follows the drive at once: margins, loops, designs."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haselab.base import Estimate, InputError, LimitError
from haselab.control import (
    DesignSpec,
    LoopSetting,
    PidGains,
    design_pid,
    loop_response,
    margins,
    predict,
    simulate_loop,
    trace_ensemble,
)
from haselab.control.feedthrough import with_measured_feedthrough
from haselab.control.plants.general_loops import loop_variants, plant_output, trace_general
from haselab.control.stability.margins import loop_margins
from haselab.models.plant import Plant, SlowMode
from haselab.models.rational import RationalModel

_PLANT = Plant(0.9, 40.0, 0.2, 0.003, (SlowMode(0.1, 2.0),))
_GAINS = PidGains(0.1, 12.0, 0.001, 0.01)


@settings(max_examples=40, deadline=None)
@given(
    share=st.floats(-0.5, 0.95),
    delay_s=st.floats(0.0, 0.04),
    omega=st.floats(20.0, 150.0),
    zeta=st.floats(0.05, 1.2),
)
def test_the_loop_measures_the_share_of_the_drive_and_the_rest_of_the_output(
    share: float, delay_s: float, omega: float, zeta: float
) -> None:
    """By the exact response of the plant alone to the drive that the loop put out."""
    plant = replace(_PLANT, natural_frequency_rad_s=omega, damping_ratio=zeta)
    setting = LoopSetting(measurement_delay_s=delay_s, feedthrough=share)
    trace = simulate_loop(plant, PidGains(0.0, 2.0), [0.02] * 400, setting)
    late_s = np.arange(400) / 100.0 - delay_s
    moved = plant.simulate(trace.u, 100.0, late_s)
    whole = math.floor((delay_s + plant.delay_s) * 100.0 + 1e-9) + 1
    driven = plant.static_gain * np.r_[np.zeros(whole), trace.u[:-whole]]
    assert trace.measured == pytest.approx((1.0 - share) * moved + share * driven, abs=1e-12)
    assert plant_output(plant, trace.measured, trace.u, setting) == pytest.approx(moved, abs=1e-11)
    assert trace.y == pytest.approx(plant.simulate(trace.u, 100.0, trace.time_s), abs=1e-15)


@pytest.mark.parametrize("share", [-0.3, 0.2, 0.6, 0.9])
def test_a_general_plant_and_many_loops_measure_the_same(share: float) -> None:
    setting = LoopSetting(measurement_delay_s=0.0062, feedthrough=share)
    desired = np.full(500, 0.02)
    one = simulate_loop(_PLANT, _GAINS, desired, setting)
    general, _ = trace_general(RationalModel.from_plant(_PLANT), [_GAINS], desired, setting)
    many = trace_ensemble([_PLANT], [_GAINS], desired, setting)
    assert general[0] == pytest.approx(one.measured, abs=1e-14)
    assert many.measured[0] == pytest.approx(
        one.measured, abs=1e-7
    )  # single precision: sums of 500


@pytest.mark.parametrize("share", [-0.3, 0.2, 0.6, 0.9])
def test_margins_are_those_at_which_the_simulated_loop_starts_to_oscillate(share: float) -> None:
    """Just below the gain margin the loop settles, and just above it grows."""
    setting = LoopSetting(measurement_delay_s=0.0062, feedthrough=share)
    found = loop_margins(_PLANT, _GAINS, setting)
    general = loop_margins(RationalModel.from_plant(_PLANT), _GAINS, setting)
    assert found.stable
    assert general.gain_margin_db == pytest.approx(found.gain_margin_db, rel=1e-6)
    assert general.phase_margin_deg == pytest.approx(found.phase_margin_deg, rel=1e-6)
    factor = 10.0 ** (found.gain_margin_db / 20.0)
    swings = []
    for share_of_limit in (0.97, 1.03):
        scale = factor * share_of_limit
        gains = replace(_GAINS, kp=_GAINS.kp * scale, ki=_GAINS.ki * scale, kd=_GAINS.kd * scale)
        wide = replace(setting, saturation=replace(setting.saturation, low=-1e30, high=1e30))
        measured = simulate_loop(_PLANT, gains, [1e-3] * 2000, wide).measured
        swings.append([np.ptp(part) for part in (measured[500:700], measured[1800:])])
    (before, after), (grown_before, grown_after) = swings
    assert after < before
    assert grown_after > grown_before


def test_a_share_of_one_half_is_half_the_response_and_half_the_gain() -> None:
    """Far above the resonance only the share is left, and far below nothing changes."""
    omega = np.array([0.01, 300.0])
    plain, shared = (
        loop_response(Plant(0.8, 20.0, 0.5), PidGains(1.0, 0.0), omega, loop_delay_s=0.01,
                      rate_hz=100.0, feedthrough=share)
        for share in (0.0, 0.5)
    )  # fmt: skip
    assert abs(shared[0] / plain[0] - 1.0) < 1e-3
    assert abs(shared[1]) == pytest.approx(0.4, rel=0.02)


def test_a_pid_designed_without_the_share_can_be_unstable_and_one_with_it_is_not() -> None:
    """A strongly damped curling HASEL whose pouches are slack: unstable when it was played."""
    plant = Plant(0.9133, 44.06, 1.242, 8.8e-5, (SlowMode(0.0517, 0.818),))
    gains = PidGains(1.499, 38.6, 0.0438, 0.05404)
    setting = LoopSetting(measurement_delay_s=0.00565)
    assert loop_margins(plant, gains, setting).phase_margin_deg > 54.0
    shared = replace(setting, feedthrough=0.7, feedthrough_range=(0.6, 0.9))
    assert not loop_margins(plant, gains, shared).stable
    found = design_pid(plant, DesignSpec(), shared, rng=np.random.default_rng(1))
    for one, loop in loop_variants(plant, shared, found.spec.frequency_spread):
        kept = loop_margins(one, found.gains, loop)
        assert kept.stable
        assert kept.phase_margin_deg >= 0.99 * found.spec.phase_margin_deg
    assert len(found.spread) == 5  # three frequencies and both ends of the share
    assert not found.shortfalls


def test_the_predicted_step_is_that_of_the_strain_and_not_of_what_is_sensed() -> None:
    """With a share of 0.95 a ringing actuator looks calm to its loop."""
    plant = Plant(1.0, 40.0, 0.05)
    setting = LoopSetting(feedthrough=0.95)
    gains = PidGains(0.0, 20.0)
    trace = simulate_loop(plant, gains, [0.02] * 1000, setting)
    sensed_overshoot = trace.measured.max() / 0.02 - 1.0
    assert sensed_overshoot < 0.05
    found = predict(plant, gains, setting, step=0.02)
    assert found.step.overshoot == pytest.approx(trace.y.max() / 0.02 - 1.0, abs=0.02)
    assert found.step.overshoot > 0.2
    general = predict(RationalModel.from_plant(plant), gains, setting, step=0.02)
    assert general.step.overshoot == pytest.approx(found.step.overshoot, abs=0.03)


def test_a_measured_share_has_a_range_of_two_deviations_within_what_a_loop_can_have() -> None:
    found = with_measured_feedthrough(LoopSetting(), Estimate.normal(0.9, 0.05, ""))
    assert found.feedthrough == 0.9
    assert found.feedthrough_range == pytest.approx((0.8, 0.98))
    assert with_measured_feedthrough(LoopSetting(), None) == LoopSetting()
    certain = with_measured_feedthrough(LoopSetting(), Estimate.normal(0.4, 0.0, ""))
    assert certain.feedthrough_range is None
    assert len(loop_variants(_PLANT, certain, 0.1)) == 3


def test_impossible_shares_are_refused() -> None:
    with pytest.raises(InputError, match=r"feedthrough = 1; it must be -0\.98 to 0\.98"):
        LoopSetting(feedthrough=1.0)
    with pytest.raises(LimitError, match="a feedthrough needs a sampled loop"):
        margins(_PLANT, _GAINS, loop_delay_s=0.0, rate_hz=None, feedthrough=0.5)
    integrating = RationalModel((1.0,), (1.0, 1.0, 0.0))
    with pytest.raises(InputError, match="the model integrates"):
        loop_margins(integrating, _GAINS, LoopSetting(feedthrough=0.5))


@pytest.mark.parametrize("delay_s", [0.0021, 0.00565, 0.0083])
@pytest.mark.parametrize("share", [0.4, 0.7, 0.86])
def test_the_delay_margin_is_where_the_simulated_loop_starts_to_oscillate(
    delay_s: float, share: float
) -> None:
    """An added delay turns the phase, and moves the feedthrough by a whole update at a jump."""
    plant, gains = Plant(1.0, 63.9, 0.76), PidGains(0.0, 116.4)
    setting = LoopSetting(measurement_delay_s=delay_s, feedthrough=share)
    found = loop_margins(plant, gains, setting)
    general = loop_margins(RationalModel.from_plant(plant), gains, setting)
    assert found.stable
    by_phase_s = min(
        np.radians(one.phase_margin_deg) % (2.0 * np.pi) / one.omega_rad_s
        for one in found.crossovers
    )
    assert general.delay_margin_s == pytest.approx(found.delay_margin_s, rel=1e-6)
    wide = replace(setting.saturation, low=-1e30, high=1e30)
    swings = []
    for added_s in (0.9 * found.delay_margin_s, 1.1 * found.delay_margin_s):
        late = replace(setting, measurement_delay_s=delay_s + added_s, saturation=wide)
        measured = simulate_loop(plant, gains, [1e-3] * 2000, late).measured
        swings.append([np.ptp(part) for part in (measured[300:500], measured[1500:1700])])
    (before, after), (grown_before, grown_after) = swings
    assert after <= before
    assert found.delay_margin_s <= by_phase_s
    if found.delay_margin_s < 0.99 * by_phase_s:  # else the search ends before it is unstable
        assert grown_after > grown_before
