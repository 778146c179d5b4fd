"""The motion that a study would record: what acts on the actuator, and when it is measured."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.actuators import GRAVITY_M_S2, Drive
from haselab.base import InputError
from haselab.identify.physical import MotionRecord
from haselab.models.actuator.sections import PhysicalRecords
from haselab.signals import constant, linear_chirp, triangle
from haselab.study.definition import Study

__all__ = ["planned_record"]

Floats = NDArray[np.float64]
_UPDATE_HZ = 100.0  # one output and one capacitance a block
_HANG_S = 1.0  # somebody takes this long to hang or lift a weight
_RAMP_STEPS = 25
_STATIC_FRAMES = 40  # of each static load
_LEAD_S = {"triangle": 0.2, "chirp": 1.0, "free_response": 0.1}  # recorded before it begins
_HOLD_S = 0.5  # recorded at each voltage held
_EMPTY = 0.05  # inertia of an empty clamp, of the largest hung mass


@dataclass
class _Bench:
    """What acts on the actuator, as it is written down step by step."""

    records: PhysicalRecords
    mass_kg: float
    time_s: float = 0.0
    drive_v: float = 0.0
    carrier: bool = True
    hung_kg: float = 0.0
    pull_n: float = 0.0
    acts: list[Floats] = field(default_factory=list)  # rows: duration, V, N, kg, V^2, block or -1
    frames: list[tuple[Floats, int]] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.hung_kg, self.pull_n = self.mass_kg, self.mass_kg * GRAVITY_M_S2

    def add(self, duration_s: float, drive_v: ArrayLike, pull_n: ArrayLike, of: int = -1) -> None:
        """Let values act one after the other, each for a duration; `of`: a recorded experiment."""
        volt, pull = np.broadcast_arrays(
            np.atleast_1d(np.asarray(drive_v, dtype=np.float64)), np.asarray(pull_n)
        )
        ripple_v2 = 0.5 * self.records.carrier_v**2 if self.carrier else 0.0
        gain = self.records.gain_v_per_v
        row = np.empty((volt.size, 6))
        row[:, 0], row[:, 1], row[:, 2] = duration_s, gain * volt, pull
        row[:, 3], row[:, 4], row[:, 5] = self.hung_kg, ripple_v2, of
        self.acts.append(row)
        self.time_s += duration_s * volt.size
        self.drive_v, self.pull_n = float(volt[-1]), float(pull[-1])

    def wait(self, drive_v: float, duration_s: float) -> None:
        """Hold a drive without recording."""
        self.add(duration_s, drive_v, self.pull_n)

    def pull(self, pull_n: float) -> None:
        """Change the load linearly in time."""
        part = (np.arange(_RAMP_STEPS) + 0.5) / _RAMP_STEPS
        steps = self.pull_n + part * (pull_n - self.pull_n)
        self.add(_HANG_S / _RAMP_STEPS, np.full(steps.size, self.drive_v), steps)
        self.pull_n = pull_n

    def film(self, duration_s: float, rate_hz: float, of: int) -> None:
        """Take frames from now on."""
        count = max(1, int(duration_s * rate_hz))
        times = self.time_s + (np.arange(count, dtype=np.float64) + 0.5) / rate_hz
        self.frames.append((times, of))

    def begin(self, name: str) -> int:
        """Begin a recorded experiment."""
        self.names.append(name)
        return len(self.names) - 1

    def play(self, name: str, drive_v: Floats, rate_hz: float) -> None:
        """Play a drive, and record."""
        of = self.begin(name)
        self.film(drive_v.size / _UPDATE_HZ, rate_hz, of)
        self.add(1.0 / _UPDATE_HZ, drive_v, self.pull_n, of)

    def record(self) -> MotionRecord:
        """The whole record."""
        acts = np.vstack(self.acts)
        edge_s = np.concatenate([[0.0], np.cumsum(acts[:, 0])])
        mass_kg = np.maximum(acts[:, 3], _EMPTY * acts[:, 3].max())
        drive = Drive(edge_s, acts[:, 1], acts[:, 2], mass_kg, acts[:, 4])
        std_m, std_f = self.records.length_std_m, self.records.capacitance_std_f
        sensed = np.flatnonzero((acts[:, 5] >= 0.0) & (acts[:, 4] > 0.0))
        sensed = sensed if std_f is not None else sensed[:0]
        frames = self.frames if std_m is not None else []
        times = np.concatenate([np.zeros(0), *(part for part, _ in frames)])
        of = [np.full(part.size, k) for part, k in frames]
        none = np.zeros(0, dtype=np.int64)
        return MotionRecord(
            "planned", drive, times, np.zeros(times.size), np.full(times.size, std_m or 1.0),
            sensed, np.arange(sensed.size), np.zeros(sensed.size),
            np.full(sensed.size, std_f or 1.0), tuple(self.names),
            np.concatenate([none, *of]), acts[sensed, 5].astype(np.int64),
            self.records.exposure_s, self.records.pixel_m,
        )  # fmt: skip


def planned_record(study: Study, records: PhysicalRecords, mass_kg: float) -> MotionRecord:
    """Write down what a study would do, in the order in which it is played.

    Args:
        study: with any of the tables triangle, static_load, free_response and chirp.
        records: gain, carrier and noise of the bench, from earlier records.
        mass_kg: hung mass.
    Returns:
        The motion's drive and the times at which it is seen; lengths and capacitances are 0.
    Raises:
        InputError: The study has another table, or nothing would be seen.
    """
    if study.has("steps"):
        raise InputError("The steps of a closed loop cannot be foreseen. Leave out [steps].")
    bench = _Bench(records, mass_kg)
    if study.has("triangle"):
        t = study.triangle
        wave = triangle(t.low_v, t.high_v, t.frequency_hz, t.cycles, _UPDATE_HZ)
        lead = constant(t.low_v, _LEAD_S["triangle"], _UPDATE_HZ)
        bench.play("triangle", np.concatenate([lead, wave]), t.frame_rate_hz)
    if study.has("static_load"):
        _static_load(bench, study)
    if study.has("triangle") and study.has("static_load"):
        settle_s, rate_hz = study.static_load.settle_s, study.static_load.frame_rate_hz
        about_v = study.nominal_baseline_v
        bench.wait(about_v, settle_s)
        bench.play("hold-1", constant(about_v, _HOLD_S, _UPDATE_HZ), rate_hz)
        bench.wait(0.0, settle_s)
    if study.has("free_response"):
        _free_response(bench, study)
    if study.has("chirp"):
        c, about_v = study.chirp, study.nominal_baseline_v
        bench.wait(about_v, c.hold_s)
        sweep = c.amplitude_v * linear_chirp(c.start_hz, c.stop_hz, c.duration_s, _UPDATE_HZ)
        lead = constant(about_v, _LEAD_S["chirp"], _UPDATE_HZ)
        bench.play("chirp", np.concatenate([lead, about_v + sweep]), c.frame_rate_hz)
    return bench.record()


def _static_load(bench: _Bench, study: Study) -> None:
    s, own_kg = study.static_load, bench.mass_kg
    of = bench.begin("static")
    bench.carrier, bench.drive_v = False, 0.0
    for mass_kg in s.masses_kg:
        bench.hung_kg = mass_kg
        bench.pull(mass_kg * GRAVITY_M_S2)
        bench.wait(0.0, s.settle_s)
        bench.film(_STATIC_FRAMES / s.frame_rate_hz, s.frame_rate_hz, of)
        bench.wait(0.0, (_STATIC_FRAMES + 1) / s.frame_rate_hz)
    bench.hung_kg = own_kg
    bench.pull(own_kg * GRAVITY_M_S2)
    bench.carrier = True
    bench.wait(0.0, s.settle_s)


def _free_response(bench: _Bench, study: Study) -> None:
    s, about_v = study.free_response, study.nominal_baseline_v
    for k in range(s.trials):
        of = bench.begin(f"free-{k + 1}")
        bench.drive_v = about_v
        bench.pull(0.0)
        bench.wait(about_v, s.settle_s)
        bench.film(_LEAD_S["free_response"] + s.record_s, s.frame_rate_hz, of)
        lead = constant(about_v, _LEAD_S["free_response"], _UPDATE_HZ)
        bench.add(1.0 / _UPDATE_HZ, lead, 0.0, of)
        held = constant(about_v, s.record_s, _UPDATE_HZ)
        bench.add(1.0 / _UPDATE_HZ, held, bench.mass_kg * GRAVITY_M_S2, of)
