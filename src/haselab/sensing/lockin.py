"""Least-squares lock-in: capacitance and series resistance from one block of both monitors."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab import _sense
from haselab.sensing.block.deviations import widen_deviations
from haselab.sensing.block.explain import DISTURBED, Explained, coarse_text, explain
from haselab.sensing.block.plan import make_plan
from haselab.sensing.block.tones import converter_step, rounding_error
from haselab.sensing.sensed import (
    Levels,
    LockinConfig,
    Phasors,
    Sensed,
    check_blocks,
    check_channels,
    middles_s,
    sensed_from_phasors,
)

__all__ = ["Lockin", "as_readings"]

_RESULT = _sense.RESULT  # of a block, by name: native/sensing/sense.h
_GLANCE, _VALUES = 256, 64  # readings, and distinct values below which a converter is coarse
_BLOCKS = 16  # blocks in which its step is searched for
_LOST = 4 | 8 | 32  # clipped, current limit, not finite: no model helps
_TOO_SHORT = "not the plain model; too few carrier periods in a block to find the cause"
_Taken = Callable[[NDArray[np.intp] | slice], NDArray[Any]]
_READ = (np.int16, np.float32, np.float64)


def as_readings(values: NDArray[Any]) -> NDArray[Any]:
    """Convert readings to the form of the C code: contiguous int16, float32 or float64."""
    kept = values.dtype in _READ
    return np.ascontiguousarray(values, dtype=values.dtype if kept else np.float64)


class Lockin:
    r"""Lock-in whose basis is sine, cosine, level and slope, so that a ramp causes no error.

    A block is cut into segments of a carrier period. One pass over the samples gives a few sums for
    each segment; least squares over the counted segments gives the phasors, and the residuals of
    each segment give the noise. A known update of the output is blanked (`LockinConfig.blank`), one
    at an unknown time is searched for (`search_updates`); each side has its own level.

    Args:
        config: see `LockinConfig`.
        models: find a model for blocks that the plain one does not explain, and refuse those
            that none explains. This requires noise in the readings.
    Raises:
        InputError: fewer than two carrier periods count, or the carrier is above a third of the
            sampling rate.
    Source: IEEE Std 1057, three-parameter sine fit, with a slope as fourth column.
    Example:
        >>> lockin = Lockin(LockinConfig(200e3, 2000, 2000.0, 0.0, 1e6))
        >>> t = np.arange(2000) / 200e3
        >>> wave = np.exp(2j * np.pi * 2000.0 * t)
        >>> block = np.stack([(1000 * wave).real, (2000j * wave).real], axis=1).round()
        >>> capacitance_f, _, valid = lockin.step(block.astype(np.int16))
        >>> round(capacitance_f * 2 * np.pi * 2000.0 * 500e3, 3), valid
        (1.0, True)
    """

    def __init__(self, config: LockinConfig, *, models: bool = True) -> None:
        self.config = config
        self._models = models
        plan = make_plan(config)
        self._native = plan.native
        self._weights = plan.weights
        self._counted = plan.counted
        scale_s, stray_s = config.admittance_scale_s, config.stray_s
        self._impedance = _sense.Impedance(
            scale_s.real,
            scale_s.imag,
            stray_s.real,
            stray_s.imag,
            config.omega_rad_s,
            config.min_amplitude_codes,
            float(plan.weights.quadrature[0]),
        )

    @property
    def middle_s(self) -> float:
        """Mean time of the counted samples, from a block's first sample, in s."""
        return float(self._weights.middle_s[0])

    @property
    def counted(self) -> NDArray[np.bool_]:
        """Samples of a block that count, shape `(block_samples,)`."""
        return self._counted.copy()

    def step(self, block: NDArray[Any]) -> tuple[float, float, bool]:
        """Process one block in a loop, by the C core.

        Args:
            block: shape `(block_samples, 2)`, voltage then current; int16, float32 or float64.
        Returns:
            Capacitance in F, series resistance in ohm, and whether they are valid.
        Raises:
            ValueError: the block has another length or type.
        """
        capacitance_f, resistance_ohm, reason = self._impedance(self._native, block)
        return capacitance_f, resistance_ohm, reason == 0

    def sense(self, readings: NDArray[Any]) -> Sensed:
        """Process many blocks, with standard deviations; the phasors are those of `step`.

        Args:
            readings: shape `(blocks, block_samples, 2)`, voltage then current.
        Returns:
            Results, arrays of shape `(blocks,)`; amplitudes in the unit of the readings.
        Raises:
            InputError: the shape does not fit the configuration.
        """
        check_blocks(readings, self.config)
        rows = np.empty(len(readings), _RESULT)
        _sense.blocks(self._native, as_readings(readings), rows)
        return self._sensed(rows, lambda blocks: readings[blocks])

    def sense_channels(self, v: NDArray[Any], i: NDArray[Any]) -> Sensed:
        """Process many blocks from two columns.

        Args:
            v: voltage monitor, shape `(blocks * block_samples,)`.
            i: current monitor, the same shape.
        Returns:
            Results, arrays of shape `(blocks,)`; amplitudes in the unit of the readings.
        Raises:
            InputError: unequal lengths, or not a whole number of blocks.
        """
        check_channels(v, i, self.config)
        rows = np.empty(v.size // self.config.block_samples, _RESULT)
        one, other = as_readings(v), as_readings(i)
        if one.dtype != other.dtype:
            one, other = one.astype(np.float64), other.astype(np.float64)
        _sense.channels(self._native, one, other, rows)
        shape = (-1, self.config.block_samples)
        pair = one.reshape(shape), other.reshape(shape)
        return self._sensed(
            rows, lambda blocks: np.stack([channel[blocks] for channel in pair], axis=2)
        )

    def _sensed(self, rows: NDArray[np.void], taken: _Taken) -> Sensed:
        phasors = self._phasors(rows)
        suspects = self._suspects(rows)
        if self._models and suspects.size:
            every = suspects.size == len(rows)
            found = explain(taken(slice(None) if every else suspects), self.config)
            if found is not None:
                phasors = _with_explained(phasors, suspects, found, self.config)
            else:
                phasors = _unexplained(phasors, suspects)
        if not self._models:
            return sensed_from_phasors(phasors, self.config)
        return widen_deviations(
            sensed_from_phasors(_without_coarse(phasors, rows, taken), self.config)
        )

    def _suspects(self, rows: NDArray[np.void]) -> NDArray[np.intp]:
        """Blocks that the plain model does not explain and that have no other fault."""
        reason = rows["reason"].astype(np.uint8)
        suspect = (rows["suspicion"] > 0) | (reason & ~np.uint8(_LOST) > 0)
        return np.flatnonzero(suspect & (reason & _LOST == 0))

    def _phasors(self, rows: NDArray[np.void]) -> Phasors:
        choice, weights = rows["choice"].astype(np.intp), self._weights
        # If the carrier's band scatters more than the noise beside it, its scatter is used.
        quadrature = weights.quadrature[choice] * rows["excess"]
        level, slope = weights.level[choice], weights.slope[choice]
        v_noise, i_noise = rows["v_noise"], rows["i_noise"]
        return Phasors(
            voltage=rows["v_re"] + 1j * rows["v_im"],
            current=rows["i_re"] + 1j * rows["i_im"],
            voltage_std=np.sqrt(quadrature * v_noise),
            current_std=np.sqrt(quadrature * i_noise),
            omega_rad_s=self.config.omega_rad_s + rows["offset_rad_s"],
            time_s=middles_s(self.config, weights.middle_s[choice]),
            reason=rows["reason"].astype(np.uint8),
            levels=Levels(
                rows["v_level"],
                rows["i_level"],
                np.sqrt(level * v_noise),
                np.sqrt(level * i_noise),
                rows["v_slope"],
                np.sqrt(slope * v_noise),
            ),
        )


def _without_coarse(phasors: Phasors, rows: NDArray[np.void], taken: _Taken) -> Phasors:
    """Add the converter's rounding error to plain blocks; refuse them where it dominates."""
    count = len(rows)
    few = taken(np.unique([0, count // 2, max(count - 1, 0)]))[:, :_GLANCE] if count else rows
    if count == 0 or all(np.unique(few[..., c]).size > _VALUES for c in (0, 1)):
        return phasors
    step = converter_step(taken(np.unique(np.linspace(0, count - 1, _BLOCKS).astype(np.intp))))
    plain = (phasors.reason == 0) & ~np.isin(np.arange(count), list(phasors.seen))
    plain &= (np.abs(phasors.voltage) > 0.0) & (np.abs(phasors.current) > 0.0)
    sizes = np.abs(np.stack([phasors.voltage, phasors.current])[:, plain])
    noise = np.stack([rows["v_noise"], rows["i_noise"]])[:, plain]
    stds = np.stack([phasors.voltage_std, phasors.current_std])[:, plain]
    error = rounding_error(sizes, np.sqrt(noise), step) * sizes
    coarse = np.hypot(*(error / sizes)) > np.hypot(*(stds / sizes))
    at = np.flatnonzero(plain)
    voltage_std, current_std = phasors.voltage_std.copy(), phasors.current_std.copy()
    voltage_std[at], current_std[at] = np.hypot(stds, error)
    reason = phasors.reason.copy()
    reason[at[coarse]] |= DISTURBED
    seen = dict(phasors.seen) | dict.fromkeys(at[coarse].tolist(), coarse_text(step))
    return replace(
        phasors, voltage_std=voltage_std, current_std=current_std, reason=reason, seen=seen
    )


def _unexplained(phasors: Phasors, blocks: NDArray[np.intp]) -> Phasors:
    """Refuse blocks that contradict the plain model and are too short for any other."""
    reason = phasors.reason.copy()
    plain = reason[blocks] == 0
    reason[blocks[plain]] |= DISTURBED
    return replace(
        phasors,
        reason=reason,
        seen=dict(phasors.seen) | dict.fromkeys(blocks[plain].tolist(), _TOO_SHORT),
    )


def _with_explained(
    phasors: Phasors, blocks: NDArray[np.intp], found: Explained, config: LockinConfig
) -> Phasors:
    """Use the results of a slower model where it explains a block; keep those of refused blocks."""
    described = np.array([text != "" for text in found.texts]) | (found.reason != 0)
    seen = {
        int(b): text for b, text, shown in zip(blocks, found.texts, described, strict=True) if shown
    }
    reason = phasors.reason.copy()
    reason[blocks] = found.reason
    kept = described & (found.reason == 0)
    blocks = blocks[kept]
    changed: dict[str, Any] = {}
    for name in ("voltage", "current", "voltage_std", "current_std", "omega_rad_s"):
        values = getattr(phasors, name).copy()
        values[blocks] = getattr(found, name)[kept]
        changed[name] = values
    changed["omega_rad_s"][blocks] += config.omega_rad_s
    time_s = phasors.time_s.copy()
    time_s[blocks] = config.block_s * blocks + found.middle_s[kept]
    if phasors.levels is not None:  # a straight line does not give the leakage here
        levels = {f.name: getattr(phasors.levels, f.name).copy() for f in fields(Levels)}
        for values in levels.values():
            values[blocks] = np.nan
        changed["levels"] = Levels(**levels)
    return replace(
        phasors,
        **changed,
        time_s=time_s,
        reason=reason,
        seen=seen,
    )
