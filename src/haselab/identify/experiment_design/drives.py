"""Drives that could be played next, inside the limits of the bench."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, LimitError
from haselab.models.voltage_plant import VoltagePlant
from haselab.signals import constant, linear_chirp, multisine, prbs, square

__all__ = ["BenchLimits", "DriveCandidate", "candidate_drives", "optimal_power"]

Floats = NDArray[np.float64]
_LEAD_S = 1.0  # at the baseline before a signal starts
_LEVELS = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1)  # of the largest amplitude
_SMALLER = 0.6  # a second amplitude, for a nonlinear actuator
_FLIPS_HZ = (0.2, 0.5, 2.0)
_LINES = 24  # of a multisine, spread
_CLOSE = 12  # near the resonance
_GUARD = 0.3  # of an optimal multisine's power spread evenly over all lines
_ROUNDS = 100  # of the multiplicative algorithm
_FASTEST = 4.0  # highest frequency over the natural frequency
_STEP = 1e-5


@dataclass(frozen=True)
class BenchLimits:
    """Limits that a drive has to respect.

    Args:
        low_v: lowest drive, in V; the polarity can alternate if it is below 0.
        high_v: highest drive, in V.
        slew_v_s: fastest change of the drive, in V/s.
        update_hz: update rate, in Hz.
        largest_output: how far the output may go from that at the baseline, in its unit.
    Raises:
        LimitError: an empty window, or a limit that is not above 0.
    """

    low_v: float
    high_v: float
    slew_v_s: float = math.inf
    update_hz: float = 100.0
    largest_output: float = math.inf

    def __post_init__(self) -> None:
        positive = (self.slew_v_s, self.update_hz, self.largest_output)
        if not (self.low_v < self.high_v and min(positive) > 0.0):
            raise LimitError(
                f"The limits of the bench are {self.low_v:g} to {self.high_v:g} V, "
                f"{self.slew_v_s:g} V/s, {self.update_hz:g} Hz and an output of "
                f"{self.largest_output:g}; the lower voltage must come first, and the other "
                "limits must be above 0."
            )

    @classmethod
    def of_amplifier(
        cls,
        window_v: tuple[float, float],
        amplifier_gain: float,
        slew_v_s: float,
        current_limit_a: float,
        capacitance_f: float,
        update_hz: float = 100.0,
    ) -> BenchLimits:
        r"""Limits of a drive whose amplifier charges a capacitance: $|dV/dt| \le I/C$.

        Args:
            window_v: lowest and highest drive, in V.
            amplifier_gain: V per V.
            slew_v_s: of the amplifier's output, in V/s.
            current_limit_a: of the amplifier, in A.
            capacitance_f: of the actuator and everything parallel to it, in F.
            update_hz: update rate, in Hz.
        Returns:
            Limits ahead of the amplifier.
        """
        fastest = min(slew_v_s, current_limit_a / capacitance_f) / amplifier_gain
        return cls(window_v[0], window_v[1], fastest, update_hz)


@dataclass(frozen=True)
class DriveCandidate:
    """A drive that could be played.

    Args:
        name: for tables.
        says: description in words.
        drive_v: one value per update, in V. Shape `(N,)`.
    """

    name: str
    says: str
    drive_v: Floats


# A drive as a function of its size, 0 to 1 of the largest amplitude.
Family = Callable[[float], DriveCandidate]


def candidate_drives(
    plant: VoltagePlant, limits: BenchLimits, duration_s: float, baseline_v: float, goal: str
) -> list[DriveCandidate]:
    """Step, chirp, multisines, pseudo-random and alternating drives.

    Args:
        plant: prior knowledge of the actuator; determines the frequencies.
        limits: of the bench.
        duration_s: of each drive, in s.
        baseline_v: drive at which the actuator has settled, in V.
        goal: name of the parameter for whose interval one multisine is optimised; any other word
            optimises it for all parameters.
    Returns:
        Candidates in up to two amplitudes, the larger at the limits; the polarity
        alternates only where the window allows it.
    Raises:
        InputError: a baseline outside the window or at 0 V, a drive that is too short.
    """
    lowest_v = max(limits.low_v, 0.0)
    if not lowest_v <= baseline_v <= limits.high_v or baseline_v == 0.0:
        raise InputError(
            f"baseline_v = {baseline_v:g} V; it must be above 0 V and within "
            f"[{lowest_v:g}, {limits.high_v:g}] V."
        )
    if not 10.0 <= duration_s * limits.update_hz <= 1e6:
        raise InputError(
            f"duration_s = {duration_s:g} s at {limits.update_hz:g} Hz; it must be 10 to a "
            "million updates."
        )
    families = _about_baseline(plant, limits, duration_s, baseline_v, goal)
    if limits.low_v < 0.0:
        families += _alternating(limits, duration_s, baseline_v)
    candidates: list[DriveCandidate] = []
    for family in families:
        kept: list[float] = []
        for level in _LEVELS:
            if kept and level > _SMALLER * kept[0] + 1e-9:
                continue
            drive = family(level)
            if _admissible(drive, plant, limits):
                candidates.append(drive)
                kept.append(level)
            if len(kept) == 2:
                break
    return candidates


def _admissible(drive: DriveCandidate, plant: VoltagePlant, limits: BenchLimits) -> bool:
    """Whether amplifier and actuator stay within their limits."""
    largest_v = float(np.abs(np.diff(drive.drive_v)).max(initial=0.0))
    if largest_v * limits.update_hz > limits.slew_v_s:
        return False
    if limits.largest_output == math.inf:
        return True
    time_s = np.arange(drive.drive_v.size) / limits.update_hz
    output = plant.simulate(drive.drive_v, limits.update_hz, time_s, limits.slew_v_s)
    return bool(np.abs(output).max() <= limits.largest_output)


def _about_baseline(
    plant: VoltagePlant, limits: BenchLimits, duration_s: float, baseline_v: float, goal: str
) -> list[Family]:
    """Drives of one polarity."""
    rate_hz = limits.update_hz
    natural_hz = plant.natural_frequency_rad_s / (2.0 * math.pi)
    highest_hz = min(_FASTEST * natural_hz, 0.4 * rate_hz)
    lead = constant(baseline_v, _LEAD_S, rate_hz)
    long_s = max(duration_s - _LEAD_S, 2.0 / rate_hz)
    reach_v = min(limits.high_v - baseline_v, baseline_v - max(limits.low_v, 0.0))

    def about(name: str, says: str, shape: Floats) -> Family:
        def at(level: float) -> DriveCandidate:
            size_v = level * reach_v
            drive_v = np.concatenate([lead, baseline_v + size_v * shape])
            return DriveCandidate(f"{name}, {size_v:.2g} V", says, drive_v)

        return at

    bit_s = max(round(0.2 / natural_hz * rate_hz), 1) / rate_hz
    lines_hz = _lines_hz(plant, long_s, highest_hz)
    if lines_hz.size == 0:
        raise InputError(
            f"duration_s = {duration_s:g} s has no whole period of a frequency up to "
            f"{highest_hz:.3g} Hz, the highest for this plant and update rate. Plan a longer drive."
        )
    power = optimal_power(plant, 2.0 * math.pi * lines_hz, baseline_v, goal)
    # For a linear plant as few lines as parameters are best; more lines guard against nonlinearity.
    power = (1.0 - _GUARD) * power + _GUARD / power.size
    lowest_hz = min(0.1, 0.1 * highest_hz)
    return [
        about(
            "step",
            "steps up and down twice, a quarter of the time each",
            square(2.0 / long_s, long_s, rate_hz),
        ),
        about(
            "chirp",
            f"sweeps up to {highest_hz:.3g} Hz",
            linear_chirp(lowest_hz, highest_hz, long_s, rate_hz),
        ),
        about("prbs", f"switches at random, at intervals of {bit_s:.2g} s or more",
              prbs(bit_s, long_s, rate_hz)),
        about(
            "multisine",
            f"excites {lines_hz.size} lines up to {highest_hz:.3g} Hz",
            multisine(lines_hz, long_s, rate_hz),
        ),
        about(
            "optimal multisine",
            f"excites {lines_hz.size} lines, the most informative ones strongest",
            multisine(lines_hz, long_s, rate_hz, power),
        ),
    ]  # fmt: skip


def _alternating(limits: BenchLimits, duration_s: float, baseline_v: float) -> list[Family]:
    """Hold, alternate the sign, rest, alternate again: separates creep with the voltage's sign."""
    rate_hz = limits.update_hz
    lead = constant(baseline_v, _LEAD_S, rate_hz)
    part_s = max(duration_s - _LEAD_S, 4.0 / rate_hz) / 4.0
    rest = constant(baseline_v, part_s, rate_hz)
    reach_v = min(limits.high_v, -limits.low_v)

    def alternation(flips_hz: float) -> Family:
        turns = square(flips_hz, part_s, rate_hz)

        def at(level: float) -> DriveCandidate:
            peak_v = level * reach_v
            return DriveCandidate(
                f"alternation {flips_hz:g} Hz, {peak_v:.2g} V",
                f"holds {peak_v:.3g} V, changes its sign {2 * flips_hz:g} times per second, rests "
                f"at {baseline_v:.3g} V, and changes its sign again",
                np.concatenate([lead, np.full(turns.size, peak_v), peak_v * turns, rest,
                                peak_v * turns]),
            )  # fmt: skip

        return at

    return [
        alternation(flips_hz)
        for flips_hz in _FLIPS_HZ
        if flips_hz * part_s >= 1.0 and flips_hz <= 0.5 * rate_hz
    ]


def _lines_hz(plant: VoltagePlant, period_s: float, highest_hz: float) -> Floats:
    """Multiples of the inverse period: logarithmically spaced, and denser near the resonance."""
    width = 3.0 * min(max(plant.damping_ratio, 0.01), 0.3)
    natural_hz = plant.natural_frequency_rad_s / (2.0 * math.pi)
    spread = np.geomspace(1.0 / period_s, highest_hz, _LINES)
    close = natural_hz * np.linspace(1.0 - width, 1.0 + width, _CLOSE)
    whole = np.unique(np.round(np.concatenate([spread, close]) * period_s))
    return np.asarray(whole[(whole >= 1.0) & (whole <= highest_hz * period_s)] / period_s)


def optimal_power(plant: VoltagePlant, omega_rad_s: Floats, baseline_v: float, goal: str) -> Floats:
    r"""Power of each multisine line that best identifies the linearised plant's parameters.

    $w_k \leftarrow w_k\, d_k^{\,1/2} / \sum_j w_j\, d_j^{\,1/2}$ with
    $d_k = c' F^{-1} F_k F^{-1} c$ for one parameter; $w_k\, \mathrm{tr}(F^{-1}F_k)/n$ for all.

    Args:
        plant: prior knowledge of the actuator.
        omega_rad_s: lines, in rad/s. Shape `(K,)`.
        baseline_v: operating point of the linearisation, in V.
        goal: name of the parameter; any other word means all.
    Returns:
        Powers that add up to one. Shape `(K,)`.
    Source: Fedorov, Theory of Optimal Experiments (1972); Titterington, Biometrika 62 (1975), 313.
    """
    names = (
        "natural_frequency_rad_s", "damping_ratio", "delay_s", "creep_share",
        "creep_time_constant_s",
    )  # fmt: skip
    here = plant.frequency_response(omega_rad_s, baseline_v)
    slopes = [here]
    for name in names:
        value = getattr(plant, name)
        moved = replace(plant, **{name: value + _STEP})
        slopes.append((moved.frequency_response(omega_rad_s, baseline_v) - here) / _STEP)
    wanted = np.array([abs(v).max() > 0.0 for v in slopes])
    s = np.stack([v / abs(v).max() for v, w in zip(slopes, wanted, strict=True) if w])
    information = np.einsum("ik,jk->kij", s, s.conj()).real
    kept = [n for n, w in zip(("gain_1", *names), wanted, strict=True) if w]
    power = np.full(omega_rad_s.size, 1.0 / omega_rad_s.size)
    for _ in range(_ROUNDS):
        total = np.einsum("k,kij->ij", power, information)
        inverse = np.linalg.pinv(total, rcond=1e-13, hermitian=True)
        if goal in kept:
            column = inverse[:, kept.index(goal)]
            gain = np.sqrt(np.einsum("i,kij,j->k", column, information, column))
        else:
            gain = np.einsum("ij,kji->k", inverse, information)
        power = power * gain / (power @ gain)
    return np.asarray(power)
