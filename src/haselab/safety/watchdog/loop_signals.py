"""Checks of individual signals of a closed loop: range, repetition, jumps, oscillation, delay."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from haselab.safety.watchdog.loop_model import LoopModel, capacitance_range
from haselab.safety.watchdog.settings import WatchdogSettings

__all__ = ["WINDOW_S", "Delay", "Jumps", "Plausible", "Repeats", "Swings"]

WINDOW_S = 0.5
_MEMORY_S = 1.0  # window in which a value must not repeat often
_SLACK = 0.05  # relative difference from the capacitance of slack pouches
_CHATTER_S = 0.2
_RECENT = 4  # blocks, besides queued ones, whose drives act on three strains in a row
_SLOW_S = 3.0
_SCATTER = 6.0  # a single change may exceed its limit by this multiple of the recent RMS
_ASKED = 2  # reversals of the drive explained by one of the reference: there, and back
_REFERENCE_SWING = 0.01  # smallest reversal of the reference, as a fraction of the strain range
_LAGS = 10
_FOLLOWED = 24  # blocks compared at each lag
_LAG_EVERY = 3
_LAG_RATIO = 3.0  # ratio of residuals: expected lag to best lag
_LEAST_CODES = 1.0  # smallest residual; less is converter noise


class Plausible:
    """Check that strain and capacitance are within the calibrated range of the maps."""

    def __init__(self, model: LoopModel, settings: WatchdogSettings) -> None:
        margin = settings.range_margin * model.range
        self._low, self._high = model.strain_low - margin, model.strain_high + margin
        self._farad, self._slack_f = (0.0, math.inf), model.slack_f
        if model.capacitance_map is not None:
            self._farad = capacitance_range(
                model.capacitance_map, self._low, self._high, model.capacitance_f
            )

    def fault(self, strain: float, capacitance_f: float | None) -> str:
        """Return why the loop must stop, or an empty text; missing values (NaN) are ignored."""
        low_f, high_f = self._farad
        if capacitance_f is not None and abs(capacitance_f - self._slack_f) < min(
            _SLACK * self._slack_f, low_f - self._slack_f
        ):
            return (
                f"Capacitance out of range: {capacitance_f:.4g} F, but the strain map covers "
                f"{low_f:.3g} to {high_f:.3g} F. The pouches of this actuator have "
                f"{self._slack_f:.3g} F at 0 V, where they are slack at any length: keep the "
                "desired strain away from that of 0 V, or design the controller again. If the "
                "drive was not near 0 V, check the monitors and their cables."
            )
        if capacitance_f is not None and not low_f <= capacitance_f <= high_f:
            return (
                f"Capacitance out of range: {capacitance_f:.4g} F, but the strain map covers "
                f"{low_f:.3g} to {high_f:.3g} F. Check the monitors, their cables and the actuator."
            )
        if not self._low <= strain <= self._high:
            return (
                f"Strain out of range: {strain:.4g}, but the maps cover {self._low:.3g} to "
                f"{self._high:.3g} (range and margin). Check the sensor and the strain map."
            )
        return ""


class Repeats:
    """Detect a frozen signal: a measured signal with noise never repeats itself exactly."""

    def __init__(self, what: str, block_s: float, repeat_s: float, advice: str) -> None:
        self._what, self._advice = what, advice
        self._limit = max(round(repeat_s / block_s), 2)
        self._kept = max(round(_MEMORY_S / block_s), self._limit)
        self._order: deque[float] = deque()
        self._counts: dict[float, int] = {}
        self._last = math.nan
        self._again = self._same = 0

    def fault(self, value: float) -> str:
        """Return why the loop must stop, or an empty text; pass a block by its hash."""
        counts = self._counts
        self._again = self._again + 1 if value in counts else 0
        self._same = self._same + 1 if value == self._last else 0
        self._last = value
        counts[value] = counts.get(value, 0) + 1
        self._order.append(value)
        if len(self._order) > self._kept:
            old = self._order.popleft()
            counts[old] -= 1
            if not counts[old]:
                del counts[old]
        if self._again < self._limit:
            return ""
        how = "stuck at one value" if self._same >= self._limit else "repeating old values"
        return f"{self._what} {how} for {self._again} values in a row. {self._advice}"


class Jumps:
    """Check changes of the strain rate, which the actuator's inertia limits.

    Args:
        model: of the loop.
        settings: limits.
        rest: static strain of the drive before the loop closes; None: unknown.
    """

    def __init__(
        self, model: LoopModel, settings: WatchdogSettings, rest: float | None = None
    ) -> None:
        self._model = model
        self._limit = settings.jump_share * model.range * model.quickness
        self._chatter = settings.chatter_share * model.range * model.quickness
        count = max(round(_CHATTER_S / model.block_s), 8)
        self._squares: deque[float] = deque(maxlen=count)
        self._sum = 0.0
        self._last: list[float] = []
        self._statics = deque([] if rest is None else [rest], maxlen=count)
        self._explained: deque[float] = deque(maxlen=count)  # of each square

    def clear(self) -> None:
        """Restart: the next value does not follow the last one."""
        self._last = []

    def _driven_at_once(self) -> float:
        """Largest second difference of the drive's static strain in the last blocks."""
        recent = list(self._statics)[-_RECENT - self._model.queued :]
        return float(np.abs(np.diff(recent, 2)).max(initial=0.0)) if len(recent) > 2 else 0.0

    def driven(self, static: float) -> None:
        """Note the static strain of the drive in force, in every block."""
        self._statics.append(static)

    def fault(self, strain: float, blocks: int) -> str:
        """Return why the loop must stop, or an empty text; `blocks` have passed since the last."""
        self._last.append(strain)
        if len(self._last) < 3:
            return ""
        a, b, c = self._last
        self._last = [b, c]
        change = abs(a - 2.0 * b + c) / blocks
        squares = self._squares
        scatter = math.sqrt(max(self._sum, 0.0) / len(squares)) if len(squares) > 7 else 0.0
        step = max(self._statics) - min(self._statics) if self._statics else 0.0
        explained = self._model.rate_change(step, blocks)
        if self._model.follows_drive:
            explained += self._driven_at_once() / blocks
        allowed = max(self._limit, explained) + _SCATTER * scatter
        if len(squares) == squares.maxlen:
            self._sum -= squares[0]
        squares.append(change * change)
        self._sum += change * change
        if change > allowed:
            return (
                f"Strain jumped from {b:.4g} to {c:.4g}: its rate changed by {change:.2g} per "
                f"block (limit {allowed:.2g}). Check the sensor and its cables."
            )
        chatter = math.sqrt(max(self._sum, 0.0) / len(squares))
        self._explained.append(explained)
        most = max(self._chatter, math.sqrt(0.5) * max(self._explained))  # RMS of a sine
        if len(squares) == squares.maxlen and chatter > most:
            return (
                f"Strain alternates: its rate changes by {chatter:.2g} per block (RMS; limit "
                f"{most:.2g}). Check the sensor; lower the gains."
            )
        return ""


class _Reversals:
    """Counts reversals of at least a given amplitude."""

    def __init__(self, amplitude: float) -> None:
        self._amplitude = amplitude
        self._low = self._high = math.nan
        self._direction = 0

    def happened(self, value: float) -> bool:
        """Whether this value completes a reversal."""
        if not self._low <= value:
            self._low = value
        if not self._high >= value:
            self._high = value
        if self._direction >= 0 and value <= self._high - self._amplitude:
            self._direction, self._high, turned = -1, value, self._direction > 0
        elif self._direction <= 0 and value >= self._low + self._amplitude:
            self._direction, self._low, turned = 1, value, self._direction < 0
        else:
            return False
        self._low = self._high = value
        return turned


class Swings:
    """Check the drive for oscillation that the reference does not explain, and for charging energy.

    Args:
        block_s: length of a block.
        reach_v: largest drive voltage.
        gain: of the amplifier.
        range_: width of the strain range.
        settings: limits.
        alternates: whether the sign of the drive alternates on purpose; only its magnitude counts.
    """

    def __init__(
        self,
        block_s: float,
        reach_v: float,
        gain: float,
        range_: float,
        settings: WatchdogSettings,
        alternates: bool = False,
    ) -> None:
        self._alternates = alternates
        self._block_s, self._reach_v, self._gain = block_s, reach_v, gain
        self._settings = settings
        self._drive = _Reversals(settings.swing_share * reach_v)
        self._reference = _Reversals(_REFERENCE_SWING * range_)
        self._windows = (
            (WINDOW_S, settings.swings_per_s, deque[tuple[int, int]]()),
            (_SLOW_S, settings.slow_swings_per_s, deque[tuple[int, int]]()),
        )
        self._count = 0
        self._last_v = math.nan
        self._energies: deque[float] = deque(maxlen=max(round(WINDOW_S / block_s), 2))
        self._energy = 0.0

    def fault(self, drive_v: float, reference: float, capacitance_f: float | None) -> str:
        """Return why the loop must stop, or an empty text."""
        self._count += 1
        acting_v = abs(drive_v) if self._alternates else drive_v
        change = self._drive.happened(acting_v) - _ASKED * (
            reference == reference and self._reference.happened(reference)
        )
        return self._swinging(change) or self._charging(drive_v, capacitance_f)

    def _swinging(self, change: int) -> str:
        for window_s, per_s, events in self._windows:
            oldest = self._count - round(window_s / self._block_s)
            while events and events[0][0] <= oldest:
                events.popleft()
            if change:
                events.append((self._count, change))
            swings = sum(each for _, each in events) if change > 0 else 0
            if swings > per_s * window_s:
                least_v = self._settings.swing_share * self._reach_v * self._gain
                return (
                    f"Output oscillates: {swings} swings of {least_v:.4g} V or more in "
                    f"{window_s:g} s that the reference does not contain (limit "
                    f"{per_s * window_s:g}). Lower the gains, or look for a delay in the loop."
                )
        return ""

    def _charging(self, drive_v: float, capacitance_f: float | None) -> str:
        step_v = drive_v - self._last_v if self._last_v == self._last_v else 0.0
        self._last_v = drive_v
        energies = self._energies
        if len(energies) == energies.maxlen:
            self._energy -= energies[0]
        energies.append(step_v * step_v)
        self._energy += step_v * step_v
        full = self._reach_v**2
        per_s = self._energy / full / WINDOW_S
        if per_s <= self._settings.charges_per_s:
            return ""
        power = ""
        if capacitance_f is not None:
            watt = 0.5 * capacitance_f * self._gain**2 * self._energy / WINDOW_S
            power = f" ({watt:.2g} W)"
        advice = (
            "Raise charges_per_s in [safety.loop] if the amplifier and the actuator withstand it."
            if self._alternates
            else "Lower the gains; check the sensor for noise."
        )
        return (
            f"Output charges the actuator too often: {per_s:.3g} full charges per second{power} "
            f"(limit {self._settings.charges_per_s:g}). {advice}"
        )


class Delay:
    """Check that the voltage monitor lags the drive by no more than the rig file states."""

    def __init__(self, model: LoopModel, settings: WatchdogSettings) -> None:
        self._model, self._allowed = model, settings.extra_delay_blocks
        self._level: deque[float] = deque(maxlen=_FOLLOWED)
        self._drive: deque[float] = deque(maxlen=_FOLLOWED + _LAGS + model.queued)
        self._count = 0
        self._against = 0
        self._counted = model.level.stop - model.level.start > 0

    def fault(self, codes: NDArray[np.int16], drive_v: float) -> str:
        """Return why the loop must stop, or an empty text."""
        if not self._counted:
            return ""
        level = codes[self._model.level, 0]
        self._level.append(float(np.add.reduce(level, dtype=np.int64)) / level.size)
        self._drive.append(drive_v * self._model.code_per_v)
        self._count += 1
        if self._count % _LAG_EVERY or len(self._drive) < (self._drive.maxlen or 0):
            return ""
        lag = self._lag()
        self._against = self._against + 1 if lag > self._allowed else 0
        if self._against < 2:
            return ""
        return (
            f"Delay too long: the voltage monitor follows the drive {lag} blocks "
            f"({1e3 * lag * self._model.block_s:.3g} ms) later than the rig file states (limit "
            f"{self._allowed} blocks). Check the acquisition's buffer and close other programs."
        )

    def _lag(self) -> int:
        """Blocks by which the monitor lags more than expected; 0 if no other lag fits better."""
        level, drive = np.array(self._level), np.array(self._drive)
        level -= level.mean()
        if _residuals(level, drive[np.newaxis, _LAGS : _LAGS + _FOLLOWED])[0] < _LEAST_CODES:
            return 0  # as nearly always; what is left is converter noise, so no lag matters
        # Row j: the drive j blocks before the one that should be in force.
        shifted = np.lib.stride_tricks.sliding_window_view(drive, _FOLLOWED)
        left = _residuals(level, shifted[: _LAGS + 1][::-1])
        best = int(left.argmin())
        return 0 if left[0] < _LAG_RATIO * left[best] else best


def _residuals(level: NDArray[np.float64], drives: NDArray[np.float64]) -> NDArray[np.float64]:
    """RMS of what each row of drives does not explain of a level of mean 0, in codes.

    Gain and offset of each row are fitted.
    """
    moved = drives - drives.mean(axis=1, keepdims=True)
    power = np.einsum("ij,ij->i", moved, moved)
    slope = moved @ level / (power + 1e-12)
    left = np.maximum(level @ level - slope * slope * power, 0.0)
    return np.asarray(np.sqrt(left / _FOLLOWED))
