"""`haselab track` on long clips: speed compared with plain reading or decoding, and memory.

`python -m benchmarks.tracking.stream [--frames 2000] [--folder DIR] [--kinds tiff avi ...]`

The clips (1024 x 1024 px, 8 bit, 300 dots that move) are made in a temporary folder. The real
command runs in its own process, from start to end with all rows written; then the same
file is read by haselab's own reader (alone, in one thread) and, for FFmpeg's formats, decoded
by PyAV on all cores, in the same state of the page cache. Frames per second are those
without the start-up and the choice of the tracker, which a clip of 30 frames shows.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import tifffile

from benchmarks.rows import RUNNER, Row
from haselab.store.video.opening import open_video

SIDE, POINTS, RATE_HZ = 1024, 300, 400
DRAWN = 40  # frames drawn; the clip goes through them there and back
SHORT, FEWEST = 30, 60  # the tracker is chosen on the first 24 frames


def scene() -> tuple[np.ndarray, np.ndarray]:
    """Frames of a sheet that stretches by 2 %, and its dots at rest."""
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid(np.linspace(80, 940, 15), np.linspace(80, 920, 20)), axis=-1)
    dots = grid.reshape(-1, 2) + rng.uniform(-8, 8, (POINTS, 2))
    y, x = np.mgrid[-9:10, -9:10]
    frames = np.empty((DRAWN, SIDE, SIDE), np.uint8)
    for k in range(DRAWN):
        image = np.full((SIDE, SIDE), 160.0)
        for cx, cy in dots * [1.0, 1.0 + 0.02 * k / DRAWN]:
            ix, iy = round(cx), round(cy)
            blob = 90 * np.exp(-((x - cx + ix) ** 2 + (y - cy + iy) ** 2) / 8.0)
            image[iy - 9 : iy + 10, ix - 9 : ix + 10] -= blob
        image += 2.0 * rng.standard_normal(image.shape, dtype=np.float32)
        frames[k] = np.clip(np.rint(image), 0, 255)
    return frames, dots


def played(frames: np.ndarray, count: int) -> Iterator[np.ndarray]:
    """There and back, until so many frames are shown."""
    turn = 2 * (len(frames) - 1)
    for k in range(count):
        place = k % turn
        yield frames[place if place < len(frames) else turn - place]


def make_tiff(path: Path, frames: np.ndarray, count: int) -> Path:
    path = path.with_suffix(".tif")
    with tifffile.TiffWriter(path, bigtiff=True) as file:
        for frame in played(frames, count):
            file.write(frame, photometric="minisblack", contiguous=True)
    return path


def make_mraw(path: Path, frames: np.ndarray, count: int) -> Path:
    header = {
        "Record Rate(fps)": RATE_HZ, "Total Frame": count, "Image Width": SIDE,
        "Image Height": SIDE, "Color Bit": 8, "EffectiveBit Depth": 8, "File Format": "MRaw",
    }  # fmt: skip
    path.with_suffix(".cih").write_text("".join(f"{k} : {v}\n" for k, v in header.items()))
    with path.with_suffix(".mraw").open("wb") as file:
        for frame in played(frames, count):
            file.write(frame.data)
    return path.with_suffix(".mraw")


def make_folder(path: Path, frames: np.ndarray, count: int) -> Path:
    path.mkdir()
    head = f"P5\n{SIDE} {SIDE}\n255\n".encode()
    for k, frame in enumerate(played(frames, count)):
        (path / f"{k:06d}.pgm").write_bytes(head + frame.tobytes())
    return path


def encoded(suffix: str, codec: str, **options: str) -> Callable[[Path, np.ndarray, int], Path]:
    def make(path: Path, frames: np.ndarray, count: int) -> Path:
        path = path.with_suffix(suffix)
        with av.open(str(path), "w") as container:
            stream = container.add_stream(codec, rate=Fraction(RATE_HZ))
            stream.width = stream.height = SIDE
            stream.pix_fmt, stream.options = "gray", options
            for frame in played(frames, count):
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="gray")))
            container.mux(stream.encode())
        return path

    return make


@dataclass(frozen=True)
class Kind:
    """One format: how to make it, what part of the frames, whether it is compressed."""

    what: str
    make: Callable[[Path, np.ndarray, int], Path]
    share: float = 1.0
    compressed: bool = False


KINDS = {
    "tiff": Kind("TIFF stack", make_tiff),
    "avi": Kind("uncompressed AVI", encoded(".avi", "rawvideo")),
    "mraw": Kind(".mraw, 8 bit", make_mraw),
    "folder": Kind("folder of PGM", make_folder),
    "ffv1": Kind("FFV1", encoded(".mkv", "ffv1", level="3", slices="4"), 0.15, True),
}  # fmt: skip


def decode(path: Path) -> None:
    with av.open(str(path)) as container:
        container.streams.video[0].thread_type = "AUTO"
        for _ in container.decode(video=0):
            pass


def read(path: Path) -> None:
    with open_video(path) as video:
        for _ in video:
            pass


def seconds(job: Callable[[Path], None], path: Path) -> float:
    start = time.perf_counter()
    job(path)
    return time.perf_counter() - start


def track(path: Path, points: Path, out: Path) -> dict[str, float]:
    """The real command, as a user types it: seconds, peak memory in MB."""
    out.unlink(missing_ok=True)  # an existing result is refused
    haselab = Path(sys.executable).with_name("haselab")
    command = [haselab, "track", path, "--points", points, "--rest-frames", "1", "--out", out]
    done = subprocess.run(
        [sys.executable, "-c", RUNNER, *map(str, command)],
        check=True, capture_output=True, text=True,
    )  # fmt: skip
    result = json.loads(done.stdout)
    if result["code"]:
        raise RuntimeError(f"{path.name}: exit code {result['code']}: {done.stderr}")
    return result


def check(out: Path, frames: int) -> str:
    """Every point of every frame has its row, and nothing was lost."""
    with out.open("rb") as file:
        rows = sum(chunk.count(b"\n") for chunk in iter(lambda: file.read(1 << 22), b"")) - 1
    if rows != frames * POINTS:
        raise RuntimeError(f"{rows} rows of {frames * POINTS}")
    return f"{rows} rows"


def figures(
    frames: int = 2000,
    parent: Path | None = None,
    kinds: Sequence[str] | None = None,
    rounds: int = 2,
) -> Iterator[Row]:
    """All figures, one after the other."""
    drawn, dots = scene()
    with tempfile.TemporaryDirectory(dir=parent) as name:
        folder = Path(name)
        points, out = folder / "points.csv", folder / "tracks.csv"
        lines = [f"p{k},{x:.4f},{y:.4f}" for k, (x, y) in enumerate(dots)]
        points.write_text("\n".join(["point,x_px,y_px", *lines]) + "\n")
        short = make_tiff(folder / "short", drawn, SHORT)
        start_s = min(track(short, points, out)["s"] for _ in range(2))
        yield Row(f"start-up and {SHORT} frames", start_s, "s")
        for kind in kinds or list(KINDS):
            yield from measured(KINDS[kind], folder, drawn, frames, (points, out, start_s, rounds))


def measured(
    kind: Kind, folder: Path, drawn: np.ndarray, frames: int, how: tuple[Path, Path, float, int]
) -> Iterator[Row]:
    points, out, start_s, rounds = how
    count = max(int(kind.share * frames), FEWEST)
    path = kind.make(folder / "clip", drawn, count)
    alone = decode if kind.compressed else read
    results, alone_s = [], []
    for _ in range(rounds):  # in turns, so that another program slows down both
        results.append(track(path, points, out))
        alone_s.append(seconds(alone, path))
    spent_s = min(one["s"] for one in results)
    steady = (count - SHORT) / max(spent_s - start_s, 1e-9)
    fps, plain = count / spent_s, count / min(alone_s)
    word = "decoding" if kind.compressed else "reading"
    cpu_ms = 1e3 * min(one["cpu_s"] for one in results) / count
    note = f"{word} alone {plain:.0f}; with start-up {fps:.0f}; {cpu_ms:.2f} ms of CPU a frame"
    note += f"; {check(out, count)}"
    goal = None if kind.compressed else 1000.0
    yield Row(f"track {kind.what}, {POINTS} points", steady, "frames / s", goal, True, note)
    if kind.compressed:
        share = plain / steady
        yield Row("   over decoding on all cores", share, "x", 1.1, False)
    yield Row("   its memory", max(one["peak_mb"] for one in results), "MB", 400.0, False)
    for file in path.iterdir() if path.is_dir() else [path]:
        file.unlink()
    if path.is_dir():
        path.rmdir()


def rows(frames: int = 2000, kinds: Sequence[str] = tuple(KINDS), rounds: int = 2) -> list[Row]:
    """All figures."""
    return list(figures(frames, None, kinds, rounds))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--frames", type=int, default=2000)
    parser.add_argument("--folder", type=Path, help="where the clips are made for a while")
    parser.add_argument("--kinds", nargs="*", choices=list(KINDS))
    parser.add_argument("--rounds", type=int, default=2)
    arguments = parser.parse_args()
    for row in figures(arguments.frames, arguments.folder, arguments.kinds, arguments.rounds):
        print(row, flush=True)


if __name__ == "__main__":
    main()
