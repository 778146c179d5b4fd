"""Studies of one or two experiments, from which the one that determines a parameter is chosen."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from haselab.base import Json
from haselab.study.definition import Study, checked_study
from haselab.study.tables import LEAST_LOADS

__all__ = ["Candidate", "Range", "candidates", "combine"]

Tables = Mapping[str, Mapping[str, Json]]
_SWINGS = (1.0, 0.7)  # of the highest drive
_CYCLES = 2
_FREQUENCIES_HZ = (0.25, 0.05, 0.0125, 0.003)
# of a drop: lifted, recorded
_DROPS_S = ((5.0, 6.0), (60.0, 6.0), (5.0, 30.0), (60.0, 120.0), (60.0, 600.0))
_BASELINES = (0.0, 0.5, 0.9)  # of the highest drive
_HEAVIER = (1.0, 1.5, 2.0, 3.0)  # over the heaviest mass so far
_SETTLE_S = (5.0, 20.0, 60.0)
_CHIRPS = ((0.1, 10.0, 10.0, 10.0), (0.05, 20.0, 60.0, 30.0))  # start, stop, duration, wait
_FRAMES = 4000  # of one recording, about
_FASTEST_HZ, _SLOWEST_HZ = 200.0, 5.0


@dataclass(frozen=True)
class Range:
    """Drive and masses from which studies are planned.

    Args:
        highest_v: drive, before the amplifier.
        heaviest_kg: heaviest mass so far.
        mass_kg: that hangs.
    """

    highest_v: float
    heaviest_kg: float
    mass_kg: float


@dataclass(frozen=True)
class Candidate:
    """A study that might be played.

    Args:
        text: what it is, in a few words.
        tables: of its file, without the name.
    """

    text: str
    tables: Tables

    def study(self) -> Study:
        """The checked study.

        Raises:
            InputError: A value is outside its range.
        """
        return checked_study(self.file("planned experiment"), "planned experiment")

    def file(self, name: str) -> dict[str, object]:
        """Contents of a study file."""
        return {"name": name, **self.tables}


def candidates(within: Range) -> list[Candidate]:
    """All single experiments.

    Args:
        within: what the actuator may be exposed to.
    """
    return [
        *_triangles(within.highest_v),
        *_free_responses(within.highest_v),
        *_chirps(within.highest_v),
        *_static_loads(within),
    ]


def combine(first: Candidate, second: Candidate) -> Candidate | None:
    """One study of two experiments; None if it needs two baselines or repeats a table."""
    shared = set(first.tables) & set(second.tables)
    if shared - {"operating_point"} or any(
        first.tables[name] != second.tables[name] for name in shared
    ):
        return None
    tables = {**first.tables, **second.tables}
    return Candidate(f"{first.text}, and {second.text}", tables)


def _frame_rate_hz(seconds: float) -> float:
    rate_hz = _FRAMES / seconds
    return next((step for step in (200.0, 100.0, 50.0, 20.0, 10.0) if step <= rate_hz), _SLOWEST_HZ)


def _triangles(highest_v: float) -> Iterator[Candidate]:
    if not highest_v > 0.0:
        return
    for swing, frequency_hz in itertools.product(_SWINGS, _FREQUENCIES_HZ):
        high_v = _rounded(swing * highest_v)
        table = {
            "low_v": 0.0,
            "high_v": high_v,
            "frequency_hz": frequency_hz,
            "cycles": _CYCLES,
            "skipped_cycles": 0,
            "frame_rate_hz": _frame_rate_hz(_CYCLES / frequency_hz),
        }
        text = f"{_CYCLES} triangles of {1.0 / frequency_hz:g} s, to a drive of {high_v:g} V"
        yield Candidate(text, {"triangle": table})


def _free_responses(highest_v: float) -> Iterator[Candidate]:
    baselines = {_rounded(part * highest_v) for part in _BASELINES}
    for about_v, (settle_s, record_s) in itertools.product(sorted(baselines), _DROPS_S):
        table = {
            "trials": 1,
            "settle_s": settle_s,
            "record_s": record_s,
            "frame_rate_hz": _frame_rate_hz(record_s),
        }
        text = (
            f"the mass lifted for {settle_s:g} s, dropped and recorded for {record_s:g} s, at a "
            f"drive of {about_v:g} V"
        )
        point = {"baseline_v": about_v}
        yield Candidate(text, {"operating_point": point, "free_response": table})


def _chirps(highest_v: float) -> Iterator[Candidate]:
    if not highest_v > 0.0:
        return
    for start_hz, stop_hz, duration_s, hold_s in _CHIRPS:
        about_v, swing_v = _rounded(0.6 * highest_v), _rounded(0.35 * highest_v)
        table = {
            "amplitude_v": swing_v,
            "start_hz": start_hz,
            "stop_hz": stop_hz,
            "duration_s": duration_s,
            "hold_s": hold_s,
            "frame_rate_hz": _FASTEST_HZ,
        }
        text = (
            f"a chirp of {start_hz:g} to {stop_hz:g} Hz in {duration_s:g} s, at a drive of "
            f"{about_v:g} V ± {swing_v:g} V"
        )
        yield Candidate(text, {"operating_point": {"baseline_v": about_v}, "chirp": table})


def _static_loads(within: Range) -> Iterator[Candidate]:
    for heavier, settle_s in itertools.product(_HEAVIER, _SETTLE_S):
        top_kg = heavier * max(within.heaviest_kg, within.mass_kg)
        masses_kg = [_rounded(top_kg * k / (LEAST_LOADS - 1)) for k in range(LEAST_LOADS)]
        table: dict[str, Json] = {
            "masses_kg": masses_kg,
            "settle_s": settle_s,
            "frame_rate_hz": 100.0,
        }
        text = f"{LEAST_LOADS} static loads up to {masses_kg[-1]:g} kg, {settle_s:g} s each"
        yield Candidate(text, {"static_load": table})


def _rounded(value: float) -> float:
    """Three digits, never above the value."""
    found = float(f"{value:.3g}")
    return found if found <= value else float(f"{0.995 * value:.3g}")
