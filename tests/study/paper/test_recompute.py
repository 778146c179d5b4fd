"""The recomputed figures against the reference document and python-control."""

import math

import control
import numpy as np
import pytest

from haselab.control import LoopSetting, PidGains, simulate_loop
from haselab.study.paper.paper_check import recompute_paper, recompute_steps

# Figures of the reference document, to half a unit of their last digit.
DOCUMENT = {
    "A1": {"natural_frequency_rad_s": (5.113, 5e-4)},
    "A2": {"damping_ratio": (0.0909, 5e-5)},
    "A3": {"periods": (20, 0)},
    "A4": {"offset": (-0.0479, 1e-4), "square_per_v2": (0.0454, 5e-5),
           "largest_residual": (0.003, 5e-4)},
    "A5": {"low_v": (270, 5), "high_v": (8950, 5)},
    "A6": {"peak_sensitivity": (5.1, 0.05)},
    "D1": {"omega_0_rad_s_1": (6.24, 5e-3), "omega_0_rad_s_2": (6.61, 5e-3),
           "omega_0_hz_1": (5.13, 5e-3), "omega_0_hz_2": (5.14, 5e-3)},
    "D2": {"damping_ratio_rad_1": (0.58, 5e-3), "damping_ratio_rad_2": (0.64, 5e-3),
           "damping_ratio_hz_1": (0.11, 5e-3), "damping_ratio_hz_2": (0.13, 5e-3)},
    "D3": {"left_per_cycle_rad_1": (0.01, 5e-3), "left_per_cycle_rad_2": (0.01, 5e-3),
           "left_per_cycle_hz_1": (0.49, 5e-3), "left_per_cycle_hz_2": (0.44, 5e-3)},
    "D4": {"rise_time_s": (0.21, 5e-3), "settling_5_s": (6.3, 0.05), "settling_2_s": (8.1, 0.05)},
    "D5": {"rise_time_s": (1.4, 0.05), "settling_2_s": (13.5, 0.05)},
    "D6": {"real_pole_per_s": (-0.53, 5e-3), "damping_ratio": (0.033, 5e-4)},
    "D7": {"plant_crossover_rad_s": (6.16, 5e-3), "crossover_rad_s": (6.02, 5e-3),
           "phase_margin_deg": (12.6, 0.05), "gain_margin_db": (8.4, 0.05),
           "peak_sensitivity": (5.1, 0.05), "delay_margin_s": (0.0365, 5e-5)},
    "D8": {"static_gain_eq8": (0.5, 0), "static_gain_eq4": (1.0, 0)},
    "D9": {"zero_strain_v": (5220, 5)},
    "D10": {"strain_low": (-0.038, 5e-4), "strain_high": (0.069, 5e-4),
            "asymmetry": (1.8, 0.05), "gain_ratio": (5.3, 0.05)},
    "D11": {"relative_capacitance": (5.6e-8, 5e-10), "plate_high_f": (5e-9, 5e-10)},
    "D11b": {"product_low": (4e-5, 5e-6), "product_high": (7e-5, 5e-6),
             "milder_low": (0.04, 5e-3), "milder_high": (0.07, 5e-3)},
    "D12": {"log_slope": (3.6, 0.05)},
    "D13": {"carrier_db": (-3, 0.5), "carrier_deg": (-180, 0.5)},
    "D14": {"stiffness_rad_n_m": (6.5, 0.05), "sag_rad_m": (0.375, 1e-3),
            "stiffness_hz_n_m": (258, 0.5), "sag_hz_m": (9.5e-3, 5e-5),
            "electric_low_n_m": (29, 0.5), "electric_high_n_m": (695, 0.5)},
    "D15": {"cycles_rad": (1 / 3, 5e-3), "reached_hz_s": (5.06, 5e-3)},
    "D16": {"delay_low_s": (0.015, 0), "delay_high_s": (0.020, 0),
            "delay_margin_hz_low_s": (0.0127, 5e-5), "delay_margin_hz_high_s": (0.0197, 5e-5)},
    "D17": {"harmonic": (20, 0), "skew_s": (2.5e-6, 0), "skew_deg": (1.8, 1e-9)},
}  # fmt: skip


@pytest.fixture(scope="module")
def rows():
    return {row.id: row for row in recompute_paper()}


@pytest.mark.parametrize("row_id", DOCUMENT)
def test_a_row_gives_the_documents_figures(rows, row_id):
    for name, (value, half_digit) in DOCUMENT[row_id].items():
        assert rows[row_id].numbers[name] == pytest.approx(value, abs=half_digit, rel=1e-9), name


def test_every_row_is_there_once_and_judged(rows):
    assert list(rows) == list(DOCUMENT)
    for row in rows.values():
        assert row.verdict == ("agrees" if row.id.startswith("A") else "disagrees")
        assert row.claim and row.paper and row.recomputed
        assert all(math.isfinite(value) for value in row.numbers.values())


def test_step_figures_of_eq_8_agree_with_python_control(rows):
    plant = control.tf([13.07], [1, 0.93, 26.14])
    closed = control.feedback(plant * control.tf([0.85, 1.5], [1, 0]), 1)
    time_s = np.linspace(0.0, 40.0, 40_001)
    for row_id, system in (("D4", plant), ("D5", closed)):
        info = control.step_info(system, T=time_s)
        # python-control reads its 1 ms grid: one step at each end.
        assert rows[row_id].numbers["rise_time_s"] == pytest.approx(info["RiseTime"], abs=2e-3)
        assert rows[row_id].numbers["settling_2_s"] == pytest.approx(info["SettlingTime"], abs=2e-3)
        assert rows[row_id].numbers["overshoot"] == pytest.approx(
            info["Overshoot"] / 100.0, abs=1e-4
        )


def test_margins_of_the_loop_agree_with_python_control(rows):
    loop = control.tf([13.07], [1, 0.93, 26.14]) * control.tf([0.85, 1.5], [1, 0])
    gain, phase, distance, _, omega, _ = control.stability_margins(loop)
    found = rows["D7"].numbers
    assert 10 ** (found["gain_margin_db"] / 20) == pytest.approx(gain, rel=1e-6)
    assert found["phase_margin_deg"] == pytest.approx(phase, rel=1e-6)
    assert found["crossover_rad_s"] == pytest.approx(omega, rel=1e-8)
    assert 1.0 / found["peak_sensitivity"] == pytest.approx(distance, rel=1e-6)


def test_the_integral_term_not_the_proportional_one_takes_the_damping(rows):
    found = rows["D6"].numbers
    printed = 0.93 / (2 * math.sqrt(26.14))
    assert found["damping_ratio_ki_alone"] < found["damping_ratio"]
    assert found["damping_ratio"] < found["damping_ratio_kp_alone"] < printed


def test_slow_branches_reconcile_the_rise_times_under_both_readings():
    rows = recompute_steps()
    assert [row.reading for row in rows] == ["rad", "hz", "rad", "hz"]
    for row in rows:
        slow = row.plant.slow_modes[0]
        # Ringing gone, the open loop is the slow branch: from 10 % at once to 90 % of the total.
        exact = slow.time_constant_s * math.log(slow.gain / (0.1 * row.plant.static_gain))
        assert row.rise_open_s == pytest.approx(exact, rel=0.02)
        assert row.error_open == pytest.approx(0.1, abs=1e-3)
        assert all(2.5 <= rise <= 3.0 for rise in row.rise_closed_s)
    assert [row.limit_cycle_delay_s for row in rows if row.reading == "hz"] == [0.015, 0.020]
    assert all(math.isnan(row.limit_cycle_delay_s) for row in rows if row.reading == "rad")


def test_the_clipped_loop_keeps_oscillating_where_the_linear_one_is_unstable():
    hz = next(row for row in recompute_steps() if row.reading == "hz")
    swing = {}
    for delay_s in (hz.limit_cycle_delay_s - 0.005, hz.limit_cycle_delay_s):
        setting = LoopSetting(100.0, delay_s)
        trace = simulate_loop(hz.plant, PidGains(0.85, 1.5), np.full(6000, 0.04), setting)
        swing[delay_s] = np.ptp(trace.y[-2000:])
    quiet, cycling = swing.values()
    assert quiet < 1e-6 and cycling > 0.04
