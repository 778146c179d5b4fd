"""Planned experiments: inside the limits, optimal, right about the hypotheses."""

from dataclasses import replace

import numpy as np
import pytest

from haselab.base import InputError, LimitError
from haselab.identify import Accuracy, BenchLimits, plan_experiment
from haselab.identify.experiment_design.drives import candidate_drives, optimal_power
from haselab.models import VoltagePlant

PLANT = VoltagePlant("mechanical", (0.05, 0.004), 5.11, 0.1, 0.01, 0.35, 3.0)
UNIPOLAR, BIPOLAR = BenchLimits(0.0, 2.0), BenchLimits(-2.0, 2.0)


def test_all_drives_stay_inside_window_slew_and_output():
    limits = BenchLimits(-1.8, 1.9, slew_v_s=250.0, largest_output=0.15)
    drives = candidate_drives(PLANT, limits, 20.0, 1.0, "all")
    assert len(drives) > 8
    for drive in drives:
        assert limits.low_v <= drive.drive_v.min()
        assert drive.drive_v.max() <= limits.high_v
        assert np.abs(np.diff(drive.drive_v)).max() * limits.update_hz <= limits.slew_v_s
        time_s = np.arange(drive.drive_v.size) / 100.0
        assert np.abs(PLANT.simulate(drive.drive_v, 100.0, time_s)).max() <= 0.15
        assert drive.drive_v.size == 2000 or "alternation" in drive.name


def test_the_amplifiers_current_into_the_capacitance_limits_the_drive():
    """12 mA into 1 nF behind a gain of 5,000 is 2,400 V/s; its own slew of 350 MV/s is no limit."""
    limits = BenchLimits.of_amplifier((0.0, 2.0), 5000.0, 350e6, 12e-3, 1e-9)
    assert limits.slew_v_s == pytest.approx(2400.0)
    # A hundred times the capacitance: 0.24 V an update; larger steps are not offered.
    heavy = BenchLimits.of_amplifier((-2.0, 2.0), 5000.0, 350e6, 12e-3, 100e-9)
    for drive in candidate_drives(PLANT, heavy, 20.0, 1.0, "all"):
        assert np.abs(np.diff(drive.drive_v)).max() <= 0.24


@pytest.mark.long
def test_a_window_of_one_polarity_is_respected_and_said():
    plan = plan_experiment(PLANT, "creep", UNIPOLAR, duration_s=20.0)
    assert all(planned.drive_v.min() >= 0.0 for planned in plan.ranked)
    assert not any("alternation" in planned.name for planned in plan.ranked)
    assert any("has one polarity" in note for note in plan.notes)


@pytest.mark.long
def test_alternating_polarity_separates_the_kinds_of_creep_best():
    both = plan_experiment(PLANT, "creep", BIPOLAR, duration_s=20.0)
    one = plan_experiment(PLANT, "creep", UNIPOLAR, duration_s=20.0)
    assert both.chosen.name.startswith("alternation")
    assert both.chosen.probability > one.chosen.probability
    assert both.chosen.separation > 2.0 * one.chosen.separation


@pytest.mark.long
@pytest.mark.parametrize("omega_rad_s", [5.11, 32.1])
def test_a_drive_that_shows_the_resonance_identifies_the_unit_of_the_frequency(omega_rad_s):
    plant = replace(PLANT, natural_frequency_rad_s=omega_rad_s)
    plan = plan_experiment(plant, "reading", UNIPOLAR, duration_s=20.0)
    assert plan.chosen.probability > 0.95


@pytest.mark.long
def test_a_poor_model_promises_less():
    good = plan_experiment(PLANT, "creep", BIPOLAR, duration_s=20.0)
    poor = plan_experiment(
        PLANT, "creep", BIPOLAR, duration_s=20.0, accuracy=Accuracy(systematic=0.3)
    )
    assert poor.chosen.probability < good.chosen.probability
    assert any("cannot tell" in note for note in poor.notes)


def test_the_ranking_of_a_number_is_that_of_its_deviation():
    plan = plan_experiment(PLANT, "natural_frequency_rad_s", UNIPOLAR, duration_s=20.0)
    stds = [planned.std["natural_frequency_rad_s"] for planned in plan.ranked]
    assert stds == sorted(stds)


@pytest.mark.long
def test_a_longer_drive_shrinks_all_intervals_of_a_stationary_signal():
    """Four times as long: half the deviation, but for the transient of the start."""
    short, long = (
        plan_experiment(PLANT, "all", UNIPOLAR, duration_s=seconds) for seconds in (20.0, 80.0)
    )
    stds = [
        next(p for p in plan.ranked if p.name.startswith("prbs")).std["damping_ratio"]
        for plan in (short, long)
    ]
    assert 0.35 < stds[1] / stds[0] < 0.65


def information(plant, omega_rad_s, baseline_v):
    """Fisher's information of each line, by central differences of the linear response."""
    names = ["natural_frequency_rad_s", "damping_ratio", "delay_s", "creep_share",
             "creep_time_constant_s"]  # fmt: skip
    rows = [plant.frequency_response(omega_rad_s, baseline_v)]
    for name in names:
        ahead, behind = (
            replace(plant, **{name: getattr(plant, name) + step}).frequency_response(
                omega_rad_s, baseline_v
            )
            for step in (1e-4, -1e-4)
        )
        rows.append((ahead - behind) / 2e-4)
    rows = np.array([row / np.abs(row).max() for row in rows])
    return np.einsum("ik,jk->kij", rows, rows.conj()).real


@pytest.mark.parametrize("omega_rad_s", [5.11, 32.1])
def test_the_optimal_powers_meet_the_equivalence_theorem(omega_rad_s):
    """Kiefer and Wolfowitz: tr(F^-1 F_k) is at most the number of numbers, 6, on every line.

    After r rounds the multiplicative algorithm is within 6 ln(lines)/r of that.
    """
    plant = replace(PLANT, natural_frequency_rad_s=omega_rad_s)
    lines = 2.0 * np.pi * np.arange(1, 60) / 59.0 * omega_rad_s / 2.0
    power = optimal_power(plant, lines, 1.0, "all")
    assert power.sum() == pytest.approx(1.0)
    each = information(plant, lines, 1.0)
    total = np.einsum("k,kij->ij", power, each)
    gains = np.einsum("ij,kji->k", np.linalg.inv(total), each)
    assert gains.max() < 6.0 + 6.0 * np.log(59) / 100 + 0.05
    flat = np.linalg.slogdet(each.mean(axis=0))[1]
    assert np.linalg.slogdet(total)[1] > flat + 0.5


def test_powers_for_one_number_serve_that_number():
    lines = 2.0 * np.pi * np.arange(1, 60) / 59.0 * 3.0
    each = information(PLANT, lines, 1.0)

    def variance(power, at):
        return np.linalg.inv(np.einsum("k,kij->ij", power, each))[at, at]

    flat = np.full(59, 1.0 / 59.0)
    everything = optimal_power(PLANT, lines, 1.0, "all")
    for at, name in ((1, "natural_frequency_rad_s"), (5, "creep_time_constant_s")):
        best = optimal_power(PLANT, lines, 1.0, name)
        best = 0.99 * best + 0.01 * flat  # so that the inverse exists
        assert variance(best, at) < variance(flat, at)
        assert variance(best, at) < variance(0.99 * everything + 0.01 * flat, at)


def test_limits_that_leave_no_drive_give_no_result():
    plan = plan_experiment(PLANT, "all", replace(UNIPOLAR, largest_output=1e-6), duration_s=20.0)
    assert plan.status.startswith("no result: no drive stays inside the limits")


def test_bad_plans_are_refused():
    with pytest.raises(
        InputError, match="goal = colour; it must be one of creep, reading, modes, all"
    ):
        plan_experiment(PLANT, "colour", UNIPOLAR)
    with pytest.raises(InputError, match=r"baseline_v = 3 V; it must be above 0 V and within"):
        plan_experiment(PLANT, "all", UNIPOLAR, baseline_v=3.0)
    with pytest.raises(InputError, match=r"duration_s = 0\.01 s"):
        plan_experiment(PLANT, "all", UNIPOLAR, duration_s=0.01)
    with pytest.raises(InputError, match="samples_per_s = 0"):
        Accuracy(samples_per_s=0.0)
    with pytest.raises(LimitError, match=r"limits of the bench are 2 to 1 V"):
        BenchLimits(2.0, 1.0)
