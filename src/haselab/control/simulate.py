"""Exact simulation of one sampled loop in double precision: saturation, anti-windup, delay."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab import _loops
from haselab.base import InputError
from haselab.control.gains import PidGains, Saturation
from haselab.control.plants.held import HeldPlants
from haselab.models.actuator.strain_map import LARGEST_FEEDTHROUGH
from haselab.models.maps import allow_start
from haselab.models.plant import Plant

__all__ = ["LoopSetting", "LoopTrace", "simulate_drive", "simulate_loop"]

_FASTEST_HZ = 1e6
_LONGEST_DELAY = 1e4


@dataclass(frozen=True)
class LoopSetting:
    r"""Settings of a loop besides plant and controller.

    Args:
        rate_hz: sampling rate, in Hz.
        measurement_delay_s: age of a measurement when the output computed from it takes effect, in
            s (half the averaged block, and input/output), without the hold. The default, one
            period at 100 Hz, is that of every design, from Python and from the command line.
        saturation: limits of the controller's output.
        initial_u: constant drive strain before the first sample, at which the plant is in steady
            state.
        points_per_sample: points of the fine trace per sample.
        feedthrough: fraction $d$ of the steady-state change of the sensed strain that appears
            together with a step of the drive, before the plant moves. It is 0 for a measured
            length. Sensing by capacitance has one if the capacitance depends on the voltage as well
            as on the length, as that of pouches: the loop measures $(1 - d)\,P u + d\,P(0)\,u$ of a
            plant $P$, both with its delay.
        feedthrough_range: lowest and highest feedthrough over the loop's strains; None: it is the
            same for all of them.
    Raises:
        InputError: a rate, delay, feedthrough or count out of range, or `initial_u` outside the
            limits.
    """

    rate_hz: float = 100.0
    measurement_delay_s: float = 0.01
    saturation: Saturation = field(default_factory=Saturation)
    initial_u: float = 0.0
    points_per_sample: int = 4
    feedthrough: float = 0.0
    feedthrough_range: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        low, high = self.saturation.low, self.saturation.high
        within = low <= self.initial_u <= high
        within |= self.initial_u == 0.0 and allow_start((low, high))
        checks = (
            ("rate_hz", self.rate_hz,
             0.0 < self.rate_hz <= _FASTEST_HZ, f"above 0, up to {_FASTEST_HZ:g} Hz"),
            ("measurement_delay_s", self.measurement_delay_s,
             0.0 <= self.measurement_delay_s * self.rate_hz <= _LONGEST_DELAY,
             f"0 to {_LONGEST_DELAY:g} sampling periods"),
            ("initial_u", self.initial_u, within, f"[{low:g}, {high:g}]"),
            ("points_per_sample", self.points_per_sample, self.points_per_sample >= 1, "1 or more"),
            ("feedthrough", self.feedthrough, abs(self.feedthrough) <= LARGEST_FEEDTHROUGH,
             f"{-LARGEST_FEEDTHROUGH:g} to {LARGEST_FEEDTHROUGH:g}"),
        )  # fmt: skip
        for name, value, good, allowed in checks:
            if not good:
                raise InputError(f"{name} = {value:g}; it must be {allowed}.")


@dataclass(frozen=True)
class LoopTrace:
    """One simulated experiment.

    Args:
        time_s: fine time from the first sample, in s. Shape `(N * points_per_sample,)`.
        y: plant output in strain, without the feedthrough of the measurement, on the fine time.
        sample_time_s: sampling instants, in s. Shape `(N,)`.
        measured: measurement that the controller used (NaN without a controller). Shape `(N,)`.
        u: output of the controller, held until the next sample. Shape `(N,)`.
    """

    time_s: NDArray[np.float64]
    y: NDArray[np.float64]
    sample_time_s: NDArray[np.float64]
    measured: NDArray[np.float64]
    u: NDArray[np.float64]


def simulate_loop(
    plant: Plant,
    gains: PidGains,
    reference: ArrayLike,
    setting: LoopSetting,
    *,
    measurement_noise: ArrayLike | None = None,
) -> LoopTrace:
    """Simulate a closed loop, exact between the samples.

    At each sample the controller reads the plant's output delayed by `measurement_delay_s`, and its
    output is held until the next. Its integrator is frozen while the unlimited output is beyond a
    limit and the error would increase that. The PID is that of the C core, in double precision.

    Args:
        plant: plant; its own delay is between drive and output.
        gains: controller.
        reference: desired strain, one value per sample. Shape `(N,)`.
        setting: rate, delay, limits, initial drive.
        measurement_noise: added to the measurements, in strain. Shape `(N,)`.
    Returns:
        The trace.
    Raises:
        InputError: a vector that is empty, not finite or of another length.
    Source: variation of constants; controller as in `core/include/hs_pid_step.h`.
    Example:
        >>> trace = simulate_loop(Plant(1.0, 32.0, 0.5), PidGains(0.0, 3.0), [0.02] * 400,
        ...                       LoopSetting())
        >>> round(float(trace.y[-1]), 4)
        0.02
    """
    reference = _vector("reference", reference)
    noise = np.zeros(reference.size) if measurement_noise is None else measurement_noise
    noise = _vector("measurement_noise", noise, size=reference.size)
    u, measured = _run(plant, gains, reference, noise, setting)
    return _trace(plant, u, measured, setting)


def simulate_drive(plant: Plant, drive: ArrayLike, setting: LoopSetting) -> LoopTrace:
    """Simulate an open loop: the plant driven by a given drive strain, without a controller.

    Args:
        plant: plant.
        drive: drive strain, one value per sample. Shape `(N,)`.
        setting: rate and initial drive; a drive outside its limits is refused.
    Returns:
        The trace.
    Raises:
        InputError: the drive is empty, not finite or outside the limits.
    Example:
        >>> trace = simulate_drive(Plant(0.5, 20.0, 0.5), [0.04] * 200, LoopSetting())
        >>> round(float(trace.y[-1]), 6)
        0.02
    """
    drive = _vector("drive", drive)
    low, high = setting.saturation.low, setting.saturation.high
    if drive.min() < low or drive.max() > high:
        raise InputError(
            f"drive spans [{drive.min():g}, {drive.max():g}]; it must be within [{low:g}, "
            f"{high:g}]. Lower it, or widen the saturation."
        )
    return _trace(plant, drive, np.full(drive.size, np.nan), setting)


def _run(
    plant: Plant,
    gains: PidGains,
    reference: NDArray[np.float64],
    noise: NDArray[np.float64],
    setting: LoopSetting,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Controller outputs, and the measurements that they respond to."""
    period_s, u = 1.0 / setting.rate_hz, setting.initial_u
    held = HeldPlants.of(
        [plant],
        period_s=period_s,
        measurement_delay_s=setting.measurement_delay_s,
        feedthrough=setting.feedthrough,
    )
    weight = period_s / (period_s + gains.derivative_filter_s)
    limits = setting.saturation
    pid = _loops.ExactPid(
        kp=gains.kp,
        ki=gains.ki,
        kd=gains.kd,
        period_s=period_s,
        filter_constant=weight,
        u_low=limits.low,
        u_high=limits.high,
    )
    u_all, measured = np.empty(reference.size), np.empty(reference.size)
    _loops.run_exact(
        free=held.free[0].copy(),
        push=held.push[0].copy(),
        feed=float(held.feed[0]),
        slow_decay=held.slow_decay[0].copy(),
        slow_push=held.slow_push[0].copy(),
        state=u * held.rest[0],
        pid=pid,
        u_before=u,
        line=np.full(int(held.samples[0]), u * float(held.static_gain[0])),
        reference=reference,
        noise=noise,
        measured=measured,
        u=u_all,
    )
    return u_all, measured


def _trace(
    plant: Plant, u: NDArray[np.float64], measured: NDArray[np.float64], setting: LoopSetting
) -> LoopTrace:
    """Fine trace of a plant in steady state at the initial drive; only changes of drive act."""
    fine_s = np.arange(u.size * setting.points_per_sample) / (
        setting.rate_hz * setting.points_per_sample
    )
    moved = plant.simulate(u - setting.initial_u, setting.rate_hz, fine_s)
    y = setting.initial_u * plant.static_gain + moved
    return LoopTrace(fine_s, y, np.arange(u.size) / setting.rate_hz, measured, u)


def _vector(name: str, values: ArrayLike, size: int | None = None) -> NDArray[np.float64]:
    vector = np.asarray(values, dtype=float)
    if vector.ndim != 1 or vector.size == 0 or not np.isfinite(vector).all():
        raise InputError(
            f"{name} has shape {vector.shape} or contains NaN; it must be a finite vector with "
            "one value per sample."
        )
    if size is not None and vector.size != size:
        raise InputError(f"{name} has {vector.size} values; it must be {size}.")
    return vector
