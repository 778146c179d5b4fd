"""Small valid files of every kind that haselab reads, made by haselab and its libraries."""

from __future__ import annotations

import io
import json
import struct
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path

import av
import h5py
import numpy as np
import scipy.io
import tifffile
from nptdms import ChannelObject, RootObject, TdmsWriter
from numpy.typing import NDArray

from haselab.pipelines.calibration_file import save_calibration
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import make_twin
from haselab.sensing.calibration import Reference, ReferenceReading, fit_calibration
from haselab.store.manifest import Manifest
from haselab.store.session.writer import ExperimentPlan, SessionWriter
from haselab.study import definition
from haselab.study.run import RunOptions, session_header

__all__ = ["seed_files"]

RATE_HZ, CARRIER_HZ = 2e4, 2e3
MODEL = {
    "plant": {
        "gain": 0.05,
        "natural_frequency_rad_s": {
            "value": 30.0, "std": 0.1, "ci95": [29.8, 30.2], "unit": "rad/s",
        },
        "damping_ratio": 0.2,
        "delay_s": 0.005,
        "slow_modes": [{"gain": 0.01, "time_constant_s": 2.0}],
    },
    "rate_hz": 100.0,
    "loop_delay_s": 0.01,
}  # fmt: skip
RATIONAL = {
    "numerator": [1.0],
    "denominator": [1.0, 0.4, 30.0],
    "delay_s": 0.01,
    "input": "u",
    "output": "y",
}
SPEC = """phase_margin_deg = 45.0
gain_margin_db = 6.0
frequency_spread = 0.1
"""
STEPS = """name = "steps"
[step_trials]
step = 0.02
zero_s = 2.0
step_s = 2.0
rest_s = 1.0
frame_rate_hz = 100.0
trials = 1
"""
TWIN = """name = "other twin"
[shell]
shear_modulus_pa = 15.6e3
locking_stretch = 3.92
length_m = 0.064
width_m = 0.0506
thickness_m = 1.2e-3
lateral_stretch = 3.0
[viscosity]
share = [0.02, 0.5]
relaxation_s = [0.1, 3.2]
damping_n_s_per_m = 1.85
[load]
mass_kg = 0.25
[dielectric]
permittivity = 3.0
series_ohm = 5e3
leakage_ohm = 2e10
breakdown_v_per_m = 40e6
[amplifier]
gain = 5000.0
bandwidth_hz = 6000.0
damping_ratio = 0.6
slew_v_per_s = 350e6
current_limit_a = 12e-3
volt_per_monitor_volt = 5000.0
ampere_per_monitor_volt = 2e-3
[acquisition]
rate_hz = 200e3
block_samples = 2000
bits = 16
range_v = 10.0
skew_s = 2.5e-6
output_delay_s = 2e-3
drive_low_v = 0.0
drive_high_v = 2.0
"""
BENCH = """kind = "bench"
name = "bench"
scale_m_per_px = 1e-4
[daq]
device = "Dev1"
server = "127.0.0.1:9"
serial_number = "01A2B3C4"
rate_hz = 200e3
block_samples = 2000
bits = 16
range_v = 10.0
output_delay_s = 2e-3
ahead_blocks = 1
drive_low_v = 0.0
drive_high_v = 2.0
[amplifier]
name = "an amplifier"
gain = 5000.0
volt_per_monitor_volt = 5000.0
ampere_per_monitor_volt = 2e-3
[generator]
address = "TCPIP::127.0.0.1::9::SOCKET"
highest_v = 1.0
[supply]
port = "/dev/nowhere"
highest_v = 5000.0
[specimen]
shell_width_m = 0.05
shell_thickness_m = 1e-3
lateral_stretch = 3.0
mass_kg = 0.25
[camera]
kind = "folder"
path = "frames"
[rating]
current_limit_a = 12e-3
slew_v_per_s = 350e6
bandwidth_hz = 6000.0
capacitance_f = 1e-9
thickness_m = 1e-3
breakdown_v_per_m = 40e6
stretch = 1.5
stretch_high = 3.0
"""


def _csv(columns: dict[str, NDArray[np.float64]], head: str = "") -> bytes:
    rows = zip(*(values.tolist() for values in columns.values()), strict=True)
    lines = [",".join(columns), *(",".join(f"{x:.6g}" for x in row) for row in rows)]
    return (head + "\n".join(lines) + "\n").encode()


def _written(name: str, write: Callable[[Path], object]) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        write(path)
        return path.read_bytes()


def _monitors() -> dict[str, NDArray[np.float64]]:
    phase = 2.0 * np.pi * CARRIER_HZ / RATE_HZ * np.arange(400)
    return {"v_monitor_v": np.sin(phase), "i_monitor_v": 0.3 * np.cos(phase)}


def _record() -> dict[str, NDArray[np.float64]]:
    """A sampled second-order system and its input."""
    rng = np.random.default_rng(1)
    u = np.repeat(rng.choice([-1.0, 1.0], 25), 8)
    y = np.zeros(200)
    for k in range(2, 200):
        y[k] = 1.5 * y[k - 1] - 0.7 * y[k - 2] + 0.1 * u[k - 1]
    return {"u": u, "y": y + 1e-3 * rng.standard_normal(200)}


def _write_h5(path: Path, columns: dict[str, NDArray[np.float64]], user_block: int = 0) -> None:
    with h5py.File(path, "w", userblock_size=user_block) as file:
        file.attrs["rate_hz"] = RATE_HZ
        for name, values in columns.items():
            if user_block:
                file[name] = values[None, :]
                file[name].attrs["MATLAB_class"] = np.bytes_("double")
            else:
                file.create_dataset(name, data=values, chunks=(100,), compression="gzip")


def _column_files(prefix: str, columns: dict[str, NDArray[np.float64]]) -> dict[str, bytes]:
    npz, npy = io.BytesIO(), io.BytesIO()
    np.savez(npz, rate_hz=RATE_HZ, **columns)
    np.save(npy, np.stack(list(columns.values()), axis=1))

    def tdms(path: Path) -> None:
        with TdmsWriter(str(path)) as writer:
            channels = [
                ChannelObject("g", name, values, properties={"wf_increment": 1.0 / RATE_HZ})
                for name, values in columns.items()
            ]
            writer.write_segment([RootObject(), *channels])

    mat = {name: values[:, None] for name, values in columns.items()}
    h73 = _written("a.mat", lambda path: _write_h5(path, columns, 512))
    return {
        f"{prefix}.csv": _csv(columns, f"# rate_hz = {RATE_HZ}\n"),
        f"{prefix}.npz": npz.getvalue(),
        f"{prefix}.npy": npy.getvalue(),
        f"{prefix}.tdms": _written("a.tdms", tdms),
        f"{prefix}.h5": _written("a.h5", lambda path: _write_h5(path, columns)),
        f"{prefix}.mat": _written("a.mat", lambda path: scipy.io.savemat(path, mat)),
        f"{prefix}73.mat": b"MATLAB 7.3 MAT-file".ljust(512) + h73[512:],
    }


def _images() -> NDArray[np.uint8]:
    """Three frames of six dots that move by a quarter of a pixel."""
    y, x = np.mgrid[:64, :64]
    frames = np.full((3, 64, 64), 160.0)
    for k in range(3):
        for cx in (16.0, 32.0, 48.0):
            for cy in (18.0, 46.0):
                frames[k] -= 90.0 * np.exp(-((x - cx) ** 2 + (y - cy - 0.25 * k) ** 2) / 18.0)
    noise = np.random.default_rng(2).normal(0.0, 1.0, frames.shape)
    return np.rint(frames + noise).astype(np.uint8)


def _container(name: str, codec: str, pixels: str, count: int = 3) -> bytes:
    def write(path: Path) -> None:
        with av.open(str(path), "w") as container:
            stream = container.add_stream(codec, rate=100)
            stream.width, stream.height, stream.pix_fmt = 64, 64, pixels
            for image in _images()[:count]:
                frame = av.VideoFrame.from_ndarray(image, format="gray")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())

    return _written(name, write)


def _cine(images: NDArray[np.uint8]) -> bytes:
    """As tests/store/video/test_video.py writes it, without time stamps."""
    count, height, width = images.shape
    setup, start = 44 + 40, 44 + 40 + 1024
    offsets = [start + 8 * count + k * (8 + height * width) for k in range(count)]
    head = struct.pack(
        "<2sHHHiIiIIII8x", b"CI", 44, 0, 1, 0, count, 0, count, 44, setup, start
    )  # fmt: skip
    bitmap = struct.pack("<IiiHHIIiiII", 40, width, height, 1, 8, 0, height * width, 0, 0, 0, 0)
    block = bytearray(1024)
    struct.pack_into("<H", block, 142, 1024)
    struct.pack_into("<I", block, 768, 100)
    struct.pack_into("<I", block, 896, 8)
    frames = b"".join(struct.pack("<II", 8, height * width) + i.tobytes() for i in images)
    return (
        head.ljust(44, b"\0") + bitmap + bytes(block) + struct.pack(f"<{count}q", *offsets) + frames
    )


def _videos() -> dict[str, bytes]:
    images = _images()
    cih = (
        "Record Rate(fps) : 100\nTotal Frame : 3\nImage Width : 64\nImage Height : 64\n"
        "Color Bit : 8\nEffectiveBit Depth : 8\nFile Format : MRaw\n"
    )
    cihx = (
        "<cih><frameInfo><totalFrame>3</totalFrame></frameInfo><imageDataInfo><resolution>"
        "<width>64</width><height>64</height></resolution><colorInfo><bit>8</bit></colorInfo>"
        "<effectiveBit><depth>8</depth></effectiveBit></imageDataInfo><recordInfo><recordRate>100"
        "</recordRate></recordInfo><imageFileInfo><fileFormat>MRaw</fileFormat></imageFileInfo></cih>"
    )

    def tiff(name: str, **settings: object) -> bytes:
        return _written(
            name, lambda path: tifffile.imwrite(path, images, photometric="minisblack", **settings)
        )

    return {
        "plain.tif": tiff("a.tif"),
        "packed.tif": tiff("a.tif", compression="zlib", metadata=None),
        "clip.avi": _container("a.avi", "ffv1", "gray"),
        "clip.mkv": _container("a.mkv", "ffv1", "gray"),
        "clip.mp4": _container("a.mp4", "mpeg4", "yuv420p"),
        "frames/a.png": _container("a.png", "png", "gray", 1),
        "frames/b.pgm": b"P5\n64 64\n255\n" + images[1].tobytes(),
        "clip.cine": _cine(images),
        "clip.mraw": images.tobytes(),
        "clip.cih": cih.encode(),
        "other.mraw": images.tobytes(),
        "other.cihx": cihx.encode(),
    }


def _calibration() -> bytes:
    references = [Reference(1e-9), Reference(2e-9), Reference(4e-9)]
    readings = [
        ReferenceReading(complex(1e-3, k * 0.2), 1e-6, (1e-3, 1e-3)) for k in (1.0, 2.0, 4.0)
    ]
    found = fit_calibration(
        references, readings, carrier_hz=CARRIER_HZ, rate_hz=RATE_HZ, amplifier="a",
        date="2024-01-01",
    )  # fmt: skip
    return _written("c.toml", lambda path: save_calibration(found, path))


def _session() -> dict[str, bytes]:
    """A recording of four blocks on the twin, and its manifest."""
    rig = make_twin(TwinConfig(), 5)
    study = definition.builtin_study(quick=True)
    plans = [ExperimentPlan("chirp", "chirp", 1, {"gain": 0.5})]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        header = session_header(study, rig.description, RunOptions(folder, 5, "none", {}))
        with (
            Manifest(folder, header),
            SessionWriter(
                folder / "session.h5", plans, rig.description.block_samples, header
            ) as session,
        ):
            rig.generator.sine(study.sensing.carrier_hz, study.sensing.carrier_v)
            for _ in range(4):
                rig.source.write(1.0)
                time_s, codes = rig.acquisition.time_s, rig.acquisition.read()
                session.append_block("chirp", codes, time_s, 1.0, float("nan"))
        return {f"session/{path.name}": path.read_bytes() for path in folder.iterdir()}


def _tables() -> dict[str, bytes]:
    stretch = np.linspace(1.0, 2.5, 24)
    strain = np.linspace(-0.02, 0.05, 30)
    farad = np.linspace(1.0, 1.3, 30)
    time_s = np.arange(200) / 100.0
    ringing = 0.1 * np.exp(-time_s) * np.cos(12.0 * time_s)
    creep = 0.1 * (1.0 - 0.3 * np.exp(-time_s))
    return {
        "sheet.csv": _csv({"stretch": stretch, "nominal_stress_pa": 2e4 * (stretch - stretch**-2)}),
        "load.csv": _csv({"stretch": stretch, "load_n": np.where(stretch < 1.7, stretch, 1.7)}),
        "voltage.csv": _csv({"strain": strain, "voltage_v": 1.0 + 8.0 * strain}),
        "farad.csv": _csv({"relative_capacitance": farad, "strain": 0.2 * (farad - 1.0)}),
        "free.csv": _csv({"time_s": time_s, "y": ringing}),
        "creep.csv": _csv({"time_s": time_s, "u": np.ones(200), "y": creep}),
        "points.csv": b"point,x_px,y_px\nupper,32,18\nlower,32,46\n",
        "times.csv": b"frame,time_s\n0,0.0\n1,0.01\n2,0.02\n",
    }


ACTUATOR = b"""\
[actuator]
name = "leg"
[actuator.geometry]
zero_length_m = 0.05
[sensing.strain_map]
slope_per_f = 4.9e8
offset = -0.27
covariance = [[1e14, 1e3, 0, 0], [1e3, 1e-6, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]
range_f = [4e-10, 9e-10]
band = [-0.001, 0.001]
[drive]
high_v = 1.8
[drive.voltage_map]
a1_v = 1.324
b1 = 3.124
a2_v = -0.2805
b2 = -26.92
[model]
gain = 0.8  # typed
natural_frequency_rad_s = 28.0
damping_ratio = 0.15
slow_modes = [{gain = 0.3, time_constant_s = 5.0}]
[controller]
kind = "pid"
parameters = {kp = 0.1, ki = 5.0, kd = 0.01, derivative_filter_s = 0.01}
limits = {low = -0.04, high = 0.08}
[controller.demands]
phase_margin_deg = 40.0
[provenance.model]
sha256 = ["00"]
"""


@cache
def seed_files() -> dict[str, bytes]:
    """Content of each seed by its name."""
    plain = {name: item["value"] if isinstance(item, dict) else item
             for name, item in MODEL["plant"].items()}  # fmt: skip
    struct_of = {"model": {"num": [[1.0]], "den": [[1.0, 0.4, 30.0]], "delay": 0.01}}
    studies = Path(definition.__file__).parent / "studies"
    run_model = {
        **MODEL,
        "plant": plain,
        "voltage_map": {"a1_v": 1.0, "b1": 5.0, "a2_v": 0.0, "b2": -20.0},
        "strain_map": {"slope_per_f": 1e8, "offset": -0.1, "curvature_per_f2": 0.0},
        "zero_strain_length_m": 0.06,
    }
    controller = "".join(
        f"[{name}]\nkp = 0.5\nki = 10.0\nkd = {kd}\nderivative_filter_s = 0.01\n"
        for name, kd in (("pi", 0.0), ("pid", 0.01))
    )
    controller += "[saturation]\nlow = -0.05\nhigh = 0.1\n[loop]\nrate_hz = 100.0\n"
    results = {
        "quantities": [{"id": "S18.a", "value": 1.0}],
        "provenance": {"study": {}, "rig_config": {}},
    }
    return {
        "model.json": json.dumps(MODEL, indent=1).encode(),
        "rational.json": json.dumps(RATIONAL, indent=1).encode(),
        "estimate.json": json.dumps(MODEL["plant"]).encode(),
        "model.mat": _written("m.mat", lambda path: scipy.io.savemat(path, struct_of)),
        "spec.toml": SPEC.encode(),
        "study.toml": (studies / "hasel-iros2018.toml").read_bytes(),
        "steps.toml": STEPS.encode(),
        "twin.toml": TWIN.encode(),
        "rig.toml": b'kind = "twin"\ntwin = "twin.toml"\nseed = 1\n',
        "bench.toml": BENCH.encode(),
        "chip.toml": b'kind = "chip"\nrun = "."\n[simulator]\nreading = "hz"\nseed = 1\n',
        "run/model.json": json.dumps(run_model, indent=1).encode(),
        "run/controller.toml": controller.encode(),
        "run/results.json": json.dumps(results).encode(),
        "run/analysis.json": b'{"reading": {"rad": 1.0}, "d_rows": []}',
        "actuator.toml": ACTUATOR,
        "calibration.toml": _calibration(),
        **_column_files("monitors", _monitors()),
        **_column_files("record", _record()),
        **_session(),
        **_videos(),
        **_tables(),
    }  # fmt: skip
