"""Plausible plants: draws of a posterior, shares that keep margins, gains chosen by the share."""

import importlib
import math

import numpy as np
import pytest

from haselab.base import InputError
from haselab.control import (
    DesignSpec,
    LoopSetting,
    PidGains,
    Saturation,
    binomial_proportion,
    design_controller,
    design_pi,
    margins,
    plausible_margins,
)
from haselab.models import Plant, PlantPosterior, RationalModel

SETTING = LoopSetting(100.0, 0.01)
SPEC = DesignSpec(frequency_spread=0.0)
NAMES = ("gain", "natural_frequency_rad_s", "damping_ratio", "delay_s")
FLAGS = (False, True, True, False)


def posterior(values=(1.0, 32.1, 0.12, 0.012), std=(0.05, 0.05, 0.2, 0.001), correlation=0.0):
    spread = correlation + (1.0 - correlation) * np.eye(4)
    return PlantPosterior(NAMES, FLAGS, np.array(values), spread * np.outer(std, std))


@pytest.fixture
def benchmark(benchmarks):
    return importlib.import_module("benchmarks.control.plausible_design")


def test_draws_have_the_moments_of_the_posterior():
    plants = posterior(correlation=0.5).draw(4000, np.random.default_rng(1))
    inner = np.array(
        [(p.gain, math.log(p.natural_frequency_rad_s), math.log(p.damping_ratio), p.delay_s)
         for p in plants]
    )  # fmt: skip
    std = np.array([0.05, 0.05, 0.2, 0.001])
    error = std / math.sqrt(4000)
    assert (np.abs(inner.mean(axis=0) - [1.0, math.log(32.1), math.log(0.12), 0.012])
            < 4.0 * error).all()  # fmt: skip
    # A standard deviation is known to 1/sqrt(2N), a correlation of 0.5 to 0.75/sqrt(N).
    assert inner.std(axis=0) == pytest.approx(std, rel=4.0 / math.sqrt(8000))
    found = np.corrcoef(inner.T)[np.triu_indices(4, 1)]
    assert found == pytest.approx(0.5, abs=4.0 * 0.75 / math.sqrt(4000))


def test_fully_correlated_numbers_move_together_and_known_ones_stay():
    std = np.array([0.1, 0.1, 0.0, 0.0])
    joint = PlantPosterior(NAMES, FLAGS, np.array([1.0, 32.1, 0.12, 0.012]), np.outer(std, std))
    for plant in joint.draw(50, np.random.default_rng(1)):
        assert math.log(plant.natural_frequency_rad_s / 32.1) == pytest.approx(plant.gain - 1.0)
        assert (plant.damping_ratio, plant.delay_s) == (0.12, 0.012)


def test_a_delay_drawn_below_zero_is_zero_and_a_damping_drawn_below_zero_is_unstable():
    early = posterior((1.0, 32.1, 0.12, -0.001), (0.0, 0.0, 0.0, 0.002))
    delays = [plant.delay_s for plant in early.draw(100, np.random.default_rng(1))]
    assert min(delays) == 0.0 < max(delays)
    linear = PlantPosterior(
        NAMES, (False, True, False, False), np.array([1.0, 32.1, 0.0, 0.0]),
        np.diag([0.0, 0.0, 1e-4, 0.0]),
    )  # fmt: skip
    plants = linear.draw(100, np.random.default_rng(1))
    unstable = [plant for plant in plants if np.real(plant.poles).max() > 0.0]
    assert all(isinstance(plant, RationalModel) for plant in unstable)
    assert 30 < len(unstable) < 70


def test_a_general_fit_is_its_own_nominal_model():
    """Two resonances, a real pole, zeros and a slow branch, against the model's own definition."""
    names = (
        "natural_frequency_rad_s", "damping_ratio", "natural_frequency_2_rad_s", "damping_ratio_2",
        "time_constant_s", "slow_time_constant_s", "delay_s", "gain", "numerator_1", "numerator_2",
        "slow_gain",
    )  # fmt: skip
    values = np.array([20.0, 0.1, 90.0, 1.3, 0.02, 6.0, 0.013, 1.5, 0.2, -0.3, 0.4])
    flags = tuple("frequency" in n or "damping" in n or "constant" in n for n in names)
    model = PlantPosterior(names, flags, values, np.zeros((11, 11))).nominal
    s = 1j * np.array([0.1, 5.0, 20.0, 200.0])
    bottom = (s * s + 4.0 * s + 400.0) * (s * s + 234.0 * s + 8100.0) * (s + 50.0)
    scale = (400.0 * 8100.0 * 50.0) ** 0.2
    fast = (1.5 + 0.2 * s / scale - 0.3 * (s / scale) ** 2) * scale**5 / bottom
    expected = (fast + 0.4 / (6.0 * s + 1.0)) * np.exp(-0.013 * s)
    assert model.frequency_response(s.imag) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"values": [1.0, 32.1, math.nan, 0.0]}, "damping_ratio is not identifiable"),
        ({"matrix": np.diag([1.0, math.inf, 0.0, 0.0])}, "natural_frequency_rad_s is not ident"),
        ({"matrix": np.diag([0.0, 40.0, 0.0, 0.0])}, "natural_frequency_rad_s is not identif"),
        ({"matrix": np.diag([0.1, -0.1, 0.0, 0.0])}, "a negative or missing variance"),
        ({"matrix": 0.01 * (np.eye(4) + np.eye(4, k=1))}, "not symmetric"),
        ({"matrix": 0.01 * (1.9 * np.eye(4) - 0.9)}, "a negative eigenvalue"),
        (
            {"matrix": np.zeros((3, 3))},
            r"rows of \[3, 3, 3\] numbers, but its 4 names need as many",
        ),
        ({"names": ["gain", "natural_frequency_rad_s", "damping", "delay_s"]}, "names damping"),
        ({"logarithmic": [False, False, True, False]}, "draws may be negative"),
        ({"values": [1.0, 32.1, 0.0, 0.0]}, "has no logarithm"),
        ({"values": [1.0, 32.1]}, "needs one value"),
        ({"matrix": [[1.0], [1.0, 2.0]]}, r"rows of \[1, 2\] numbers, but its 4 names"),
        ({"matrix": 4 * [[1.0, 2.0, "three", 4.0]]}, "is incomplete or has a wrong value"),
        ({"matrix": 4 * [1.0]}, "is incomplete or has a wrong value"),
    ],
)
def test_what_is_no_posterior_is_refused(change, message):
    data = {**posterior().to_dict(), **change}
    if "damping_ratio" in data["names"] and "logarithmic" in change:
        data["matrix"] = np.diag([0.0, 0.1, 0.0, 0.0])
    with pytest.raises(InputError, match=message):
        PlantPosterior.from_dict(data)


def general(top, bottom, spread=0.1, delay_s=0.013):
    """Posterior of a rational model's factors; `bottom` without its leading one."""
    names = [f"b_{k}" for k in reversed(range(len(top)))]
    names += [f"a_{k}" for k in reversed(range(len(bottom)))] + ["delay_s"]
    values = np.array([*top, *bottom, delay_s])
    covariance = np.diag((spread * values) ** 2)
    return PlantPosterior(tuple(names), (False,) * len(names), values, covariance)


HARD = {
    "damping 0.001": (posterior((1.0, 32.1, 1e-3, 0.013), (0.1, 0.1, 0.5, 0.001)), 0.05),
    "damping 1.4": (posterior((1.0, 32.1, 1.4, 0.013), (0.1, 0.1, 0.3, 0.001)), 8.0),
    "gain of either sign": (posterior(std=(0.8, 0.1, 0.3, 0.001)), 3.0),
    "delay of 3 periods": (posterior((1.0, 32.1, 0.3, 0.03), (0.1, 0.1, 0.3, 0.005)), 5.0),
    "uncertain about stability": (posterior(std=(0.3, 0.5, 0.9, 0.01)), 6.0),
    "RHP zero": (general([-20.0, 900.0], [18.0, 900.0]), 3.0),
    "integrator": (general([900.0], [30.0, 900.0, 0.0]), 3.0),
    "unstable pole": (general([300.0], [40.0, -100.0]), 5.0),
}


@pytest.mark.parametrize("case", HARD, ids=str)
def test_margins_of_the_draws_are_the_exact_ones(case):
    drawn, ki = HARD[case]
    gains = PidGains(0.9 if case == "unstable pole" else 0.0, ki, 0.004, 0.006)
    plants = drawn.draw(40, np.random.default_rng(3))
    found = plausible_margins(plants, gains, SETTING, SPEC)
    exact = [margins(plant, gains, loop_delay_s=0.01, rate_hz=100.0) for plant in plants]
    assert found.stable.tolist() == [item.stable for item in exact]
    keeps = [
        (item.stable and item.phase_margin_deg >= 50.0, item.stable and item.gain_margin_db >= 6.0)
        for item in exact
    ]
    assert list(zip(found.keeps_phase.tolist(), found.keeps_gain.tolist(), strict=True)) == keeps
    stable = found.stable
    phases = np.array([item.phase_margin_deg for item in exact])
    assert found.phase_margin_deg[stable] == pytest.approx(phases[stable], abs=0.5)


def test_the_unit_of_the_model_changes_no_share():
    """V to mm: gains are a ten-thousandth, controllers ten thousand times as large."""
    strain, volts = posterior(), posterior((1e-4, 32.1, 0.12, 0.012), (5e-6, 0.05, 0.2, 0.001))
    shares = [
        plausible_margins(
            model.draw(100, np.random.default_rng(1)), PidGains(0.0, ki), SETTING, SPEC
        ).share.value
        for model, ki in ((strain, 4.0), (volts, 4e4))
    ]
    assert shares[0] == shares[1] and 0.02 < shares[0] < 0.98


def test_a_share_has_the_binomial_error_and_an_interval_that_is_never_empty():
    share = binomial_proportion(np.arange(100) < 90)
    assert (share.value, share.std) == (0.9, pytest.approx(0.03))
    # Wilson's interval of 90 out of 100, by his formula in another program (R, prop.test).
    assert share.ci95 == pytest.approx((0.8256, 0.9448), abs=5e-5)
    assert binomial_proportion(np.ones(400, bool)).ci95 == (pytest.approx(0.99049, abs=5e-6), 1.0)
    with pytest.raises(InputError, match="at least one draw"):
        binomial_proportion(np.zeros(0, bool))


@pytest.mark.long
def test_shares_agree_with_python_control(benchmark):
    for damping, late, kind in ((0.12, 1, "PID"), (1.2, 1, "PI")):
        drawn = benchmark.posterior(damping, late / 100.0).draw(15, np.random.default_rng(2))
        wrong, mine, _ = benchmark.disagreements(drawn, benchmark.loops(damping)[kind])
        assert wrong == 0 and mine > 0.0


def test_a_tiny_covariance_gives_the_gains_of_the_best_plant():
    spec = DesignSpec()  # its spread of frequency leaves the best plant room
    tiny = posterior(std=(1e-6, 1e-6, 1e-6, 1e-9))
    alone = design_pi(tiny.nominal, spec, SETTING, rng=np.random.default_rng(4))
    found = design_controller(
        tiny, spec, SETTING, structure="pi", probability=0.99, rng=np.random.default_rng(4)
    )
    assert found.gains == alone.gains and found.shortfalls == ()
    assert found.plausible.share.value == 1.0


@pytest.mark.long
def test_a_wider_covariance_gives_more_careful_gains():
    spec = DesignSpec(frequency_spread=0.0, steady_state_error=1.0)  # slow is allowed
    gains = []
    for scale in (0.1, 1.0, 3.0):
        wide = posterior(std=scale * np.array([0.05, 0.05, 0.2, 0.001]))
        found = design_controller(
            wide, spec, SETTING, structure="pi", probability=0.95, rng=np.random.default_rng(4),
            draws=200,
        )  # fmt: skip
        assert found.shortfalls == () and found.plausible.share.value >= 0.95
        fresh = wide.draw(400, np.random.default_rng(99))
        share = plausible_margins(fresh, found.gains, SETTING, spec).share
        assert share.value > 0.95 - 4.0 * math.sqrt(0.95 * 0.05 * (1 / 200 + 1 / 400))
        gains.append(found.gains.ki)
    assert gains[0] > gains[1] > gains[2] > 0.0


@pytest.mark.long
def test_a_share_out_of_reach_is_a_shortfall_with_the_best_one():
    """With a gain of either sign no integral controller stands more than its positive part."""
    either = posterior(std=(1.0, 0.05, 0.2, 0.001))  # positive with a probability of 84 %
    found = design_controller(
        either, SPEC, SETTING, structure="pi", probability=0.95, rng=np.random.default_rng(4),
        draws=200,
    )  # fmt: skip
    assert len(found.shortfalls) == 1 and "at most" in found.shortfalls[0]
    assert 0.7 < found.plausible.share.value <= 0.84 + 4.0 * math.sqrt(0.84 * 0.16 / 200)


def test_a_negative_static_gain_is_refused_as_without_a_posterior():
    with pytest.raises(InputError, match="with a minus before the name of the output column"):
        design_controller(
            posterior((-1.0, 32.1, 0.12, 0.012)), SPEC, SETTING, rng=np.random.default_rng(1)
        )


@pytest.mark.parametrize(("probability", "draws"), [(0.0, 400), (1.0, 400), (0.999, 400), (0.9, 9)])
def test_what_the_draws_cannot_show_is_refused(probability, draws):
    with pytest.raises(InputError, match=r"can show a share|must be 50 to"):
        design_controller(
            posterior(), SPEC, SETTING, rng=np.random.default_rng(1), probability=probability,
            draws=draws,
        )  # fmt: skip


@pytest.mark.long
def test_a_general_plant_in_volts_and_millimetres_gets_careful_gains():
    drawn = general([-2e-3, 0.09], [18.0, 900.0], spread=0.15)  # 0.1 um a volt, zero at 45 rad/s
    setting = LoopSetting(100.0, 0.01, Saturation(0.0, 8000.0))
    spec = DesignSpec(frequency_spread=0.0, step=0.2, noise_gain=1e6)
    found = design_controller(
        drawn, spec, setting, structure="pi", probability=0.9, rng=np.random.default_rng(4),
        draws=100,
    )  # fmt: skip
    assert found.shortfalls == () and found.plausible.share.value >= 0.9
    alone = design_pi(drawn.nominal, spec, setting, rng=np.random.default_rng(4))
    assert found.gains.ki <= alone.gains.ki


@pytest.mark.long
def test_the_true_plant_keeps_its_margins_as_often_as_requested(benchmark):
    """A slice of the benchmark: 12 records at 0.9; 8 or fewer happen once in 40 times."""
    assert isinstance(benchmark.TRUTH, Plant)
    assert sum(benchmark.covered(seed, 0.9)[1] for seed in range(12)) >= 9
