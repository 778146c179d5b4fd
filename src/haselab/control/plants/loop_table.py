"""Loops in the form of `native/loops/loops.c`, and the noise on their measurements."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab import _loops
from haselab.base import InputError
from haselab.control.gains import PidGains
from haselab.control.plants.held import HeldPlants
from haselab.control.simulate import LoopSetting
from haselab.models.plant import Plant

__all__ = ["Disturbance", "LoopTable", "WhiteNoise"]

_LONGEST_DELAY = 2**20  # samples
_LARGEST = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class WhiteNoise:
    """Normal noise, generated while the loops run, without memory for its samples.

    Sample `k` of loop `b` depends on the seed, `b` and `k` only. Values are limited to 5.4
    standard deviations.

    Args:
        std: standard deviation, in strain; one value for all loops, or one each. Shape `()` or
            `(B,)`.
        seed: 0 or more.
    Raises:
        InputError: a standard deviation or a seed below 0, or not finite.
    Source: `native/loops/loops_noise.h`.
    """

    std: ArrayLike
    seed: int = 0

    def __post_init__(self) -> None:
        std = np.asarray(self.std, dtype=float)
        if std.ndim > 1 or std.size == 0 or not ((std >= 0.0) & (std < np.inf)).all():
            raise InputError(
                f"std of the noise has shape {std.shape} and spans [{std.min(initial=np.inf):g}, "
                f"{std.max(initial=-np.inf):g}]; it must be one value, or one per loop, 0 or more."
            )
        if self.seed < 0:
            raise InputError(f"seed = {self.seed}; it must be 0 or more.")


@dataclass(frozen=True)
class Disturbance:
    """Noise in the form of the loops: values, or seeds of generated noise, or neither.

    Args:
        values: noise. Shape `(B, N)` or `(0, 0)`.
        seeds: seeds of the samples and of the loops. Shape `(2,)` or `(0,)`.
    """

    values: NDArray[np.float32]
    seeds: NDArray[np.uint32]

    @classmethod
    def of(cls, noise: ArrayLike | WhiteNoise | None, loops: int, samples: int) -> Disturbance:
        """Check and convert the noise given by a user.

        Raises:
            InputError: a shape that fits neither common nor separate noise, an infinity.
        """
        no_values, no_seeds = np.zeros((0, 0), np.float32), np.zeros(0, np.uint32)
        if noise is None:
            return cls(no_values, no_seeds)
        if isinstance(noise, WhiteNoise):
            seeds = np.random.SeedSequence(noise.seed).generate_state(2)
            return cls(no_values, seeds.astype(np.uint32))
        with np.errstate(over="ignore"):
            given = np.asarray(noise, dtype=np.float32)
        if given.shape not in ((samples,), (loops, samples)) or np.isinf(given).any():
            raise InputError(
                f"measurement_noise has shape {given.shape} or contains an infinity; it must be "
                f"({samples},) or ({loops}, {samples}), with finite or NaN values."
            )
        return cls(np.ascontiguousarray(np.broadcast_to(given, (loops, samples))), no_seeds)


@dataclass(frozen=True)
class LoopTable:
    """Loops as rows of a table.

    Args:
        rows: coefficients, states at the start, controller, noise. Shape `(B,)`.
        branches: number of slow branches.
        period_s: time between samples, in s.
    """

    rows: NDArray[np.void]
    branches: int
    period_s: float

    @classmethod
    def of(
        cls,
        plants: Sequence[Plant],
        gains: Sequence[PidGains],
        setting: LoopSetting,
        noise_std: ArrayLike = 0.0,
    ) -> LoopTable:
        """Build the table from one plant and one controller per loop, with one setting.

        Raises:
            InputError: no loop, unequal numbers, too many slow modes, too long a delay, a value
                beyond single precision.
        """
        if len(plants) != len(gains) or not plants:
            raise InputError(
                f"{len(plants)} plants and {len(gains)} controllers; there must be one controller "
                "per plant, 1 or more. Repeat a common one."
            )
        branches = max(len(plant.slow_modes) for plant in plants)
        if branches > _loops.SLOW:
            raise InputError(
                f"a plant has {branches} slow modes; at most {_loops.SLOW} are possible. Leave "
                "out the smallest."
            )
        if np.size(noise_std) not in (1, len(plants)):
            raise InputError(
                f"noise has {np.size(noise_std)} standard deviations; it must have 1 or "
                f"{len(plants)}, one per loop."
            )
        period_s = 1.0 / setting.rate_hz
        held = HeldPlants.of(
            plants,
            period_s=period_s,
            measurement_delay_s=setting.measurement_delay_s,
            feedthrough=setting.feedthrough,
        )
        if held.samples.max() >= _LONGEST_DELAY:
            raise InputError(
                f"the longest delay is {held.samples.max()} samples; it must be below "
                f"{_LONGEST_DELAY}. Lower the rate or the delay."
            )
        rows = _rows(held, gains, setting, noise_std)
        largest = float(np.abs(rows.view(np.float64)).max())
        if not largest < _LARGEST:
            raise InputError(
                f"a loop contains the value {largest:g}; it must be in the range of single "
                f"precision, below {_LARGEST:.1e}. Check gains and plants."
            )
        return cls(rows, branches, period_s)

    def loops(self) -> _loops.Loops:
        """The loops, ready to run."""
        return _loops.Loops(self.rows, self.period_s, self.branches)


def _rows(
    held: HeldPlants, gains: Sequence[PidGains], setting: LoopSetting, noise_std: ArrayLike
) -> NDArray[np.void]:
    """The loops as the C code reads them; branches that a plant does not have are 0."""
    loops, branches = held.slow_decay.shape
    u = float(np.float32(setting.initial_u))  # as in the controller
    rows = np.zeros(loops, _loops.LOOP)
    rows["free"], rows["push"], rows["feed"] = held.free, held.push, held.feed
    rows["slow_decay"][:, :branches] = held.slow_decay
    rows["slow_push"][:, :branches] = held.slow_push
    rows["start"], rows["slow_start"][:, :branches] = np.split(held.rest * u, [2], axis=1)
    rows["kp"], rows["ki"], rows["kd"], rows["filter_s"] = np.array(
        [(g.kp, g.ki, g.kd, g.derivative_filter_s) for g in gains]
    ).T
    rows["u_low"], rows["u_high"] = setting.saturation.low, setting.saturation.high
    rows["u"], rows["rest"] = u, held.static_gain * u
    rows["delay"], rows["noise_std"] = held.samples, noise_std
    return rows
