"""Steps of the loops as the identified plant predicts them, to compare with the played ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, JsonObject
from haselab.control import (
    LoopSetting,
    PidGains,
    Saturation,
    simulate_drive,
    simulate_loop,
    step_metrics,
)
from haselab.models.plant import Plant
from haselab.study.fits.loops import Loops
from haselab.study.fits.trials import Trials

__all__ = ["map_errors", "predicted_metrics"]

_OPEN = "open loop"
_SHARE_AT_END = 0.1  # of the step, as in the final error
_ENDLESS = Saturation(-1e3, 1e3)  # an open loop has no controller that saturates

Floats = NDArray[np.float64]


def predicted_metrics(
    groups: Mapping[str, Trials], plant: Plant, loops: Loops
) -> dict[str, JsonObject]:
    """Metrics of the steps that the identified plant predicts, as those of the played steps.

    The loop starts at rest at zero strain. Hysteresis, errors of both maps, and noise are no part
    of the prediction.

    Args:
        groups: trials by group; those other than "open loop", "PI" and "PID" are left out.
        plant: as it was identified.
        loops: their gains, and rate, delay, limits and feedthrough.
    Returns:
        By group: `rise_time_s`, `overshoot`, `settling_time_s` and `error`; a group whose response
        does not follow the step is left out.
    """
    known = {_OPEN: None, "PI": loops.pi, "PID": loops.pid}
    found: dict[str, JsonObject] = {}
    for name, gains in known.items():
        if name not in groups:
            continue
        seen = groups[name]
        strain = _response(seen, plant, gains, loops.setting)
        try:
            metrics = step_metrics(seen.time_s, strain, seen.reference)
        except InputError:
            continue
        found[name] = {
            "rise_time_s": metrics.rise_time_s.value,
            "overshoot": metrics.overshoot.value,
            "settling_time_s": metrics.settling_time_s.value,
            "error": metrics.steady_state_error.value,
        }
    return found


def _response(seen: Trials, plant: Plant, gains: PidGains | None, setting: LoopSetting) -> Floats:
    """Predicted strain at the times of the trials. Shape `(N,)`."""
    period_s = 1.0 / setting.rate_hz
    count = int(np.ceil(seen.time_s[-1] / period_s)) + 1
    at = np.searchsorted(seen.time_s, np.arange(count) * period_s).clip(0, seen.time_s.size - 1)
    reference = seen.reference[at]
    if gains is None:
        trace = simulate_drive(plant, reference, replace(setting, saturation=_ENDLESS))
    else:
        trace = simulate_loop(plant, gains, reference, setting)
    return np.interp(seen.time_s, trace.time_s, trace.y)


def map_errors(groups: Mapping[str, Trials]) -> dict[str, float]:
    """The part of each final error that the map from capacitance to strain explains.

    A closed loop controls the sensed strain, so the camera sees the error of the map in the end.

    Args:
        groups: trials by group.
    Returns:
        Sensed minus measured strain in the last tenth of the step, as a fraction of the step.
    """
    found = {}
    for name, seen in groups.items():
        after = np.flatnonzero(seen.reference != seen.reference[0])
        last = after[-max(1, round(_SHARE_AT_END * after.size)) :]
        size = float(seen.reference[-1] - seen.reference[0])
        found[name] = float((seen.sensed[:, last] - seen.strain[:, last]).mean()) / size
    return found
