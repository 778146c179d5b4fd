"""`haselab sense` on large recordings: time compared with reading the file, and memory.

`python -m benchmarks.sensing.stream [--size-gb 2] [--folder DIR] [--rounds 3]`

Each recording is made in a temporary folder. The real command runs in its own process, from start
to end with all rows written; then the same file is read by plain sequential reads in
the same state of the page cache. Cold means dropped from it before each of the two. A compressed
recording is compared with h5py reading the same datasets.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import h5py
import numpy as np

from benchmarks.rows import RUNNER, Row
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import make_twin
from haselab.store.session.writer import ExperimentPlan, SessionWriter

RATE_HZ, CARRIER_HZ, BLOCK = 200e3, 2000.0, 2000
LARGE_GB = 1.0  # from which the start-up of a second does not decide
GIB = 1e9
CHUNK = 1 << 22  # bytes of one plain read


@dataclass(frozen=True)
class Recording:
    """A file, how to sense it, how to read it alone, and how many bytes of readings it holds."""

    what: str
    path: Path
    options: list[str]
    read: Callable[[], None]
    readings_bytes: int


def monitors(blocks: int) -> np.ndarray:
    """Volts of both monitors, shape `(samples, 2)`: a series R-C, a slow drive, 0.3 mV noise."""
    omega = 2.0 * np.pi * CARRIER_HZ
    time_s = np.arange(blocks * BLOCK) / RATE_HZ
    z_ohm = 8e3 + 1.0 / (1j * omega * 1.2e-9)
    turn = np.exp(1j * omega * time_s)
    drive = 0.5 + 0.4 * np.sin(2.0 * np.pi * 0.8 * time_s)
    record = np.stack([0.05 * turn, 0.05 * 2.5e6 / z_ohm * turn], axis=1).real
    record[:, 0] += drive
    return record + 0.3e-3 * np.random.default_rng(1).standard_normal(record.shape)


def parts(volts: np.ndarray, total: int) -> Iterator[np.ndarray]:
    """The same seconds again and again, until so many samples are made."""
    while total > 0:
        yield volts[:total]
        total -= len(volts)


def plain_read(path: Path) -> None:
    buffer = bytearray(CHUNK)
    with path.open("rb", buffering=0) as file:
        while file.readinto(buffer):
            pass


def make_npy(folder: Path, volts: np.ndarray, size: int) -> Recording:
    samples, path = size // (2 * volts.itemsize), folder / "recording.npy"
    samples -= samples % BLOCK
    array = np.lib.format.open_memmap(path, "w+", volts.dtype, (samples, 2))
    place = 0
    for part in parts(volts, samples):
        array[place : place + len(part)] = part
        place += len(part)
    array.flush()
    del array
    return Recording(f".npy, {volts.dtype}", path, [], lambda: plain_read(path), size)


def make_npz(folder: Path, volts: np.ndarray, size: int) -> Recording:
    import zipfile

    samples, path = size // (2 * volts.itemsize), folder / "recording.npz"
    samples -= samples % BLOCK
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for k, name in enumerate(("v_monitor_v", "i_monitor_v")):
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                header = {"descr": volts.dtype.str, "fortran_order": False, "shape": (samples,)}
                np.lib.format.write_array_header_1_0(file, header)
                for part in parts(volts, samples):
                    file.write(np.ascontiguousarray(part[:, k]).data)
    return Recording(f".npz, {volts.dtype}", path, [], lambda: plain_read(path), size)


def make_hdf5(folder: Path, volts: np.ndarray, size: int) -> Recording:
    samples, path = size // (2 * volts.itemsize), folder / "recording.h5"
    samples -= samples % BLOCK
    with h5py.File(path, "w") as file:
        for k, name in enumerate(("v_monitor_v", "i_monitor_v")):
            data = file.create_dataset(name, (samples,), volts.dtype)
            place = 0
            for part in parts(volts, samples):
                data[place : place + len(part)] = part[:, k]
                place += len(part)
    return Recording(f"HDF5, {volts.dtype}", path, [], lambda: plain_read(path), size)


def make_session(folder: Path, volts: np.ndarray, size: int) -> Recording:
    """A session of the twin's rig: int16 codes, compressed by blocks."""
    rig, path = make_twin(TwinConfig(), 1).description, folder / "session.h5"
    codes = np.round(volts / rig.volt_per_code).astype(np.int16).reshape(-1, BLOCK, 2)
    blocks = size // codes[0].nbytes
    header = {
        "rig": asdict(rig) | {"skew_s": 0.0},
        "study": {"sensing": {"carrier_hz": CARRIER_HZ}},
    }
    with SessionWriter(path, [ExperimentPlan("long", "play", 1, {})], BLOCK, header) as session:
        for k in range(blocks):
            session.append_block("long", codes[k % len(codes)], k * BLOCK / RATE_HZ, 0.0, np.nan)

    def read() -> None:
        with h5py.File(path, "r") as file:
            data = file["experiments/long/codes"]
            for k in range(0, len(data), 260):
                data[k : k + 260]

    return Recording("compressed session", path, ["--experiment", "long"], read, size)


def forget(path: Path) -> None:
    """Drop a file from the page cache."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)


def sense(recording: Recording, out: Path) -> dict[str, float]:
    """The real command, as a user types it: seconds, peak memory in MB."""
    out.unlink(missing_ok=True)  # an existing result is refused
    haselab = Path(sys.executable).with_name("haselab")
    command = [str(haselab), "sense", str(recording.path), "--out", str(out), *recording.options]
    if "--experiment" not in recording.options:
        command += ["--carrier-hz", str(CARRIER_HZ), "--rate-hz", str(RATE_HZ)]
    done = subprocess.run(
        [sys.executable, "-c", RUNNER, *command], check=True, capture_output=True, text=True
    )
    result = json.loads(done.stdout)
    if result["code"]:
        raise RuntimeError(f"{recording.what}: exit code {result['code']}: {done.stderr}")
    return result


def timed(recording: Recording, out: Path, cold: bool, rounds: int) -> tuple[float, float, float]:
    """Median seconds of sensing and of reading, in turns, and the largest memory in MB."""
    sensed, read, peaks = [], [], []
    for _ in range(rounds):
        if cold:
            forget(recording.path)
        result = sense(recording, out)
        sensed.append(result["s"])
        peaks.append(result["peak_mb"])
        if cold:
            forget(recording.path)
        start = time.perf_counter()
        recording.read()
        read.append(time.perf_counter() - start)
    return statistics.median(sensed), statistics.median(read), max(peaks)


@contextmanager
def made(
    make: Callable[[Path, np.ndarray, int], Recording], parent: Path | None, dtype: str, size: int
) -> Iterator[Recording]:
    """A recording in a folder that is deleted afterwards."""
    volts = monitors(500).astype(dtype)
    with tempfile.TemporaryDirectory(dir=parent) as folder:
        yield make(Path(folder), volts, size)


def check(recording: Recording, out: Path) -> str:
    """Every block has its row, and the median is the capacitance that was put in."""
    with out.open(encoding="utf-8") as file:
        file.readline()
        values = [float(line.split(",", 2)[1]) for line in file]
    blocks = recording.readings_bytes // out_bytes(recording)
    error = np.nanmedian(values) / 1.2e-9 - 1.0
    if len(values) != blocks or not abs(error) < 1e-3:
        raise RuntimeError(f"{recording.what}: {len(values)} rows of {blocks}, off by {error:.1e}")
    return f"{len(values)} blocks"


def out_bytes(recording: Recording) -> int:
    """Bytes of one block."""
    width = {"float64": 8, "float32": 4}.get(recording.what.rpartition(" ")[2], 2)
    return 2 * BLOCK * width


def figures(size_gb: float, parent: Path | None, rounds: int) -> Iterator[Row]:
    """All figures, one after the other."""
    size = int(size_gb * GIB)
    large = size_gb >= LARGE_GB
    cases: list[tuple[Callable[[Path, np.ndarray, int], Recording], str]] = [
        (make_npy, "f8"), (make_npy, "f4"), (make_npz, "f8"), (make_hdf5, "f8"),
    ]  # fmt: skip
    for make, dtype in cases:
        with made(make, parent, dtype, size) as recording:
            for cold in (True, False):
                state = "cold" if cold else "warm"
                yield from measured(
                    recording, cold, rounds, (2.0 if large else None, "x reading", state)
                )
    with made(make_session, parent, "f8", size) as recording:
        yield from measured(
            recording, False, rounds, (1.1 if large else None, "x decompressing", "warm")
        )


def measured(
    recording: Recording, cold: bool, rounds: int, goal: tuple[float | None, str, str]
) -> Iterator[Row]:
    most, unit, state = goal
    out = recording.path.with_suffix(".csv")
    spent_s, read_s, peak_mb = timed(recording, out, cold, rounds)
    note = f"{spent_s:.2f} s, alone {read_s:.2f} s; {check(recording, out)}"
    what = f"sense {recording.what}, {state}"
    yield Row(what, spent_s / read_s, unit, most, False, note)
    yield Row("   its memory", peak_mb, "MB", 300.0, False)


def rows(size_gb: float = 2.0, parent: Path | None = None, rounds: int = 3) -> list[Row]:
    """All figures."""
    return list(figures(size_gb, parent, rounds))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--size-gb", type=float, default=2.0)
    parser.add_argument("--folder", type=Path, help="where the recordings are made for a while")
    parser.add_argument("--rounds", type=int, default=3)
    arguments = parser.parse_args()
    for row in figures(arguments.size_gb, arguments.folder, arguments.rounds):
        print(row, flush=True)


if __name__ == "__main__":
    main()
