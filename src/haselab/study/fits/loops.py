"""Design controllers for the identified plant, with margins at the true delay of the loop."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, JsonObject, ResultError
from haselab.control import (
    DesignSpec,
    LoopSetting,
    PidGains,
    Saturation,
    design_pid,
)
from haselab.control.feedthrough import with_measured_feedthrough
from haselab.control.plants.general import AnyPlant
from haselab.control.plants.general_loops import loop_variants
from haselab.control.reach import reachable_range
from haselab.control.stability.margins import loop_margins
from haselab.models.maps import VoltageMap
from haselab.models.plant import Plant
from haselab.rig import RigDescription
from haselab.runtime.lockin import lockin_of
from haselab.sensing import latency
from haselab.study.definition import Study
from haselab.study.fits.dynamics import Dynamics
from haselab.study.fits.observe import Observation

__all__ = [
    "Loops",
    "design_loops",
    "loop_saturation",
    "loop_setting",
    "margin_estimates",
    "measured_latency",
    "pid_demands",
    "printed_gains",
    "reduce_gains",
]

_UNITS = {"phase_margin": "deg", "gain_margin": "dB", "delay_margin": "s", "crossover": "rad/s"}
_LATENCY_TOLERANCE_S = 0.25e-3  # for the rise time of the amplifier
_LEAST_DB = 2.0  # gain margin for which the printed PI is played; 2.8 to 3.6 on the twin
_LOWERED_DB = 6.0  # gain margin of a PI with reduced gains
_SHARES = [0.01 * percent for percent in range(99, 0, -1)]  # of a gain, tried in this order
_PID = DesignSpec(rise_time_s=0.8, overshoot=0.07, phase_margin_deg=50.0, frequency_spread=0.10)


@dataclass(frozen=True)
class Loops:
    """Controllers of the study.

    Args:
        pi: the paper's PI: its gains for a plant of gain 1/2, scaled to the identified plant (D8).
        pid: with the derivative of the filtered measurement, row S25.
        setting: rate, delay, saturation.
        delayed_pi: the PI for delayed outputs, see `Steps.extra_delay_blocks`.
        quantities: results by id.
        figures: section of analysis.json.
        notes: by id, remarks for the reader.
    """

    pi: PidGains
    pid: PidGains
    setting: LoopSetting
    delayed_pi: PidGains
    quantities: dict[str, Estimate]
    figures: JsonObject
    notes: dict[str, str]


def loop_setting(
    study: Study, rig: RigDescription, to_volt: VoltageMap, output_s: float | None = None
) -> LoopSetting:
    """The true delay of a loop on this rig, without the hold, and its saturation.

    The delay lasts from the middle of the samples that the lock-in uses to the end of the block,
    and from there to the new output.

    Args:
        study: carrier and saturation.
        rig: nominal values.
        to_volt: corrected strain to drive voltage.
        output_s: measured time from a block's last sample to the new output; None: the rig's.
    """
    averaging_s = rig.block_s - lockin_of(rig, study.sensing.carrier_hz).middle_s
    return LoopSetting(
        rate_hz=1.0 / rig.block_s,
        measurement_delay_s=averaging_s + (_nominal_s(rig) if output_s is None else output_s),
        saturation=loop_saturation(study, rig, to_volt),
    )


def loop_saturation(study: Study, rig: RigDescription, to_volt: VoltageMap) -> Saturation:
    """The saturation of [control], narrowed to what the drive puts out through the voltage map.

    Args:
        study: with [control].
        rig: its drive limits.
        to_volt: corrected strain to drive voltage.
    Returns:
        The range that is left.
    """
    wanted = Saturation(study.control.saturation_low, study.control.saturation_high)
    return reachable_range(wanted, to_volt, rig.drive_limits.low, rig.drive_limits.high)


def _nominal_s(rig: RigDescription) -> float:
    return rig.switch_sample / rig.rate_hz


def measured_latency(opened: Sequence[Observation], rig: RigDescription) -> Estimate | None:
    """Measure the time from a block's last sample to the new output, from open-loop steps.

    Raises:
        ResultError: it differs from the rig's value, so blanking misses the updates.
    """
    found = latency(np.concatenate([seen.latency_s for seen in opened]), rig.rate_hz)
    if (
        found is not None
        and abs(found.value - _nominal_s(rig)) > _LATENCY_TOLERANCE_S + 4.0 * found.std
    ):
        raise ResultError(
            f"The outputs took effect {1e3 * found.value:.3f} ms after the end of their block, but "
            f"the rig states {1e3 * _nominal_s(rig):.3f} ms. Change output_delay_s or "
            "ahead_blocks."
        )
    return found


def printed_gains(study: Study, plant: Plant) -> PidGains:
    """The printed PI, scaled so that the loop gain is that of the paper (ADR 0004)."""
    factor = study.control.plant_gain / plant.gain
    return PidGains(study.control.kp * factor, study.control.ki * factor)


def _holds(plant: Plant, gains: PidGains, setting: LoopSetting, least_db: float) -> bool:
    found = loop_margins(plant, gains, setting)
    return found.stable and found.gain_margin_db >= least_db


def reduce_gains(plant: Plant, gains: PidGains, setting: LoopSetting) -> PidGains:
    """Reduce the gains of the PI if the delay of the loop requires it.

    Each output that waits in a device adds one block of delay. If this leaves less than 2 dB of
    gain margin, the proportional gain, which excites the resonance, is reduced until the margin is
    6 dB. If 0 is not low enough, the integral gain of the remaining controller is reduced, too.

    Args:
        plant: as it was identified.
        gains: of the study.
        setting: rate and delay.
    Returns:
        The gains, unchanged or reduced.
    Raises:
        ResultError: no gains reach the margin.
    """
    if _holds(plant, gains, setting, _LEAST_DB):
        return gains
    lower = [replace(gains, kp=share * gains.kp) for share in _SHARES]
    lower += [replace(gains, kp=0.0, ki=share * gains.ki) for share in (1.0, *_SHARES)]
    for trial in lower:
        if _holds(plant, trial, setting, _LOWERED_DB):
            return trial
    raise ResultError(
        f"No PI reaches a gain margin of {_LOWERED_DB:g} dB with a delay of "
        f"{1e3 * setting.measurement_delay_s:.3g} ms. Queue fewer outputs (daq.ahead_blocks)."
    )


def _loop_delay_s(setting: LoopSetting) -> float:
    """Delay of a loop in s, including half a hold but not the plant's own delay."""
    return setting.measurement_delay_s + 0.5 / setting.rate_hz


def _delay_text(setting: LoopSetting, plant: Plant) -> str:
    """The total delay for the margins: that of the loop and that of the fitted plant."""
    loop_ms, own_ms = 1e3 * _loop_delay_s(setting), 1e3 * plant.delay_s
    if own_ms <= 0.0:
        return f"a delay of {loop_ms:.3g} ms"
    return (
        f"a delay of {loop_ms + own_ms:.3g} ms ({loop_ms:.3g} ms of the loop and {own_ms:.3g} ms "
        "of the fitted plant, S20.delay)"
    )


def _lowered(printed: PidGains, played: PidGains, setting: LoopSetting, plant: Plant) -> str:
    """Note about reduced gains; empty if the gains are the printed ones."""
    if printed == played:
        return ""
    kind = ", an integral controller" if played.kp == 0.0 else ""
    return (
        f"kp {printed.kp:.3g} -> {played.kp:.3g}, ki {printed.ki:.3g} -> {played.ki:.3g}/s{kind}: "
        f"with {_delay_text(setting, plant)} the scaled PI has less than {_LEAST_DB:g} dB of "
        "gain margin"
    )


def _margin_note(gains: PidGains, plant: Plant, setting: LoopSetting) -> str:
    """Note about the delay of a gain margin, and the margin without the plant's part of it."""
    delay = f"with {_delay_text(setting, plant)}"
    if plant.delay_s <= 0.0:
        return delay
    alone = loop_margins(replace(plant, delay_s=0.0), gains, setting)
    return f"{delay}; with the loop's delay only {alone.gain_margin_db:.3g} dB"


def pid_demands(study: Study) -> DesignSpec:
    """The demands that a study's PID is designed for.

    Args:
        study: with its step.
    """
    return replace(_PID, step=study.steps.step or None)


def design_loops(
    found: Dynamics,
    to_volt: VoltageMap,
    study: Study,
    rig: RigDescription,
    rng: np.random.Generator,
    output: Estimate | None = None,
    given: Loops | None = None,
) -> Loops:
    """Scale the paper's PI to the identified plant, and design a PID.

    Args:
        found: identified plant with covariance.
        to_volt: corrected strain to drive voltage.
        study: printed gains, saturation.
        rig: for the delay.
        rng: random numbers of the search.
        output: measured latency of the output, see `measured_latency`.
        given: controllers to evaluate on this plant instead of designing them.
    Returns:
        Gains, results S21, S22 and S25, data for figure 7.
    Source: reference study, rows S21 to S23 and S25.
    """
    output_s = None if output is None else output.value
    setting = given.setting if given else loop_setting(study, rig, to_volt, output_s)
    if study.steps.feedback != "video":
        setting = with_measured_feedthrough(setting, found.significant_feedthrough)
    held_back_s = study.steps.extra_delay_blocks * rig.block_s
    late = replace(setting, measurement_delay_s=setting.measurement_delay_s + held_back_s)
    scaled = printed_gains(study, found.plant)
    pi = given.pi if given else reduce_gains(found.plant, scaled, setting)
    delayed_pi = given.delayed_pi if given else reduce_gains(found.plant, scaled, late)
    demands = pid_demands(study)
    pid = given.pid if given else design_pid(found.plant, demands, setting, rng=rng).gains
    as_printed = PidGains(study.control.kp, study.control.ki)
    alone = LoopSetting(rate_hz=setting.rate_hz, measurement_delay_s=0.0)
    judged = {
        "S21.": margin_estimates(pi, found, setting, ("phase_margin", "gain_margin", "delay_margin",
                                             "crossover")),
        "S21.plant_": margin_estimates(PidGains(1.0, 0.0), found, alone, ("crossover",)),
        "S21.printed_": margin_estimates(as_printed, found, setting, ("gain_margin",)),
        "S21.delayed_": margin_estimates(scaled, found, late, ("gain_margin",)),
        "S25.": margin_estimates(pid, found, setting, ("phase_margin", "gain_margin")),
    }  # fmt: skip
    quantities = {
        f"{prefix}{name}": value for prefix, part in judged.items() for name, value in part.items()
    }
    figure = _figure(found.plant, pi, pid, setting, demands.frequency_spread) | {
        "output_s": {"nominal": _nominal_s(rig), "measured": output}
    }
    return Loops(
        pi, pid, setting, delayed_pi,
        {**_played(pi, pid, setting, found), **quantities},
        {"loop": figure},
        _notes(study, found.plant, (scaled, pi, delayed_pi), (setting, late), rig)
        | _pid_notes(pid, found.plant, setting),
    )  # fmt: skip


def _played(
    pi: PidGains, pid: PidGains, setting: LoopSetting, found: Dynamics
) -> dict[str, Estimate]:
    """Gains, delay and limits of the closed loops."""
    share = found.quantities["S20.gain"].std / abs(found.plant.gain)
    return {
        "S21.kp": Estimate.normal(pi.kp, share * pi.kp, ""),
        "S21.ki": Estimate.normal(pi.ki, share * pi.ki, "1/s"),
        "S21.delay": Estimate.normal(_loop_delay_s(setting), 0.0, "s"),
        "S22.saturation_low": Estimate.normal(setting.saturation.low, 0.0, ""),
        "S22.saturation_high": Estimate.normal(setting.saturation.high, 0.0, ""),
        "S25.kp": Estimate.normal(pid.kp, 0.0, ""),
        "S25.ki": Estimate.normal(pid.ki, 0.0, "1/s"),
        "S25.kd": Estimate.normal(pid.kd, 0.0, "s"),
        "S25.derivative_filter": Estimate.normal(pid.derivative_filter_s, 0.0, "s"),
    }


def _pid_notes(pid: PidGains, plant: Plant, setting: LoopSetting) -> dict[str, str]:
    """Notes about the PID."""
    notes = {"S25.gain_margin": _margin_note(pid, plant, setting)}
    if pid.kp == 0.0:
        notes["S25.kp"] = (
            "integral and derivative action only: a proportional term would raise the resonance"
        )
    return notes


def _notes(
    study: Study,
    plant: Plant,
    gains: tuple[PidGains, PidGains, PidGains],
    settings: tuple[LoopSetting, LoopSetting],
    rig: RigDescription,
) -> dict[str, str]:
    """Notes about scaled, played and delayed gains, and about the limits."""
    scaled, pi, delayed_pi = gains
    setting, late = settings
    scaling = (
        f"kp and ki of [control] times {study.control.plant_gain:g} / {plant.gain:.4g}, the ratio "
        "of the gain of the plant that they were chosen for and the identified plant's gain"
    )
    lowered = _lowered(scaled, pi, setting, plant)
    late_lowered = _lowered(scaled, delayed_pi, late, plant)
    notes = {
        "S21.kp": "; ".join(filter(None, (scaling, lowered))),
        "S21.ki": scaling,
        "S21.phase_margin": f"with {_delay_text(setting, plant)}",
        "S21.gain_margin": _margin_note(pi, plant, setting),
        "S21.delay_margin": f"in addition to {_delay_text(setting, plant)}",
        "S21.printed_gain_margin": _margin_note(
            PidGains(study.control.kp, study.control.ki), plant, setting
        ),
        "S24.rise_delayed": late_lowered or f"with {_delay_text(late, plant)}",
        "S21.delayed_gain_margin": _margin_note(scaled, plant, late),
    }
    control, limits = study.control, setting.saturation
    narrowed = limits.low > control.saturation_low or limits.high < control.saturation_high
    if narrowed:
        notes["S22.saturation_low"] = notes["S22.saturation_high"] = (
            f"narrowed to the strains whose voltage is within {rig.drive_limits.low:g} to "
            f"{rig.drive_limits.high:g} V by the voltage map"
        )
    if lowered:
        notes["S21.phase_margin"] = notes["S24.rise_closed"] = lowered
    return notes


def margin_estimates(
    gains: PidGains, found: Dynamics, setting: LoopSetting, names: tuple[str, ...]
) -> dict[str, Estimate]:
    """Margins with their uncertainty from the plant's covariance.

    Args:
        gains: of the controller.
        found: the plant with its covariance.
        setting: rate and delay.
        names: which margins: `phase_margin`, `gain_margin`, `delay_margin`, `crossover` (the upper
            one).
    Returns:
        Estimates by name.
    """

    def numbers(plant: AnyPlant) -> NDArray[np.float64]:
        m = loop_margins(plant, gains, setting)
        last = m.crossovers[-1].omega_rad_s if m.crossovers else np.nan
        every = {
            "phase_margin": m.phase_margin_deg,
            "gain_margin": m.gain_margin_db,
            "delay_margin": m.delay_margin_s,
            "crossover": last,
        }
        return np.array([every[name] for name in names])

    centre, covariance = found.posterior.propagated(numbers)
    std = np.sqrt(np.diag(covariance))
    return {
        name: Estimate.normal(float(value), float(one), _UNITS[name])
        for name, value, one in zip(names, centre, std, strict=True)
    }


def _figure(
    plant: Plant, pi: PidGains, pid: PidGains, setting: LoopSetting, spread: float
) -> dict[str, Any]:
    wn = plant.natural_frequency_rad_s
    omega_rad_s = np.unique(
        np.concatenate([np.geomspace(0.05, 300.0, 400), wn * np.linspace(0.8, 1.2, 80)])
    )
    open_response = plant.frequency_response(omega_rad_s)
    held = np.exp(-1j * omega_rad_s * (setting.measurement_delay_s + 0.5 / setting.rate_hz))
    sensed = open_response
    if share := setting.feedthrough:
        direct = plant.static_gain * np.exp(-1j * omega_rad_s * plant.delay_s)
        sensed = (1.0 - share) * open_response + share * direct
    variants = loop_variants(plant, setting, spread)
    controllers = {}
    for name, gains in (("PI", pi), ("PID", pid)):
        loop = sensed * held * gains.sampled_response(omega_rad_s, setting.rate_hz)
        m = loop_margins(plant, gains, setting)
        every = [loop_margins(one, gains, loop_of_one) for one, loop_of_one in variants]
        controllers[name] = {
            "magnitude": np.abs(loop),
            "phase_rad": np.unwrap(np.angle(loop)),
            "phase_margin_deg": m.phase_margin_deg,
            "gain_margin_db": m.gain_margin_db,
            "worst_phase_margin_deg": min(one.phase_margin_deg for one in every),
            "worst_gain_margin_db": min(one.gain_margin_db for one in every),
            "crossover_rad_s": m.crossover_rad_s,
            "kp": gains.kp,
            "ki": gains.ki,
            "kd": gains.kd,
            "derivative_filter_s": gains.derivative_filter_s,
        }
    return {
        "omega_rad_s": omega_rad_s,
        "plant": {
            "magnitude": np.abs(open_response),
            "phase_rad": np.unwrap(np.angle(open_response)),
        },
        "controllers": controllers,
        "worst": {
            "frequency_spread": spread,
            "feedthrough": setting.feedthrough,
            "feedthrough_range": setting.feedthrough_range,
        },
    }
