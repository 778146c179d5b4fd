"""Scores of many candidate controllers: distance of each from its specification."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.control.ensemble import trace_ensemble
from haselab.control.gains import PidGains
from haselab.control.plants.general import AnyPlant, PlantScale
from haselab.control.plants.general_loops import (
    closed_loop_poles,
    loop_variants,
    plant_output,
    trace_general,
)
from haselab.control.reach import default_step
from haselab.control.ringing import Ringing
from haselab.control.simulate import LoopSetting
from haselab.control.spec import DesignSpec
from haselab.control.stability.grid import PlantGrid
from haselab.control.stability.plausible import Chance
from haselab.control.step_metrics import step_numbers
from haselab.models.plant import Plant

__all__ = ["CandidateScores", "Task", "plant_crossover", "score"]

_RISE_WEIGHT = 10.0  # a missed rise time has priority over missed margins
_MOST_SAMPLES = 250_000  # of one simulated step: 25 s at 10 kHz
_UNSTABLE = 1e3
_MET = 1e-9
_LARGEST_EXCESS = 1e12
_UNASKED = 2.0  # larger than any miss of a share
_SMALL_GAIN = 0.1  # a larger one may be that of a slow branch, whose resonance has a gain of 1
_NOISE_GAIN = 15.0  # default for a plant from strain to strain
_LONGEST_WINDOW = 250  # largest number of samples of half a period of ringing


@dataclass(frozen=True)
class Task:
    """A plant with its loop setting and its specification.

    Args:
        plant: nominal plant.
        setting: rate, measurement delay and saturation.
        spec: specification.
        chance: plausible plants, a share of which has to keep the margins; None: not required.
    """

    plant: AnyPlant
    setting: LoopSetting
    spec: DesignSpec
    chance: Chance | None = None

    def __post_init__(self) -> None:
        samples = self.horizon_s() * self.setting.rate_hz
        if not 10.0 <= samples <= _MOST_SAMPLES:
            raise InputError(
                f"rate_hz = {self.setting.rate_hz:g} Hz: the simulated step of "
                f"{self.horizon_s():.3g} s has {samples:.3g} samples, but the search needs at "
                f"least 10 and at most {_MOST_SAMPLES}. Change the rate."
            )

    def variants(self) -> tuple[tuple[AnyPlant, LoopSetting], ...]:
        """The nominal plant and loop, and others that the controller has to work with.

        The natural frequency is varied to both sides, and the feedthrough to its ends.
        """
        return loop_variants(self.plant, self.setting, self.spec.frequency_spread)

    @cached_property
    def step(self) -> float:
        """Reference step of the simulated experiments."""
        if self.spec.step is None:
            return default_step(self.plant, self.setting.saturation)
        return self.spec.step

    @cached_property
    def noise_gain(self) -> float:
        """Largest change of the controller's output if one measurement changes by 1."""
        if self.spec.noise_gain is not None:
            return self.spec.noise_gain
        gain = abs(PlantScale.of(self.plant).gain)
        return _NOISE_GAIN / gain if 0.0 < gain < _SMALL_GAIN else _NOISE_GAIN

    def horizon_s(self) -> float:
        """Length of the simulated step, in s: several rise times, and the slow modes."""
        rise = self.spec.rise_time_s or 0.0
        if isinstance(self.plant, Plant):
            slow = [mode.time_constant_s for mode in self.plant.slow_modes]
            ring = 30.0 / self.plant.natural_frequency_rad_s
        else:
            scale = PlantScale.of(self.plant)
            slow, ring = [1.0 / scale.slow_rad_s], 30.0 / scale.fast_rad_s
        return min(max(8.0 * rise, ring, 4.0 * max(slow, default=0.0), 2.0), max(25.0, ring))


@dataclass(frozen=True)
class CandidateScores:
    """Performance of candidates, and their shortfalls.

    Args:
        miss: weighted sum of the relative shortfalls, 0 if all demands are met. Shape `(C,)`.
        peak_sensitivity: worst over the plants. Shape `(C,)`.
        low_frequency_gain: integral gain, in 1/s. Shape `(C,)`.
    """

    miss: NDArray[np.float64]
    peak_sensitivity: NDArray[np.float64]
    low_frequency_gain: NDArray[np.float64]


def score(candidates: Sequence[PidGains], task: Task) -> CandidateScores:
    """Margins on a grid and a simulated step, for each candidate on each plant of the spread.

    Args:
        candidates: controllers. Length `C`.
        task: plant, setting, specification.
    Returns:
        Scores, in the order of the candidates.
    """
    variants = task.variants()
    spec = task.spec
    miss = np.zeros(len(candidates))
    peak = np.zeros(len(candidates))
    for plant, setting in variants:
        found = PlantGrid.of(plant, setting).margins(candidates)
        missed = _short(found.phase_margin_deg, spec.phase_margin_deg)
        missed += _short(found.gain_margin_db, spec.gain_margin_db)
        missed += _over(found.peak_sensitivity, spec.peak_sensitivity)
        if spec.keep_crossover:
            missed += _short(found.crossover_rad_s, plant_crossover(plant, setting))
        missed[~found.stable] = _UNSTABLE
        miss, peak = np.maximum(miss, missed), np.maximum(peak, found.peak_sensitivity)
    jump = [gains.jump_gain(task.setting.rate_hz) for gains in candidates]
    miss = miss + _over(np.array(jump), task.noise_gain)
    calm = np.flatnonzero(miss < 0.5 * _UNSTABLE)
    if calm.size:
        miss[calm] += _step_miss([candidates[index] for index in calm.tolist()], variants, task)
    if task.chance is not None:  # evaluated last, and only for loops that meet everything else
        good = miss <= _MET
        kept = [gains for gains, met in zip(candidates, good.tolist(), strict=True) if met]
        miss[~good] += _UNASKED
        miss[good] += task.chance.miss(kept, task.spec)
    return CandidateScores(miss, peak, np.array([gains.ki for gains in candidates]))


def _short(value: NDArray[np.float64], least: float) -> NDArray[np.float64]:
    """Relative shortfall below `least`."""
    return np.maximum(0.0, 1.0 - np.nan_to_num(value, posinf=1e9) / max(least, 1e-9))


def _over(value: NDArray[np.float64], most: float) -> NDArray[np.float64]:
    """Relative excess over `most`; compressed beyond 10, so that large misses still count."""
    over = np.clip(value / max(most, 1e-9) - 1.0, 0.0, _LARGEST_EXCESS)
    return np.where(over > 10.0, 10.0 + 0.1 * np.log(np.maximum(over, 10.0) / 10.0), over)


def plant_crossover(plant: AnyPlant, setting: LoopSetting) -> float:
    """Highest frequency at which the plant's own gain is 1, in rad/s; 0 without one."""
    found = PlantGrid.of(plant, setting).margins([PidGains(1.0, 0.0)]).crossover_rad_s
    return float(found[0])


def _step_miss(
    candidates: Sequence[PidGains], variants: Sequence[tuple[AnyPlant, LoopSetting]], task: Task
) -> NDArray[np.float64]:
    """Relative misses of rise time, overshoot and error in the simulated step."""
    spec, setting = task.spec, task.setting
    reference = np.full(round(task.horizon_s() * setting.rate_hz), task.step)
    strains, poles = _traces(candidates, variants, reference)
    strains *= math.copysign(1.0, task.step)
    rings = [_lasting(row, setting.rate_hz) for row in poles]
    numbers = [_step_numbers(y, ring, task) for y, ring in zip(strains, rings, strict=True)]
    shape = (3, len(variants), len(candidates))
    rise, overshoot, error = np.array(numbers).T.reshape(shape)
    miss = _over(error.max(axis=0), spec.steady_state_error)
    if spec.rise_time_s is not None and spec.rise_time_tolerance is not None:
        off = np.abs(rise[0] / spec.rise_time_s - 1.0)  # for the nominal plant
        miss += _RISE_WEIGHT * np.minimum(10.0, np.maximum(0.0, off - spec.rise_time_tolerance))
    elif spec.rise_time_s is not None:
        miss += _over(rise.max(axis=0), spec.rise_time_s)
    if spec.overshoot is not None:
        miss += np.minimum(10.0, np.maximum(0.0, overshoot.max(axis=0) - spec.overshoot) / 0.1)
    return miss


def _traces(
    candidates: Sequence[PidGains],
    variants: Sequence[tuple[AnyPlant, LoopSetting]],
    reference: NDArray[np.float64],
) -> tuple[NDArray[np.float64], list[NDArray[np.complex128]]]:
    """Outputs and poles of every candidate on the first plant, then on the second, ...

    An output is that of the plant, with the delay of the measurement.
    """
    outputs, poles = [], []
    for plant, setting in variants:
        if isinstance(plant, Plant):
            plants = [plant] * len(candidates)
            traces = trace_ensemble(plants, candidates, reference, setting)
            measured, u = traces.measured.astype(float), traces.u.astype(float)
        else:
            measured, u = trace_general(plant, candidates, reference, setting)
        poles += list(closed_loop_poles(plant, candidates, setting))
        outputs.append(plant_output(plant, measured, u, setting))
    return np.concatenate(outputs), poles


def _step_numbers(
    measured: NDArray[np.float64], ring: Ringing | None, task: Task
) -> tuple[float, float, float]:
    """Rise time, overshoot over the reference, and error of a response in the step's direction."""
    if measured[-measured.size // 10 :].mean() <= 0.0:
        return 1e3, 1e3, 1e3
    step, rate_hz = abs(task.step), task.setting.rate_hz
    if ring is not None:  # a long period is averaged on fewer samples
        every = max(1, int(math.pi / ring.omega_rad_s * rate_hz / _LONGEST_WINDOW))
        measured, rate_hz = measured[::every], rate_hz / every
    numbers = step_numbers(measured, step, step, rate_hz=rate_hz, ringing=ring)
    overshoot = max(numbers.overshoot, float(measured.max()) / step - 1.0)
    return numbers.rise_time_s, overshoot, abs(numbers.steady_state_error)


def _lasting(poles: NDArray[np.complex128], rate_hz: float) -> Ringing | None:
    """The least damped pair of a sampled loop, if it rings for more than a period."""
    upper = poles[(poles.imag > 1e-9) & (np.abs(poles) < 1.0)]
    s = np.log(upper) * rate_hz
    if s.size == 0:
        return None
    worst = s[np.argmin(-s.real / s.imag)]
    ring = Ringing(float(worst.imag), float(-worst.real))
    return ring if ring.lasts and ring.omega_rad_s < 0.5 * math.pi * rate_hz else None
