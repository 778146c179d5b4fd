"""Capacitance without a carrier: integrated current over voltage."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.sensing.charge.flat_tops import flat_tops
from haselab.sensing.charge.noise import Noise, dither_of, hum_of, noise_of
from haselab.sensing.charge.offset import Offset, fit_offset
from haselab.sensing.charge.path import Anchors, Path, find_anchors, runs_of
from haselab.sensing.sensed import (
    AMPLITUDE_LOST,
    CLIPPED,
    CURRENT_LIMIT,
    NOT_FINITE,
    PHASE_OUT,
    Sensed,
    check_blocks,
    check_channels,
)

__all__ = ["Charge", "ChargeConfig"]

Floats = NDArray[np.float64]

_DISTURBED = 128
_SHORTEST = 16  # samples of a block
_POINTS = 256  # smallest number of points kept of a block that has as many
_MOST_POINTS = 40_000_000  # of a record: 640 MB
_MOST_COMPENSATION = 0.1  # share of the voltage's mean square that is noise
_FEW_VALUES = 3
_FEWEST_STEPS = 5.0  # converter steps in the voltage's rms; with fewer, rounding is not noise
_MOST_STD = 0.2  # of the capacitance
_MOST_OF_STEPS = 0.1  # the same for a bias common to all blocks
_CLEAR = 5.0  # standard deviations
_TOO_UNCERTAIN = {
    "noise": "drive hardly changes compared with the noise",
    "offset": "offset of the current not known outside two crossings of 0 V",
    "leakage": "leakage not separable",
    "step": "converter step too coarse for the current",
    "wander": "offset of the current drifts",
}
_NOTABLE = 0.5  # share of the variance above which a cause is reported


@dataclass(frozen=True)
class ChargeConfig:
    """Configuration for sensing a record without a carrier.

    Args:
        rate_hz: samples per second and channel.
        block_samples: samples per block, at least 16.
        ohm_per_ratio: impedance for equal readings on both channels, in ohm:
            (V per V of the amplifier output) / (A per V) of the two monitors.
        skew_s: time from a voltage sample to its current sample; less than a quarter of a block.
        full_scale: a reading of this magnitude is out of the converter's range, unit of the
            readings.
        current_limit: the same for the current monitor at the amplifier's current limit.
    Raises:
        InputError: a value outside its range.
    """

    rate_hz: float
    block_samples: int
    ohm_per_ratio: float
    skew_s: float = 0.0
    full_scale: float = float("inf")
    current_limit: float = float("inf")

    def __post_init__(self) -> None:
        for name in ("rate_hz", "ohm_per_ratio"):
            value = getattr(self, name)
            if not 0.0 < value < float("inf"):
                raise InputError(f"{name} is {value:g}, but must be a finite number above 0.")
        if self.block_samples < _SHORTEST:
            raise InputError(
                f"A block has {self.block_samples} samples, but sensing by charge requires "
                f"at least {_SHORTEST}. Lengthen the block."
            )
        if not abs(self.skew_s) < 0.25 * self.block_s:
            raise InputError(
                f"skew_s is {self.skew_s:g} s, but must be less than a quarter of a block, "
                f"{0.25 * self.block_s:g} s. Lengthen the block."
            )

    @property
    def block_s(self) -> float:
        """Duration of one block, in s."""
        return self.block_samples / self.rate_hz

    @property
    def points(self) -> int:
        """Points of a block that are kept, each the mean of `thinning` samples."""
        return self.block_samples // self.thinning

    @property
    def thinning(self) -> int:
        """Samples averaged per point; a divisor of the block length."""
        most = max(1, self.block_samples // _POINTS)
        return next(n for n in range(most, 0, -1) if self.block_samples % n == 0)


@dataclass(frozen=True)
class _Record:
    """A whole record, thinned: arrays of shape `(blocks, points)` and `(blocks,)`."""

    v: Floats
    i: Floats
    reason: NDArray[np.uint8]
    v_pp: Floats
    i_pp: Floats
    step: Floats
    dither: NDArray[np.intp]


@dataclass
class _Rows:
    """Results under construction, in the unit of the readings; arrays of shape `(blocks,)`."""

    kappa: Floats
    variance: Floats
    reason: NDArray[np.uint8]
    seen: dict[int, str] = field(default_factory=dict)
    causes: dict[int, str] = field(default_factory=dict)  # main cause of the std

    def refuse(self, block: int, reason: int, text: str) -> None:
        """Mark a block as not valid."""
        self.reason[block] |= reason
        self.kappa[block] = self.variance[block] = np.nan
        self.seen[block] = text


class Charge:
    r"""Capacitance from charge over voltage, for records without a carrier.

    $q(t) = \int (i - i_0 - G v)\,dt,\quad C = \sum v q \big/ (\sum v^2 - N\sigma_v^2)$

    The charge is zero where the voltage passes 0 V: there, at the anchors, the integral is set
    to zero, so that an offset $i_0$ of the current monitor cancels between two of them. C is
    the mean of $q/v$ in a block with the weight $v^2$; it may be an arbitrary function of voltage
    and time. $G$ comes from the anchors if their intervals have different mean voltages, otherwise
    from the energy lost per cycle: half of the value that explains all of the loss, with
    an equal standard deviation, because a hysteresis of C also loses energy.

    The standard deviation includes the noise of both monitors, the random walk of the integral, the
    anchors, $i_0$ and $G$, kinks between two samples and steps of the converter. A series
    resistance is not identified; `resistance_ohm` is NaN.

    A record is added in chunks of whole blocks; each block is kept as about 256 points if its
    number of samples has a suitable divisor.

    Args:
        config: see `ChargeConfig`.
    Example:
        >>> time_s = np.arange(8000) / 1e3
        >>> turn = time_s / 2 % 1
        >>> v = 2.0 * (1 - np.abs(2 * turn - 1))  # triangle, 0 to 2 V, one each 2 s
        >>> i = 2.5e6 * 1e-9 * np.where(turn < 0.5, 2.0, -2.0)  # 1 nF
        >>> noise = np.random.default_rng(1).normal(0.0, 1e-4, (2, 8000))
        >>> charge = Charge(ChargeConfig(1e3, 500, 2.5e6))
        >>> sensed = charge.sense_channels(v + noise[0], i + noise[1])
        >>> bool(sensed.valid.all()), round(float(sensed.capacitance_f.mean()) * 1e9, 2)
        (True, 1.0)
    """

    def __init__(self, config: ChargeConfig) -> None:
        self.config = config
        self._parts: list[_Record] = []
        self._points = 0

    def sense(self, readings: NDArray[Any]) -> Sensed:
        """Capacitance of a whole record.

        Args:
            readings: shape `(blocks, block_samples, 2)`, voltage then current.
        Returns:
            Results, arrays of shape `(blocks,)`.
        Raises:
            InputError: the shape does not fit the configuration.
        """
        check_blocks(readings, self.config)
        return self.sense_channels(readings[:, :, 0].ravel(), readings[:, :, 1].ravel())

    def sense_channels(self, v: NDArray[Any], i: NDArray[Any]) -> Sensed:
        """Capacitance of a record from two columns of shape `(blocks * block_samples,)`."""
        self.add(v, i)
        return self.finish()

    def add(self, v: NDArray[Any], i: NDArray[Any]) -> None:
        """Add the next blocks of a record.

        Args:
            v: voltage monitor, shape `(blocks * block_samples,)`.
            i: current monitor, the same shape.
        Raises:
            InputError: the shapes differ or are not whole blocks, or the record is too long.
        """
        check_channels(v, i, self.config)
        part = _thinned(v, i, self.config)
        self._points += part.v.size
        if self._points > _MOST_POINTS:
            raise InputError(
                f"The record has more than {_MOST_POINTS} points, the limit of sensing by charge. "
                "Use blocks of a multiple of 256 samples, or cut the record."
            )
        self._parts.append(part)

    def finish(self) -> Sensed:
        """Sense the added blocks, and start a new record.

        Returns:
            Results, arrays of shape `(blocks,)`.
        """
        parts, self._parts, self._points = self._parts, [], 0
        if not parts:
            parts = [_thinned(np.empty(0), np.empty(0), self.config)]
        record = _Record(
            v=np.concatenate([part.v for part in parts]),
            i=np.concatenate([part.i for part in parts]),
            reason=np.concatenate([part.reason for part in parts]),
            v_pp=np.concatenate([part.v_pp for part in parts]),
            i_pp=np.concatenate([part.i_pp for part in parts]),
            step=np.max([part.step for part in parts], axis=0),
            dither=np.sum([part.dither for part in parts], axis=0),
        )
        return _sensed(record, self.config)


def _thinned(v: NDArray[Any], i: NDArray[Any], config: ChargeConfig) -> _Record:
    """Blocks as means of neighbouring samples, with the faults of each."""
    blocks = v.size // config.block_samples
    means, most, pp = [], [], []
    used = config.points * config.thinning
    for channel in (v, i):
        block = channel.reshape(blocks, config.block_samples).astype(np.float64)
        low, high = block.min(axis=1, initial=np.inf), block.max(axis=1, initial=-np.inf)
        most.append(np.maximum(-low, high))
        pp.append(high - low)
        means.append(block[:, :used].reshape(blocks, config.points, config.thinning).mean(axis=2))
    size = np.stack(most, axis=1).reshape(blocks, 2)
    reason = np.where((size >= config.full_scale).any(axis=1), CLIPPED, 0)
    reason |= np.where(size[:, 1] >= config.current_limit, CURRENT_LIMIT, 0)
    reason = np.where(np.isfinite(size).all(axis=1), reason, NOT_FINITE)
    steps = _steps(v, i, reason)
    dither = dither_of(i, float(steps[1]))
    return _Record(means[0], means[1], reason.astype(np.uint8), pp[0], pp[1], steps, dither)


def _steps(v: NDArray[Any], i: NDArray[Any], reason: NDArray[Any]) -> Floats:
    """Steps of the converter on both channels, shape `(2,)`; 0 where there are none."""
    from haselab.sensing.block.tones import converter_step  # scipy takes half a second to import

    length = v.size // max(1, reason.size)
    fine = np.repeat(reason & NOT_FINITE == 0, length)
    if not fine.any():
        return np.zeros(2)
    steps = converter_step(np.stack([v[fine], i[fine]], axis=1)[np.newaxis])
    if steps[0] > 0.0 and steps[1] == 0.0 and np.unique(i[fine]).size <= _FEW_VALUES:
        steps[1] = max(steps[0], float(np.ptp(i[fine])))  # too few values to find the step
    return steps


def _sensed(record: _Record, config: ChargeConfig) -> Sensed:
    blocks = len(record.v)
    rows = _Rows(np.full(blocks, np.nan), np.full(blocks, np.nan), record.reason.copy())
    leakage = (np.nan, np.nan)
    runs = [] if blocks == 0 else runs_of(record.reason == 0)
    if runs:
        leakage = _sense_runs(record, runs, config, rows)
        if rows.reason.all():
            _name_swapped(record, runs, config, rows)
    valid = rows.reason == 0
    nan = np.full(blocks, np.nan)
    middle_s = 0.5 * (config.points * config.thinning - 1) / config.rate_hz
    return Sensed(
        time_s=middle_s + config.block_s * np.arange(blocks, dtype=np.float64),
        capacitance_f=rows.kappa / config.ohm_per_ratio,
        capacitance_std_f=np.sqrt(rows.variance) / config.ohm_per_ratio,
        resistance_ohm=nan,
        resistance_std_ohm=nan,
        leakage_s=np.where(valid, leakage[0] / config.ohm_per_ratio, nan),
        leakage_std_s=np.where(valid, leakage[1] / config.ohm_per_ratio, nan),
        phase_rad=nan,
        v_pp=record.v_pp,
        i_pp=record.i_pp,
        valid=valid,
        reason=rows.reason,
        seen=rows.seen,
    )


def _sense_runs(
    record: _Record, runs: list[slice], config: ChargeConfig, rows: _Rows
) -> tuple[float, float]:
    """Fill the rows of all runs of good blocks; return leakage and its standard deviation."""
    point_s = config.thinning / config.rate_hz
    noise = noise_of(record.v, record.i, runs, record.step, config.thinning, record.dither)
    most = max(float(np.abs(record.v[run]).max()) for run in runs)
    paths = []
    for run in runs:
        v, i = record.v[run].ravel(), record.i[run].ravel()
        hum = hum_of(v, i, point_s)
        path = Path.of(v, i, point_s, config.skew_s, noise, hum)
        paths.append((run, path, find_anchors(path, most, config.points, noise)))
    offset = fit_offset([(path, anchors) for _, path, anchors in paths])
    started_s = 0.0
    for (run, path, anchors), bad in zip(paths, offset.broken, strict=True):
        from_s, started_s = offset.middle_s - started_s, started_s + float(path.time[-1])
        path, anchors = path.without_drift(anchors, offset.slope, from_s)
        v, i = record.v[run].ravel(), record.i[run].ravel() - offset.level
        slow = (path.v, np.gradient(path.charge, point_s) - offset.level) if path.hum_hz else None
        flat = flat_tops(v, i, noise, record.step, slow)
        _sense_run(run, path, anchors, bad, flat, (offset, noise), rows, config)
    _judge(rows)
    if offset.leakage < -_CLEAR * offset.leakage_std:
        _name_skew(record, runs, offset, noise, rows, config)
        return np.nan, np.nan
    return offset.leakage, offset.leakage_std


def _name_swapped(record: _Record, runs: list[slice], config: ChargeConfig, rows: _Rows) -> None:
    """Report swapped columns if the other order gives a capacitance in most of the blocks."""
    other = replace(record, v=record.i, i=record.v, step=record.step[::-1])
    nan = np.full(rows.kappa.size, np.nan)
    trial = _Rows(nan, nan.copy(), np.zeros_like(rows.reason))
    _sense_runs(other, runs, config, trial)
    right = [b for run in runs for b in range(run.start, run.stop) if trial.reason[b] == 0]
    if 2 * len(right) > sum(run.stop - run.start for run in runs):
        for block in right:
            rows.reason[block] = 0
            rows.refuse(block, PHASE_OUT, "the columns seem swapped")


def _name_skew(
    record: _Record, runs: list[slice], offset: Offset, noise: Noise, rows: _Rows,
    config: ChargeConfig,
) -> None:  # fmt: skip
    """Report a skew in valid blocks where the charge leads or lags the voltage."""
    valid = np.flatnonzero(rows.reason == 0)
    if not valid.size:
        return
    v = np.concatenate([record.v[run].ravel() for run in runs])
    i = np.concatenate([record.i[run].ravel() for run in runs]) - offset.level
    # Where i = k v', a current that is late by d has the conductance -k d <v'^2> / <v^2>.
    moved = max(float(i @ i) - i.size * noise.i_var, 1e-300)
    kappa = float(np.median(rows.kappa[valid]))
    skew_s = config.skew_s - offset.leakage * kappa * float(v @ v) / moved
    text = f"negative leakage, as from a skew of {1e3 * skew_s:.2g} ms"
    for block in valid.tolist():
        rows.seen[block] = "; ".join(part for part in (rows.seen.get(block, ""), text) if part)


def _sense_run(
    run: slice,
    path: Path,
    anchors: Anchors,
    bad: NDArray[np.bool_],
    flat: tuple[NDArray[np.bool_], NDArray[np.bool_]],
    known: tuple[Offset, Noise],
    rows: _Rows,
    config: ChargeConfig,
) -> None:
    if anchors.at.size == 0:
        for block in range(run.start, run.stop):
            rows.refuse(block, _DISTURBED, "charge unknown: the voltage does not cross 0 V")
        return
    tied = path.tied(anchors)
    stuck = np.unique(np.searchsorted(anchors.at, np.flatnonzero(flat[1])))
    for k, block in enumerate(range(run.start, run.stop)):
        part = slice(k * config.points, (k + 1) * config.points)
        text = path.fault(anchors, bad, part)
        first, last = np.searchsorted(anchors.at, (part.start, part.stop - 1))
        if flat[0][part].any():
            text = "flat top: the voltage monitor saturates"
        elif ((stuck >= first) & (stuck <= last)).any():
            text = "flat top: the current monitor saturates"
        if text:
            rows.refuse(block, _DISTURBED, text)
            continue
        _sense_block(block, part, (path, anchors, tied, *known), rows)


def _sense_block(
    block: int,
    part: slice,
    known: tuple[Path, Anchors, tuple[Floats, Floats, Floats], Offset, Noise],
    rows: _Rows,
) -> None:
    path, anchors, (charge, time, area), offset, noise = known
    v = path.v[part]
    energy = float(v @ v)
    idle = v.size * noise.v_var / path.smoothing
    if not max(idle / _MOST_COMPENSATION, v.size * (_FEWEST_STEPS * noise.v_step) ** 2) < energy:
        rows.refuse(block, AMPLITUDE_LOST, "drive hardly changes")
        return
    below = energy - idle
    by_time, by_area = float(v @ time[part]), float(v @ area[part])
    if by_time != 0.0 and not np.isfinite(offset.level_var) and abs(by_time) > 1e-9 * energy:
        rows.refuse(block, _DISTURBED, "offset not separable: fewer than two crossings of 0 V")
        return
    level, leakage = offset.level, offset.leakage
    kappa = (float(v @ charge[part]) - level * by_time - leakage * by_area) / below
    walk = path.walk_variance(anchors, part) * offset.inflation**2
    doubt = (by_area - offset.mean_voltage * by_time) ** 2 * offset.leakage_std**2
    outside = by_time**2 * offset.level_var if by_time else 0.0
    own = kappa**2 * (noise.v_var * below + 2 * idle * noise.v_var)
    coarse = (kappa * below * noise.coarse) ** 2
    parts = {"noise": walk + own, "offset": outside, "leakage": doubt, "step": coarse}
    total = sum(parts.values())
    rows.kappa[block], rows.variance[block] = kappa, total / below**2
    most = max(parts, key=lambda name: parts[name])
    wanders = most == "noise" and offset.wanders
    rows.causes[block] = "wander" if wanders else most
    words = [f"hum at {path.hum_hz:g} Hz"] if path.hum_hz else []
    words += ["leakage or hysteresis"] if doubt > _NOTABLE * total and offset.by_loss else []
    if words:
        rows.seen[block] = "; ".join(words)


def _judge(rows: _Rows) -> None:
    """Refuse blocks that are too uncertain relative to the record's mean.

    Relative to a block's own capacitance, noise would select the largest values.
    """
    blocks = np.array(sorted(rows.causes), dtype=np.intp)
    weights = 1.0 / np.maximum(rows.variance[blocks], 1e-300)
    mean = float(weights @ rows.kappa[blocks] / weights.sum()) if blocks.size else 0.0
    for block in blocks.tolist():
        std, cause = float(rows.variance[block]) ** 0.5, rows.causes[block]
        if rows.kappa[block] < -_CLEAR * std:
            rows.refuse(block, PHASE_OUT, "negative: one monitor inverted, or the columns swapped")
        elif not std < (_MOST_OF_STEPS if cause == "step" else _MOST_STD) * mean:
            reason = AMPLITUDE_LOST if cause == "noise" else _DISTURBED
            rows.refuse(block, reason, _TOO_UNCERTAIN[cause])
