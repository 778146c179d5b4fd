"""The table of all results: name, unit, printed value, recomputed value."""

from __future__ import annotations

import functools
import math
from dataclasses import replace

from haselab.control import PidGains, margins
from haselab.models.plant import Plant
from haselab.study.paper.paper_check import EQ_4, paper_step
from haselab.study.quantity import TOLERANCE, Quantity

__all__ = ["paper_rows", "quantities"]

_PAPER_WN_RAD_S = math.sqrt(26.14)
_PAPER = Plant(0.5, _PAPER_WN_RAD_S, 0.93 / (2.0 * _PAPER_WN_RAD_S))
_PAPER_PI = PidGains(0.85, 1.5)
_RISE = "ringing averaged out; not well defined if the overshoot with ringing is large"
_ERROR = "fraction of the step; negative: beyond the reference"
_CALIBRATED_ONCE = (
    "The interval includes differences between the trials, but not the error of the chip's "
    "calibration, which a run makes once: 0.1 % of capacitance corresponds to 0.008 of a step of "
    "0.04 and to 0.02 of one of 0.014"
)
_OUTER = "linear region and reach of the run"
_IN_HZ = "printed in rad/s; the same number in Hz is {:.1f} rad/s"


# Names without the paper's equations, for other studies.
_PLAIN = {
    "S10.rise_printed_chain": "rise time, PI with phase-based sensing",
    "S10.error_printed_chain": "steady-state error, PI with phase-based sensing",
    "S15.slope": "strain over relative capacitance, slope",
    "S15.offset": "strain over relative capacitance, offset",
    "S15.slope_at_strain": "strain over relative capacitance, slope, edges averaged by strain",
    "S15.offset_at_strain": "strain over relative capacitance, offset, edges averaged by strain",
    "S19.omega_0": "free response, natural frequency",
    "S19.eq6_omega_d": "free response without a creep term, damped frequency",
    "S19.eq6_decay": "free response without a creep term, decay",
    "S19.eq6_omega_0": "free response without a creep term, natural frequency",
    "S19.eq6_rms": "free response without a creep term, rms residual",
    "S20.eq8_gain": "plant without a slow branch, gain",
    "S20.eq8_omega_n": "plant without a slow branch, natural frequency",
    "S20.eq8_zeta": "plant without a slow branch, damping ratio",
}


@functools.cache
def _paper_numbers() -> dict[str, float]:
    """Margins and rise times of the printed plant and controller, and the range of eq. 4."""
    loop = margins(_PAPER, _PAPER_PI, loop_delay_s=0.0, rate_hz=None)
    plant = margins(_PAPER, PidGains(1.0, 0.0), loop_delay_s=0.0, rate_hz=None)
    opened, closed = (paper_step(gains) for gains in (None, _PAPER_PI))
    at_low, at_high = (float(strain) for strain in EQ_4.strain([0.0, 2.0]))
    return {
        "attenuation": 1.0 / math.sqrt(1.0 + (2000.0 / 2001.0) ** 8),
        "phase": loop.phase_margin_deg,
        "gain": loop.gain_margin_db,
        "delay": loop.delay_margin_s,
        "crossover": loop.crossovers[-1].omega_rad_s,
        "plant_crossover": plant.crossover_rad_s,
        "rise_open": opened.rise_time_s,
        "rise_open_raw": opened.raw_rise_time_s,
        "rise": closed.rise_time_s,
        "rise_raw": closed.raw_rise_time_s,
        "at_low": at_low,
        "at_high": at_high,
    }


def _sensing() -> dict[str, Quantity]:
    eq_2 = "with the scale 2.5e3 in eq. 2 (D11b)"
    trade = "the coefficients are correlated; S14.rms_difference compares the curves"
    loop = _paper_numbers()
    return {
        "S6.carrier_gain": Quantity(
            "low-pass gain at the carrier frequency",
            "",
            recomputed=loop["attenuation"],
            paper_note="D13",
            reference_only=True,
        ),
        "S7.periods": Quantity(
            "carrier periods in a buffer",
            "",
            20.0,
            setting="carrier and buffer of the study",
            reference_only=True,
        ),
        "S8.phase": Quantity(
            "phase, paper's sensing chain minus lock-in", "rad", reference_only=True
        ),
        "S8.difference_rising": Quantity(
            "capacitance, relative difference of the paper's "
            "sensing chain from the lock-in, rising drive",
            "",
            reference_only=True,
        ),
        "S8.difference_falling": Quantity(
            "capacitance, relative difference of the paper's "
            "sensing chain from the lock-in, falling drive",
            "",
            reference_only=True,
        ),
        "S10.rise_printed_chain": Quantity(
            "rise time, PI with the paper's sensing chain",
            "s",
            paper_note="the paper's 2.5 to 3 s are compared in S24.rise_closed; a larger carrier, "
            "because the steps of the output leak into a small one (D17)",
        ),
        "S10.error_printed_chain": Quantity(
            "steady-state error, PI with the paper's sensing chain",
            "",
            note=_ERROR,
            paper_note="uses the straight line of eq. 5; the other loops use the triangle's map",
        ),
        "S13.residual_first": Quantity(
            "residual strain after the first cycle", "", paper_note="paper: never returns to zero"
        ),
        "S13.peak_drift": Quantity(
            "strain farthest from the start of its cycle, last cycle minus first one used",
            "",
            paper_note="paper: cycles 2 to 5 are repeatable",
        ),
        "S13.residual_drift": Quantity("residual strain, last cycle minus first one used", ""),
        "S14.a1": Quantity("voltage map, a1", "V", 1.324, paper_note=trade),
        "S14.b1": Quantity("voltage map, b1", "", 3.124, paper_note=trade),
        "S14.a2": Quantity("voltage map, a2", "V", -0.2805, paper_note=trade),
        "S14.b2": Quantity("voltage map, b2", "", -26.92, paper_note=trade),
        "S14.zero": Quantity(
            "voltage map at zero strain",
            "V",
            recomputed=float(EQ_4.voltage_v(0.0)),
            paper_note="recomputed: eq. 4 (D9)",
        ),
        "S14.rms_difference": Quantity(
            "voltage map, rms difference from eq. 4", "", 0.0, within=TOLERANCE, reference_only=True
        ),
        "S15.slope": Quantity(
            "eq. 5, slope",
            "",
            4.923e6,
            paper_note=f"edges averaged over time, as in the paper; {eq_2}",
            planar_only=True,
        ),
        "S15.offset": Quantity("eq. 5, offset", "", -0.276, planar_only=True),
        "S15.slope_at_strain": Quantity(
            "eq. 5, slope, edges averaged at equal strain", "", paper_note=eq_2, planar_only=True
        ),
        "S15.offset_at_strain": Quantity(
            "eq. 5, offset, edges averaged at equal strain", "", planar_only=True
        ),
    }


def _statics() -> dict[str, Quantity]:
    loop = _paper_numbers()
    return {
        "S16.mu": Quantity("Arruda-Boyce shear modulus", "Pa"),
        "S16.lambda_m": Quantity("Arruda-Boyce locking stretch", ""),
        "S17.region_low": Quantity("longest linear region, from", ""),
        "S17.region_high": Quantity("longest linear region, to", ""),
        "S18.baseline": Quantity(
            "baseline voltage", "V", 1.0, paper_note="at the DAQ output; 1 V is the paper's 5 kV"
        ),
        "S18.centre_offset": Quantity(
            "distance of the operating point from the linear region's centre, fraction of its "
            "half-width",
            "",
            0.0,
            within=TOLERANCE,
        ),
        "S18.rest": Quantity(
            "strain at rest at the baseline voltage",
            "",
            note="zero strain is the mean length of the triangle's edges at that voltage",
        ),
        "S18.strain_min": Quantity(
            "smallest strain in the triangle",
            "",
            recomputed=loop["at_low"],
            paper_note="recomputed: eq. 4 at 0 V",
        ),
        "S18.strain_max": Quantity(
            "largest strain in the triangle",
            "",
            recomputed=loop["at_high"],
            paper_note="recomputed: eq. 4 at 2 V",
        ),
    }


def _dynamics() -> dict[str, Quantity]:
    hz = 2.0 * math.pi
    damped = _IN_HZ.format(5.1 * hz)
    by_eq_7 = (math.hypot(5.1, 3.6), math.hypot(5.1, 4.2))
    natural = _IN_HZ.format(5.11 * hz)
    return {
        "S19.omega_d": Quantity("free response, damped frequency", "rad/s", 5.1, paper_note=damped),
        "S19.decay_1": Quantity("free response, decay of the positive envelope", "1/s", 3.6),
        "S19.decay_2": Quantity("free response, decay of the negative envelope", "1/s", 4.2),
        "S19.omega_0": Quantity("natural frequency by eq. 7", "rad/s", 5.1, by_eq_7, damped),
        "S19.eq6_omega_d": Quantity(
            "eq. 6 alone, damped frequency", "rad/s", 5.1, paper_note=damped, same_as="S19.omega_d"
        ),
        "S19.eq6_decay": Quantity("eq. 6 alone, decay", "1/s", (3.6, 4.2), same_as="S19.decay_1"),
        "S19.eq6_decay_1": Quantity(
            "exponential through the positive peaks, decay", "1/s", 3.6, same_as="S19.decay_1"
        ),
        "S19.eq6_decay_2": Quantity(
            "exponential through the negative peaks, decay", "1/s", 4.2, same_as="S19.decay_2"
        ),
        "S19.eq6_omega_0": Quantity(
            "eq. 6 alone, natural frequency by eq. 7",
            "rad/s",
            5.1,
            by_eq_7,
            damped,
            same_as="S19.omega_0",
        ),
        "S19.eq6_rms": Quantity("rms residual of eq. 6 alone", "m"),
        "S19.chirp_difference": Quantity(
            "natural frequency, free response over chirp, minus 1",
            "",
            0.0,
            paper_note="paper: the free response validates the chirp (D2)",
            within=TOLERANCE,
        ),
        "S20.gain": Quantity(
            "plant, gain of the fast mode", "", 0.5, paper_note="eq. 4 makes it 1 (D8)"
        ),
        "S20.omega_n": Quantity(
            "plant, natural frequency", "rad/s", 5.11, _PAPER_WN_RAD_S, natural
        ),
        "S20.zeta": Quantity("plant, damping ratio", "", 0.09, _PAPER.damping_ratio),
        "S20.delay": Quantity(
            "plant, own delay",
            "s",
            paper_note="eq. 8 has none",
            note="fitted in addition to the loop's delay; margins include it if it is above 0",
        ),
        "S20.slow_gain": Quantity(
            "plant, gain of the slow branch",
            "",
            paper_note="a first-order term in addition to eq. 8: the creep in a step",
        ),
        "S20.slow_tau": Quantity("plant, time constant of the slow branch", "s"),
        "S20.feedthrough": Quantity(
            "feedthrough: fraction of the sensed strain that follows the voltage at once",
            "",
            paper_note="0 for a capacitance that depends on the length alone",
        ),
        "S20.eq8_gain": Quantity(
            "eq. 8 alone, gain", "", 0.5, note="without a slow branch", same_as="S20.gain"
        ),
        "S20.eq8_omega_n": Quantity(
            "eq. 8 alone, natural frequency",
            "rad/s",
            5.11,
            _PAPER_WN_RAD_S,
            natural,
            same_as="S20.omega_n",
        ),
        "S20.eq8_zeta": Quantity(
            "eq. 8 alone, damping ratio", "", 0.09, _PAPER.damping_ratio, same_as="S20.zeta"
        ),
    }


def _loops() -> dict[str, Quantity]:
    loop = _paper_numbers()
    return {
        "S21.kp": Quantity("PI, proportional gain used", "", 0.85, setting="scaled (D8)"),
        "S21.ki": Quantity("PI, integral gain used", "1/s", 1.5, setting="scaled (D8)"),
        "S21.phase_margin": Quantity(
            "PI, phase margin",
            "deg",
            recomputed=loop["phase"],
            paper_note="recomputed: without delay",
        ),
        "S21.gain_margin": Quantity(
            "PI, gain margin",
            "dB",
            recomputed=loop["gain"],
            paper_note="recomputed: without delay",
        ),
        "S21.delay": Quantity(
            "delay of the loop including half a hold, without the plant's own delay (S20.delay)",
            "s",
            recomputed=(0.015, 0.020),
            paper_note="recomputed: D16",
        ),
        "S21.delay_margin": Quantity(
            "PI, delay margin",
            "s",
            recomputed=loop["delay"],
            paper_note="recomputed: without delay",
        ),
        "S21.crossover": Quantity(
            "PI, upper crossover",
            "rad/s",
            recomputed=loop["crossover"],
            paper_note="paper: at least that of the plant alone (D7)",
        ),
        "S21.plant_crossover": Quantity(
            "plant alone, upper crossover", "rad/s", recomputed=loop["plant_crossover"]
        ),
        "S21.printed_gain_margin": Quantity(
            "printed gains on this plant, gain margin",
            "dB",
            paper_note="the printed gains, not scaled (D8); negative: unstable",
            reference_only=True,
        ),
        "S21.delayed_gain_margin": Quantity(
            "scaled PI with extra delay, gain margin",
            "dB",
            note="below 2 dB the trial uses lower gains; negative: unstable",
        ),
        "S22.saturation_low": Quantity(
            "lower saturation limit of the controller output",
            "",
            -0.05,
            setting="limits of the study",
        ),
        "S22.saturation_high": Quantity(
            "upper saturation limit of the controller output",
            "",
            0.1,
            setting="limits of the study",
        ),
        "S22.saturated_fraction": Quantity("saturating trial, fraction of time at the limit", ""),
        "S22.recovery_time": Quantity(
            "saturating trial, time to leave the limit",
            "s",
            note="after the reference returns; shows the anti-windup",
        ),
        "S24.rise_open": Quantity(
            "rise time, open loop",
            "s",
            (6.0, 8.0),
            loop["rise_open"],
            "eq. 8 alone is then an ideal step, hence 0 s (D4)",
            note="ringing averaged out: from the response without its fast oscillation",
        ),
        "S24.rise_open_raw": Quantity(
            "rise time, open loop, ringing included",
            "s",
            recomputed=loop["rise_open_raw"],
            paper_note="recomputed: eq. 8 alone (D4)",
        ),
        "S24.rise_closed": Quantity(
            "rise time, PI",
            "s",
            (2.5, 3.0),
            loop["rise"],
            "recomputed: eq. 8 alone (D5)",
            note="ringing averaged out",
        ),
        "S24.rise_closed_raw": Quantity(
            "rise time, PI, ringing included",
            "s",
            recomputed=loop["rise_raw"],
            paper_note="recomputed: eq. 8 alone (D5)",
        ),
        "S24.error_open": Quantity(
            "steady-state error, open loop",
            "",
            note=_ERROR,
        ),
        "S24.error_closed": Quantity("steady-state error, PI", "", note=_ERROR),
        "S24.overshoot_closed": Quantity("overshoot, PI, ringing averaged out", ""),
        "S24.rise_delayed": Quantity(
            "rise time, PI with extra delay",
            "s",
            paper_note="the paper has no such trial",
        ),
        "S24.error_delayed": Quantity("steady-state error, PI with extra delay", "", note=_ERROR),
        "S25.kp": Quantity("PID, proportional gain", ""),
        "S25.ki": Quantity("PID, integral gain", "1/s"),
        "S25.kd": Quantity("PID, derivative gain", "s"),
        "S25.derivative_filter": Quantity("PID, time constant of the derivative's filter", "s"),
        "S25.phase_margin": Quantity("PID, phase margin", "deg"),
        "S25.gain_margin": Quantity("PID, gain margin", "dB"),
        "S25.rise_pid": Quantity("rise time, PID", "s", note=_RISE),
        "S25.overshoot_pid": Quantity("overshoot, PID, ringing included", ""),
        "S25.error_pid": Quantity("steady-state error, PID", "", note=_ERROR),
        "S25.rise_own": Quantity("rise time, controller of [control] kind", "s", note=_RISE),
        "S25.overshoot_own": Quantity(
            "overshoot, controller of [control] kind, ringing included", ""
        ),
        "S25.error_own": Quantity(
            "steady-state error, controller of [control] kind", "", note=_ERROR
        ),
        "S25.rise_observer": Quantity(
            "rise time, observer with the physical model", "s", note=_RISE
        ),
        "S25.overshoot_observer": Quantity("overshoot, observer, ringing included", ""),
        "S25.error_observer": Quantity("steady-state error, observer", "", note=_ERROR),
        "S26.rise": Quantity("rise time, loop on the chip", "s", note=_RISE),
        "S26.settling": Quantity("settling time, loop on the chip", "s"),
        "S26.overshoot": Quantity("overshoot, loop on the chip, ringing included", ""),
        "S26.error": Quantity(
            "steady-state error, loop on the chip",
            "",
            note=f"{_ERROR}. {_CALIBRATED_ONCE}",
        ),
        "S26.phase_margin": Quantity("loop on the chip, phase margin", "deg"),
        "S27.mass_error_own": Quantity("sensed minus hung mass, the mass of the study", "kg"),
        "S27.mass_error_other": Quantity(
            "sensed minus hung mass, another mass",
            "kg",
            note="the controller was not informed of this mass",
        ),
        "S27.rise_own": Quantity("rise time, hybrid", "s", note=_RISE),
        "S27.overshoot_own": Quantity("overshoot, hybrid, ringing included", ""),
        "S27.error_own": Quantity("steady-state error, hybrid", "", note=_ERROR),
        "S27.rise_other": Quantity("rise time, hybrid with the other mass", "s", note=_RISE),
        "S27.overshoot_other": Quantity(
            "overshoot, hybrid with the other mass, ringing included", ""
        ),
        "S27.error_other": Quantity(
            "steady-state error, hybrid with the other mass", "", note=_ERROR
        ),
        "S28.rise": Quantity("rise time, miniature bench", "s"),
        "S28.settling": Quantity("settling time, miniature bench", "s"),
        "S28.overshoot": Quantity("overshoot, miniature bench, noise included", ""),
        "S28.error": Quantity(
            "steady-state error, miniature bench",
            "",
            note=f"{_ERROR}. {_CALIBRATED_ONCE}",
        ),
        "S28.phase_margin": Quantity(
            "miniature bench, phase margin",
            "deg",
            note="of the plant at the study's operating point",
        ),
        "S30.lowest": Quantity("lowest strain of the steps", "", setting=_OUTER),
        "S30.highest": Quantity("highest strain of the steps", "", setting=_OUTER),
        "S30.error": Quantity("largest strain error at rest, outside of the linear region", ""),
        "S30.overshoot": Quantity(
            "largest overshoot of a step outside of the linear region",
            "",
            note="hybrid; camera noise included",
        ),
    }


@functools.cache
def quantities() -> dict[str, Quantity]:
    """The table of all results, by id."""
    rows = {**_sensing(), **_statics(), **_dynamics(), **_loops()}
    return {key: replace(row, plain_name=_PLAIN.get(key, "")) for key, row in rows.items()}


def paper_rows(*prefixes: str) -> dict[str, Quantity]:
    """Select results of the reference study, by id.

    Args:
        prefixes: of the ids, such as `S19.`.
    Example:
        >>> list(paper_rows("S16."))
        ['S16.mu', 'S16.lambda_m']
    """
    return {key: row for key, row in quantities().items() if key.startswith(prefixes)}
