"""What is identifiable from records: structures, creep, swapped columns, runaway, bootstrap."""

import numpy as np
import pytest

from haselab.base import InputError, ResultError
from haselab.identify.record import Record
from haselab.identify.transfer.bootstrap import bootstrap_transfer
from haselab.identify.transfer.choice import choose_transfer
from haselab.identify.transfer.fit import TransferStructure, fit_transfer
from haselab.models import Plant, SlowMode

OMEGA, ZETA = float(np.sqrt(26.14)), 0.0909495
CHIRP_S, STEP_S = np.arange(4000) / 400.0, np.arange(12000) / 400.0
CHIRP = np.sin(2 * np.pi * (0.1 * CHIRP_S + 0.495 * CHIRP_S**2))
STEP = np.where(STEP_S < 2.0, 0.0, 1.0)
STD = 0.015


def creeping(seed, omega=OMEGA):
    """A chirp and a step of a plant with 10 % creep, each from its own state and offset."""
    rng = np.random.default_rng([11, seed])
    plant = Plant(0.5, omega, ZETA, 0.012, (SlowMode(0.05, 5.0),))
    sweep = plant.simulate(CHIRP, 400.0, CHIRP_S, [0.03, 0.0, 0.0]) + 0.02
    rise = plant.simulate(STEP, 400.0, STEP_S, [-0.02, 0.0, 0.0]) - 0.03
    return (
        Record.sampled(CHIRP, sweep + STD * rng.normal(size=sweep.size), 400.0),
        Record.sampled(STEP, rise + STD * rng.normal(size=rise.size), 400.0),
    )


@pytest.mark.long
@pytest.mark.parametrize("omega", [OMEGA, 2 * np.pi * 5.11])
def test_a_chirp_and_a_step_choose_the_structure_that_made_them(omega):
    choice = choose_transfer(creeping(1, omega))
    chosen = choice.fit.structure
    assert (chosen.poles, chosen.zeros, chosen.delay, chosen.slow_modes) == (2, 0, "auto", 1)
    assert choice.notes == ()
    tau = choice.fit.parameters["slow_time_constant_s"]
    assert abs(tau.value - 5.0) < 4.0 * tau.std < 4.0
    assert choice.answer()["candidates"][0]["bic"] == 0.0 < choice.answer()["candidates"][1]["bic"]


@pytest.mark.parametrize("omega", [OMEGA, 2 * np.pi * 5.11])
def test_from_the_chirp_alone_creep_is_reported_as_not_identifiable(omega):
    (sweep, _) = creeping(2, omega)
    fit = fit_transfer([sweep], TransferStructure(slow_modes=1))
    for name in ("slow_time_constant_s", "slow_gain"):
        assert np.isnan(fit.parameters[name].value)
        assert fit.parameters[name].ci95 == (-np.inf, np.inf)
        assert any(note.startswith(f"{name} is not identifiable") for note in fit.notes)
    assert np.isnan(fit.poles[-1])
    with pytest.raises(ResultError, match="slow_gain not identifiable"):
        _ = fit.plant
    choice = choose_transfer([sweep], varied=["slow_modes"])
    assert any("not identifiable" in note for note in (*choice.notes, *choice.fit.notes))


@pytest.mark.long
def test_a_zero_and_a_third_pole_are_chosen_where_they_are():
    rng = np.random.default_rng(3)
    u = rng.normal(size=4000)
    slow, fast = Plant(0.5, OMEGA, 0.3), Plant(0.3, 40.0, 0.1)
    y = slow.simulate(u, 400.0, CHIRP_S) + fast.simulate(u, 400.0, CHIRP_S)
    record = Record.sampled(u, y + 0.002 * rng.normal(size=4000), 400.0)
    choice = choose_transfer([record], varied=["poles", "zeros"])
    # Two modes side by side have four poles and two zeros.
    assert (choice.fit.structure.poles, choice.fit.structure.zeros) == (4, 2)


def test_a_delay_of_zero_is_preferred_where_there_is_none():
    rng = np.random.default_rng(3)
    y = Plant(0.5, OMEGA, ZETA).simulate(CHIRP, 400.0, CHIRP_S) + STD * rng.normal(size=4000)
    choice = choose_transfer([Record.sampled(CHIRP, y, 400.0)], varied=["delay"])
    assert choice.fit.structure.delay == 0.0


@pytest.mark.long
def test_residuals_of_a_softening_plant_and_of_a_missing_mode_are_noticed():
    fired = correlated = 0
    runs = 8
    for run in range(runs):
        rng = np.random.default_rng([6, run])
        y = Plant(0.5, OMEGA, ZETA).simulate(CHIRP, 400.0, CHIRP_S)
        y = y / np.abs(y).max()
        softened = y - 0.05 * y**3
        noise = np.sqrt(np.mean(y**2) / 1e3) * rng.normal(size=y.size)
        fired += (
            fit_transfer([Record.sampled(CHIRP, softened + noise, 400.0)]).residual_whiteness_p
            < 0.05
        )
        u = rng.normal(size=4000)
        two = Plant(0.5, OMEGA, 0.3).simulate(u, 400.0, CHIRP_S)
        two = two + Plant(0.1, 40.0, 0.1).simulate(u, 400.0, CHIRP_S)
        missing = fit_transfer([Record.sampled(u, two + 0.01 * rng.normal(size=4000), 400.0)])
        correlated += missing.input_correlation_p < 0.05
    assert fired == correlated == runs


@pytest.mark.long
def test_the_residual_tests_pass_where_the_model_is_right():
    passed = np.zeros(2)
    runs = 60
    for run in range(runs):
        rng = np.random.default_rng([8, run])
        y = Plant(0.5, OMEGA, ZETA, 0.01).simulate(CHIRP, 400.0, CHIRP_S)
        fit = fit_transfer([Record.sampled(CHIRP, y + STD * rng.normal(size=4000), 400.0)])
        passed += [fit.residual_whiteness_p > 0.05, fit.input_correlation_p > 0.05]
    # Binomial: 3 spreads below 95 %.
    assert (passed / runs >= 0.95 - 3 * np.sqrt(0.95 * 0.05 / runs)).all()


@pytest.mark.long
def test_the_bootstrap_has_the_spread_of_the_covariance_and_stays_inside_it():
    (sweep, rise) = creeping(4)
    fit = fit_transfer([sweep, rise], TransferStructure(slow_modes=1))
    drawn = bootstrap_transfer(fit, 300, np.random.default_rng(1))
    for name, estimate in fit.parameters.items():
        # The spread of 300 draws has a relative error of 1/sqrt(600): 4 of it.
        assert drawn[name].std == pytest.approx(estimate.std, rel=0.17), name
        assert drawn[name].ci95[0] < estimate.value < drawn[name].ci95[1]
    with pytest.raises(InputError, match="must be 100 or more"):
        bootstrap_transfer(fit, 10, np.random.default_rng(1))


def test_swapped_columns_and_an_output_that_diverges_are_named():
    (sweep, _) = creeping(5)
    swapped = fit_transfer([Record.sampled(sweep.y, sweep.u, 400.0)])
    assert swapped.status == "no result: the input responds to the output; the columns are swapped"
    growing = sweep.y + 0.01 * np.exp(0.8 * CHIRP_S) * np.sin(5.0 * CHIRP_S)
    assert "not stable" in fit_transfer([Record.sampled(CHIRP, growing, 400.0)]).status


def test_a_gap_in_time_and_unequal_columns_are_refused():
    time_s = np.concatenate([CHIRP_S[:1000], CHIRP_S[1600:]])
    with pytest.raises(InputError, match=r"gap of 1\.5025 s after 2\.4975 s"):
        Record(CHIRP, 400.0, np.sin(time_s), time_s)
    with pytest.raises(InputError, match="u has 3999 values and y 4000"):
        Record.sampled(CHIRP[1:], CHIRP, 400.0)
    with pytest.raises(
        InputError, match="held_at_hz = 90 Hz; it must be 400 Hz divided by a whole"
    ):
        Record.sampled(CHIRP, CHIRP, 400.0, held_at_hz=90.0)
    with pytest.raises(
        InputError, match="hold = linear; it must be one of zero, first, band-limited"
    ):
        Record.sampled(CHIRP, CHIRP, 400.0, hold="linear")
