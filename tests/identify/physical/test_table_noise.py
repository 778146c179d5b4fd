"""Noise of tables, which do not state it: estimated without the motion, and only for tables."""

from dataclasses import replace

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2, Drive, PlanarHasel, SampledLaw
from haselab.identify.physical import ChannelNoise, IdentifiedModel, fit_actuator, predict_motion
from haselab.identify.physical.plausible import find_implausible
from haselab.identify.physical.unknowns import Unknowns
from haselab.pipelines.motion_table import motion_of_table

LAW, MASS_KG = PlanarHasel(), 0.2
LENGTH_STD_M, CAPACITANCE_STD_F = 2e-6, 3e-13


def moved(seed, *, rows=2000, hold=30, step_s=0.01):
    """Times, voltages held for some rows, lengths and capacitances without noise."""
    rng = np.random.default_rng(seed)
    time_s = step_s * np.arange(rows)
    volt = np.repeat(rng.uniform(0.0, 8e3, rows // hold + 1), hold)[:rows]
    volt[:hold] = 0.0
    same = np.ones(rows)
    drive = Drive(np.append(time_s, step_s * rows), volt, MASS_KG * GRAVITY_M_S2 * same,
                  MASS_KG * same, 0.0 * same)  # fmt: skip
    sampled = SampledLaw(LAW, 11e3)
    start, _ = sampled.at_rest(0.0, 0.0, MASS_KG * GRAVITY_M_S2)
    length_m = sampled.respond(drive, time_s, start).length_m
    return time_s, volt, length_m, LAW.capacitance_f(length_m)


def recorded(seed, **options):
    """The same as a table, with noise."""
    rng = np.random.default_rng(1000 + seed)
    time_s, volt, length_m, capacitance_f = moved(seed, **options)
    return motion_of_table(
        f"table-{seed}", time_s, volt, mass_kg=MASS_KG,
        length_m=length_m + LENGTH_STD_M * rng.standard_normal(time_s.size),
        capacitance_f=capacitance_f + CAPACITANCE_STD_F * rng.standard_normal(time_s.size),
    )  # fmt: skip


@pytest.mark.parametrize("seed", range(3))
def test_the_noise_of_a_table_contains_no_motion(seed):
    found = recorded(seed)
    # The median of 2,000 values is certain to 1.17/sqrt(4,000), the differences of order 8 are as
    # good as a fifth as many independent ones: 4 %. Of 7 orders, the smallest estimate counts.
    assert found.length_std_m[0] == pytest.approx(LENGTH_STD_M, rel=0.15)
    assert found.capacitance_std_f[0] == pytest.approx(CAPACITANCE_STD_F, rel=0.15)


def test_the_noise_is_at_least_that_of_the_steps_of_the_values():
    time_s, volt, length_m, _ = moved(1)
    found = motion_of_table("a", time_s, volt, mass_kg=MASS_KG,
                            length_m=np.round(length_m / 2e-5) * 2e-5)  # fmt: skip
    assert found.length_std_m[0] >= 0.999 * 2e-5 / np.sqrt(12.0)


def test_unix_times_are_times_since_the_first_row():
    time_s, volt, length_m, capacitance_f = moved(1, rows=300)
    one, other = (
        motion_of_table("a", time_s + first_s, volt, mass_kg=MASS_KG, length_m=length_m,
                        capacitance_f=capacitance_f)
        for first_s in (0.0, 1.7e9)
    )  # fmt: skip
    # the last digit of a double of 1.7e9 is 2.4e-7
    assert np.allclose(one.drive.edge_s, other.drive.edge_s, rtol=0.0, atol=1e-6)
    assert np.allclose(one.length_time_s, other.length_time_s, rtol=0.0, atol=1e-6)


def test_the_factor_of_a_fit_does_not_change_the_noise_that_another_record_estimates():
    unknowns = Unknowns.of(LAW, added_inertia_kg=0.0, mass_kg=MASS_KG)
    model = IdentifiedModel(unknowns, 1e-20 * np.eye(unknowns.values.size),
                            ChannelNoise(0.4, LENGTH_STD_M))  # fmt: skip
    table = recorded(5, rows=300)
    stated = replace(table, std_estimated=False)
    part, other = (predict_motion(model, one, free_offset=True).together("length")
                   for one in (table, stated))  # fmt: skip
    assert np.allclose(part.std, LENGTH_STD_M, rtol=1e-3)
    assert np.allclose(other.std, 0.4 * table.length_std_m, rtol=1e-3)


@pytest.mark.parametrize("seed", range(3))
def test_an_actuator_that_moves_in_each_row_is_not_called_still(seed):
    """At 20 Hz with voltages held for 3 rows, differences of all orders contain the motion."""
    moving = recorded(seed, rows=90, hold=3, step_s=0.05)
    assert moving.length_std_m[0] > 100.0 * LENGTH_STD_M
    assert find_implausible(LAW, [moving]) == ""
    rng = np.random.default_rng(seed)
    still = replace(
        moving, length_m=0.09 + LENGTH_STD_M * rng.standard_normal(90),
        length_std_m=np.full(90, LENGTH_STD_M),
        capacitance_f=1e-10 + CAPACITANCE_STD_F * rng.standard_normal(90),
        capacitance_std_f=np.full(90, CAPACITANCE_STD_F),
    )  # fmt: skip
    assert "the actuator does not move" in find_implausible(LAW, [still])


@pytest.mark.slow
def test_a_model_of_tables_predicts_a_record_that_states_its_noise():
    """The estimates of the tables' noise are 3 times too high here, as where all rows move."""
    vague = [replace(one, length_std_m=3.0 * one.length_std_m)
             for one in (recorded(1), recorded(2))]  # fmt: skip
    fit = fit_actuator(LAW, vague, mass_kg=MASS_KG, camera_bias_m=5e-5)
    assert fit.status == "ok" and fit.length_factor == 1.0
    # 4 standard deviations of the rms of 4,000 values
    assert fit.length_noise_m == pytest.approx(LENGTH_STD_M, rel=4.0 / np.sqrt(8000.0))
    session = recorded(3)
    session = replace(
        session, length_std_m=np.full(session.length_m.size, LENGTH_STD_M),
        capacitance_std_f=np.full(session.capacitance_f.size, CAPACITANCE_STD_F),
        std_estimated=False,
    )  # fmt: skip
    found = predict_motion(IdentifiedModel.of_fit(fit), session, free_offset=True)
    assert found.status == "ok"
    for part in found.all_parts:
        # 4 standard deviations of a share of 95 % of 2,000 values
        assert part.inside_band == pytest.approx(0.95, abs=4.0 * np.sqrt(0.95 * 0.05 / 2000))
