"""Checks of measured columns shared by all static fits: length, variation, plausible units."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.identify.record import finite_vector

__all__ = [
    "check_pair",
    "note_on_voltage",
    "plausible_capacitance",
    "plausible_strain",
    "plausible_stretch",
    "plausible_voltage",
]

Floats = NDArray[np.float64]
_LONGEST = 30.0  # stretch: above the break of any elastomer
_LARGEST_STRAIN = 5.0  # larger than the actuation strain of any elastomer
_LARGE_STRAIN = 1.0
_LARGE = "The strain reaches {:.3g} times the length. If it is in per cent, divide it by 100."
_SMALLEST_STRAIN = 1e-7  # span that no camera or gauge of such a test resolves
_HIGHEST_V = 1e5
_HIGHEST_F = 1e-3  # a million times the capacitance of a HASEL actuator
_KILOVOLTS_V = 20.0  # span below which volts of an amplifier's output could be kilovolts


def check_pair(
    first: str, one: object, second: str, two: object, *, least: int, record: str
) -> tuple[Floats, Floats]:
    """Check two columns: finite, equally long, neither constant.

    Args:
        first: name of the first column.
        one: its values. Shape `(N,)`.
        second: name of the second column.
        two: its values. Shape `(N,)`.
        least: fewest values.
        record: what to do when a column does not change.
    Returns:
        Both columns as numbers. Shape `(N,)`.
    Raises:
        InputError: too few values, NaN, unequal lengths, a constant column.
    """
    x, y = finite_vector(first, one, least), finite_vector(second, two, least)
    if x.size != y.size:
        raise InputError(
            f"{first} has {x.size} values and {second} {y.size}, but they must be equally long. "
            f"Give one {second} for each {first}."
        )
    for name, column in ((first, x), (second, y)):
        if np.ptp(column) == 0.0:
            raise InputError(
                f"{name} is {column[0]:g} throughout; it must change. "
                f"Name the right column, or {record}."
            )
    return x, y


def plausible_stretch(stretch: Floats, other: str, values: Floats) -> None:
    """Refuse a column that cannot be stretch: loads or stresses, strain, per cent.

    Args:
        stretch: column that should be the stretch. Shape `(N,)`.
        other: name of the other column.
        values: that column, to detect swapped columns. Shape `(N,)`.
    Raises:
        InputError: a value not above 0, or above 30.
    """
    low, high = float(stretch.min()), float(stretch.max())
    if low > 0.0 and high <= _LONGEST:
        return
    got = f"stretch lies in [{low:g}, {high:g}]; it must be above 0 and at most {_LONGEST:g}"
    beside = float(values.min()) > 0.5 and 1.0 < float(values.max()) <= _LONGEST
    swapped = f"{other} looks like stretch. Are the two columns swapped?"
    if high > _LONGEST:
        load = "This looks like a load or a stress. Name the right column."
        per_cent = "If this is per cent, give 1 + strain/100."
        raise InputError(f"{got}. {swapped if beside else load if high > 1000.0 else per_cent}")
    hint = f" Or: {swapped}" if beside else ""
    raise InputError(f"{got} (1 is the natural length). Give stretch, not strain.{hint}")


def plausible_strain(strain: Floats, other: str, values: Floats) -> tuple[str, ...]:
    """Refuse a column that cannot be strain: per cent, millimetres, a swapped column.

    Args:
        strain: column that should be the strain. Shape `(N,)`.
        other: name of the other column.
        values: that column. Shape `(N,)`.
    Returns:
        A note where the strain is so large that it may be per cent, or nothing.
    Raises:
        InputError: a magnitude above 5, or a span below 1e-7.
    """
    size, span = float(np.abs(strain).max()), float(np.ptp(strain))
    swapped = size > _LARGEST_STRAIN or span < _SMALLEST_STRAIN
    if not swapped:
        return () if size <= _LARGE_STRAIN else (_LARGE.format(size),)
    fits = np.abs(values).max() <= 1.0 and np.ptp(values) >= 100.0 * _SMALLEST_STRAIN
    hint = f"{other} looks like strain. Are the two columns swapped?"
    if size > _LARGEST_STRAIN:
        raise InputError(
            f"strain reaches {size:g}; it must be at most {_LARGEST_STRAIN:g} (1 is twice the "
            f"length). {hint if fits else 'If it is in per cent, divide it by 100.'}"
        )
    raise InputError(
        f"strain spans {span:g}; it must be at least {_SMALLEST_STRAIN:g}. "
        f"{hint if fits else 'Name the right column.'}"
    )


def plausible_capacitance(name: str, capacitance_f: Floats) -> None:
    """Refuse a column in F whose values are in another unit.

    Args:
        name: of the column.
        capacitance_f: its values. Shape `(N,)`.
    Raises:
        InputError: a capacitance above 1 mF.
    """
    size = float(np.abs(capacitance_f).max())
    if size > _HIGHEST_F:
        raise InputError(
            f"Column {name} reaches {size:g} F; it must be at most {_HIGHEST_F:g} F. If it is in "
            f"pF, add --unit {name}=pF. If it is a relative capacitance, give it a name without "
            "the unit F."
        )


def plausible_voltage(voltage_v: Floats) -> None:
    """Refuse implausible voltages.

    Args:
        voltage_v: column of voltages. Shape `(N,)`.
    Raises:
        InputError: a voltage above 100 kV.
    """
    size = float(np.abs(voltage_v).max())
    if size > _HIGHEST_V:
        raise InputError(
            f"voltage_v reaches {size:g} V; it must be at most {_HIGHEST_V:g} V. "
            "Give volts, or name the right column."
        )


def note_on_voltage(name: str, voltage_v: Floats) -> tuple[str, ...]:
    """Return a note where voltages without a unit may be kilovolts.

    Args:
        name: of the column.
        voltage_v: its values. Shape `(N,)`.
    Returns:
        A note, or nothing.
    """
    size = float(np.abs(voltage_v).max())
    if size >= _KILOVOLTS_V:
        return ()
    return (
        f"Column {name} states no unit and reaches {size:.3g} only. It is taken as the drive ahead "
        f"of the amplifier, in V. If it is in kV, add --unit '{name}=kV'.",
    )
