"""Print a digest of computed results, to compare two installations of haselab bit by bit.

    python packaging/digest.py

The digests are equal only with the same numpy, scipy and processor type, because numpy and scipy
choose instructions at run time. haselab's own modules give the same bits with all instructions.
"""

from __future__ import annotations

import hashlib
import json

import numpy as np

import haselab as hl
from haselab.base import Estimate
from haselab.control import LoopSetting, PidGains, simulate_ensemble, trace_ensemble
from haselab.identify import LoopRecord
from haselab.models import Plant, PrandtlIshlinskii
from haselab.sensing import Lockin, LockinConfig
from haselab.tracking import track_frames

BLOCK, RATE_HZ = 2000, 200e3


def of(*arrays: object) -> str:
    """First 16 digits of a hash of the values."""
    digest = hashlib.sha256()
    for array in arrays:
        values = np.ascontiguousarray(array)
        digest.update(f"{values.dtype}{values.shape}".encode() + values.tobytes())
    return digest.hexdigest()[:16]


def estimates(named: dict[str, Estimate]) -> list[float]:
    """Values and standard deviations in the order of the names."""
    return [number for name in sorted(named) for number in (named[name].value, named[name].std)]


def sensing() -> str:
    """The lock-in's results for random codes and a carrier."""
    noise = np.random.default_rng(1).integers(-40, 40, (200, BLOCK, 2), np.int16)
    phase = 2.0 * np.pi * 2000.0 / RATE_HZ * np.arange(BLOCK)
    carrier = np.round(3000.0 * np.stack([np.sin(phase), np.cos(phase)], axis=-1)).astype(np.int16)
    config = LockinConfig(
        rate_hz=RATE_HZ, block_samples=BLOCK, carrier_hz=2000.0, skew_s=2.5e-6, ohm_per_ratio=2.5e6
    )
    found = Lockin(config).sense(noise + carrier)
    return of(found.capacitance_f, found.capacitance_std_f, found.resistance_ohm, found.valid)


def tracking() -> str:
    """A speckle pattern that moves by parts of a pixel."""
    random = np.random.default_rng(2)
    pattern = random.integers(0, 256, (160, 160)).astype(np.float64)
    for axis in (0, 1, 0, 1):
        pattern = (np.roll(pattern, 1, axis) + 2.0 * pattern + np.roll(pattern, -1, axis)) / 4.0
    frames = [
        np.clip(np.round((1.0 - s) * pattern + s * np.roll(pattern, 1, 1)), 0, 255).astype(np.uint8)
        for s in (0.0, 0.25, 0.5, 0.75)
    ]
    points = np.array([[50.0, 50.0], [80.0, 90.0], [110.0, 60.0]])
    found = track_frames(frames, points)
    return of(found.x_px, found.y_px, found.std_x_px, found.quality)


def twin() -> tuple[str, str]:
    """Monitors, camera and self-sensing of the twin, and a model identified from them."""
    with hl.Runner(hl.twin(seed=3), baseline_v=1.0) as runner:
        slow = runner.play(hl.signals.triangle(0.0, 2.0, 0.5, 1, runner.update_hz))
        chirp = 1.0 + 0.2 * hl.signals.linear_chirp(0.1, 10.0, 10.0, runner.update_hz)
        fast = runner.play(chirp)
    fit = hl.fit_transfer(fast.records())
    recorded = of(*(one[name] for one in (slow, fast) for name in ("strain", "capacitance_f")))
    return recorded, of(estimates(dict(fit.parameters)))


def loops() -> str:
    """Closed loops of many plants, with noise."""
    plants = [Plant(0.05, omega, 0.3) for omega in np.linspace(10.0, 60.0, 96)]
    noise = np.random.default_rng(4).normal(0.0, 1e-3, 400)
    case = (plants, [PidGains(0.5, 8.0, 0.01)] * 96, [0.02] * 400, LoopSetting())
    traces = trace_ensemble(*case, measurement_noise=noise)
    found = simulate_ensemble(*case, measurement_noise=noise)
    return of(traces.measured, traces.u, found.settling_time_s, found.overshoot)


def identification() -> str:
    """A transfer function and a hysteresis from generated records."""
    random = np.random.default_rng(5)
    u = np.repeat(random.choice([-1.0, 1.0], 200), 10)
    y = np.convolve(u, np.exp(-np.arange(60) / 12.0) * np.sin(np.arange(60) / 4.0))[: u.size]
    measured = {"u": u, "y": y + random.normal(0.0, 0.05, u.size)}
    fit = hl.fit_transfer(hl.records(measured, "u", "y", rate_hz=100.0))
    drive = np.tile(np.concatenate([np.linspace(-1, 1, 200), np.linspace(1, -1, 200)]), 3)
    play = PrandtlIshlinskii(1.0, (0.15, 0.5), (0.4, 0.3), 0.2)
    bent = play.simulate(drive) + random.normal(0.0, 0.005, drive.size)
    curve = hl.fit_hysteresis([LoopRecord(drive, bent, 100.0)], "prandtl-ishlinskii")
    return of(estimates(dict(fit.parameters)), estimates(dict(curve.parameters)))


def main() -> None:
    """Print the digests as JSON."""
    recorded, model = twin()
    print(
        json.dumps(
            {
                "sensing": sensing(),
                "tracking": tracking(),
                "twin": recorded,
                "twin's model": model,
                "loops": loops(),
                "identification": identification(),
            }
        )
    )


if __name__ == "__main__":
    main()
