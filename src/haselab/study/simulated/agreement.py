"""Compare the chip's simulated step with the prediction of its actuator file, and say why."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from haselab.actuators import equilibrium_m, linearise
from haselab.base import LimitError, ResultError
from haselab.control import (
    DesignSpec,
    LoopSetting,
    PidGains,
    Saturation,
    margins,
    simulate_loop,
)
from haselab.control.plants.general import AnyPlant
from haselab.models.rational import RationalModel
from haselab.rig.chip import ChipDesign
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.history import precondition
from haselab.rig.twin.twin_bench import GRAVITY_M_S2, TwinBench
from haselab.study.chip.loops import CHIP_DELAY_S, FAST, LoopRun, StepPlan, desktop_loop

__all__ = ["Agreement", "StepCase", "agreement_of", "check_stable", "predicted_loop"]

_FROM_S = -1.0  # of the step: from here on the responses are compared
_SOFTENED = 0.01  # loss of stiffness that is a cause
_MAP_POINTS = 65  # voltages at which the strain map is checked
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
        band = self.design.tables.strain_map().band or (0.0, 0.0)
        return max(-band[0], band[1]) / abs(self.plan.after - self.plan.before)

    def deviation(self, one: LoopRun, other: LoopRun) -> float:
        """Largest difference of two responses, as a fraction of the step."""
        shown = one.time_s > _FROM_S
        largest = float(np.abs(one.strain - other.strain)[shown].max())
        return largest / abs(self.plan.after - self.plan.before)


@dataclass(frozen=True)
class Agreement:
    """How far a simulated step is from the predicted one.

    Args:
        deviation: largest difference of the strains from 1 s before the step on, as a fraction of
            the step.
        covered: the same between the prediction and that for a plant whose natural frequency
            differs by as much as the design covers, plus the band of the strain map.
        causes: what differs between twin and model; only determined if the responses do.
    """

    deviation: float
    covered: float
    causes: tuple[str, ...] = ()

    @property
    def agrees(self) -> bool:
        """Whether the step is one that the design covers."""
        return self.deviation <= self.covered


def predicted_loop(run: LoopRun, case: StepCase, factor: float = 1.0) -> LoopRun:
    """Predict a response with the identified plant, at the rate and delay of the loop.

    Args:
        run: the simulated response, from a drive of 0 V on.
        case: plant and controller.
        factor: on the natural frequency of the plant.
    Returns:
        The predicted response.
    """
    settings, plant = case.design.settings, case.design.plant
    plant = replace(plant, natural_frequency_rad_s=factor * plant.natural_frequency_rad_s)
    limits = Saturation(settings.strain_low, settings.strain_high)
    setting = LoopSetting(run.rate_hz, run.delay_s, limits, settings.strain_start, 1)
    return replace(run, strain=simulate_loop(plant, case.gains, run.reference, setting).y)


def agreement_of(desktop: LoopRun, chip: LoopRun, case: StepCase) -> Agreement:
    """Compare the chip's step with its prediction.

    Args:
        desktop: step of the desktop's loop at the chip's rate.
        chip: its step.
        case: of both.
    Returns:
        The comparison, with causes if the responses differ.
    """
    expected = predicted_loop(chip, case)
    covered = max(
        case.deviation(predicted_loop(chip, case, factor), expected)
        for factor in (1.0 - case.spread, 1.0 + case.spread)
    )
    found = Agreement(case.deviation(chip, expected), covered + case.map_band)
    if found.agrees:
        return found
    return replace(found, causes=tuple(_causes(desktop, chip, case, found.covered)))


def check_stable(case: StepCase) -> None:
    """Refuse a loop that is unstable with the model of the actuator file or on the twin.

    Args:
        case: model, controller and twin.
    Raises:
        ResultError: The loop is unstable.
    """

    def stable(plant: AnyPlant) -> bool:
        return margins(plant, case.gains, loop_delay_s=CHIP_DELAY_S, rate_hz=FAST.rate_hz).stable

    if not stable(case.design.plant):
        raise ResultError(
            f"The loop of [model] and [controller] is unstable at the chip's {FAST.rate_hz:g} Hz "
            f"with a delay of {1e3 * CHIP_DELAY_S:.3g} ms. Design it again with --rate-hz and "
            f"--delay-s: {case.design.path}"
        )
    if not stable(_linear(case, case.plan.before)):
        raise ResultError(
            f"The loop is unstable on this twin: {_two_plants(case)}. Choose the twin of this "
            f"actuator with --twin or --reading: {case.design.path}"
        )


# ---- causes --------------------------------------------------------------------------------------


def _causes(desktop: LoopRun, chip: LoopRun, case: StepCase, covered: float) -> Iterator[str]:
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
    if off > covered:
        yield f"the capacitance-to-strain map is off by {100.0 * off:.3g} % of the step on the twin"


def _linear(case: StepCase, strain: float) -> RationalModel:
    """The softened twin from corrected strain to strain, where the model reaches a strain."""
    settings, volt = case.design.settings, case.design.tables.voltage_map()
    corrected = strain / case.design.plant.static_gain
    corrected = min(max(corrected, settings.strain_low), settings.strain_high)
    law, load = case.config.law, case.config.load
    high_v = _gain_v(case)
    point = linearise(
        law,
        high_v * max(float(volt.voltage_v(corrected)), 0.0),
        load.mass_kg * GRAVITY_M_S2,
        load.mass_kg + load.added_inertia_kg,
        longest_m=law.length_limits_m.high,
    )
    gain = point.gain_m_per_v * high_v * float(volt.slope_v(corrected)) / case.plan.zero_length_m
    bottom, top = np.real(np.poly(point.poles)), np.real(np.poly(point.zeros))
    return RationalModel(tuple(gain * bottom[-1] / top[-1] * top), tuple(bottom))


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
