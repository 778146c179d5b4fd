"""Records that cannot be those of an actuator: wrong units, masses, signs and voltages."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from haselab.actuators import ActuatorLaw, equilibrium_m
from haselab.base import LimitError
from haselab.identify.physical.plausible.coarse import Glimpse, StartLaw, correlation
from haselab.identify.physical.plausible.times import find_wrong_times, follows_with_inertia
from haselab.identify.physical.record import MotionRecord

__all__ = ["find_implausible", "motion_before_drive"]

Floats = NDArray[np.float64]

_LENGTH, _CAPACITANCE = 10.0, 100.0  # factor from the start values that no start explains
_BREAKDOWN = 3.0  # fields over that of breakdown, likewise
_MONITOR = 0.05  # largest error of the voltage's monitor and of the amplifier's gain together
_FEWEST_CLIPPED, _CLIPPED = 10, 0.02  # least number and share of values at an end of the range
_UNSEEN = 0.01  # motion over the noise of a length
_STILL = 20.0  # spread of the lengths over their noise, of an actuator that moves
_FOLLOWS = 0.7  # correlation with the simulated motion, of lengths that follow the drive
_LITTLE = 1e-3  # of the motion, which no start explains
_LONGEST_S = 5e3  # of a simulation for these checks: seconds of computing
_LOW = 0.3  # of the highest voltage, below which the load decides the length
_HEAVIER = 1.1  # load over another one, whose lengths are compared
_REVERSED = 0.25  # of the simulated difference of two lengths
_LEAST_LENGTHS = 5  # of a load
_MIDDLE = 0.1, 0.5, 0.9  # of the lengths under a load: least, middle and most
_MOVES = 1.5  # spread of all values over their noise; below, nothing moves
_LEAST_STILL = 30  # values, whose spread is then certain to 13 %
_LAGS, _BY_CHANCE = (0, 1, 2, 4, 6), 1e-6  # intervals of the drive; probability without motion
_BEFORE, _SHARE_BEFORE = 5.0, 0.1  # spread before the drive changes, over noise; of the whole range
_DECIDES = 0.5  # simulated difference over that at rest; above, creep does not reverse it


def find_implausible(
    law: ActuatorLaw, records: Sequence[MotionRecord], added_inertia_kg: float = 0.0
) -> str:
    """Say which unit, voltage, sign or mass of the records cannot be right.

    Args:
        law: at the start values, which may be off by a factor of 2.
        records: to be fitted.
        added_inertia_kg: without weight, where the fit begins.
    Returns:
        What is wrong and what to do; empty if nothing is.
    """
    for record in records:
        for fault in (
            _length(law, record), _capacitance(law, record), _field(law, record), _monitor(record),
            _clipped(record),
        ):  # fmt: skip
            if fault:
                return f"{record.name}: {fault}"
    if fault := _still(records):
        return fault
    start = StartLaw(law, added_inertia_kg)
    beginnings = [_beginning(record) for record in records if _seen_early(record).any()]
    lengths = [_simulated_m(start, record) for record in beginnings]
    for record, length_m in zip(beginnings, lengths, strict=True):
        if fault := _drive(law, record, length_m):
            return f"{record.name}: {fault}"
    for record in records:
        if fault := find_wrong_times(start, record):
            return f"{record.name}: {fault}"
    for record, length_m in zip(beginnings, lengths, strict=True):
        if fault := _sign(start, record, length_m):
            return f"{record.name}: {fault}"
    return _loads(law, beginnings, lengths)


def motion_before_drive(records: Sequence[MotionRecord]) -> str:
    """Say which record begins in motion, although each is assumed to begin at rest.

    Args:
        records: to be fitted.
    Returns:
        A sentence without its full stop; empty if no record shows it.
    """
    for record in records:
        drive = record.drive
        changes = np.flatnonzero((np.diff(drive.voltage_v) != 0.0) | (np.diff(drive.load_n) != 0.0))
        end_s = drive.edge_s[changes[0] + 1] if changes.size else drive.edge_s[-1]
        early_m = record.length_m[record.length_time_s < end_s]
        if early_m.size < _LEAST_LENGTHS:
            continue
        moved_m, noise_m = float(np.ptp(early_m)), float(np.median(record.length_std_m))
        most_m = max(_SHARE_BEFORE * float(np.ptp(record.length_m)), _BEFORE * noise_m)
        if float(np.std(early_m)) > _BEFORE * noise_m and moved_m > most_m:
            when = (
                f"before the voltage first changes, after {end_s - drive.edge_s[0]:.3g} s"
                if changes.size
                else "although the voltage never changes"
            )
            return (
                f"{record.name}: the length changes by {1e6 * moved_m:.3g} um {when}, but each "
                "record is assumed to begin at rest under its first voltage. Give the record from "
                "its beginning"
            )
    return ""


def _still(records: Sequence[MotionRecord]) -> str:
    """Whether nothing moves in all records together: they say nothing of the actuator."""
    spreads = []
    for values, stds in (
        ([r.length_m for r in records], [r.length_std_m for r in records]),
        ([r.capacitance_f for r in records], [r.capacitance_std_f for r in records]),
    ):
        joined = np.concatenate(values)
        if joined.size >= _LEAST_STILL:
            spreads.append(float(np.std(joined) / np.median(np.concatenate(stds))))
    if not spreads or max(spreads) > _MOVES or any(map(_follows_voltage, records)):
        return ""
    highest_v = max(float(np.abs(record.drive.voltage_v).max()) for record in records)
    return (
        f"the actuator does not move: the measured values vary by {max(spreads):.2g} times their "
        f"noise, at voltages up to {highest_v:.3g} V. Record a voltage that changes and moves it, "
        "or check the voltage column and the amplifier's gain"
    )


def _follows_voltage(record: MotionRecord) -> bool:
    """Whether values whose noise is only an estimate depend on the voltages before them.

    If the voltage changes in almost every row, the estimate contains the motion.
    """
    square_v2 = record.drive.voltage_v**2
    if not record.std_estimated or not np.ptp(square_v2) > 0.0:
        return False
    first = np.unique(record.window_of, return_index=True)[1]
    for values, at in (
        (record.length_m, _interval(record)), (record.capacitance_f, record.window[first])
    ):  # fmt: skip
        degrees = values.size - len(_LAGS) - 1
        if degrees < _LEAST_LENGTHS:
            continue
        past = [square_v2[np.maximum(at - lag, 0)] / square_v2.max() for lag in _LAGS]
        columns = np.column_stack([np.ones(values.size), *past])
        centred = (values - values.mean()) / np.std(values)
        left = centred - columns @ np.linalg.lstsq(columns, centred, rcond=None)[0]
        unexplained = float(left @ left)
        ratio = (values.size - unexplained) / len(_LAGS) / max(unexplained / degrees, 1e-300)
        if float(fdtrc(len(_LAGS), degrees, ratio)) < _BY_CHANCE:
            return True
    return False


def _length(law: ActuatorLaw, record: MotionRecord) -> str:
    if not record.length_m.size:
        return ""
    typical_m, free_m = float(np.median(record.length_m)), law.free_length_m
    if free_m / _LENGTH < typical_m < free_m * _LENGTH:
        return ""
    return (
        f"the lengths are about {typical_m:.3g} m, but the start values give a length of "
        f"{free_m:.3g} m without load. Check the unit of the lengths (m) and the camera's scale"
    )


def _capacitance(law: ActuatorLaw, record: MotionRecord) -> str:
    if not record.capacitance_f.size:
        return ""
    typical_f = float(np.median(record.capacitance_f))
    limits = law.length_limits_m
    lengths_m = np.linspace(limits.low, limits.high, 5)
    known_f = law.capacitance_f(lengths_m)
    if known_f.min() / _CAPACITANCE < typical_f < known_f.max() * _CAPACITANCE:
        return ""
    return (
        f"the capacitances are about {typical_f:.3g} F, but the start values give "
        f"{float(np.median(known_f)):.3g} F. Check the unit of the capacitances (F) and the gains "
        "of the monitors"
    )


def _field(law: ActuatorLaw, record: MotionRecord) -> str:
    highest_v = float(np.abs(record.drive.voltage_v).max())
    field_v_m = highest_v / float(law.gap_m(law.free_length_m))
    if field_v_m <= _BREAKDOWN * law.circuit.breakdown_v_per_m:
        return ""
    return (
        f"the drive reaches {highest_v:.3g} V, a field of {field_v_m:.3g} V/m, and the "
        f"dielectric breaks down at {law.circuit.breakdown_v_per_m:.3g} V/m. State the volts "
        "at the actuator: check that the amplifier's gain is not counted twice"
    )


def _monitor(record: MotionRecord) -> str:
    if not abs(record.voltage_ratio - 1.0) > _MONITOR:
        return ""
    return (
        f"the voltage by the monitor is {record.voltage_ratio:.3g} times drive times gain. Check "
        "the gain of the amplifier, the scale of its voltage monitor, and that the monitor follows "
        "the drive"
    )


def _clipped(record: MotionRecord) -> str:
    """Whether many values are exactly at an end of their range while the voltage changes."""
    drive = record.drive
    first = np.unique(record.window_of, return_index=True)[1]
    capacitance_s = drive.edge_s[record.window[first]]
    for what, values, time_s, unit in (
        ("lengths", record.length_m, record.length_time_s, "m"),
        ("capacitances", record.capacitance_f, capacitance_s, "F"),
    ):
        at = np.searchsorted(drive.edge_s, time_s, side="right") - 1
        square_v2 = drive.voltage_v[np.clip(at, 0, drive.voltage_v.size - 1)] ** 2
        for end in {float(values.min()), float(values.max())} if values.size else ():
            count = _stuck(values == end, square_v2)
            others = values[values != end]
            repeats = float(np.mean(np.diff(others) == 0.0)) if others.size > 1 else 1.0
            if count >= max(_FEWEST_CLIPPED, _CLIPPED * values.size) and repeats < _CLIPPED:
                return (
                    f"{count} of the {what} are exactly {end:.6g} {unit} while the voltage "
                    f"changes: they are clipped. Leave these {what} out (valid = 0), or record "
                    "with a larger range"
                )
    return ""


def _stuck(at_end: NDArray[np.bool_], square_v2: Floats) -> int:
    """Number of values at the end of a range, in runs and after the voltage has changed in them.

    The value at the first change is still that of the voltage before.
    """
    edges = np.flatnonzero(np.diff(at_end, prepend=False, append=False))
    count = 0
    for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        changed = np.flatnonzero(np.diff(square_v2[start:end]) != 0.0)
        count += max(end - start - int(changed[0]) - 2, 0) if changed.size else 0
    return count


def _drive(law: ActuatorLaw, record: MotionRecord, simulated_m: Floats | None) -> str:
    """Whether the actuator moves far more than the stated voltages explain."""
    highest_v = float(np.abs(record.drive.voltage_v).max())
    moved_m = None if highest_v == 0.0 else _moved_m(law, record, highest_v)
    if moved_m is None:
        return ""
    usual, noise_m = _usually_loaded(record), float(np.median(record.length_std_m))
    seen_m = record.length_m[usual]
    spread_m = float(np.std(seen_m))
    if float(np.ptp(record.drive.voltage_v)) == 0.0:
        return ""
    moves = moved_m < _UNSEEN * noise_m and spread_m > _STILL * noise_m
    moves = moves and float(np.ptp(record.drive.load_n)) == 0.0  # else the load may have moved it
    if simulated_m is not None and moved_m < _LITTLE * spread_m:
        moves = moves or correlation(seen_m, simulated_m[usual]) > _FOLLOWS
    if not moves:
        return ""
    return (
        f"the drive of at most {highest_v:.3g} V would move the actuator by {1e6 * moved_m:.2g} "
        "um, but it moves. State the volts at the actuator, not those at the amplifier's input: "
        "check the amplifier's gain and the unit of the voltage (V)"
    )


def _usually_loaded(record: MotionRecord) -> NDArray[np.bool_]:
    """Which lengths were seen under the load that acted longest. Shape `(F,)`."""
    drive = record.drive
    _, of = np.unique(drive.load_n, return_inverse=True)
    usual = np.argmax(np.bincount(of, np.diff(drive.edge_s)))
    return np.asarray(of[_interval(record)] == usual)


def _interval(record: MotionRecord) -> NDArray[np.int64]:
    """Interval of the drive in which each length was seen. Shape `(F,)`."""
    at = np.searchsorted(record.drive.edge_s, record.length_time_s, side="right") - 1
    return np.clip(at, 0, record.drive.voltage_v.size - 1)


def _moved_m(law: ActuatorLaw, record: MotionRecord, voltage_v: float) -> float | None:
    """Motion from 0 V to a voltage at the first load; None where there is no equilibrium."""
    load_n = float(record.drive.load_n[0])
    try:
        rest_m, at_m = (equilibrium_m(law, v, load_n) for v in (0.0, voltage_v))
    except LimitError:
        return None
    return abs(at_m - rest_m)


def _simulated_m(law: StartLaw, record: MotionRecord) -> Floats | None:
    """Lengths that the start values give; None where they describe no motion. Shape `(F,)`."""
    found = law.simulated(record)
    return None if found is None else found[0]


def _early_count(record: MotionRecord) -> int:
    """Number of intervals within a simulation of a few seconds of computing; at least 1."""
    edge_s = record.drive.edge_s
    return max(int(np.searchsorted(edge_s, edge_s[0] + _LONGEST_S, side="right")) - 1, 1)


def _seen_early(record: MotionRecord) -> NDArray[np.bool_]:
    """Which lengths belong to these intervals. Shape `(F,)`."""
    return np.asarray(record.length_time_s <= record.drive.edge_s[_early_count(record)])


def _beginning(record: MotionRecord) -> MotionRecord:
    """The part of a record that is simulated within a few seconds of computing; its lengths."""
    drive, none = record.drive, np.zeros(0)
    count, seen = _early_count(record), _seen_early(record)
    empty = np.zeros(0, dtype=np.int64)
    return replace(
        record,
        drive=replace(
            drive, edge_s=drive.edge_s[: count + 1], voltage_v=drive.voltage_v[:count],
            load_n=drive.load_n[:count], mass_kg=drive.mass_kg[:count],
            ripple_v2=drive.ripple_v2[:count],
        ),
        length_time_s=record.length_time_s[seen], length_m=record.length_m[seen],
        length_std_m=record.length_std_m[seen], length_experiment=record.length_experiment[seen],
        window=empty, window_of=empty, window_weight=none, capacitance_f=none,
        capacitance_std_f=none, capacitance_experiment=empty, capacitance_later_s=0.0, block=empty,
    )  # fmt: skip


def _sign(law: StartLaw, record: MotionRecord, simulated_m: Floats | None) -> str:
    """Whether the lengths grow where the actuator contracts, with any inertia."""
    if simulated_m is None or float(np.ptp(record.drive.voltage_v)) == 0.0:
        return ""
    usual = _usually_loaded(record)
    found = correlation(record.length_m[usual], simulated_m[usual])
    if found > -_FOLLOWS:
        return ""
    glimpse = Glimpse.of(record)
    if glimpse is not None and follows_with_inertia(law, glimpse):
        return ""  # above its resonance, it moves against the drive
    return (
        f"the lengths grow where the actuator contracts (correlation with the simulated lengths: "
        f"{found:.2f}). Give lengths that fall when the actuator contracts, not a displacement "
        "that rises"
    )


@dataclass(frozen=True)
class _Level:
    """Lengths of a record under one load and a low voltage, without the farthest tenths."""

    name: str
    load_n: float
    seen_m: float
    least_m: float
    most_m: float
    simulated_m: float
    noise_m: float

    @property
    def moved_m(self) -> float:
        """Largest difference of these lengths."""
        return self.most_m - self.least_m


def _levels(record: MotionRecord, simulated_m: Floats) -> Iterator[_Level]:
    drive, interval = record.drive, _interval(record)
    volt = np.abs(drive.voltage_v)
    low = volt[interval] <= _LOW * volt.max()
    for load_n in np.unique(drive.load_n):
        chosen = low & (drive.load_n[interval] == load_n)
        if np.count_nonzero(chosen) >= _LEAST_LENGTHS:
            least_m, seen_m, most_m = np.quantile(record.length_m[chosen], _MIDDLE)
            yield _Level(
                record.name,
                float(load_n),
                float(seen_m),
                float(least_m),
                float(most_m),
                float(np.median(simulated_m[chosen])),
                float(np.median(record.length_std_m)),
            )


def _stretch_m(law: ActuatorLaw, light_n: float, heavy_n: float) -> float:
    """By how much a heavier load stretches the actuator at rest; infinite if not computable."""
    try:
        return equilibrium_m(law, 0.0, heavy_n) - equilibrium_m(law, 0.0, light_n)
    except LimitError:
        return math.inf


def _loads(
    law: ActuatorLaw, records: Sequence[MotionRecord], lengths: Sequence[Floats | None]
) -> str:
    """Whether the actuator is shorter under a heavier load, at a low voltage."""
    levels = [
        level
        for record, length_m in zip(records, lengths, strict=True)
        if length_m is not None
        for level in _levels(record, length_m)
    ]
    for light, heavy in itertools.permutations(levels, 2):
        longer_m = heavy.simulated_m - light.simulated_m
        if heavy.load_n < _HEAVIER * light.load_n or longer_m <= 0.0:
            continue
        shorter_m = light.seen_m - heavy.seen_m
        if shorter_m <= max(_REVERSED * longer_m, _STILL * light.noise_m):
            continue
        # still in motion after the last change of the load
        if light.least_m < heavy.most_m or shorter_m < max(light.moved_m, heavy.moved_m):
            continue
        # creep after the previous load may exceed the difference of two similar loads
        if longer_m > _DECIDES * _stretch_m(law, light.load_n, heavy.load_n):
            return (
                f"{heavy.name}: the length is {1e3 * heavy.seen_m:.4g} mm under "
                f"{heavy.load_n:.3g} N, but {1e3 * light.seen_m:.4g} mm under {light.load_n:.3g} N "
                f"({light.name}), both at a low voltage. A heavier load must stretch the actuator. "
                "Check the masses, which may be swapped, and that all records are of one actuator"
            )
    return ""
