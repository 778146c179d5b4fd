"""Fits of the voltage plant: known truths, correct intervals, notes on identifiability."""

import numpy as np
import pytest

from haselab.base import InputError
from haselab.identify import Record, VoltageStructure, fit_voltage_plant
from haselab.identify.model_comparison.voltage_plant import predicted_std, spread_indices
from haselab.models import VoltagePlant

RATE_HZ = 100.0


def record(plant, drive_v, noise, seed=1, offset=0.0):
    time_s = np.arange(drive_v.size) / RATE_HZ
    y = plant.simulate(drive_v, RATE_HZ, time_s)
    y = y + offset + noise * np.random.default_rng(seed).normal(size=time_s.size)
    return Record(drive_v, RATE_HZ, y, time_s)


def jumps(low_v, high_v, seconds=20, every=0.5, seed=4):
    rng = np.random.default_rng(seed)
    return np.repeat(rng.uniform(low_v, high_v, round(seconds / every)), round(every * RATE_HZ))


@pytest.mark.parametrize("creep", ["mechanical", "electrical"])
def test_the_numbers_of_the_truth_lie_in_their_intervals(creep):
    truth = VoltagePlant(creep, (0.05, 0.006), 5.11, 0.09, 0.012, 0.3, 3.0)
    low_v = 0.2 if creep == "mechanical" else -1.8
    fit = fit_voltage_plant([record(truth, jumps(low_v, 1.8), 5e-4)], VoltageStructure(creep))
    assert fit.succeeded
    for name in ("natural_frequency_rad_s", "damping_ratio", "delay_s", "creep_share",
                 "creep_time_constant_s"):  # fmt: skip
        estimate = fit.parameters[name]
        assert abs(estimate.value - getattr(truth, name)) <= 4.0 * estimate.std, name
    for k, gain in enumerate(truth.gains, start=1):
        estimate = fit.parameters[f"gain_{k}"]
        assert abs(estimate.value - gain) <= 4.0 * estimate.std
    assert fit.answer()["residual_whiteness_p"] > 1e-3


@pytest.mark.long
def test_several_records_give_one_plant_each_with_its_own_offset():
    truth = VoltagePlant("mechanical", (0.05, 0.006), 30.0, 0.1, 0.005, 0.3, 3.0)
    records = [record(truth, jumps(0.2, 1.8, seed=s), 5e-4, s, offset=0.1 * s) for s in (1, 2)]
    fit = fit_voltage_plant(records)
    together = fit.parameters["natural_frequency_rad_s"]
    alone = fit_voltage_plant(records[:1]).parameters["natural_frequency_rad_s"]
    assert abs(together.value - 30.0) <= 4.0 * together.std
    # Twice the data: the interval shrinks by root two, each known to some ten percent.
    assert 0.5 < together.std / alone.std < 0.95


@pytest.mark.long
def test_the_predicted_deviation_is_that_of_repeated_fits():
    """Twenty fits: the ratio of variances times 19 is chi-square, 99.9 % within 5.4 and 43.8."""
    truth = VoltagePlant("mechanical", (0.05,), 5.11, 0.09, 0.012, 0.3, 3.0)
    drive_v, noise = jumps(0.2, 1.8), 2e-3
    planned = record(truth, drive_v, 0.0)
    predicted, _ = predicted_std(truth, [planned], noise, drive_v.size)
    fits = [
        fit_voltage_plant(
            [record(truth, drive_v, noise, seed)], VoltageStructure(powers=1), [truth]
        )
        for seed in range(20)
    ]
    for name, logarithmic in (
        ("natural_frequency_rad_s", True),
        ("creep_share", False),
        ("gain_1", True),
    ):
        values = np.array([fit.parameters[name].value for fit in fits])
        scatter = np.log(values).var(ddof=1) if logarithmic else values.var(ddof=1)
        assert 5.4 < 19 * scatter / predicted[name] ** 2 < 43.8, name


def test_creep_that_the_record_does_not_show_has_no_number():
    """Two seconds of motion about a level say nothing of a time constant of minutes."""
    truth = VoltagePlant("mechanical", (0.05,), 30.0, 0.1, 0.005)
    fit = fit_voltage_plant([record(truth, jumps(0.8, 1.2, 3, 0.1), 2e-3)])
    unknown = fit.parameters["creep_time_constant_s"]
    assert np.isnan(unknown.value)
    assert unknown.ci95 == (-np.inf, np.inf)
    assert any(note.startswith("creep_time_constant_s") for note in fit.notes)


def test_the_callers_arrays_stay_as_they_were():
    drive_v = jumps(0.2, 1.8, 10)
    given = record(VoltagePlant("mechanical", (0.05,), 5.11, 0.09), drive_v, 1e-3)
    before = (given.u.copy(), given.y.copy(), given.output_time_s.copy())
    fit_voltage_plant([given])
    for kept, now in zip(before, (given.u, given.y, given.output_time_s), strict=True):
        np.testing.assert_array_equal(kept, now)


@pytest.mark.parametrize(("count", "wanted"), [(10, 20), (20, 20), (27, 20), (4000, 300)])
def test_spread_indices_rise_and_leave_no_hole(count, wanted):
    kept = spread_indices(count, wanted)
    assert (np.diff(kept) > 0).all()
    assert kept.size >= min(count, 0.6 * wanted)
    assert kept.max() < count
    assert np.diff(kept).max() <= 2.0 * max(count / wanted, 1.0) + 1.0


def test_bad_input_is_refused_in_one_line():
    truth = VoltagePlant("mechanical", (0.05,), 5.11, 0.09)
    good = record(truth, jumps(0.2, 1.8, 10), 1e-3)
    with pytest.raises(InputError, match="records is empty"):
        fit_voltage_plant([])
    with pytest.raises(InputError, match="V; it must be at most 100 V ahead of the amplifier"):
        fit_voltage_plant([Record(1000.0 * good.u, RATE_HZ, good.y, good.output_time_s)])
    with pytest.raises(InputError, match="12 outputs; 11 parameters need at least 22"):
        fit_voltage_plant([Record(good.u, RATE_HZ, good.y[:12], good.output_time_s[:12])])
    with pytest.raises(InputError, match="The drive is 1 V throughout"):
        fit_voltage_plant([Record(np.ones(1000), RATE_HZ, good.y, good.output_time_s, None)])
    with pytest.raises(InputError, match="powers = 9; it must be 1 to 4"):
        VoltageStructure(powers=9)
    with pytest.raises(InputError, match="creep = thermal"):
        VoltageStructure("thermal")
    with pytest.raises(InputError, match="from 5 to 2 rad/s"):
        VoltageStructure(lowest_rad_s=5.0, highest_rad_s=2.0)
    with pytest.raises(InputError, match="slew_v_s = 0 V/s"):
        VoltageStructure(slew_v_s=0.0)
