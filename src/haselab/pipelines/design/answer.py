"""What is reported of a design: gains, margins, predicted step, shares of plausible plants."""

from __future__ import annotations

from typing import Any

from haselab.base import Estimate, JsonObject
from haselab.control import Design, LoopSetting, Margins
from haselab.control.stability.plausible import PlausibleMargins, binomial_proportion

__all__ = [
    "design_answer",
    "margins_answer",
    "plausible_sentence",
]


def margins_answer(found: Margins, setting: LoopSetting) -> JsonObject:
    """Collect the margins for an answer.

    Args:
        found: the margins.
        setting: rate and delay that they were computed with.
    Returns:
        Names and numbers.
    """
    return {
        "stable": found.stable,
        "phase_margin_deg": found.phase_margin_deg,
        "gain_margin_db": found.gain_margin_db,
        "delay_margin_s": found.delay_margin_s,
        "peak_sensitivity": found.peak_sensitivity,
        "crossover_rad_s": found.crossover_rad_s,
        "rate_hz": setting.rate_hz,
        "delay_s": setting.measurement_delay_s,
        **_feedthrough(setting),
    }


def _feedthrough(setting: LoopSetting) -> JsonObject:
    """Feedthrough of the measurement and its range, where the loop has one."""
    if setting.feedthrough == 0.0:
        return {}
    nominal = setting.feedthrough
    range_ = setting.feedthrough_range or (nominal, nominal)
    return {"feedthrough": nominal, "feedthrough_range": list(range_)}


def _shares(found: PlausibleMargins) -> dict[str, Estimate]:
    """Shares of the plausible plants: stable, phase margin kept, gain margin kept, both kept."""
    return {
        "stable": binomial_proportion(found.stable),
        "phase_margin": binomial_proportion(found.keeps_phase),
        "gain_margin": binomial_proportion(found.keeps_gain),
        "margins": found.share,
    }


def plausible_sentence(found: PlausibleMargins) -> str:
    """Say which shares of the plausible plants keep their margins.

    Args:
        found: margins of plausible plants.
    Returns:
        Half a sentence that begins with the share that keeps both.
    """
    shares = {name: f"{100.0 * share.value:.4g} %" for name, share in _shares(found).items()}
    low, high = (100.0 * end for end in found.share.ci95)
    return (
        f"{shares['margins']} of {found.stable.size} plausible plants (95 % interval: {low:.3g} to "
        f"{high:.3g} %) keep {found.least_phase_deg:g} deg and {found.least_gain_db:g} dB; "
        f"{shares['stable']} are stable, {shares['phase_margin']} keep the phase margin, "
        f"{shares['gain_margin']} the gain margin"
    )


def _posterior(found: PlausibleMargins) -> dict[str, Any]:
    """The shares as JSON."""
    return {
        "draws": found.stable.size,
        "least_phase_margin_deg": found.least_phase_deg,
        "least_gain_margin_db": found.least_gain_db,
        **_shares(found),
    }


def design_answer(design: Design) -> JsonObject:
    """Collect the answer of `haselab design`.

    Args:
        design: gains with their predictions.
    Returns:
        Gains, margins, predicted step, unmet demands and shares of plausible plants, by name.
    """
    gains, margin, step = design.gains, design.nominal.margins, design.nominal.step
    more = {} if design.plausible is None else {"posterior": _posterior(design.plausible)}
    worst = [item.margins for item in design.spread]
    return {
        "kp": gains.kp,
        "ki": gains.ki,
        "kd": gains.kd,
        "derivative_filter_s": gains.derivative_filter_s,
        "phase_margin_deg": margin.phase_margin_deg,
        "gain_margin_db": margin.gain_margin_db,
        "delay_margin_s": margin.delay_margin_s,
        "peak_sensitivity": margin.peak_sensitivity,
        "crossover_rad_s": margin.crossover_rad_s,
        "rise_time_s": step.rise_time_s,
        "raw_rise_time_s": step.raw_rise_time_s,
        "overshoot": step.overshoot,
        "settling_time_s": step.settling_time_s,
        "steady_state_error": step.steady_state_error,
        "worst_phase_margin_deg": min(item.phase_margin_deg for item in worst),
        "worst_gain_margin_db": min(item.gain_margin_db for item in worst),
        "worst_overshoot": max(item.step.overshoot for item in design.spread),
        "frequency_spread": design.spec.frequency_spread,
        "step": design.spec.step,
        "limits": [design.setting.saturation.low, design.setting.saturation.high],
        "rate_hz": design.setting.rate_hz,
        "delay_s": design.setting.measurement_delay_s,
        **_feedthrough(design.setting),
        "shortfalls": list(design.shortfalls),
        **more,
    }
