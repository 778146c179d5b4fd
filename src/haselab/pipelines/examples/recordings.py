"""Recordings of the twin for the example data sets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.history import precondition
from haselab.rig.twin.twin_bench import TwinBench, describe
from haselab.runtime.lockin import lockin_of
from haselab.signals import constant, linear_chirp, triangle
from haselab.store.video.writer import VideoWriter

__all__ = [
    "CARRIER_HZ", "ZERO_LENGTH_M", "ActuatorRecords", "Cycles", "actuator_records", "chirp",
    "cycles", "film", "monitors", "release", "tensile",
]  # fmt: skip

Floats = NDArray[np.float64]
CARRIER_HZ = 2000.0
_CARRIER_V, _MASS_KG, _BLOCK_S = 0.02, 0.25, 0.01
_CAMERA_M = 3e-6  # standard deviation of a measured length
_SETTLE_S = 30.0
_HIGHEST_V, _FRAMES_HZ = 2.0, 50.0
ZERO_LENGTH_M = 0.051  # of the records of one actuator


@dataclass(frozen=True)
class Cycles:
    """Triangles of the drive, with a row for every fifth block.

    Args:
        time_s: middle of each block. Shape `(N,)`.
        voltage_v: at the actuator. Shape `(N,)`.
        capacitance_f: from the lock-in. Shape `(N,)`.
        strain: relative to the first row. Shape `(N,)`.
    """

    time_s: Floats
    voltage_v: Floats
    capacitance_f: Floats
    strain: Floats


@dataclass(frozen=True)
class ActuatorRecords:
    """Records of one actuator, for the design of its controller.

    Args:
        monitors_v: voltage and current monitor during the triangle. Shape `(N, 2)`.
        monitor_rate_hz: of the monitors.
        played: time, drive before the amplifier in V, and strain, by the name of the drive:
            `triangle`, `chirp`, `steps`. Shape `(3, B)` each.
    """

    monitors_v: Floats
    monitor_rate_hz: float
    played: dict[str, Floats]


def _bench(seed: int, *, carrier: bool, reading: Literal["rad", "hz"] = "rad") -> TwinBench:
    """Make a twin with its hung mass, at rest."""
    bench = TwinBench(twin_of_reading(reading), seed)
    bench.hang(_MASS_KG)
    bench.wait(_SETTLE_S)
    if carrier:
        bench.sine(CARRIER_HZ, _CARRIER_V)
        for _ in range(10):
            bench.read()
    return bench


def _played(bench: TwinBench, drive_v: Floats, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """Play a drive; return the codes of all blocks and the length at the middle of each."""
    codes, length_m = [], []
    for value in drive_v:
        before_m = bench.length_m
        bench.write(float(value))
        codes.append(bench.read())
        length_m.append(0.5 * (before_m + bench.length_m))
    noise_m = _CAMERA_M * rng.standard_normal(len(length_m))
    return np.array(codes), np.array(length_m) + noise_m


def monitors(seed: int) -> tuple[Floats, Floats, float]:
    """Record both monitors during two seconds of a triangle.

    Args:
        seed: of all noise.
    Returns:
        Voltage and current monitor in V, shape `(N,)`, and their rate in Hz.
    """
    bench = _bench(seed, carrier=True)
    rig = describe(twin_of_reading("rad"))
    drive_v = triangle(0.0, 1.2, 0.5, 1, 1.0 / _BLOCK_S)
    codes, _ = _played(bench, drive_v, np.random.default_rng(seed))
    every = 4  # 200 kHz is more than a carrier of 2 kHz needs
    volts = codes.reshape(-1, 2)[::every] * rig.volt_per_code
    return volts[:, 0], volts[:, 1], rig.rate_hz / every


def cycles(seed: int) -> Cycles:
    """Record capacitance and strain during three triangles of the drive.

    Args:
        seed: of all noise.
    Returns:
        The recording, with a row for every fifth block.
    """
    bench = _bench(seed, carrier=True)
    rig = describe(twin_of_reading("rad"))
    drive_v = triangle(0.0, 1.5, 0.05, 3, 1.0 / _BLOCK_S)  # far below the resonance
    _played(bench, drive_v[:4000], np.random.default_rng(seed))  # creep has settled after cycles
    codes, length_m = _played(bench, drive_v, np.random.default_rng(seed))
    capacitance_f = lockin_of(rig, CARRIER_HZ).sense(codes.astype(np.int16)).capacitance_f
    time_s = np.asarray((np.arange(drive_v.size) + 0.5) * _BLOCK_S, np.float64)
    strain = length_m / length_m[0] - 1.0
    every = slice(None, None, 5)
    voltage_v = rig.amplifier_gain * drive_v
    return Cycles(time_s[every], voltage_v[every], capacitance_f[every], strain[every])


def chirp(seed: int) -> tuple[Floats, Floats, Floats]:
    """Record a small chirp around an operating point, up and down again.

    Args:
        seed: of all noise.
    Returns:
        Time in s, drive in V relative to the operating point, displacement in m. Shape `(N,)` each.
    """
    bench = _bench(seed, carrier=False)
    rate_hz, middle_v = 1.0 / _BLOCK_S, 1.0
    rng = np.random.default_rng(seed)
    _played(bench, np.full(2, middle_v), rng)
    bench.wait(4.0 * _SETTLE_S)
    up = linear_chirp(0.1, 3.0, 40.0, rate_hz)
    change_v = 0.04 * np.concatenate([up, up[::-1]])
    _, length_m = _played(bench, middle_v + change_v, rng)
    time_s = np.arange(change_v.size) / rate_hz
    # Lengths belong to the middle of a block, whose output began 2 ms after its start.
    return time_s, change_v, length_m - length_m[0]


def actuator_records(seed: int) -> ActuatorRecords:
    """Record what the design of a controller for one actuator needs.

    Args:
        seed: of all noise.
    Returns:
        A triangle with the monitors, a chirp after a step, and steps.
    """
    bench, rng = _bench(seed, carrier=True, reading="hz"), np.random.default_rng(seed)
    precondition(bench, _HIGHEST_V)
    rate_hz, played = 1.0 / _BLOCK_S, dict[str, Floats]()
    drives = {
        "triangle": triangle(0.0, _HIGHEST_V, 1.0 / 1.5, 2, rate_hz),
        "chirp": np.concatenate([
            constant(1.0, 5.0, rate_hz), constant(1.3, 15.0, rate_hz),
            1.0 + 0.5 * linear_chirp(0.1, 10.0, 20.0, rate_hz),
        ]),
        "steps": np.repeat([1.0, 1.3, 0.8, 1.2, 0.9], round(5.0 * rate_hz)),
    }  # fmt: skip
    codes: list[NDArray[np.int16]] = []
    for name, drive_v in drives.items():
        length_m = []
        for value in drive_v:
            length_m.append(bench.length_m)
            bench.write(float(value))
            if name == "triangle":
                codes.append(bench.read())
            else:
                bench.wait(_BLOCK_S)
        noise_m = _CAMERA_M * rng.standard_normal(drive_v.size)
        strain = (np.array(length_m) + noise_m) / ZERO_LENGTH_M - 1.0
        played[name] = np.stack([np.arange(drive_v.size) / rate_hz, drive_v, strain])
        bench.write(1.0)
        bench.wait(_SETTLE_S)
    rig = describe(twin_of_reading("hz"))
    every = 4
    volts = np.asarray(np.concatenate(codes)[::every] * rig.volt_per_code, np.float64)
    return ActuatorRecords(volts, rig.rate_hz / every, played)


def film(seed: int, path: Path) -> None:
    """Record a video of one triangle of the drive, 50 frames a second, the first 20 at rest.

    Args:
        seed: of all noise.
        path: of the new video, `.mkv` or `.avi`. The times of the frames go to a CSV file next to
            it.
    """
    bench = _bench(seed, carrier=False)
    writer = VideoWriter(path, _FRAMES_HZ)
    drive_v = np.concatenate([constant(0.0, 0.4, 1.0 / _BLOCK_S),
                              triangle(0.0, _HIGHEST_V, 0.5, 1, 1.0 / _BLOCK_S)])  # fmt: skip
    bench.start(_FRAMES_HZ)
    start_s = bench.time_s
    for value in drive_v:
        bench.write(float(value))
        bench.read()
        frames = bench.take()
        if frames is not None:
            writer.append(frames.images, frames.time_s - start_s)
    writer.close()


def release(seed: int) -> tuple[Floats, Floats]:
    """Record the free response after the hung mass is lifted and dropped.

    Args:
        seed: of all noise.
    Returns:
        Time in s and displacement in m. Shape `(N,)` each.
    """
    bench = _bench(seed, carrier=False)
    rest_m = bench.length_m
    bench.lift()
    bench.wait(_SETTLE_S)
    bench.drop()
    _, length_m = _played(bench, np.zeros(800), np.random.default_rng(seed))
    time_s = np.asarray(np.arange(800) * _BLOCK_S, np.float64)
    return time_s, length_m - rest_m


def tensile(seed: int) -> tuple[Floats, Floats]:
    """Record a slow tensile test.

    Args:
        seed: of all noise.
    Returns:
        Stretch and force in N. Shape `(N,)` each.
    """
    config = twin_of_reading("rad")
    bench = TwinBench(config, seed)
    load_n = np.linspace(0.2, 6.0, 60)
    length_m = []
    for load in load_n:
        bench.pull(float(load))
        bench.wait(_SETTLE_S)
        length_m.append(bench.length_m)
    noise = np.random.default_rng(seed).standard_normal((2, load_n.size))
    stretch = (np.array(length_m) + _CAMERA_M * noise[0]) / config.shell.length_m
    return stretch, load_n + 2e-3 * noise[1]
