"""Plan of a block: its segments, which of them count, and the resulting least squares."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from haselab import _sense
from haselab.base import InputError
from haselab.sensing.sensed import LockinConfig

__all__ = ["BlockPlan", "Weights", "make_plan"]

Floats = NDArray[np.float64]

_LANES = 16  # of core/hs_lockin.c: a segment of a multiple of these samples wastes none
_SHORTEST = 64
_FEW = 5  # segments of a block, enough to estimate its noise and disturbances
_LONGEST = 65535
_ALL = _sense.ROOM
_TESTED = 6  # full segments beside an update: their levels have three parameters
_PERIODS = 2.0  # fewest counted carrier periods
_PERIODS_ALONE = 1.0 - 1e-9


class Weights(NamedTuple):
    """Variances of the least-squares estimates for readings of variance 1; shape `(choices,)`.

    Args:
        quadrature: variance of one quadrature of a phasor.
        level: variance of the mean level.
        slope: variance of the slope, per s^2.
        middle_s: mean time of the counted samples, from the block's first sample.
    """

    quadrature: Floats
    level: Floats
    slope: Floats
    middle_s: Floats


@dataclass(frozen=True)
class BlockPlan:
    """Precomputed data of every block.

    Args:
        native: plan for the C code.
        weights: of each choice; the first is the planned one.
        counted: samples that the planned choice uses. Shape `(block_samples,)`.
        local_normal: normal matrix of a full segment over cosine, sine, 1 and sample / segment.
    """

    native: _sense.Plan
    weights: Weights
    counted: NDArray[np.bool_]
    local_normal: Floats


class _Choice(NamedTuple):
    native: NDArray[np.void]
    quadrature: float
    level: float
    slope: float
    middle_s: float


def _segment_length(config: LockinConfig) -> int:
    """Samples of a full segment: at least a carrier period.

    Short where segments are left out, long where all count, since each one costs time.
    """
    period = config.rate_hz / config.carrier_hz
    whole = config.blank[0] == config.blank[1] and not config.search_updates
    segments = _FEW if whole else _sense.SEGMENTS
    least = max(period, _SHORTEST, config.block_samples / segments)
    return min(_LANES * int(np.ceil(least / _LANES - 1e-9)), config.block_samples)


def make_plan(config: LockinConfig, *, alone: bool = False, vectors: int = 512) -> BlockPlan:
    """Plan the least squares for one configuration.

    Args:
        config: of the readings.
        alone: whether the block is one segment of at least a carrier period, combined with its
            neighbours.
        vectors: bits of the widest vector instructions that may be used, 0 for none. The results
            are the same.
    Returns:
        The plan.
    Raises:
        InputError: fewer than two carrier periods count, the carrier is above a third of the
            sampling rate, or a block exceeds the limit of the C code.
    """
    n = config.block_samples
    m = n if alone else _segment_length(config)
    _check(config, m, _PERIODS_ALONE if alone else _PERIODS)
    angle = 2.0 * np.pi * config.carrier_hz / config.rate_hz * np.arange(m)
    cosine, sine = np.cos(angle), np.sin(angle)
    starts = np.arange(0, n, m)
    sizes = np.minimum(m, n - starts)
    rest = int(n % m)
    table = np.array([[cosine.sum(), sine.sum()], [cosine[:rest].sum(), sine[:rest].sum()]])
    turn = np.zeros(_ALL)
    turn[: starts.size] = 2.0 * np.pi * (config.carrier_hz / config.rate_hz * starts % 1.0)
    turns = np.stack([np.cos(turn), np.sin(turn)])
    if starts.size == 1:  # the phase of a single segment still advances to the next block
        step = 2.0 * np.pi * (config.carrier_hz / config.rate_hz * m % 1.0)
        turns[:, 1] = np.cos(step), np.sin(step)
    local = _inverse(_normal(cosine, sine, (np.arange(m) - 0.5 * (m - 1)) / m))
    whitening = _inverse(local[:2, :2])
    choices = _choices(config, starts, sizes)
    native = _sense.Plan(
        samples=n,
        cosine=cosine,
        sine=sine,
        table=table,
        turn=turns,
        local=local,
        whitening=whitening,
        choices=np.concatenate([choice.native for choice in choices]),
        period_s=1.0 / config.rate_hz,
        omega_rad_s=2.0 * np.pi * config.carrier_hz,
        full_scale=config.full_scale,
        current_limit=config.current_limit,
        vectors=vectors,
    )
    weights = Weights(*(np.array(column) for column in zip(*(c[1:] for c in choices), strict=True)))
    counted = np.repeat(choices[0].native["used"][0, : starts.size].astype(bool), sizes)
    return BlockPlan(native, weights, counted, _normal(cosine, sine, np.arange(m) / m))


def _check(config: LockinConfig, segment: int, least: float) -> None:
    low, high = config.blank
    n = config.block_samples
    if config.search_updates and 0 < low < high < n:
        raise InputError(
            f"Samples [{low}, {high}) are blanked in mid-block, and updates are searched for as "
            "well, but a block can have only one step. Blank the start, or specify the update."
        )
    used = n - (high - low)
    periods = used * config.carrier_hz / config.rate_hz
    if not (periods >= least and config.carrier_hz <= config.rate_hz / 3.0 and used >= 8):
        raise InputError(
            f"Lock-in at {config.carrier_hz:g} Hz has {periods:g} periods in {used} samples of "
            f"{config.rate_hz:g} Hz; at least {least:.2g} periods and a carrier up to "
            f"{config.rate_hz / 3:g} Hz are required. Lengthen the block, or sample faster."
        )
    if segment > _LONGEST:
        raise InputError(
            f"A block of {n} samples is longer than {_LONGEST * _sense.SEGMENTS}. Shorten the "
            "block."
        )


def _inverse(matrix: Floats) -> Floats:
    return np.asarray(np.linalg.inv(matrix), dtype=np.float64)


def _normal(cosine: Floats, sine: Floats, ramp: Floats) -> Floats:
    basis = np.stack([cosine, sine, np.ones_like(cosine), ramp])
    return np.asarray(basis @ basis.T)


def _choices(config: LockinConfig, starts: NDArray[np.int64], sizes: NDArray[np.int64]) -> list[
    _Choice
]:  # fmt: skip
    """The planned choice, and, with a search, one for an update in each segment."""
    normals = _segment_normals(config, starts, sizes)
    low, high = config.blank
    ends = starts + sizes
    used = ~((starts < high) & (ends > low)) if high > low else np.ones(starts.size, dtype=bool)
    planned = [used]
    if config.search_updates:
        for k in range(starts.size):
            left = used.copy()
            left[k : k + 2] = False
            planned.append(left)
            if k > 1:  # the previous block's update still settles in the first segment
                early = left.copy()
                early[0] = False
                planned.append(early)
    found = [
        _choice(config, normals, starts, sizes, used, planned=k == 0)
        for k, used in enumerate(planned)
    ]
    if found[0] is None:
        raise InputError(
            f"Blanking [{low}, {high}) leaves too little of a block of {config.block_samples} "
            "samples, counted in carrier periods. Lengthen the block, or blank less."
        )
    return [choice for choice in found if choice is not None]


def _segment_normals(
    config: LockinConfig, starts: NDArray[np.int64], sizes: NDArray[np.int64]
) -> Floats:
    """Normal matrix of each segment over cosine, sine, 1 and the block's ramp."""
    n = config.block_samples
    index = np.arange(n)
    angle = 2.0 * np.pi * (config.carrier_hz / config.rate_hz * index % 1.0)
    ramp = (index - 0.5 * (n - 1)) / n
    return np.stack(
        [
            _normal(np.cos(angle[part]), np.sin(angle[part]), ramp[part])
            for part in (slice(k, k + size) for k, size in zip(starts, sizes, strict=True))
        ]
    )


def _choice(
    config: LockinConfig,
    normals: Floats,
    starts: NDArray[np.int64],
    sizes: NDArray[np.int64],
    used: NDArray[np.bool_],
    *,
    planned: bool,
) -> _Choice | None:
    """Least squares over the segments that count, with a step where they are interrupted."""
    n, full = config.block_samples, sizes == sizes[0]
    tested = int((used & full).sum())
    if not tested or sizes[used].sum() < _PERIODS_ALONE * (config.rate_hz / config.carrier_hz):
        return None
    gap = np.flatnonzero(~used)
    after = used & (np.arange(used.size) > gap[-1]) if gap.size else np.zeros_like(used)
    if gap.size and not (after & full).any():  # a separate level would absorb a tail
        used, after = used & ~after, np.zeros_like(used)
    if not (used & ~after).any() or not after.any():
        after = np.zeros_like(used)
    if not planned and tested < _TESTED:
        return None
    normal = np.zeros((5, 5))
    normal[:4, :4] = normals[used].sum(axis=0)
    columns = 4
    if after.any():
        normal[4, :4] = normal[:4, 4] = normals[after][:, 2].sum(axis=0)
        normal[4, 4] = normals[after][:, 2, 2].sum()
        columns = 5
    inverse = np.zeros((5, 5))
    inverse[:columns, :columns] = _inverse(normal[:columns, :columns])
    samples = float(sizes[used].sum())
    share = float(sizes[after].sum()) / samples
    level = np.array([0.0, 0.0, 1.0, 0.0, share])
    middles = starts + 0.5 * (sizes - 1)
    duration_s = n / config.rate_hz
    native = np.zeros(1, _sense.CHOICE)
    native["used"][0, : used.size] = used
    native["after"][0, : after.size] = after
    native["inverse"], native["samples"], native["after_share"] = inverse, samples, share
    native["full"] = (used & full).sum()
    return _Choice(
        native,
        0.5 * float(inverse[0, 0] + inverse[1, 1]),
        float(level @ inverse @ level),
        float(inverse[3, 3]) / duration_s**2,
        float((sizes * middles)[used].sum() / samples) / config.rate_hz,
    )
