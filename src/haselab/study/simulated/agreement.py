"""Compare the chip's simulated step with the prediction of its actuator file, and say why."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import OperatingPoint, equilibrium_m, feedthrough, linearise
from haselab.base import LimitError, ResultError
from haselab.control import (
    DesignSpec,
    LoopSetting,
    PidGains,
    Saturation,
    simulate_loop,
)
from haselab.control.feedthrough import with_feedthrough
from haselab.control.plants.general_loops import loop_variants
from haselab.control.stability.margins import loop_margins
from haselab.firmware import CAPACITANCE_NOISE
from haselab.models.actuator.strain_map import LARGEST_FEEDTHROUGH, StrainMap
from haselab.models.rational import RationalModel
from haselab.rig.chip import ChipDesign
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.history import precondition
from haselab.rig.twin.twin_bench import GRAVITY_M_S2, TwinBench
from haselab.study.chip.loops import CHIP_DELAY_S, FAST, LoopRun, StepPlan, desktop_loop

__all__ = [
    "Agreement",
    "StepCase",
    "agreement_of",
    "check_stable",
    "largest_noise",
    "predicted_loop",
    "tolerance",
]

_FROM_S = -1.0  # of the step: from here on the responses are compared
_SAME_FEEDTHROUGH = 0.05
_SOFTENED = 0.01  # loss of stiffness that is a cause
_MAP_POINTS = 65  # voltages at which the strain map is checked
_CAPACITANCES = 10_001  # at which the ends of the step are searched
_UNUSUAL = 1e-3  # share of runs whose noise may be larger than tolerated
_DRAWS = 10  # of the noise, for its standard deviation
_FREQUENCIES = 5  # from the lowest to the highest that the design covers
_NOTHING = 1.0  # of the step: the deviation of a strain that does not move
_LIMITING = 0.5  # of the deviation: what is left without the drive's rate limit if it is a cause


@dataclass(frozen=True)
class StepCase:
    """A step with a PID, and the twin on which it is simulated.

    Args:
        design: model, maps and demands of the actuator file.
        gains: of the PID.
        config: of the twin.
        plan: of the step.
        seed: of the twin's noise.
    """

    design: ChipDesign
    gains: PidGains
    config: TwinConfig
    plan: StepPlan
    seed: int

    @property
    def spread(self) -> float:
        """Error of the natural frequency that the design covers, as a fraction."""
        controller = self.design.tables.controller
        demands = DesignSpec.from_mapping({} if controller is None else controller.demands)
        return demands.frequency_spread or DesignSpec().frequency_spread

    @property
    def map_band(self) -> float:
        """Stated error of the strain map, as a fraction of the step; 0 without a band."""
        band = self._strain_map.band or (0.0, 0.0)
        return max(0.0, -band[0], band[1]) / abs(self.plan.after - self.plan.before)

    @property
    def sensing_error(self) -> float:
        """Strain of one code of the chip's current channel, as a fraction of the step.

        The simulated converter rounds each period in the same way, so the error does not average
        out; it is at most about one code.
        """
        farad_per_code = 1.0 / self.design.settings.front_end.current_codes(1.0)
        slope_per_f = max(abs(self._strain_map.slope_at(end_f)) for end_f in self._ends_f)
        return farad_per_code * slope_per_f / abs(self.plan.after - self.plan.before)

    @property
    def noise_std(self) -> float:
        """Standard deviation of the strain that one update of the chip measures."""
        changes = [abs(end_f * self._strain_map.slope_at(end_f)) for end_f in self._ends_f]
        return CAPACITANCE_NOISE * max(changes)

    @property
    def static_error(self) -> float:
        """Error of a strain at rest by strain map and chip, as a fraction of the step.

        They are independent, so their squares add up.
        """
        return math.hypot(self.map_band, self.sensing_error)

    @property
    def _strain_map(self) -> StrainMap:
        return self.design.tables.strain_map()

    @property
    def _ends_f(self) -> tuple[float, ...]:
        """Capacitances at both ends of the step, by the strain map."""
        farad = np.linspace(*self.design.settings.capacitance_range_f, _CAPACITANCES)
        strain = self._strain_map.strain(farad)
        return tuple(
            float(farad[np.abs(strain - end).argmin()])
            for end in (self.plan.before, self.plan.after)
        )

    @property
    def is_robust(self) -> bool:
        """Whether the loop is stable with each natural frequency that the design covers."""
        return all(
            loop_margins(plant, self.gains, loop).stable
            for plant, loop in loop_variants(self.design.plant, self.loop, self.spread)
        )

    @cached_property
    def loop(self) -> LoopSetting:
        """The chip's loop, with the feedthrough of the actuator file."""
        settings = self.design.settings
        limits = Saturation(settings.strain_low, settings.strain_high)
        setting = LoopSetting(FAST.rate_hz, CHIP_DELAY_S, limits)
        return with_feedthrough(setting, self.design.tables)

    def differences(self, one: LoopRun, other: LoopRun) -> NDArray[np.float64]:
        """Difference of two responses at each time, as a fraction of the step.

        Args:
            one: response with `N` samples.
            other: response at the same times.
        Returns:
            The absolute differences, without unit. Shape `(N,)`.
        """
        step = abs(self.plan.after - self.plan.before)
        return np.asarray(np.abs(one.strain - other.strain) / step)

    def deviation(self, one: LoopRun, other: LoopRun) -> float:
        """Largest difference of two responses, as a fraction of the step."""
        return float(self.differences(one, other)[one.time_s > _FROM_S].max())


@dataclass(frozen=True)
class Agreement:
    """How far a simulated step is from the predicted one.

    Args:
        deviation: difference of the strains at `at_s`, as a fraction of the step.
        covered: difference that is tolerated at this time, as a fraction of the step.
        at_s: time since the step at which the difference is largest relative to the tolerated one,
            in s.
        causes: what differs between twin and model; only determined if the responses do.
        says_nothing: why no difference would be a fault; empty if the comparison is meaningful.
    """

    deviation: float
    covered: float
    at_s: float
    causes: tuple[str, ...] = ()
    says_nothing: str = ""

    @property
    def agrees(self) -> bool:
        """Whether the step is one that the design covers."""
        return not self.says_nothing and self.deviation <= self.covered


def predicted_loop(
    run: LoopRun, case: StepCase, factor: float = 1.0, *, noise: bool = False
) -> LoopRun:
    """Predict a response with the identified plant, at the rate and delay of the loop.

    Args:
        run: the simulated response, from a drive of 0 V on.
        case: plant and controller.
        factor: on the natural frequency of the plant.
        noise: add the noise of the chip's sensing to the measurements.
    Returns:
        The predicted response.
    """
    settings, plant = case.design.settings, case.design.plant
    plant = replace(plant, natural_frequency_rad_s=factor * plant.natural_frequency_rad_s)
    limits = Saturation(settings.strain_low, settings.strain_high)
    setting = LoopSetting(
        run.rate_hz, run.delay_s, limits, settings.strain_start, 1, case.loop.feedthrough
    )
    white = None
    if noise:
        white = np.random.default_rng(case.seed).normal(0.0, case.noise_std, run.time_s.size)
    trace = simulate_loop(plant, case.gains, run.reference, setting, measurement_noise=white)
    return replace(run, strain=trace.y)


def tolerance(run: LoopRun, case: StepCase) -> NDArray[np.float64]:
    """Difference from the prediction that is no fault, at each time.

    It is the sum of what a wrong natural frequency, within the spread of the design, changes from
    this time on, of the error of a strain at rest (band of the strain map, sensing of the chip),
    and of the chip's noise.

    Args:
        run: the simulated response with `N` samples.
        case: plant and controller.
    Returns:
        The tolerated difference, as a fraction of the step. Shape `(N,)`.
    """
    expected = predicted_loop(run, case)
    factors = np.linspace(1.0 - case.spread, 1.0 + case.spread, _FREQUENCIES)
    moved = np.max(
        [case.differences(predicted_loop(run, case, f), expected) for f in factors], axis=0
    )
    for part in (run.time_s <= 0.0, run.time_s > 0.0):  # a response passes through the other one
        moved[part] = np.maximum.accumulate(moved[part][::-1])[::-1]
    return np.asarray(moved + case.static_error + largest_noise(run, case))


def largest_noise(run: LoopRun, case: StepCase) -> float:
    """Largest noise of the strain in a run, as a fraction of the step.

    The largest value of one drawn noise changes by a quarter from draw to draw, and grows with the
    length of the run. So it is computed from the standard deviation, that of several draws, and
    the number of samples.

    Args:
        run: the simulated response with `N` samples.
        case: plant and controller.
    Returns:
        The value that some sample of normal noise exceeds in at most 0.1 % of all runs.
    """
    shown = run.time_s > _FROM_S
    quiet = predicted_loop(run, case)
    draws = [
        case.differences(predicted_loop(run, replace(case, seed=seed), noise=True), quiet)[shown]
        for seed in range(case.seed, case.seed + _DRAWS)
    ]
    std = float(np.sqrt(np.mean(np.square(draws))))
    return std * NormalDist().inv_cdf(1.0 - 0.5 * _UNUSUAL / int(shown.sum()))


def agreement_of(desktop: LoopRun, chip: LoopRun, case: StepCase) -> Agreement:
    """Compare the chip's step with its prediction.

    Args:
        desktop: step of the desktop's loop at the chip's rate.
        chip: its step.
        case: of both.
    Returns:
        The comparison, with causes if the responses differ.
    """
    shown = chip.time_s > _FROM_S
    deviation = case.differences(chip, predicted_loop(chip, case))[shown]
    covered = tolerance(chip, case)[shown]
    worst = int(np.argmax(deviation / covered))
    at_s = float(chip.time_s[shown][worst])
    found = Agreement(float(deviation[worst]), float(covered[worst]), at_s)
    if not case.is_robust:
        return replace(found, says_nothing=_unstable_within_spread(case))
    if found.agrees and covered.max() >= _NOTHING:
        return replace(found, says_nothing=_too_tolerant(case, float(covered.max())))
    if found.agrees:
        return found
    return replace(found, causes=tuple(_causes(desktop, chip, case)))


def check_stable(case: StepCase) -> None:
    """Refuse a loop that is unstable with the model of the actuator file or on the twin.

    Args:
        case: model, controller and twin.
    Raises:
        ResultError: The loop is unstable.
    """
    if not loop_margins(case.design.plant, case.gains, case.loop).stable:
        raise ResultError(
            f"The loop of [model] and [controller] is unstable at the chip's {FAST.rate_hz:g} Hz "
            f"with a delay of {1e3 * CHIP_DELAY_S:.3g} ms. Design it again with --rate-hz and "
            f"--delay-s: {case.design.path}"
        )
    twins = _feedthrough(case, case.plan.before)
    on_twin = replace(case.loop, feedthrough=twins, feedthrough_range=None)
    if not loop_margins(_linear(case, case.plan.before), case.gains, on_twin).stable:
        raise ResultError(
            f"The loop is unstable on this twin: {_two_plants(case)}{_twins_feedthrough(case)}. "
            f"Choose the twin of this actuator with --twin or --reading: {case.design.path}"
        )


def _feedthrough_text(case: StepCase) -> str:
    """Range of the feedthrough, if the loop has one."""
    if case.loop.feedthrough_range is None:
        return ""
    low, high = case.loop.feedthrough_range
    return f" or a feedthrough of {low:.2g} to {high:.2g}"


def _twins_feedthrough(case: StepCase) -> str:
    """Feedthrough of the twin and of the file, if they differ."""
    twins, known = _feedthrough(case, case.plan.before), case.loop.feedthrough
    if abs(twins - known) < _SAME_FEEDTHROUGH:
        return ""
    return (
        f", and {twins:.2g} of its sensed strain follows the drive at once, but the file states "
        f"feedthrough = {known:.2g} in [sensing.strain_map]"
    )


def _unstable_within_spread(case: StepCase) -> str:
    return (
        f"with a natural frequency that differs from [model] by {100.0 * case.spread:.3g} % "
        f"(frequency_spread){_feedthrough_text(case)}, the loop is unstable, so any difference "
        "would be tolerated. Design the controller again with haselab design"
    )


def _too_tolerant(case: StepCase, covered: float) -> str:
    return (
        f"a difference of {100.0 * covered:.3g} % of the step would be tolerated "
        f"({100.0 * case.map_band:.3g} % for the band of the strain map, "
        f"{100.0 * case.sensing_error:.3g} % for the sensing error, the rest for frequency_spread "
        "and noise), so even a strain that does not move would agree. Use a larger --step, or fit "
        "the strain map to a better record"
    )


# ---- causes --------------------------------------------------------------------------------------


def _causes(desktop: LoopRun, chip: LoopRun, case: StepCase) -> Iterator[str]:
    """Yield each known difference between the chip on the twin and the prediction."""
    plant, plan = case.design.plant, case.plan
    ends = [_linear(case, strain) for strain in (plan.before, plan.after)]
    ratios = [_resonance(end) / plant.natural_frequency_rad_s for end in ends]
    ratios += [_gain(end) / plant.static_gain for end in ends]
    if max(abs(ratio - 1.0) for ratio in ratios) > case.spread:
        yield (
            f"{_two_plants(case)}; choose the twin of this actuator, or a step in the range of the "
            "model"
        )
    lost = _softened(chip, case)
    if lost > _SOFTENED:
        yield (
            f"the step stretches the twin farther than before, which softens it by "
            f"{100.0 * lost:.2g} % (Mullins effect; --precondition is {plan.precondition_v:g} V)"
        )
    free = desktop_loop(
        case.config, case.seed, case.design.settings, replace(FAST, limited=False), plan
    )
    limited, unlimited = (case.deviation(run, predicted_loop(run, case)) for run in (desktop, free))
    if unlimited < _LIMITING * limited:
        yield (
            f"the drive changes by at most {case.design.settings.rise_v_per_s:g} V/s: without this "
            f"limit, the desktop's loop at the chip's rate deviates by {100.0 * unlimited:.2g} % "
            f"instead of {100.0 * limited:.2g} %; design with a smaller noise_gain in "
            "[controller.demands]"
        )
    off = _map_error(chip, case)
    if off > case.static_error:
        yield f"the capacitance-to-strain map is off by {100.0 * off:.3g} % of the step on the twin"


def _linear(case: StepCase, strain: float) -> RationalModel:
    """The softened twin from corrected strain to strain, where the model reaches a strain."""
    volt, high_v = case.design.tables.voltage_map(), _gain_v(case)
    point, corrected = _point(case, strain)
    gain = point.gain_m_per_v * high_v * float(volt.slope_v(corrected)) / case.plan.zero_length_m
    bottom, top = np.real(np.poly(point.poles)), np.real(np.poly(point.zeros))
    return RationalModel(tuple(gain * bottom[-1] / top[-1] * top), tuple(bottom))


def _point(case: StepCase, strain: float) -> tuple[OperatingPoint, float]:
    """The softened twin where the model reaches a strain, and the corrected strain there."""
    settings, volt = case.design.settings, case.design.tables.voltage_map()
    corrected = strain / case.design.plant.static_gain
    corrected = min(max(corrected, settings.strain_low), settings.strain_high)
    law, load = case.config.law, case.config.load
    point = linearise(
        law,
        _gain_v(case) * max(float(volt.voltage_v(corrected)), 0.0),
        load.mass_kg * GRAVITY_M_S2,
        load.mass_kg + load.added_inertia_kg,
        longest_m=law.length_limits_m.high,
    )
    return point, corrected


def _feedthrough(case: StepCase, strain: float) -> float:
    """Feedthrough of the softened twin where the model reaches a strain."""
    point, _ = _point(case, strain)
    found = feedthrough(case.config.law, point.length_m, point.voltage_v, point.gain_m_per_v)
    return float(np.clip(found, -LARGEST_FEEDTHROUGH, LARGEST_FEEDTHROUGH))


def _gain_v(case: StepCase) -> float:
    """Volts at the twin for one at the amplifier's input."""
    amplifier = case.config.amplifier
    return amplifier.gain * (1.0 + amplifier.gain_error)


def _resonance(model: RationalModel) -> float:
    """Natural frequency of the complex poles, else of the fastest pole, in rad/s."""
    swinging = model.poles[model.poles.imag > 0.0]
    return float(np.abs(swinging if swinging.size else model.poles).max())


def _gain(model: RationalModel) -> float:
    return model.numerator[-1] / model.denominator[-1]


def _two_plants(case: StepCase) -> str:
    """Resonance and gain of the twin and of the model in words."""
    ends = [_linear(case, strain) for strain in (case.plan.before, case.plan.after)]
    resonances = " to ".join(f"{_resonance(end):.3g}" for end in ends)
    gains = " to ".join(f"{_gain(end):.3g}" for end in ends)
    plant = case.design.plant
    return (
        f"from the start of the step to its end, the twin has a natural frequency of {resonances} "
        f"rad/s and a static gain of {gains}, but [model] has {plant.natural_frequency_rad_s:.3g} "
        f"rad/s and {plant.static_gain:.3g}"
    )


def _softened(run: LoopRun, case: StepCase) -> float:
    """Share of the stiffness that the twin loses by the step."""
    law, length_m = case.config.law, case.plan.zero_length_m * (1.0 + run.strain)
    first_m = precondition(TwinBench(case.config, case.seed), case.plan.precondition_v)
    before_m = max(first_m, float(length_m[run.time_s <= 0.0].max()))
    after_m = max(before_m, float(length_m.max()))
    stiff, soft = law.losses.softening(np.array([before_m, after_m]) / law.free_length_m)
    return float(stiff / soft) - 1.0


def _map_error(run: LoopRun, case: StepCase) -> float:
    """Largest error of the file's strain map on the twin at rest, as a fraction of the step.

    At rest within the strains of the run: a capacitance depends on the voltage in some kinds.
    """
    config, zero_m = case.config, case.plan.zero_length_m
    shown = run.strain[run.time_s > _FROM_S]
    off, load_n = [0.0], config.load.mass_kg * GRAVITY_M_S2
    for voltage_v in np.linspace(
        0.0, _gain_v(case) * case.design.settings.drive_high_v, _MAP_POINTS
    ):
        try:
            length_m = equilibrium_m(config.law, voltage_v, load_n)
        except LimitError:
            break
        strain = length_m / zero_m - 1.0
        if shown.min() <= strain <= shown.max():
            capacitance_f = config.law.differential_capacitance_f(length_m, voltage_v)
            seen = case.design.tables.strain_map().strain(capacitance_f)
            off.append(abs(float(seen) - strain))
    return max(off) / abs(case.plan.after - case.plan.before)
