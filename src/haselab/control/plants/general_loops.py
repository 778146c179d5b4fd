"""Sampled loops with any rational plant: traces of many controllers, closed-loop poles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.control.gains import PidGains
from haselab.control.plants.general import (
    AnyPlant,
    HeldModel,
    delay_in_updates,
    frequency_variants,
    static_gain,
)
from haselab.control.plants.modes import SampledLoops
from haselab.control.simulate import LoopSetting
from haselab.models.plant import Plant
from haselab.models.rational import RationalModel

__all__ = ["closed_loop_poles", "loop_variants", "plant_output", "trace_general"]

Floats = NDArray[np.float64]


def _law(gains: Sequence[PidGains], period_s: float) -> tuple[Floats, Floats, Floats, Floats]:
    """Proportional, integral and derivative gains per sample, and the filter's weight; `(C,)`."""
    kp, ki, kd, tau = np.array([(g.kp, g.ki, g.kd, g.derivative_filter_s) for g in gains]).T
    return kp, ki * period_s, kd / period_s, period_s / (period_s + tau)


def loop_variants(
    plant: AnyPlant, setting: LoopSetting, spread: float
) -> tuple[tuple[AnyPlant, LoopSetting], ...]:
    """A plant with its loop, and the variants that a controller has to work with.

    Args:
        plant: nominal plant.
        setting: its loop.
        spread: change of the frequencies to either side, relative to them.
    Returns:
        The nominal plant and loop, then other frequencies, then the ends of the feedthrough.
    """
    ends = {end for end in setting.feedthrough_range or () if end != setting.feedthrough}
    return (
        *((one, setting) for one in frequency_variants(plant, spread)),
        *((plant, replace(setting, feedthrough=end)) for end in sorted(ends)),
    )


def plant_output(plant: AnyPlant, measured: Floats, u: Floats, setting: LoopSetting) -> Floats:
    """The plant's output, with the delay of the measurement, from what a simulated loop measured.

    Args:
        plant: plant.
        measured: measurements of the loop, which starts at rest at 0. Shape `(..., N)`.
        u: outputs of its controller. Shape `(..., N)`.
        setting: of the loop.
    Returns:
        The measurements without the feedthrough. Shape `(..., N)`.
    """
    if setting.feedthrough == 0.0:
        return measured
    late = delay_in_updates(plant.delay_s + setting.measurement_delay_s, 1.0 / setting.rate_hz)
    direct = np.zeros_like(measured)
    direct[..., late:] = (
        setting.feedthrough * static_gain(plant) * u[..., : measured.shape[-1] - late]
    )
    return np.asarray((measured - direct) / (1.0 - setting.feedthrough))


def _held(model: RationalModel, setting: LoopSetting) -> HeldModel:
    return HeldModel.of(
        model,
        period_s=1.0 / setting.rate_hz,
        measurement_delay_s=setting.measurement_delay_s,
        feedthrough=setting.feedthrough,
    )


def trace_general(
    model: RationalModel, gains: Sequence[PidGains], reference: ArrayLike, setting: LoopSetting
) -> tuple[Floats, Floats]:
    """Simulate closed loops that start from rest at 0.

    The controller is that of the C core, as in `simulate_loop`.

    Args:
        model: plant.
        gains: controllers. Length `C`.
        reference: one value per sample. Shape `(N,)`.
        setting: rate, delay and limits.
    Returns:
        Measurements and controller outputs. Shape `(C, N)` each.
    """
    period_s = 1.0 / setting.rate_hz
    held = _held(model, setting)
    kp, ki, kd, weight = _law(gains, period_s)
    low, high = setting.saturation.low, setting.saturation.high
    desired = np.asarray(reference, dtype=float)
    count, size = kp.size, desired.size
    x = np.zeros((count, held.push.size))
    line = np.zeros((held.samples, count))
    integral, filtered = np.zeros(count), np.zeros(count)
    measured_all, u_all = np.empty((size, count)), np.empty((size, count))
    for k in range(size):
        measured = line[k % held.samples]
        error = desired[k] - measured
        change = weight * (measured - filtered)
        filtered = filtered + change
        direct = kp * error - kd * change
        free = direct + integral
        frozen = ((free > high) & (error > 0.0)) | ((free < low) & (error < 0.0))
        integral = np.where(frozen, integral, integral + ki * error)
        u = np.minimum(np.maximum(direct + integral, low), high)
        measured_all[k], u_all[k] = measured, u
        line[k % held.samples] = x @ held.read + held.feed * u
        x = x @ held.step.T + u[:, None] * held.push
    return measured_all.T, u_all.T


def closed_loop_poles(
    plant: AnyPlant, gains: Sequence[PidGains], setting: LoopSetting
) -> NDArray[np.complex128]:
    """Poles of the loops in the z-plane, without saturation. Shape `(C, states)`."""
    period_s = 1.0 / setting.rate_hz
    if isinstance(plant, Plant):
        loops = SampledLoops.of(
            [plant] * len(gains),
            gains,
            period_s=period_s,
            measurement_delay_s=setting.measurement_delay_s,
            feedthrough=setting.feedthrough,
        )
        return loops.poles()
    held = _held(plant, setting)
    n, late = held.push.size, held.samples
    size = n + late + 2  # plant, delayed outputs, integrator, filter
    rows = []
    for kp, ki, kd, weight in zip(*_law(gains, period_s), strict=True):
        measured = np.eye(size)[n]
        change = weight * (measured - np.eye(size)[-1])
        grown = -ki * measured
        u = np.eye(size)[-2] + grown - kp * measured - kd * change
        after = np.zeros((size, size))
        after[:n, :n] = held.step
        after[:n] += np.outer(held.push, u)
        after[n : n + late - 1, n + 1 : n + late] = np.eye(late - 1)
        after[n + late - 1, :n] = held.read
        after[n + late - 1] += held.feed * u
        after[-2] = np.eye(size)[-2] + grown
        after[-1] = np.eye(size)[-1] + change
        rows.append(np.linalg.eigvals(after))
    return np.array(rows, dtype=complex)
