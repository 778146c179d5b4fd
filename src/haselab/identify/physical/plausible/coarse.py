"""Simulations at the start values, for checks that need not be exact."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import ActuatorLaw, Drive, SampledLaw, motion_parameters
from haselab.base import HaselabError
from haselab.identify.physical.misfit import highest_of
from haselab.identify.physical.record import MotionRecord

__all__ = ["Glimpse", "StartLaw", "correlation"]

Floats = NDArray[np.float64]
_MOST = 1000  # values of a glimpse
_LEAD = 4  # the first of so many parts of it is not compared
_LONGEST_S = 4e3  # of a glimpse, with at least `_LEAST` values
_LEAST = 60
_STRIDE = 16  # values from a glimpse to the next one that is considered
_LAGS = (1, 2, 4, 8, 16, 32, 64)  # values from one to that with which it is compared
_CLEAR = 5.0  # motion over noise of such a difference
_FEWEST = 5  # values of a correlation
_ROUNDING = 1e-9  # of the steps


class StartLaw:
    """A law at its start values, which is tabulated once for all simulations.

    Args:
        law: at the start values.
        added_inertia_kg: without weight.
    """

    def __init__(self, law: ActuatorLaw, added_inertia_kg: float = 0.0) -> None:
        self.law, self.added_inertia_kg = law, added_inertia_kg
        self._tables: dict[float, SampledLaw] = {}
        self._rests: dict[tuple[float, float, float, float], NDArray[np.void] | None] = {}

    def simulated(
        self, record: MotionRecord, time_scale: float = 1.0, inertia: float = 0.0
    ) -> tuple[Floats, Floats] | None:
        """Lengths and capacitances of a record; None where the start values give no motion.

        Args:
            record: with what acted, and when the values were seen.
            time_scale: true over stated times.
            inertia: without weight, over the hung mass; it is added.
        Returns:
            Both, shapes `(F,)` and `(C,)`.
        """
        drive, highest_v = record.drive, highest_of(record)
        acts = (float(drive.voltage_v[0]), float(drive.ripple_v2[0]), float(drive.load_n[0]))
        slower = replace(drive, edge_s=time_scale * drive.edge_s)
        seen_s = np.clip(time_scale * record.length_time_s, slower.edge_s[0], slower.edge_s[-1])
        begun = self._begun(highest_v, acts)
        if begun is None:
            return None
        table, rest = begun
        table.parameters["inertia_kg"] = (
            motion_parameters(self.law)["inertia_kg"]
            + self.added_inertia_kg
            + inertia * drive.mass_kg.max()
        )
        try:
            found = table.respond(slower, seen_s, rest.copy(), sensed=record.sensed)
        except HaselabError:
            return None
        if not record.capacitance_f.size:
            return found.length_m, np.zeros(0)
        return found.length_m, record.over_windows(found.capacitance_f[record.sensed])

    def _begun(
        self, highest_v: float, acts: tuple[float, float, float]
    ) -> tuple[SampledLaw, NDArray[np.void]] | None:
        """Table and state at rest under voltage, ripple and load; None where there is none."""
        if (highest_v, *acts) not in self._rests:
            try:
                if highest_v not in self._tables:
                    self._tables[highest_v] = SampledLaw(self.law, highest_v)
                rest = self._tables[highest_v].at_rest(*acts)[0]
            except HaselabError:
                self._rests[highest_v, *acts] = None
            else:
                self._rests[highest_v, *acts] = rest
        found = self._rests[highest_v, *acts]
        return None if found is None else (self._tables[highest_v], found)


@dataclass(frozen=True)
class Glimpse:
    """The part of a record that moves most, short enough to be simulated many times.

    Args:
        record: that part; it is simulated as if it began at rest.
        seen: lengths, or capacitances if there are no lengths. Shape `(N,)`.
        noise: standard deviation of each.
        first: value from which they are compared; the simulated motion before is that of the start.
        square_v2: voltage squared under which each was seen. Shape `(N,)`.
    """

    record: MotionRecord
    seen: Floats
    noise: float
    first: int
    square_v2: Floats

    @classmethod
    def of(cls, record: MotionRecord) -> Glimpse | None:
        """That of a record; None if it has too few values."""
        lengths = record.length_m.size >= _FEWEST
        if lengths:
            time_s, seen, stds = record.length_time_s, record.length_m, record.length_std_m
        else:
            first = np.unique(record.window_of, return_index=True)[1]
            time_s = record.drive.edge_s[record.window[first]]
            seen, stds = record.capacitance_f, record.capacitance_std_f
        if seen.size < _FEWEST or not (np.diff(time_s) > 0.0).all():
            return None
        low, high = _most_moving(time_s, seen)
        part = _part(record, time_s[low], time_s[high - 1], lengths=lengths)
        kept = seen[low:high]
        if (part.length_m if lengths else part.capacitance_f).size != kept.size:
            return None
        skipped = 0 if low == 0 else kept.size // _LEAD
        at = np.searchsorted(record.drive.edge_s, time_s[low:high], side="right") - 1
        volt = record.drive.voltage_v[np.clip(at, 0, record.drive.voltage_v.size - 1)]
        return cls(part, kept, float(np.median(stds)), skipped, volt**2)

    @property
    def duration_s(self) -> float:
        """Of the part."""
        return float(np.ptp(self.record.drive.edge_s))

    @property
    def interval_s(self) -> float:
        """Typical time from value to value."""
        return self.duration_s / self.seen.size

    @cached_property
    def lag(self) -> int:
        """Values from one to that with which it is compared: so many that noise hardly counts."""
        kept = self.seen[self.first :]
        usable = [lag for lag in _LAGS if lag + _FEWEST <= kept.size] or [1]
        clear = (k for k in usable if float(np.std(_steps(kept, k))) > _CLEAR * self.noise)
        return next(clear, usable[0])

    def agreement(self, law: StartLaw, time_scale: float, inertia: float = 0.0) -> float:
        """Correlation of the steps from value to value with simulated ones.

        Args:
            law: at the start values.
            time_scale: true over stated times.
            inertia: without weight, over the hung mass.
        """
        found = law.simulated(self.record, time_scale, inertia)
        if found is None:
            return 0.0
        simulated = found[0] if self.record.length_m.size else found[1]
        return correlation(self._compared(self.seen), self._compared(simulated))

    def _compared(self, values: Floats) -> Floats:
        """Steps; of capacitances, without what follows the voltage at once, at any time scale."""
        steps = _steps(values[self.first :], self.lag)
        if self.record.length_m.size:
            return steps
        at_once = _steps(self._at_once[self.first :], self.lag)
        left = steps - at_once @ np.linalg.lstsq(at_once, steps, rcond=None)[0]
        # what rounding leaves of a signal that follows at once does not count
        return left if float(np.ptp(left)) > _ROUNDING * float(np.ptp(steps)) else 0.0 * left

    @cached_property
    def _at_once(self) -> Floats:
        """Signals that follow the voltage at once. Shape `(N, 3)`."""
        relative = self.square_v2 / max(float(self.square_v2.max()), 1e-300)
        return np.column_stack([np.sqrt(relative), relative, relative**2])


def correlation(one: Floats, other: Floats) -> float:
    """Of two signals; 0 where one of them does not change.

    Args:
        one: signal. Shape `(N,)`.
        other: signal. Shape `(N,)`.
    """
    if one.size < _FEWEST or not (np.ptp(one) > 0.0 and np.ptp(other) > 0.0):
        return 0.0
    return float(np.corrcoef(one, other)[0, 1])


def _steps(values: Floats, lag: int) -> Floats:
    return values[lag:] - values[:-lag]


def _most_moving(time_s: Floats, seen: Floats) -> tuple[int, int]:
    """First value, and that after the last one, of the part with the largest steps."""
    energy = np.concatenate([[0.0], np.cumsum(np.diff(seen) ** 2)])
    usual_s = float(np.median(np.diff(time_s)))
    count = int(np.clip(_LONGEST_S / usual_s, _LEAST, _MOST))
    if seen.size <= count:
        return 0, seen.size
    starts = np.append(np.arange(0, seen.size - count, _STRIDE), seen.size - count)
    first = np.where(starts > 0, starts + count // _LEAD, 0)  # that is compared
    low = int(starts[np.argmax(energy[starts + count - 1] - energy[first])])
    # waits between experiments may make it longer than wanted
    late = np.searchsorted(time_s, time_s[low] + max(_LONGEST_S, _LEAST * usual_s), side="right")
    return low, min(low + count, int(late))


def _part(record: MotionRecord, low_s: float, high_s: float, *, lengths: bool) -> MotionRecord:
    """The values of one channel from one time to another, with what acted then."""
    drive, none = record.drive, np.zeros(0, dtype=np.int64)
    start = max(int(np.searchsorted(drive.edge_s, low_s, side="right")) - 1, 0)
    end = min(int(np.searchsorted(drive.edge_s, high_s, side="right")), drive.voltage_v.size)
    chosen = slice(start, end)
    inside = (record.length_time_s >= low_s) & (record.length_time_s <= high_s) & lengths
    windows = (record.window >= start) & (record.window < end) & (not lengths)
    numbers, window_of = np.unique(record.window_of[windows], return_inverse=True)
    weight = record.window_weight
    return replace(
        record,
        drive=Drive(
            drive.edge_s[start : end + 1], drive.voltage_v[chosen], drive.load_n[chosen],
            drive.mass_kg[chosen], drive.ripple_v2[chosen],
        ),
        length_time_s=record.length_time_s[inside], length_m=record.length_m[inside],
        length_std_m=record.length_std_m[inside],
        length_experiment=record.length_experiment[inside],
        window=record.window[windows] - start, window_of=window_of,
        window_weight=weight[windows] if weight.size else weight,
        capacitance_f=record.capacitance_f[numbers],
        capacitance_std_f=record.capacitance_std_f[numbers],
        capacitance_experiment=record.capacitance_experiment[numbers],
        capacitance_later_s=0.0, block=none,
    )  # fmt: skip
