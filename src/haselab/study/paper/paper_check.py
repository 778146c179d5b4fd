"""Recompute the printed numbers of the reference study, and check which are consistent."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.control import (
    LoopSetting,
    PidGains,
    Saturation,
    StepNumbers,
    margins,
    simulate_drive,
    simulate_loop,
    step_metrics,
)
from haselab.models.maps import LinearMap, VoltageMap
from haselab.models.plant import Plant, SlowMode

__all__ = [
    "EQ_4",
    "RecomputedRow",
    "ReconcilingRow",
    "paper_step",
    "recompute_paper",
    "recompute_steps",
]

# As printed: eqs. 4, 5, 8, 12, 13, the bench, and the saturation.
EQ_4 = VoltageMap(1.324, 3.124, -0.2805, -26.92)
_EQ5 = LinearMap(4.923e6, -0.276)
_STIFFNESS_PER_MASS = 26.14
_DAMPING_PER_MASS = 0.93
_WN_RAD_S = math.sqrt(_STIFFNESS_PER_MASS)
_ZETA = _DAMPING_PER_MASS / (2.0 * _WN_RAD_S)
_EQ8 = Plant(0.5, _WN_RAD_S, _ZETA)
_PI = PidGains(0.85, 1.5)
_LIMITS = Saturation(-0.05, 0.1)
_AMPLIFIER = 5000.0
_MASS_KG = 0.25
_GRAVITY_M_S2 = 9.80665
_OMEGA_D = 5.1  # printed as rad/s
_DECAYS_PER_S = (3.6, 4.2)
_CARRIER_HZ = 2000.0
_EPSILON_0_F_M = 8.8541878128e-12
_TURN = 2.0 * math.pi


@dataclass(frozen=True)
class RecomputedRow:
    """One printed claim, and the value recomputed from the paper's own numbers.

    Args:
        id: `A1`, `A2` ... for claims that agree, `D1`, `D2` ... for those that do not.
        claim: its subject.
        paper: the printed value.
        recomputed: the recomputed value, as text.
        numbers: the recomputed numbers by name, SI, unit last.
        verdict: `agrees` or `disagrees`.
    """

    id: str
    claim: str
    paper: str
    recomputed: str
    numbers: Mapping[str, float]
    verdict: str


@dataclass(frozen=True)
class ReconcilingRow:
    """Step metrics of a plant with one slow branch, for one unit of the frequency axis.

    Args:
        reading: `rad` or `hz`.
        plant: resonance and slow branch.
        rise_open_s: 10 to 90 %, ringing averaged out, in s.
        error_open: open-loop error, part of the step.
        rise_closed_s: closed loop with the printed PI at 5 and 10 ms of measurement delay, in s.
        limit_cycle_delay_s: smallest of the delays 5, 10, ... 25 ms at which the saturated loop
            oscillates; NaN: none.
    """

    reading: str
    plant: Plant
    rise_open_s: float
    error_open: float
    rise_closed_s: tuple[float, float]
    limit_cycle_delay_s: float


def recompute_paper() -> tuple[RecomputedRow, ...]:
    """Check the claims of the paper: first those that agree, then D1 to D17.

    Returns:
        The rows, computed from the printed numbers.
    Source: reference study, eqs. 2 to 13 and the text around them.
    Example:
        >>> {row.id: row.verdict for row in recompute_paper()}["D1"]
        'disagrees'
    """
    groups = (_agreeing, _free_response, _steps, _loop, _maps, _capacitance, _bench)
    return tuple(row for group in groups for row in group())


def recompute_steps() -> tuple[ReconcilingRow, ...]:
    """Open- and closed-loop steps of plants that explain the paper's rise times.

    Returns:
        Two slow branches, each with both units of the frequency axis.
    """
    rows = []
    for fast, slow, tau_s in ((0.5, 0.4, 4.7), (0.4, 0.5, 4.1)):
        for reading, wn, zeta in (("rad", 5.11, 0.09), ("hz", _TURN * 5.11, 0.12)):
            plant = Plant(fast, wn, zeta, slow_modes=(SlowMode(slow, tau_s),))
            opened = _step(plant, None, 0.0)
            closed = (_step(plant, _PI, 0.005), _step(plant, _PI, 0.010))
            rise_s = (closed[0].rise_time_s, closed[1].rise_time_s)
            rows.append(
                ReconcilingRow(
                    reading,
                    plant,
                    opened.rise_time_s,
                    opened.steady_state_error,
                    rise_s,
                    _limit_cycle_delay_s(plant),
                )
            )
    return tuple(rows)


def _step(plant: Plant, gains: PidGains | None, delay_s: float) -> StepNumbers:
    """Metrics of a 0.04 step in a 100 Hz loop with the printed saturation."""
    setting = LoopSetting(100.0, delay_s, _LIMITS)
    reference = np.r_[np.zeros(100), np.full(4000, 0.04)]
    if gains is None:
        trace = simulate_drive(plant, reference, setting)
    else:
        trace = simulate_loop(plant, gains, reference, setting)
    desired = np.repeat(reference, setting.points_per_sample)
    return step_metrics(trace.time_s, trace.y, desired).trials[0]


def paper_step(gains: PidGains | None) -> StepNumbers:
    """Metrics of a step of 0.04 with eq. 8, held at 100 Hz, with the printed saturation.

    Args:
        gains: of the controller, with 5 ms of measurement delay; None: open loop.
    """
    return _step(_EQ8, gains, 0.0 if gains is None else 0.005)


def _limit_cycle_delay_s(plant: Plant) -> float:
    """Smallest tested delay at which the linear loop is unstable, so the saturated one cycles."""
    for delay_s in (0.005, 0.010, 0.015, 0.020, 0.025):
        if not margins(plant, _PI, loop_delay_s=delay_s, rate_hz=100.0).stable:
            return delay_s
    return math.nan


def _agreeing() -> list[RecomputedRow]:
    strain = np.linspace(_LIMITS.low, _LIMITS.high, 601)
    volts = EQ_4.voltage_v(strain)
    square, offset = np.polyfit(volts**2, strain, 1)
    residual = float(np.abs(strain - offset - square * volts**2).max())
    monotone = EQ_4.is_monotone(_LIMITS.low, _LIMITS.high)
    low_v, high_v = (float(v) * _AMPLIFIER for v in volts[[0, -1]])
    loop = margins(_EQ8, _PI, loop_delay_s=0.0, rate_hz=None)
    periods = _CARRIER_HZ * 2000 / 200e3
    return [
        _row("A1", "natural frequency of eq. 8 (eq. 9)", "5.11 rad/s", f"{_WN_RAD_S:.3f} rad/s",
             {"natural_frequency_rad_s": _WN_RAD_S}, agrees=round(_WN_RAD_S, 2) == 5.11),
        _row("A2", "damping ratio of eq. 8 (eq. 10)", "0.09", f"{_ZETA:.4f}",
             {"damping_ratio": _ZETA}, agrees=round(_ZETA, 2) == 0.09),
        _row("A3", "sine periods in one buffer", "20", f"{periods:g}",
             {"periods": periods}, agrees=periods == 20.0),
        _row("A4", "voltage from strain (eq. 4) can be inverted", "two exponentials",
             f"{'strictly' if monotone else 'not'} monotone; within {residual:.4f} of strain = "
             f"{offset:.4f} + {square:.4f} V^2",
             {"offset": offset, "square_per_v2": square, "largest_residual": residual},
             agrees=monotone),
        _row("A5", "saturation against breakdown", "-0.05 to 0.1 strain, tested 0 to 10 kV",
             f"{low_v / 1e3:.2f} kV to {high_v / 1e3:.2f} kV",
             {"low_v": low_v, "high_v": high_v}, agrees=0.0 <= low_v < high_v <= 10e3),
        _row("A6", "the PI loop on eq. 8 is stable", "stable", "stable" if loop.stable else
             "unstable", {"peak_sensitivity": loop.peak_sensitivity}, agrees=loop.stable),
    ]  # fmt: skip


def _free_response() -> list[RecomputedRow]:
    rad = [math.hypot(_OMEGA_D, decay) for decay in _DECAYS_PER_S]
    hz = [math.hypot(_TURN * _OMEGA_D, decay) / _TURN for decay in _DECAYS_PER_S]
    ratio = [decay / omega for decay, omega in zip(_DECAYS_PER_S, rad, strict=True)]
    ratio_hz = [decay / (_TURN * f) for decay, f in zip(_DECAYS_PER_S, hz, strict=True)]
    kept = [math.exp(-decay * _TURN / _OMEGA_D) for decay in _DECAYS_PER_S]
    kept_hz = [math.exp(-decay / _OMEGA_D) for decay in _DECAYS_PER_S]
    return [
        _row("D1", "natural frequency of the free response (eq. 7)", "5.1 rad/s in both cases",
             f"{rad[0]:.2f} and {rad[1]:.2f} rad/s; with 5.1 read as Hz {hz[0]:.2f} and "
             f"{hz[1]:.2f} Hz", _pairs("omega_0_rad_s", rad) | _pairs("omega_0_hz", hz)),
        _row("D2", "the free response validates the Bode plot", "damping ratio 0.09",
             f"{ratio[0]:.2f} and {ratio[1]:.2f}; in Hz {ratio_hz[0]:.2f} and {ratio_hz[1]:.2f}",
             _pairs("damping_ratio_rad", ratio) | _pairs("damping_ratio_hz", ratio_hz)),
        _row("D3", "envelopes (hull curves) through several peaks", "peaks on both sides",
             f"after one cycle at 5.1 rad/s {kept[0]:.1%} and {kept[1]:.1%} remain: no second "
             f"peak; at 5.1 Hz {kept_hz[0]:.0%} and {kept_hz[1]:.0%}",
             _pairs("left_per_cycle_rad", kept) | _pairs("left_per_cycle_hz", kept_hz)),
    ]  # fmt: skip


def _exact_step(
    numerator: list[float], denominator: list[float], time_s: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Unit step of a transfer function with distinct poles, by partial fractions."""
    total = np.full(time_s.shape, numerator[-1] / denominator[-1], dtype=complex)
    for pole in np.roots(denominator):
        residue = np.polyval(numerator, pole) / np.polyval(np.polyder(denominator), pole)
        total += residue / pole * np.exp(pole * time_s)
    return total.real


def _rise_and_settling_s(
    y: NDArray[np.float64], final: float, time_s: NDArray[np.float64]
) -> tuple[float, float, float]:
    """Rise time 10 to 90 % with ringing, and settling times to 5 % and 2 %, in s."""
    first = [float(time_s[np.argmax(y >= part * final)]) for part in (0.1, 0.9)]
    away = np.abs(y / final - 1.0)
    kept = [float(time_s[np.flatnonzero(away > band)[-1]]) for band in (0.05, 0.02)]
    return first[1] - first[0], kept[0], kept[1]


def _steps() -> list[RecomputedRow]:
    time_s = np.linspace(0.0, 40.0, 400_001)
    top = 0.5 * _STIFFNESS_PER_MASS
    plant = [1.0, _DAMPING_PER_MASS, _STIFFNESS_PER_MASS]
    closed = [1.0, _DAMPING_PER_MASS, _STIFFNESS_PER_MASS + top * _PI.kp, top * _PI.ki]
    y_open = _exact_step([top], plant, time_s)
    y_closed = _exact_step([top * _PI.kp, top * _PI.ki], closed, time_s)
    rise, settle_5, settle_2 = _rise_and_settling_s(y_open, 0.5, time_s)
    rise_c, _, settle_c = _rise_and_settling_s(y_closed, 1.0, time_s)
    averaged = paper_step(_PI).rise_time_s
    over, over_c = float(y_open.max()) / 0.5 - 1.0, float(y_closed.max()) - 1.0
    return [
        _row("D4", "open-loop rise time", "6 to 8 s",
             f"eq. 8 rises in {rise:.2f} s with {over:.0%} overshoot; it settles in "
             f"{settle_5:.1f} s (5 %) and {settle_2:.1f} s (2 %)",
             {"rise_time_s": rise, "overshoot": over, "settling_5_s": settle_5,
              "settling_2_s": settle_2}),
        _row("D5", "closed-loop rise time", "2.5 to 3 s, faster than open loop",
             f"eq. 8 with the PI rises in {rise_c:.2f} s ({averaged:.2f} s with saturation and "
             f"the ringing averaged out) and settles in {settle_c:.1f} s (2 %), slower than open",
             {"rise_time_s": rise_c, "ring_averaged_rise_time_s": averaged,
              "overshoot": over_c, "settling_2_s": settle_c}),
    ]  # fmt: skip


def _closed_poles(kp: float, ki: float) -> tuple[float, float]:
    """Real pole, in 1/s, and damping ratio of the pair, of eq. 8 with a PI controller."""
    top = 0.5 * _STIFFNESS_PER_MASS
    poles = np.roots([1.0, _DAMPING_PER_MASS, _STIFFNESS_PER_MASS + top * kp, top * ki])
    pair = poles[np.argmax(poles.imag)]
    return float(poles[np.argmin(np.abs(poles.imag))].real), float(-pair.real / abs(pair))


def _loop() -> list[RecomputedRow]:
    real, damping = _closed_poles(_PI.kp, _PI.ki)
    p_alone, i_alone = _closed_poles(_PI.kp, 0.0)[1], _closed_poles(0.0, _PI.ki)[1]
    plant = margins(_EQ8, PidGains(1.0, 0.0), loop_delay_s=0.0, rate_hz=None)
    loop = margins(_EQ8, _PI, loop_delay_s=0.0, rate_hz=None)
    at = [item.omega_rad_s for item in loop.crossovers]
    return [
        _row("D6", "the P term shortens the rise time", "Kp raises the crossover",
             f"the slow real pole {real:.2f} 1/s ({-1.0 / real:.1f} s) comes from Ki; the pair's "
             f"damping falls from {_ZETA:.3f} to {damping:.3f}, through Ki ({i_alone:.3f} with Ki "
             f"alone, {p_alone:.3f} with Kp alone)",
             {"real_pole_per_s": real, "damping_ratio": damping,
              "damping_ratio_kp_alone": p_alone, "damping_ratio_ki_alone": i_alone}),
        _row("D7", "the crossover frequency increases", "at least unchanged",
             f"the upper one decreases from {plant.crossover_rad_s:.2f} to {at[-1]:.2f} rad/s (a "
             f"new one appears at {at[0]:.2f}); phase margin {loop.phase_margin_deg:.1f} deg, gain "
             f"margin {loop.gain_margin_db:.1f} dB, peak sensitivity {loop.peak_sensitivity:.1f}, "
             f"delay margin {loop.delay_margin_s * 1e3:.1f} ms",
             {"plant_crossover_rad_s": plant.crossover_rad_s, "crossover_rad_s": at[-1],
              "low_crossover_rad_s": at[0], "phase_margin_deg": loop.phase_margin_deg,
              "gain_margin_db": loop.gain_margin_db, "peak_sensitivity": loop.peak_sensitivity,
              "delay_margin_s": loop.delay_margin_s}),
    ]  # fmt: skip


def _maps() -> list[RecomputedRow]:
    zero_v = float(EQ_4.voltage_v(0.0)) * _AMPLIFIER
    at_baseline, down, up = (float(x) for x in EQ_4.strain(np.array([5e3, 2e3, 8e3]) / _AMPLIFIER))
    slopes = 1.0 / EQ_4.slope_v(np.linspace(_LIMITS.low, _LIMITS.high, 1001))
    spread = float(slopes.max() / slopes.min())
    return [
        _row("D8", "static gain of eq. 8", "1/2",
             f"eq. 4 was fitted to make strain equal to desired strain: 1, not "
             f"{_EQ8.static_gain:g}",
             {"static_gain_eq8": _EQ8.static_gain, "static_gain_eq4": 1.0}),
        _row("D9", "voltage of zero strain", "5 kV",
             f"eq. 4 gives {zero_v / 1e3:.2f} kV, and {at_baseline:.4f} strain at 5 kV",
             {"zero_strain_v": zero_v, "strain_at_5_kv": at_baseline}),
        _row("D10", "chirp of 3 kV to either side of the baseline", "about the baseline",
             f"{down:.3f} to {up:+.3f} strain, {-up / down:.1f} to 1; the local gain varies "
             f"{spread:.1f} times over the saturation range",
             {"strain_low": down, "strain_high": up, "asymmetry": -up / down,
              "gain_ratio": spread}),
    ]  # fmt: skip


def _capacitance() -> list[RecomputedRow]:
    relative = [(strain - _EQ5.offset) / _EQ5.slope for strain in (_LIMITS.low, 0.0, _LIMITS.high)]
    plate_f = [3.0 * _EPSILON_0_F_M * area_m2 / gap_m
               for area_m2, gap_m in ((0.06 * 0.04, 3e-4), (0.19 * 0.10, 1e-4))]  # fmt: skip
    omega = _TURN * _CARRIER_HZ
    products = [1.0 / (omega * 10.0 * value * 2.5e6) for value in relative]
    milder = [1e3 * value for value in products]
    slope = 1.0 / -_EQ5.offset
    step_v = 20.0 / 2**16
    return [
        _row("D11", "relative capacitance", "a capacitance",
             f"{relative[1]:.1e} at zero strain; parallel plates of 60 x 40 mm at 0.3 mm to "
             f"190 x 100 mm at 0.1 mm give {plate_f[0] * 1e9:.1f} to {plate_f[1] * 1e9:.1f} nF: "
             "arbitrary units",
             {"relative_capacitance": relative[1], "plate_low_f": plate_f[0],
              "plate_high_f": plate_f[1]}),
        _row("D11b", "eqs. 2, 3 and 5 together", "scale factors 2.5e6 and 10",
             f"eq. 5's {relative[0]:.1e} to {relative[2]:.1e} needs |Vv/Vc| sin|phi| of "
             f"{products[2]:.1e} to {products[0]:.1e}: below one step of the converter unless Vc "
             f"exceeds {step_v / products[0]:.1f} V; 2.5e3 would need {milder[2]:.2f} to "
             f"{milder[0]:.2f}",
             {"product_low": products[2], "product_high": products[0], "milder_low": milder[2],
              "milder_high": milder[0], "converter_step_v": step_v,
              "least_current_monitor_v": step_v / products[0]}),
        _row("D12", "capacitance linear in strain", "a straight line",
             f"d ln C / d strain = {slope:.1f}; pure shear at constant volume gives 2, equal "
             f"biaxial 4", {"log_slope": slope, "range_ratio": relative[2] / relative[0]}),
    ]  # fmt: skip


def _bench() -> list[RecomputedRow]:
    return [_filter_row(), _stiffness_row(), _chirp_row(), _delay_row(), _sensing_row()]


def _filter_row() -> RecomputedRow:
    from scipy.signal import butter, freqs

    b, a = butter(4, _TURN * 2001.0, analog=True)
    _, response = freqs(b, a, _TURN * np.array([1900.0, _CARRIER_HZ, 2100.0]))
    gain_db = 20.0 * np.log10(np.abs(response))
    phase_deg = math.degrees(float(np.angle(response[1])))
    phase_deg -= 360.0 if phase_deg > 0.0 else 0.0
    return _row("D13", "the low-pass removes noise", "4th-order Butterworth at 2,001 Hz",
                f"its corner is at the carrier: {gain_db[1]:.1f} dB, {phase_deg:.0f} deg, and "
                f"{gain_db[0]:.1f} and {gain_db[2]:.1f} dB 100 Hz to either side; equal on both "
                f"channels, so the capacitance is unaffected",
                {"carrier_db": float(gain_db[1]), "carrier_deg": phase_deg,
                 "lower_side_db": float(gain_db[0]), "upper_side_db": float(gain_db[2])},
                )  # fmt: skip


def _stiffness_row() -> RecomputedRow:
    stiffness = [_MASS_KG * (turn * 5.11) ** 2 for turn in (1.0, _TURN)]
    sag = [_MASS_KG * _GRAVITY_M_S2 / k for k in stiffness]
    square_per_v2 = _agreeing()[3].numbers["square_per_v2"] / _AMPLIFIER**2
    # F = V^2/2 dC/dx with d ln C / d strain = 2 and plates of W x L and gap t: the strain b V^2
    # requires k = 2 eps W / (2 b t L).
    electric = [3.0 * _EPSILON_0_F_M * width / (square_per_v2 * gap * length)
                for width, gap, length in ((0.06, 3e-4, 0.10), (0.19, 1e-4, 0.04))]  # fmt: skip
    return _row("D14", "0.25 kg at the natural frequency", "5.1 rad/s",
                f"stiffness {stiffness[0]:.1f} N/m, sag {sag[0] * 1e3:.0f} mm; at 5.1 Hz "
                f"{stiffness[1]:.0f} N/m, {sag[1] * 1e3:.1f} mm; eq. 4's own electromechanical "
                f"stiffness is {electric[0]:.0f} to {electric[1]:.0f} N/m",
                {"stiffness_rad_n_m": stiffness[0], "sag_rad_m": sag[0],
                 "stiffness_hz_n_m": stiffness[1], "sag_hz_m": sag[1],
                 "electric_low_n_m": electric[0], "electric_high_n_m": electric[1]},
                )  # fmt: skip


def _chirp_row() -> RecomputedRow:
    low_hz, high_hz, length_s = 0.1, 10.0, 10.0
    slope = (high_hz - low_hz) / length_s
    reached = [(f - low_hz) / slope for f in (_WN_RAD_S / _TURN, _WN_RAD_S)]
    cycles = [low_hz * t + 0.5 * slope * t * t for t in reached]
    return _row("D15", "the chirp identifies the resonance", "0.81 Hz",
                f"0.81 Hz is reached at {reached[0]:.2f} s, after {cycles[0]:.2f} of a cycle; "
                f"5.11 Hz at {reached[1]:.2f} s, in mid-sweep, after {cycles[1]:.0f} cycles",
                {"reached_rad_s": reached[0], "cycles_rad": cycles[0],
                 "reached_hz_s": reached[1], "cycles_hz": cycles[1]},
                )  # fmt: skip


def _delay_row() -> RecomputedRow:
    fast = [Plant(0.5, _TURN * _WN_RAD_S, zeta) for zeta in (_ZETA, 0.13)]
    margin = [margins(p, _PI, loop_delay_s=0.0, rate_hz=None).delay_margin_s for p in fast]
    slow = margins(_EQ8, _PI, loop_delay_s=0.0, rate_hz=None).delay_margin_s
    least, most = 0.005 + 0.005 + 0.005, 0.005 + 0.005 + 0.010
    return _row("D16", "100 Hz loop", "updates every 10 ms",
                f"block average, hold and input/output add up to {least * 1e3:.0f} to "
                f"{most * 1e3:.0f} ms; the delay margin is {slow * 1e3:.1f} ms at 5.1 rad/s, but "
                f"{margin[0] * 1e3:.1f} to {margin[1] * 1e3:.1f} ms at 5.1 Hz",
                {"delay_low_s": least, "delay_high_s": most, "delay_margin_rad_s": slow,
                 "delay_margin_hz_low_s": margin[0], "delay_margin_hz_high_s": margin[1]},
                )  # fmt: skip


def _sensing_row() -> RecomputedRow:
    harmonic = _CARRIER_HZ / 100.0
    skew_s = 1.0 / 400e3
    skew_deg = 360.0 * _CARRIER_HZ * skew_s
    return _row("D17", "sensing at 2 kHz with a 100 Hz staircase", "separate signals",
                f"2 kHz is harmonic {harmonic:g} of the staircase: each step leaks into the "
                f"carrier's bin; multiplexed channels are {skew_s * 1e6:.1f} us apart, "
                f"{skew_deg:.1f} deg",
                {"harmonic": harmonic, "skew_s": skew_s, "skew_deg": skew_deg},
                )  # fmt: skip


def _pairs(name: str, values: list[float]) -> dict[str, float]:
    return {f"{name}_{index}": value for index, value in enumerate(values, 1)}


def _row(
    row_id: str,
    claim: str,
    paper: str,
    recomputed: str,
    numbers: Mapping[str, float],
    *,
    agrees: bool = False,
) -> RecomputedRow:
    verdict = "agrees" if agrees else "disagrees"
    plain = {name: float(value) for name, value in numbers.items()}
    return RecomputedRow(row_id, claim, paper, recomputed, plain, verdict)
