"""A bench with the limits and the calibration of an actuator file."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from haselab.base import InputError
from haselab.models.actuator import ActuatorTables
from haselab.pipelines.calibration_file import load_calibration
from haselab.rig import Rig
from haselab.rig.protocols import MonitorCalibration
from haselab.rig.twin.config import TwinConfig
from haselab.runtime.lockin import lockin_of

__all__ = ["prepare_bench", "refuse_other_kind"]

_SAME_GAIN = 0.05  # relative difference of a nominal and a measured gain


def refuse_other_kind(tables: ActuatorTables, path: Path, twin: TwinConfig) -> None:
    """Refuse to play the maps and the controller of one kind of actuator on a twin of another.

    Args:
        tables: of the actuator file.
        path: of that file.
        twin: configuration of the twin.
    Raises:
        InputError: the file states another kind than that of the twin.
    """
    about = tables.actuator
    if "kind" in about.model_fields_set and about.kind != twin.kind:
        raise InputError(
            f"The actuator file is for kind {about.kind!r}, but the twin simulates kind "
            f"{twin.kind!r}. Use the actuator file of the twin, or a twin of the actuator's kind. "
            f"{path}"
        )


def prepare_bench(
    rig: Rig,
    tables: ActuatorTables,
    path: Path,
    carrier_hz: float,
    twin: TwinConfig | None = None,
) -> str:
    """Narrow the drive limits of a bench to those of an actuator, and use its calibration.

    The twin of an identified actuator reads capacitances as the calibrated bench did, so the
    calibration of that bench is left out.

    Args:
        rig: the bench; its description is changed.
        tables: of the actuator file.
        path: of that file.
        carrier_hz: frequency of the sensing signal.
        twin: configuration, if the bench is one.
    Returns:
        Why the calibration was left out; empty if it is used or there is none.
    Raises:
        InputError: the gain of the amplifier is another one, no voltage is within both limits, the
            calibration is for another carrier, sampling rate or amplifier, or the twin is of
            another kind.
    """
    if twin is not None:
        refuse_other_kind(tables, path, twin)
    _refuse_other_gain(rig, tables, path)
    _limit(rig, tables, path)
    if not tables.sensing.is_calibrated:
        return ""
    found, about = load_calibration(path), rig.description
    if twin is not None and twin.origin is not None and found.amplifier != about.amplifier:
        return f"the calibration is for {found.amplifier!r} and is left out on the twin. {path}"
    found.apply(lockin_of(about, carrier_hz).config, amplifier=about.amplifier)
    scale_s, stray_s = ((z.real, z.imag) for z in (found.scale_s, found.stray_s))
    calibration = MonitorCalibration(scale_s, stray_s, found.offsets_v)
    rig.description = replace(about, calibration=calibration)
    return ""


def _refuse_other_gain(rig: Rig, tables: ActuatorTables, path: Path) -> None:
    """Refuse an actuator file whose voltages become others at the actuator of this rig."""
    stated, actual = tables.drive.gain_v_per_v, rig.description.amplifier_gain
    if stated is None or abs(actual / stated - 1.0) <= _SAME_GAIN:
        return
    raise InputError(
        f"gain_v_per_v = {stated:g} in [drive], but the amplifier of the rig has a gain of "
        f"{actual:g}: the voltages in the actuator file would be {actual / stated:.3g} times as "
        f"high at the actuator. Correct the gain in one of the files. {path}"
    )


def _limit(rig: Rig, tables: ActuatorTables, path: Path) -> None:
    """Limit the drive to what the actuator withstands as well.

    Raises:
        InputError: no voltage is within both ranges.
    """
    limits = narrowed = rig.description.drive_limits
    low, high = tables.drive_ends_v(rig.description.amplifier_gain)
    source = f"[drive] of {path}"
    if low is not None and low > limits.low:
        narrowed = replace(narrowed, low=low, low_source=source)
    if high is not None and high < limits.high:
        narrowed = replace(narrowed, high=high, high_source=source)
    if not narrowed.low < narrowed.high:
        raise InputError(
            f"[drive] permits {low} to {high} V, but the rig outputs {limits.low:g} to "
            f"{limits.high:g} V. Change low_v, high_v and highest_field_v_per_m. {path}"
        )
    rig.description = replace(rig.description, drive_limits=narrowed)
