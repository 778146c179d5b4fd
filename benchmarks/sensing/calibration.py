"""Absolute self-sensing on the twin: farads, ohms and strain after two reference capacitors.

    python -m benchmarks.sensing.calibration

The monitors of this twin lag and err, the channels are skewed, cable and fixture add 30 pF. Known
loads and the actuator are measured, and strain is compared with what the camera tracks while the
drive sweeps from 0 to 20 Hz: the map is fitted on one record and validated on another.
"""

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from benchmarks.rows import Row
from haselab.models.actuator import StrainMap
from haselab.rig import Rig
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import TwinBench, rig_of
from haselab.runtime.lockin import BLANKING_S
from haselab.sensing import Lockin, LockinConfig
from haselab.sensing.calibration import (
    Calibration,
    Reference,
    fit_calibration,
    read_reference,
)
from haselab.sensing.strain import fit_strain_map
from haselab.tracking import PointTracker, TrackOptions, detect_fiducials

CARRIER_HZ, CARRIER_V = 2000.0, 0.02
REFERENCES_F = (0.47e-9, 2.2e-9)
LOADS = [(c, r) for c in (0.3e-9, 0.5e-9, 1e-9, 2e-9, 5e-9) for r in (5e3, 20e3)]
BLOCKS = 50
FRAME_RATE_HZ = 200.0
TOP_HZ = 20.0
BASELINE_V, SWING_V = 1.0, 0.3
BANDS_HZ = ((0.0, 4.0), (4.0, 8.0), (8.0, 14.0), (14.0, 20.0))

# Amplifier and monitors of the third figure.
CONFIG = TwinConfig.model_validate(
    {
        "amplifier": {
            "bandwidth_hz": 6000.0,
            "gain_error": 0.03,
            "i_monitor_gain_error": 0.12,
            "v_monitor_lag_s": 3e-6,
            "i_monitor_lag_s": 8e-6,
            "v_monitor_offset_v": 2e-3,
            "i_monitor_offset_v": -3e-3,
            "stray_f": 30e-12,
        },
        "acquisition": {"skew_s": 2.5e-6},
    }
)


@dataclass(frozen=True)
class Motion:
    """Self-sensed capacitance and the camera's strain on one clock."""

    time_s: np.ndarray
    capacitance_f: np.ndarray
    strain: np.ndarray
    rate_per_s: np.ndarray
    frequency_hz: np.ndarray


def blocks_of(rig: Rig, count: int) -> np.ndarray:
    """Blocks at 0 V with the carrier on, settled."""
    rig.source.write(0.0)
    rig.generator.sine(CARRIER_HZ, CARRIER_V)
    for _ in range(10):
        rig.acquisition.read()
    codes = np.stack([rig.acquisition.read() for _ in range(count)])
    rig.safe()
    return codes


def calibrate(rig: Rig) -> Calibration:
    d = rig.description
    readings = []
    for capacitance_f in REFERENCES_F:
        rig.fixture.connect(capacitance_f)
        readings.append(
            read_reference(
                blocks_of(rig, 100),
                rate_hz=d.rate_hz,
                carrier_hz=CARRIER_HZ,
                volt_per_reading=d.volt_per_code,
            )
        )
    rig.fixture.connect(None)
    return fit_calibration(
        [Reference(c) for c in REFERENCES_F],
        readings,
        carrier_hz=CARRIER_HZ,
        rate_hz=d.rate_hz,
        amplifier=d.amplifier,
        date="2026-01-01",
    )


def nominal(rig: Rig) -> LockinConfig:
    """As the description alone has it: what is read without a calibration."""
    d = rig.description
    return LockinConfig(
        rate_hz=d.rate_hz,
        block_samples=d.block_samples,
        carrier_hz=CARRIER_HZ,
        skew_s=d.skew_s,
        ohm_per_ratio=d.i_monitor_v_per_a / d.v_monitor_v_per_v,
        blank=(0, d.switch_sample + round(BLANKING_S * d.rate_hz)),
    )


def calibrated(rig: Rig, calibration: Calibration) -> LockinConfig:
    return calibration.apply(
        nominal(rig),
        amplifier=rig.description.amplifier,
        volt_per_reading=rig.description.volt_per_code,
    )


def load_errors(rig: Rig, config: LockinConfig) -> tuple[np.ndarray, np.ndarray]:
    """Relative errors of C and R over the known loads, means of `BLOCKS` blocks."""
    lockin, errors = Lockin(config), []
    for capacitance_f, series_ohm in LOADS:
        rig.fixture.connect(capacitance_f, series_ohm)
        found_f, found_ohm = means(lockin, blocks_of(rig, BLOCKS))
        errors.append([found_f / capacitance_f - 1, found_ohm / series_ohm - 1])
    rig.fixture.connect(None)
    return tuple(np.array(errors).T)


def means(lockin: Lockin, codes: np.ndarray) -> tuple[float, float]:
    """Mean capacitance and series resistance of the blocks that hold: nearly all must."""
    sensed = lockin.sense(codes)
    assert sensed.valid.mean() > 0.9, f"{sensed.valid.mean():.0%} of the blocks hold"
    return (
        float(sensed.capacitance_f[sensed.valid].mean()),
        float(sensed.resistance_ohm[sensed.valid].mean()),
    )


def actuator_errors(bench: TwinBench, rig: Rig, config: LockinConfig) -> tuple[float, float]:
    """The same of the actuator itself, against the twin's own length."""
    bench.wait(20.0)
    found_f, found_ohm = means(Lockin(config), blocks_of(rig, BLOCKS))
    true_f = bench._native.capacitance(bench._native.length_m)
    return found_f / true_f - 1, found_ohm / CONFIG.dielectric.series_ohm - 1


class Watch:
    """The camera, followed as by the runtime's camera recorder: six fiducials on two clamps.

    The first ten frames of all are the reference of all records, for tracking and for strain.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.rig.camera.start(FRAME_RATE_HZ)
        self.rig.stand.wait(0.2)
        frames = rig.camera.take()
        assert frames is not None
        points = detect_fiducials(frames.images[:10].mean(axis=0), 6)
        self.tracker = PointTracker(points, TrackOptions(subset_px=21, search_px=40))
        self.state = self.tracker.init(list(frames.images[:10]))
        self.rest_px = float(np.mean([self._length_px(image) for image in frames.images]))
        self.rig.camera.stop()

    def start(self) -> None:
        self.placed = False
        self.times_s: list[np.ndarray] = []
        self.strains: list[float] = []
        self.rig.camera.start(FRAME_RATE_HZ)

    def look(self) -> None:
        frames = self.rig.camera.take()
        if frames is None:
            return
        if not self.placed:
            self.state = self.tracker.placed(self.state, detect_fiducials(frames.images[0], 6))
            self.placed = True
        self.strains += [self._length_px(image) / self.rest_px - 1 for image in frames.images]
        self.times_s.append(frames.time_s)

    def _length_px(self, image: np.ndarray) -> float:
        self.state, found = self.tracker.step(self.state, image)
        assert found.valid.all()
        return float(found.y_px[3:].mean() - found.y_px[:3].mean())


def sweep(
    watch: Watch, config: LockinConfig, duration_s: float, swing_v: float, *, down: bool
) -> Motion:
    """The drive sweeps over 0 to 20 Hz about its baseline."""
    rig = watch.rig
    d = rig.description
    time_s = np.arange(round(duration_s / d.block_s)) * d.block_s
    rate_hz_s = TOP_HZ / duration_s
    cycles = TOP_HZ * time_s - rate_hz_s * time_s**2 / 2 if down else rate_hz_s * time_s**2 / 2
    drive_v = BASELINE_V + swing_v * np.sin(2 * np.pi * cycles)
    rig.source.write(BASELINE_V)
    rig.stand.wait(20.0)
    rig.generator.sine(CARRIER_HZ, CARRIER_V)
    rig.acquisition.read()
    codes = []
    start_s = rig.acquisition.time_s
    watch.start()
    for k, value in enumerate(drive_v):
        rig.source.write(value)
        codes.append(rig.acquisition.read())
        if k % 20 == 19:
            watch.look()
    rig.safe()
    sensed = Lockin(config).sense(np.stack(codes))
    frames_s = np.concatenate(watch.times_s)
    # C belongs to the middle of the samples that count; the camera is read at that time.
    at_s = start_s + sensed.time_s
    kept = sensed.valid & (at_s < frames_s[-1]) & (at_s > frames_s[0])
    camera = CubicSpline(frames_s, watch.strains)
    sweep_hz = TOP_HZ - rate_hz_s * time_s if down else rate_hz_s * time_s
    return Motion(
        at_s[kept],
        sensed.capacitance_f[kept],
        camera(at_s[kept]),
        camera(at_s[kept], 1),
        sweep_hz[kept],
    )


@dataclass(frozen=True)
class StrainError:
    """Of the validation record: rms over its span, over all and over parts of the sweep.

    `delay_s` is the time by which the sensed strain lags the camera's, with its deviation.
    """

    rms: float
    delay_s: float
    delay_std_s: float
    by_band: list[float]
    span: float
    held: float


def strain_error(fitted: StrainMap, validation: Motion) -> StrainError:
    inside = fitted.inside(validation.capacitance_f)
    deviation = fitted.strain(validation.capacitance_f[inside]) - validation.strain[inside]
    span = float(np.ptp(validation.strain))
    frequency_hz = validation.frequency_hz[inside]

    def rms(where: np.ndarray) -> float:
        return float(np.sqrt(np.mean(deviation[where] ** 2)) / span)

    bands = [rms((frequency_hz >= low) & (frequency_hz < high)) for low, high in BANDS_HZ]
    low, high = fitted.interval(validation.capacitance_f[inside])
    held = np.mean((validation.strain[inside] >= low) & (validation.strain[inside] <= high))
    rate = validation.rate_per_s[inside]
    moved = float(rate @ rate)
    return StrainError(
        rms(np.full(inside.sum(), True)),
        float(-(rate @ deviation) / moved),
        float(np.std(deviation) / np.sqrt(moved)),
        bands,
        span,
        float(held),
    )


def make() -> tuple[TwinBench, Rig]:
    bench = TwinBench(CONFIG, 11)
    return bench, rig_of(bench, CONFIG)


def strain_errors(rig: Rig, config: LockinConfig, duration_s: float) -> dict[str, StrainError]:
    """Line and cubic map, fitted on a sweep up, validated on a smaller sweep down."""
    watch = Watch(rig)
    first = sweep(watch, config, duration_s, SWING_V, down=False)
    other = sweep(watch, config, duration_s, 0.9 * SWING_V, down=True)
    return {
        kind: strain_error(fit_strain_map(first.capacitance_f, first.strain, kind), other)
        for kind in ("line", "cubic")
    }


def rows() -> list[Row]:
    """Figure 3 of self-sensing, for `bench.py`."""
    bench, rig = make()
    raw, config = nominal(rig), calibrated(rig, calibrate(rig))
    raw_c, raw_r = load_errors(rig, raw)
    load_c, load_r = load_errors(rig, config)
    own_c, own_r = actuator_errors(bench, rig, config)
    found = strain_errors(rig, config, 10.0)
    line, curve = found["line"], found["cubic"]
    parts = ", ".join(
        f"{low:g}-{high:g} Hz {100 * part:.2f}"
        for (low, high), part in zip(BANDS_HZ, curve.by_band, strict=True)
    )
    return [
        Row(
            "C after two references, 0.3 to 5 nF, worst",
            100 * max(np.abs(load_c).max(), abs(own_c)),
            "%",
            0.5,
            False,
            f"without {100 * np.abs(raw_c).max():.3g} %",
        ),
        Row(
            "   series resistance, 5 and 20 kohm, worst",
            100 * max(np.abs(load_r).max(), abs(own_r)),
            "%",
            5.0,
            False,
            f"without {100 * np.abs(raw_r).max():.3g} %",
        ),
        Row(
            "strain against camera, 0 to 20 Hz, rms",
            100 * curve.rms,
            "% of span",
            1.0,
            False,
            f"{parts}; line {100 * line.rms:.2f}; band of 95 % held {100 * curve.held:.1f} %; "
            f"delay {1e6 * curve.delay_s:.0f} us",
        ),
    ]


if __name__ == "__main__":
    for row in rows():
        note = "   ".join(part for part in (row.outcome(), row.note) if part)
        print(f"{row.what:44s} {row.value:10.4g} {row.unit:13s} {note}")
