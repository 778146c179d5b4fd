"""Loops that a lower gain makes unstable: unstable plants and conditionally stable loops."""

import dataclasses
import math

import control
import numpy as np
import pytest

from haselab.base import InputError
from haselab.control import DesignSpec, LoopSetting, PidGains, design_pi, design_pid
from haselab.control.stability.grid import PlantGrid
from haselab.control.stability.margins import margins
from haselab.models.rational import RationalModel

PERIOD_S = 0.01
UNSTABLE = RationalModel([10.0], [1.0, -2.0])
TWICE = RationalModel([2.0], [1.0, 0.0, 0.0])
TWICE_PID = PidGains(2.0, 0.8, 1.6, 0.02)
LOOPS = [
    (UNSTABLE, PidGains(0.22, 0.0)),
    (UNSTABLE, PidGains(0.5, 0.2)),
    (UNSTABLE, PidGains(12.0, 0.2)),
    (TWICE, TWICE_PID),
    (RationalModel([4.0], [1.0, 3.0, -4.0]), PidGains(1.4, 0.0)),
    (RationalModel([9.0], [1.0, 1.0, 9.0]), PidGains(0.1, 0.5)),
]


def scaled(gains: PidGains, factor: float) -> PidGains:
    return dataclasses.replace(
        gains, kp=factor * gains.kp, ki=factor * gains.ki, kd=factor * gains.kd
    )


def radius(plant: RationalModel, gains: PidGains) -> float:
    """Largest closed-loop pole of the sampled loop without delay, from python-control's plant."""
    held = control.c2d(control.tf(plant.numerator, plant.denominator), PERIOD_S, "zoh")
    num, den = np.atleast_1d(held.num[0][0]), np.atleast_1d(held.den[0][0])
    tau = gains.derivative_filter_s
    law, poles = np.poly1d(gains.kp), np.poly1d(1.0)
    for top, bottom in (
        ([gains.ki * PERIOD_S, 0.0], [1.0, -1.0]),
        ([gains.kd, -gains.kd], [tau + PERIOD_S, -tau]),
    ):
        if any(top):
            law = law * np.poly1d(bottom) + np.poly1d(top) * poles
            poles = poles * np.poly1d(bottom)
    closed = np.poly1d(den) * poles + np.poly1d(num) * law
    return float(np.abs(closed.roots).max())


@pytest.mark.parametrize(("plant", "gains"), LOOPS)
def test_the_gain_margin_is_the_first_change_of_gain_that_moves_a_pole_out(plant, gains):
    found = margins(plant, gains, loop_delay_s=0.0, rate_hz=1.0 / PERIOD_S)
    assert found.stable
    factor = 10.0 ** (found.gain_margin_db / 20.0)
    # Every change that is smaller by a per mille leaves all poles inside, in both directions ...
    for share in np.linspace(-0.999, 0.999, 41):
        assert radius(plant, scaled(gains, factor**share)) < 1.0
    # ... and in one direction a change that is larger by a per mille moves one out.
    beyond = [radius(plant, scaled(gains, factor**share)) for share in (-1.001, 1.001)]
    assert max(beyond) > 1.0


@pytest.mark.parametrize(("plant", "gains"), [loop for loop in LOOPS if loop[1].kp < 5.0])
def test_the_gain_margin_of_a_continuous_loop_is_that_of_python_control(plant, gains):
    s = control.tf("s")
    derivative = gains.kd * s / (gains.derivative_filter_s * s + 1)
    law = gains.kp + derivative + (gains.ki / s if gains.ki else 0)
    loop = control.tf(plant.numerator, plant.denominator) * law
    factors = control.stability_margins(loop, returnall=True)[0]
    expected = min(abs(20.0 * math.log10(factor)) for factor in factors)
    found = margins(plant, gains, loop_delay_s=0.0, rate_hz=None)
    # The response at frequency 0 is read at the lower end of the grid.
    assert found.gain_margin_db == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize(("plant", "gains"), LOOPS)
def test_the_grid_of_the_search_and_of_plausible_plants_has_the_same_gain_margin(plant, gains):
    exact = margins(plant, gains, loop_delay_s=0.0, rate_hz=100.0)
    grid = PlantGrid.of(plant, LoopSetting(100.0, 0.0)).margins([gains], between=True)
    # 0.1 dB is what the interpolation promises.
    assert float(grid.gain_margin_db[0]) == pytest.approx(exact.gain_margin_db, abs=0.1)


@pytest.mark.long
def test_a_design_keeps_its_gain_margin_in_both_directions():
    setting = LoopSetting(1.0 / PERIOD_S, 0.0)
    design = design_pid(TWICE, DesignSpec(), setting, rng=np.random.default_rng(0))
    assert design.nominal.margins.gain_margin_db > 5.9
    for change_db in (-5.9, 5.9):
        assert radius(TWICE, scaled(design.gains, 10.0 ** (change_db / 20.0))) < 1.0


@pytest.mark.long
def test_an_unstable_plant_of_negative_static_gain_is_designed_for():
    """10/(s - 2) has the static gain -5; gains above 0 stabilise it."""
    spec = DesignSpec(phase_margin_deg=40.0, gain_margin_db=3.0, overshoot=0.6)
    design = design_pi(UNSTABLE, spec, LoopSetting(50.0, 0.0), rng=np.random.default_rng(0))
    assert design.shortfalls == ()
    # The same loop, simulated with the solution of x' = 2 x + 10 u between the samples.
    grown, size = math.exp(2.0 / 50.0), design.spec.step
    x, integral, outputs = 0.0, 0.0, []
    for _ in range(1250):
        error = size - x
        integral += design.gains.ki / 50.0 * error
        u = design.gains.kp * error + integral
        assert -0.05 < u < 0.1  # the usual limits are not reached
        x = grown * x + 5.0 * (grown - 1.0) * u
        outputs.append(x)
    assert outputs[-1] == pytest.approx(size, rel=spec.steady_state_error)
    # The peak is read after smoothing over a tenth of the rise.
    assert max(outputs) / size - 1.0 == pytest.approx(design.nominal.step.overshoot, abs=0.02)


@pytest.mark.parametrize(
    ("numerator", "denominator", "message"),
    [
        ([-4.0], [1.0, 3.0, -4.0], "plant numerator's last term = -4; it must be above 0"),
        ([-4.0], [1.0, 3.0, 4.0], "plant static gain = -1; it must be above 0"),
        ([1.0, 0.0], [1.0, 3.0, 4.0], "The plant has a zero at s = 0: with a constant input"),
    ],
)
def test_a_plant_that_no_gain_above_0_stabilises_is_refused(numerator, denominator, message):
    plant = RationalModel(numerator, denominator)
    with pytest.raises(InputError, match=message):
        design_pi(plant, DesignSpec(), LoopSetting(), rng=np.random.default_rng(0))
