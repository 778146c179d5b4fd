"""Records that cannot be right: what `physical_model` makes of them, for each kind of actuator."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from benchmarks.identification.physical_kinds import Kind
from benchmarks.rows import Row
from haselab.identify.physical import MotionRecord, fit_actuator

__all__ = ["bad_rows"]

_GAIN = 5000.0  # of the amplifier
_WRONG_MASS = 1.5  # over the true one


def _with_drive(record: MotionRecord, volts: float = 1.0, mass: float = 1.0) -> MotionRecord:
    drive = record.drive
    return replace(record, drive=replace(
        drive, voltage_v=volts * drive.voltage_v, ripple_v2=volts**2 * drive.ripple_v2,
        load_n=mass * drive.load_n, mass_kg=mass * drive.mass_kg,
    ))  # fmt: skip


def _bad(kind: Kind, seed: int) -> dict[str, tuple[list[MotionRecord], str]]:
    """Records of a seed, and a word that the status must have."""
    record, other = (kind.drawn(s)[1] for s in (seed, seed + 1000))
    of_length, of_farad = (
        {name: 10.0**n * getattr(record, name) for name in names}
        for n, names in (
            (3, ("length_m", "length_std_m")),
            (12, ("capacitance_f", "capacitance_std_f")),
        )
    )
    return {
        "two actuators in one fit": ([record, other], "one actuator"),
        "mass 1.5 times too high": ([_with_drive(record, mass=_WRONG_MASS)], "mass"),
        "mass 1.5 times too low": ([_with_drive(record, mass=1.0 / _WRONG_MASS)], "mass"),
        "lengths in mm": ([replace(record, **of_length)], "unit of the lengths"),
        "capacitances in pF": ([replace(record, **of_farad)], "unit of the capacitances"),
        "volts at the amplifier's input": (
            [_with_drive(record, volts=1.0 / _GAIN)], "amplifier's gain"),
        "amplifier's gain counted twice": (
            [_with_drive(record, volts=_GAIN)], "amplifier's gain"),
    }  # fmt: skip


def bad_rows(kind: Kind, cases: int) -> Iterator[Row]:
    """Share of the cases without numbers whose status names what is wrong.

    Args:
        kind: of the actuator.
        cases: of each fault.
    """
    named: dict[str, list[bool]] = {}
    for seed in range(1, cases + 1):
        for what, (records, word) in _bad(kind, seed).items():
            fit = fit_actuator(kind.law, records, mass_kg=float(records[0].drive.mass_kg[0]))
            named.setdefault(what, []).append(not fit.parameters and word in fit.status)
            if not named[what][-1]:
                print(f"# {kind.name}, seed {seed}, {what}: {fit.status}", flush=True)
    for what, found in named.items():
        share = 100.0 * float(np.mean(found))
        yield Row(f"bad input: {what}", share, "%", 95.0, note=f"of {cases}: named, no numbers")
