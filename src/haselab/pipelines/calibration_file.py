"""Calibration files (TOML): the result, and the references that it was computed from."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, field_validator

from haselab.base import InputError, ResultError, table_at
from haselab.base.numbers_only import numbers_only
from haselab.sensing.calibration import Calibration, Reference, ReferenceReading, fit_calibration
from haselab.store.folder import write_text
from haselab.store.toml import read_toml, validated

__all__ = ["calibration_section", "load_calibration", "save_calibration"]

_HEAD = """\
# Calibration of the monitors: Y = scale_s * I / V - stray_s, complex numbers as [real, imaginary].
# Valid only for this carrier, sampling rate and amplifier. SI units.
"""
_ROUNDING = 1e-9  # relative difference of the same fit on another machine


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    _numbers = field_validator("*", mode="before")(classmethod(numbers_only))


_Number = Annotated[float, Field(ge=-1e18, le=1e18)]  # squares do not overflow


class _ReferenceTable(_Strict):
    capacitance_f: float = Field(ge=1e-18, le=1)
    series_ohm: float = Field(ge=0, le=1e12)
    tolerance: _Number
    ratio: tuple[_Number, _Number]
    ratio_std: float = Field(ge=0, le=1e6)
    offsets_v: tuple[_Number, _Number]


class _File(_Strict):
    date: str
    amplifier: str
    carrier_hz: float = Field(ge=1e-3, le=1e9)
    rate_hz: float = Field(ge=1e-3, le=1e12)
    scale_s: tuple[_Number, _Number]
    scale_std_s: _Number
    stray_s: tuple[_Number, _Number]
    offsets_v: tuple[_Number, _Number]
    residual: _Number
    reference: list[_ReferenceTable]


def save_calibration(calibration: Calibration, path: Path) -> None:
    """Write a calibration file; replace an older one atomically.

    Args:
        calibration: the calibration.
        path: of the file.
    Raises:
        DeviceError: the file cannot be written.
    """
    head, tables = _tables(calibration)
    parts = [_HEAD + _rows(head), *("[[reference]]\n" + _rows(table) for table in tables)]
    write_text(path, "\n".join(parts))


def calibration_section(calibration: Calibration) -> Mapping[str, object]:
    """Keys of a calibration for `[sensing]` of an actuator file."""
    head, tables = _tables(calibration)
    return {**head, "reference": tables}


def _tables(calibration: Calibration) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """The result, and the references that it was computed from."""
    c = calibration
    head = {
        "date": c.date,
        "amplifier": c.amplifier,
        "carrier_hz": c.carrier_hz,
        "rate_hz": c.rate_hz,
        "scale_s": c.scale_s,
        "scale_std_s": c.scale_std_s,
        "stray_s": c.stray_s,
        "offsets_v": c.offsets_v,
        "residual": c.residual,
    }
    tables = [
        {
            "capacitance_f": reference.capacitance_f,
            "series_ohm": reference.series_ohm,
            "tolerance": reference.tolerance,
            "ratio": reading.ratio,
            "ratio_std": reading.ratio_std,
            "offsets_v": reading.offsets_v,
        }
        for reference, reading in zip(c.references, c.readings, strict=True)
    ]
    return head, tables


def _rows(values: dict[str, Any]) -> str:
    return "".join(f"{name} = {_literal(value)}\n" for name, value in values.items())


def _literal(value: Any) -> str:
    if isinstance(value, complex):
        value = (value.real, value.imag)
    if isinstance(value, tuple):
        return f"[{', '.join(_literal(item) for item in value)}]"
    return json.dumps(value, ensure_ascii=False) if isinstance(value, str) else repr(float(value))


def load_calibration(path: Path) -> Calibration:
    """Read a calibration, and check that it follows from its references.

    Args:
        path: of a calibration file, or of an actuator file with a calibration in `[sensing]`.
    Returns:
        The calibration.
    Raises:
        InputError: no such file, an error in it, or numbers that contradict its references.
    """
    data = read_toml(path, "calibration file")
    if sensing := table_at(data, "sensing"):
        data = {key: sensing[key] for key in _File.model_fields if key in sensing}
        if "scale_s" not in data:
            raise InputError(
                "[sensing] has no calibration. Add one with: haselab calibrate --actuator "
                f"{path.name}  {path}"
            )
    file = validated(_File, data, path)
    try:
        found = fit_calibration(
            [Reference(r.capacitance_f, r.series_ohm, r.tolerance) for r in file.reference],
            [ReferenceReading(complex(*r.ratio), r.ratio_std, r.offsets_v) for r in file.reference],
            carrier_hz=file.carrier_hz,
            rate_hz=file.rate_hz,
            amplifier=file.amplifier,
            date=file.date,
        )
    except (InputError, ResultError) as error:
        raise InputError(f"{error} {path}") from None
    for name, claimed, follows in (
        ("scale_s", complex(*file.scale_s), found.scale_s),
        ("stray_s", complex(*file.stray_s), found.stray_s),
    ):
        size = max(abs(found.scale_s), abs(found.stray_s))
        if not abs(claimed - follows) <= _ROUNDING * size or not math.isfinite(abs(follows)):
            raise InputError(
                f"{name} is {claimed:.6g} S, but the references in the file give {follows:.6g} S. "
                f"Calibrate again, or undo the change. {path}"
            )
    return found
