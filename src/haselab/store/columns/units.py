"""Units in the headers of tables: which one a column states, and its factor to SI."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass

from haselab.base import InputError

__all__ = ["Unit", "find_unit", "is_unit", "parse_unit", "split_header"]

_PREFIXES = {"f": 1e-15, "p": 1e-12, "n": 1e-9, "u": 1e-6, "µ": 1e-6, "m": 1e-3, "": 1.0,
             "k": 1e3, "M": 1e6, "G": 1e9}  # fmt: skip
_WITH_PREFIX = ("V", "A", "F", "s", "Hz", "m", "N", "Pa", "Ω", "C", "J", "W", "H")
_NEVER_LARGE = ("A", "F", "s", "m", "C", "H")  # Mm is rather a misspelt mm, and Gs gauss
_OTHER = {
    "1": ("1", 1.0), "-": ("1", 1.0), "a.u.": ("1", 1.0), "%": ("1", 0.01), "‰": ("1", 1e-3),
    "ppm": ("1", 1e-6), "mm/mm": ("1", 1.0), "µm/m": ("1", 1e-6), "cm": ("m", 0.01),
    "g": ("kg", 1e-3), "kg": ("kg", 1.0), "mg": ("kg", 1e-6), "min": ("s", 60.0),
    "h": ("s", 3600.0), "rad": ("rad", 1.0), "mrad": ("rad", 1e-3), "°": ("rad", math.pi / 180.0),
    "deg": ("rad", math.pi / 180.0), "rad/s": ("rad/s", 1.0), "1/s": ("1/s", 1.0),
    "m/s": ("m/s", 1.0), "mm/s": ("m/s", 1e-3), "m/s²": ("m/s²", 1.0),
    "mm/s²": ("m/s²", 1e-3), "V/m": ("V/m", 1.0),
    "kV/mm": ("V/m", 1e6), "V/µm": ("V/m", 1e6), "MV/m": ("V/m", 1e6), "V/s": ("V/s", 1.0),
    "kV/s": ("V/s", 1e3), "V²": ("V²", 1.0), "mV²": ("V²", 1e-6), "kV²": ("V²", 1e6),
    "N/m": ("N/m", 1.0), "N/mm": ("N/m", 1e3), "Nm": ("Nm", 1.0), "mNm": ("Nm", 1e-3),
    "N/mm²": ("Pa", 1e6), "N/m²": ("Pa", 1.0), "bar": ("Pa", 1e5), "mbar": ("Pa", 100.0),
    "psi": ("Pa", 6894.757293168), "°C": ("°C", 1.0), "K": ("K", 1.0), "m²": ("m²", 1.0),
    "mm²": ("m²", 1e-6), "cm²": ("m²", 1e-4), "gf": ("N", 9.80665e-3), "kgf": ("N", 9.80665),
}  # fmt: skip
# Of these, every spelling in upper and lower case means the same.
_ANY_CASE = (
    "V", "kV", "A", "kA", "F", "Hz", "kHz", "N", "kN", "kPa", "Ω", "kΩ", "J", "kJ", "W", "kW",
    "cm", "kg", "kgf", "min", "bar", "psi", "ppm", "deg", "rad", "rad/s", "V/m", "kV/mm", "V/s",
    "kV/s", "V²", "kV²", "N/m", "N/mm", "N/mm²", "N/m²", "°C",
)  # fmt: skip
_WORDS = {
    "volt": "V", "volts": "V", "millivolt": "mV", "millivolts": "mV", "kilovolt": "kV",
    "kilovolts": "kV", "amp": "A", "amps": "A", "ampere": "A", "amperes": "A", "sec": "s",
    "secs": "s", "second": "s", "seconds": "s", "sekunden": "s", "msec": "ms", "usec": "µs",
    "millisecond": "ms", "milliseconds": "ms", "microseconds": "µs", "mins": "min",
    "minute": "min", "minutes": "min", "minuten": "min", "hr": "h", "hrs": "h", "hour": "h",
    "hours": "h", "stunden": "h", "farad": "F",
    "farads": "F", "picofarad": "pF", "picofarads": "pF", "nanofarad": "nF", "nanofarads": "nF",
    "newton": "N", "newtons": "N", "meter": "m", "meters": "m", "metre": "m", "metres": "m",
    "millimeter": "mm", "millimeters": "mm", "millimetre": "mm", "millimetres": "mm",
    "micron": "µm", "microns": "µm", "pascal": "Pa", "hertz": "Hz", "percent": "%",
    "per cent": "%", "pct": "%", "prozent": "%", "permille": "‰", "microstrain": "µm/m",
    "m/m": "1", "degree": "deg", "degrees": "deg", "degc": "°C",
    "min.": "min", "sec.": "s", "au": "a.u.", "arb. units": "a.u.", "s/s": "Hz", "v/v": "1",
    "µε": "µm/m", "um/m": "µm/m", "n/mm2": "N/mm²", "n/m2": "N/m²", "v/um": "V/µm", "none": "1",
    "sequence": "1", "samples": "1", "dimensionless": "1", "arbitrary": "a.u.",
    "code": "1", "counts": "1",
}  # fmt: skip
# Endings of names, as in voltage_kv. Those of SI units are the default, so they state nothing.
_ENDINGS = {
    "mv": "mV", "uv": "µV", "kv": "kV", "ma": "mA", "ua": "µA", "na": "nA", "ms": "ms", "us": "µs",
    "ns": "ns", "pf": "pF", "nf": "nF", "uf": "µF", "mm": "mm", "um": "µm", "cm": "cm",
    "kpa": "kPa", "kn": "kN", "khz": "kHz", "minutes": "min", "hours": "h",
    "percent": "%", "pct": "%", "permille": "‰", "ppm": "ppm",
}  # fmt: skip
# After a space, as in "Weg mm"; a single letter or min there is more often part of the name.
_LAST_WORDS = {*_ENDINGS.values(), "um", "uA", "us", "uF", "Hz", "MPa", "°C"} - {"min", "h"}
_AMBIGUOUS = "mpa"  # an ending that is milli or mega, and not to be taken as the default
_SPELLINGS = (("μ", "µ"), ("Ω", "Ω"), ("Ohms", "Ω"), ("Ohm", "Ω"), ("ohms", "Ω"), ("ohm", "Ω"),
              ("^2", "²"), ("·", ""), ("*", ""))  # fmt: skip
_BRACKETS = re.compile(
    r"^(?P<name>.*?)\s*(?:\[(?P<square>[^\[\]]*)\]|\((?P<round>[^()]*)\)|\{(?P<curly>[^{}]*)\})\s*$"
)
_STROKE = re.compile(r"^(?P<name>.+?)\s*(?:/|,|\s+in\s)\s*(?P<unit>[^/,\s]+)$")
_MOST_SEARCHED = 200  # characters at the end of a header; the patterns are slow on a long one
_LOOKS_LIKE_ONE = re.compile(r"[fpnuµmkg]?(v|a|f|s|hz|m|n|pa|ohm|c|g)(\^\d)?", re.IGNORECASE)
_STATED = re.compile(r"[^\s\d]{1,8}(\^-?\d)?")  # in square brackets
_KNOWN = (
    f"{', '.join(_WITH_PREFIX)} and g with a prefix from f to k (such as kV, mV, µA or uA, pF, mm, "
    "ms), MHz, MPa, MΩ, %, ‰, min, h, cm, bar, gf, kgf, °, °C, V², mm², N/mm², V/m, m/s, or 1 for "
    "a pure number"
)


@dataclass(frozen=True)
class Unit:
    """A unit that a column states.

    Args:
        symbol: as it is usually written, such as mV.
        si: the SI unit of the same quantity, such as V; "1" for pure numbers.
        factor: to multiply by, to get SI values.
    """

    symbol: str
    si: str
    factor: float


def _table() -> dict[str, Unit]:
    found = {symbol: Unit(symbol, si, factor) for symbol, (si, factor) in _OTHER.items()}
    for si in _WITH_PREFIX:
        for prefix, factor in _PREFIXES.items():
            if prefix not in ("M", "G") or si not in _NEVER_LARGE:
                found[prefix + si] = Unit(prefix + si, si, factor)
    return found


_UNITS = _table()
_LOWER = {symbol.lower(): _UNITS[symbol] for symbol in _ANY_CASE}
# Written where a unit is, these state one, although it is refused: Mm, MA, siemens.
_REFUSED = {prefix + si for prefix in "MG" for si in _NEVER_LARGE} | {"mS", "µS", "uS", "nS"}
_MISSPELT = {symbol.lower() for symbol in _UNITS}  # refused in brackets too, such as (mV/m)


def is_unit(text: str) -> bool:
    """Whether a text, perhaps in brackets, is a unit."""
    return find_unit(text.strip().strip("[]()")) is not None


def find_unit(text: str) -> Unit | None:
    """The unit that a text names, as `parse_unit`; None where it is unknown or ambiguous."""
    plain = text.strip()
    for written, symbol in _SPELLINGS:
        plain = plain.replace(written, symbol)
    if plain in _UNITS:
        return _UNITS[plain]
    lower = plain.lower()
    if lower in _WORDS:
        return _UNITS[_WORDS[lower]]
    if lower == plain and lower in _ENDINGS:  # the m of mv is milli: only the v is misspelt
        return _UNITS[_ENDINGS[lower]]
    return _LOWER.get(lower)


def parse_unit(text: str, where: str) -> Unit:
    """The unit that a text names.

    Args:
        text: such as mV, pF, µs or %.
        where: it was found, for the message.
    Returns:
        The unit.
    Raises:
        InputError: the unit is unknown, or ambiguous in upper and lower case.
    Example:
        >>> parse_unit("kV", "--unit")
        Unit(symbol='kV', si='V', factor=1000.0)
        >>> parse_unit("pF", "--unit").factor
        1e-12
    """
    unit = find_unit(text)
    if unit is None:
        raise InputError(
            f"{where} states the unit '{text.strip()}', which is unknown or ambiguous. Use "
            f"{_KNOWN}."
        )
    return unit


def split_header(header: str) -> tuple[str, str]:
    """Name and stated unit of a column header; an empty unit where none is stated.

    Args:
        header: one cell, such as `Spannung [V]`, `C (pF)`, `U / mV`, `Weg mm` or `voltage_kv`.
    Returns:
        The name without the unit, and the text of the unit. A text in brackets that is no unit
        stays part of the name, unless it looks like one.
    Example:
        >>> split_header("Spannung [mV]"), split_header("C (pF)"), split_header("voltage_kv")
        (('Spannung', 'mV'), ('C', 'pF'), ('voltage', 'kV'))
        >>> split_header("U (measured)"), split_header("voltage_v")
        (('U (measured)', ''), ('voltage_v', ''))
    """
    whole = header.strip()
    first, text = whole[:-_MOST_SEARCHED], whole[-_MOST_SEARCHED:]
    name, unit = _split(text)
    return first + name, unit


def _split(text: str) -> tuple[str, str]:
    if match := _BRACKETS.match(text):
        unit = next(part for part in match.group("square", "round", "curly") if part is not None)
        stated = (
            find_unit(unit) is not None
            or unit.strip().lower() in _MISSPELT
            or _LOOKS_LIKE_ONE.fullmatch(unit.strip()) is not None
        )
        if stated or (match["square"] is not None and _STATED.fullmatch(unit.strip())):
            return match["name"].rstrip() or text, unit.strip()
        return text, ""
    units = _UNITS.keys() | _REFUSED
    if (match := _STROKE.match(text)) and match["unit"] in units and match["unit"] not in "1-":
        return match["name"].rstrip(), match["unit"]
    name, _, word = text.rpartition(" ")
    if name and word in _LAST_WORDS:
        return name.rstrip(), word
    name, _, ending = text.rpartition("_")
    known = ending in _ENDINGS or ending == _AMBIGUOUS or (ending in units and len(ending) > 1)
    if name and known:
        return name, _ENDINGS.get(ending, ending)
    return text, ""
