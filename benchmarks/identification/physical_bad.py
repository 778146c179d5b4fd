"""Records that cannot be right: what `physical_model` makes of them, for each kind of actuator.

    python -m benchmarks.identification.physical_bad --kinds dea-stack --drives steps chirp \
        --channels camera --faults time mass --seeds 1

A board of tables of hidden laws with one column stated in a wrong unit or by a wrong factor: one
line for each, with what the identification makes of it. The lines of the faults "none" are valid
records.
"""

from __future__ import annotations

import argparse
import itertools
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from benchmarks.identification.physical_kinds import KINDS, Kind, shifted
from benchmarks.rows import Row
from haselab.actuators import GRAVITY_M_S2, Drive, SampledLaw, with_parameters
from haselab.base import HaselabError
from haselab.identify.physical import ActuatorFit, MotionRecord, fit_actuator
from haselab.identify.physical.plausible import find_implausible
from haselab.identify.physical.unknowns import fitted_parameters
from haselab.pipelines.motion_table import motion_of_table

__all__ = ["Case", "Played", "bad_rows", "board", "played"]

Floats = NDArray[np.float64]
_GAIN = 5000.0  # of the amplifier
_WRONG_MASS = 1.5  # over the true one
DRIVES = ("steps", "chirp", "staircase", "free", "creep")
CHANNELS = ("camera", "capacitance", "both")
# the word that the status or a note must have, by what is wrong
WORDS = {
    "none": ("",),
    "time": (
        "all times were",
        "times that are stated",
        "unit of the times",
        "unit of time",
        "frame rate",
    ),
    "mass": ("mass",),
    "voltage": ("gain", "volt"),
    "length": ("length", "scale of the camera"),
}
FACTORS = (1000.0, 60.0, 10.0, 2.0, 0.5, 0.1, 1.0 / 60.0, 0.001)
_NOISE_M, _NOISE_F = 4e-6, 3e-13  # of tables
_GENERAL = ("Without capacitances", "Without lengths")  # begin the notes that all such records have
_CLOCK, _ZERO_M = 1e-3, 5e-5  # what the command assumes of tables


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


def _volts(drive: str, highest_v: float, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Times of the rows and voltages of a drive; each begins at rest at 0 V."""
    time_s = np.arange(0.0, {"staircase": 34.0, "free": 6.0}.get(drive, 20.0), 0.01)
    if drive == "steps":
        levels = np.append(0.0, rng.uniform(0.2, 1.0, 9) * rng.permutation([0, 1] * 4 + [1]))
        return time_s, highest_v * levels[(time_s / 2.0).astype(int)]
    if drive == "chirp":
        moving = np.maximum(time_s - 1.0, 0.0)
        phase = 2.0 * np.pi * 0.2 * 19.0 / np.log(60.0) * (60.0 ** (moving / 19.0) - 1.0)
        return time_s, highest_v * np.sqrt(0.35 * (1.0 - np.cos(phase)))
    if drive == "staircase":
        step = (time_s / 2.0).astype(int)
        return time_s, highest_v * np.minimum(step, 16 - step) / 8.0
    if drive == "free":
        return time_s, np.where(time_s < 1.0, 0.9 * highest_v, 0.0)
    time_s = np.arange(0.0, 900.0, 0.5)
    return time_s, np.where((time_s > 10.0) & (time_s < 600.0), 0.8 * highest_v, 0.0)


@dataclass(frozen=True)
class Played:
    """What a table would state of a hidden law, without a fault."""

    truth: dict[str, float]
    time_s: Floats
    voltage_v: Floats
    mass_kg: float
    length_m: Floats
    capacitance_f: Floats

    def table(self, channel: str, fault: str = "none", factor: float = 1.0) -> MotionRecord:
        """The record of a channel, with a column or the mass off by a factor."""
        by = {name: factor if name == fault else 1.0 for name in WORDS}
        rng = np.random.default_rng(7)
        length_m = self.length_m + _NOISE_M * rng.standard_normal(self.time_s.size)
        sensed_f = self.capacitance_f + _NOISE_F * rng.standard_normal(self.time_s.size)
        return motion_of_table(
            "table", by["time"] * self.time_s, by["voltage"] * self.voltage_v,
            mass_kg=by["mass"] * self.mass_kg,
            length_m=None if channel == "capacitance" else by["length"] * length_m,
            capacitance_f=None if channel == "camera" else sensed_f,
        )  # fmt: skip


def played(kind: Kind, drive: str, seed: int) -> Played:
    """Play a drive on a law whose parameters are moved by up to 30 %."""
    for attempt in range(100):
        rng = np.random.default_rng([seed, attempt, DRIVES.index(drive)])
        truth = shifted(fitted_parameters(kind.law), rng)
        time_s, volt = _volts(drive, kind.highest_v, rng)
        count, step_s = time_s.size, time_s[1]
        # the capacitance of a row is that at its beginning
        edge_s = np.append(np.stack([time_s, time_s + 0.01 * step_s], axis=1).ravel(),
                           time_s[-1] + step_s)  # fmt: skip
        weight = np.full(2 * count, kind.mass_kg * GRAVITY_M_S2)
        acts = Drive(edge_s, np.repeat(volt, 2), weight, np.full(2 * count, kind.mass_kg),
                     np.zeros(2 * count))  # fmt: skip
        try:
            law = with_parameters(kind.law, truth)
            sampled = SampledLaw(law, 11e3)
            start, _ = sampled.at_rest(float(volt[0]), 0.0, float(weight[0]))
            found = sampled.respond(acts, time_s, start)
        except HaselabError:
            continue
        limits = law.length_limits_m
        if limits.low < found.length_m.min() <= found.length_m.max() < limits.high:
            truth |= {"load.added_inertia_kg": 0.0}
            return Played(truth, time_s, volt, kind.mass_kg, found.length_m,
                          found.capacitance_f[::2])  # fmt: skip
    raise RuntimeError(f"No draw of seed {seed} can be simulated with {drive}.")


@dataclass(frozen=True)
class Case:
    """One line of the board: what was made of a fault."""

    name: str
    fault: str
    verdict: str
    seconds: float
    coarse_seconds: float
    said: str

    def __str__(self) -> str:
        times = f"{self.coarse_seconds:6.2f} {self.seconds:7.1f} s"
        return f"{self.verdict:9} {times}  {self.name}: {self.said}"


def _verdict(fault: str, fit: ActuatorFit) -> tuple[str, str]:
    """In one word and in those of the fit."""
    notes = [note for note in fit.notes if not note.startswith(_GENERAL)]
    general = [note.lower() for note in fit.notes if note.startswith(_GENERAL)]
    said = " | ".join([fit.status, *notes])
    if fault == "none":
        return ("accepted" if fit.parameters else "REFUSED"), said
    names = any(word in said.lower() for word in WORDS[fault])
    if not fit.parameters:
        return ("named" if names else "refused"), said
    if fit.status != "ok" or notes:
        return ("warned" if names else "doubted"), said
    # what all records of a camera alone, or of capacitances alone, are told
    known = any(word in note for note in general for word in WORDS[fault])
    return ("general" if known else "SILENT"), said


def _wrong(fit: ActuatorFit, truth: dict[str, float]) -> str:
    """How many intervals miss the truth, and the farthest in its half widths."""
    z = {}
    for name, found in fit.parameters.items():
        if name in truth and name not in fit.not_identifiable:
            low, high = found.ci95
            half = found.value - low if truth[name] < found.value else high - found.value
            z[name] = abs(found.value - truth[name]) / half
    if not z:
        return ""
    worst = max(z, key=lambda name: z[name])
    outside = sum(value > 1.0 for value in z.values())
    return f" [{outside} of {len(z)} intervals wrong, {worst} by {z[worst]:.3g}]"


def board(
    kinds: list[str],
    drives: list[str],
    channels: list[str],
    faults: list[str],
    factors: list[float],
    seeds: int,
    *,
    coarse: bool = False,
) -> Iterator[Case]:
    """All combinations, one after the other.

    Args:
        kinds: of actuators.
        drives: of `DRIVES`.
        channels: of `CHANNELS`.
        faults: of `WORDS`.
        factors: stated over true value.
        seeds: of the hidden laws.
        coarse: only the check before the fit.
    """  # fmt: skip
    for name, drive, seed in itertools.product(kinds, drives, range(1, seeds + 1)):
        kind = KINDS[name]
        true = played(kind, drive, seed)
        for channel, fault in itertools.product(channels, faults):
            if fault == "length" and channel == "capacitance":
                continue
            for factor in factors if fault != "none" else [1.0]:
                record = true.table(channel, fault, factor)
                words = f"{name} {drive} {seed}, {channel}, {fault} x {factor:.4g}"
                start_s = time.perf_counter()
                found = find_implausible(kind.law, [record])
                coarse_s = time.perf_counter() - start_s
                fit = ActuatorFit(status=found or "plausible", kind=name)
                if not (coarse or found):
                    fit = fit_actuator(
                        kind.law, [record], mass_kg=float(record.drive.mass_kg[0]),
                        camera_bias_m=_ZERO_M, clock_std=_CLOCK,
                    )  # fmt: skip
                verdict, said = _verdict(fault, fit)
                if coarse and not found:
                    verdict = "passed"
                yield Case(words, fault, verdict, time.perf_counter() - start_s, coarse_s,
                           said + _wrong(fit, true.truth))  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kinds", nargs="+", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--drives", nargs="+", choices=DRIVES, default=DRIVES)
    parser.add_argument("--channels", nargs="+", choices=CHANNELS, default=CHANNELS)
    parser.add_argument("--faults", nargs="+", choices=list(WORDS), default=list(WORDS))
    parser.add_argument("--factors", nargs="+", type=float, default=FACTORS)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--coarse", action="store_true", help="only the check before the fit")
    found = []
    for case in board(**vars(parser.parse_args())):
        print(case, flush=True)
        found.append(case)
    for fault in dict.fromkeys(case.fault for case in found):
        count = Counter(case.verdict for case in found if case.fault == fault)
        print(f"{fault}: " + ", ".join(f"{n} {what}" for what, n in count.most_common()))
    coarse_s = np.array([case.coarse_seconds for case in found])
    print(f"check before the fit: {coarse_s.sum():.1f} s, at most {coarse_s.max():.2f} s")


if __name__ == "__main__":
    main()
