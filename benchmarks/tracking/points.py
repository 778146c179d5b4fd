"""Point tracking on clips with exact truth, compared with other libraries.

python -m benchmarks.tracking.points

    --quick      fewer frames and one round
    --cache DIR  keep rendered clips there
    --only NAME  points, bias, field or stress, one or more
    --seeds N    stress clips of so many seeds

All times are CPU seconds of one thread; haselab and the others take turns. Trust the ratios.
Libraries that are not installed are listed: `pip install '.[bench,comparison]'` brings them.
"""

from __future__ import annotations

import argparse
import functools
import os
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

if "numba" not in sys.modules:  # it refuses a change of its threads while they run
    os.environ.update(OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", NUMBA_NUM_THREADS="1")

import numpy as np
from numpy.typing import NDArray

from benchmarks.rows import Row
from benchmarks.tracking.clips import DOTS, Clip, Floats, bound_px, lone_dots, make_clip, stressed
from benchmarks.tracking.libraries import LIBRARIES, Library
from haselab import _track
from haselab.tracking import PointTracker, TrackOptions

REST = 10
BOUND_FRAMES = [0, 60, 110, 160, 210, 240, 300, 390]
WRONG_PX = 0.3


@dataclass(frozen=True)
class Run:
    """One method on one clip: CPU seconds, positions `(F, P, 2)`, NaN where it reports lost."""

    seconds: float
    found: Floats
    std: Floats | None = None


@contextmanager
def instruction_set(name: str) -> Iterator[None]:
    """The tracker with the kernels of that name; the machine's fastest where there is none."""
    step = _track.step
    if name:
        _track.step = functools.partial(step, kernels=name)
    try:
        yield
    finally:
        _track.step = step


def ours(
    options: TrackOptions, rest: int = REST, kernels: str = ""
) -> Callable[[NDArray[np.uint8], Floats], Run]:
    def run(frames: NDArray[np.uint8], points: Floats) -> Run:
        tracker = PointTracker(points, options)
        state = tracker.init(list(frames[:rest]))
        found, std = np.empty((2, len(frames), len(points), 2))
        with instruction_set(kernels):
            start = time.process_time()
            for k, frame in enumerate(frames):
                state, here = tracker.step(state, frame)
                found[k, :, 0], found[k, :, 1] = here.x_px, here.y_px
                std[k, :, 0], std[k, :, 1] = here.std_x_px, here.std_y_px
        return Run(time.process_time() - start, found, std)

    return run


def rms(values: Floats) -> float:
    return float(np.sqrt(np.nanmean(np.square(values))))


def load(clip: Clip, name: str, cache: Path | None) -> NDArray[np.uint8]:
    """The clip's frames, rendered or from the cache."""
    path = None if cache is None else cache / f"{name}.npy"
    if path is not None and path.is_file():
        kept: NDArray[np.uint8] = np.load(path)
        if len(kept) == clip.motion.frames:
            return kept
    print(f"rendering {name} ...", flush=True)
    frames = clip.frames()
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, frames)
    return frames


def lost(error: Floats) -> int:
    """Points that are not within 1 px of the truth in the last frame."""
    away = np.abs(error[-1]).max(axis=1)
    return int(np.sum(~(away < 1.0)))


def points_table(quick: bool, cache: Path | None) -> None:
    for side in (512, 1024):
        for speckle in (False, True):
            name = f"{'speckle' if speckle else 'dots'}-{side}"
            clip = make_clip(side, speckle=speckle)
            frames = load(clip, name, cache)
            if quick:
                frames = frames[:120]
            known = np.array([clip.truth(clip.points_px, k) for k in range(len(frames))])
            kept = [k for k in BOUND_FRAMES if k < len(frames)]
            compare_points(clip, name, frames, known, kept, 1 if quick else 5)


def compare_points(
    clip: Clip, name: str, frames: NDArray[np.uint8], known: Floats, kept: list[int], rounds: int
) -> None:
    points = clip.points_px
    subset = TrackOptions().subset_px
    if len(clip.rest_px) > len(points):
        scene, places, window = clip, points[:DOTS], subset
    else:  # a dot has no more information than it shows alone
        scene, window = lone_dots(clip), 29
        places = scene.rest_px
    bound, single = (bound_px(scene, places, window, kept, rest) for rest in (REST, 1))
    print(f"\n== {name}: {len(points)} points, {len(frames)} frames, {subset} px subsets")
    print(f"   bound {bound:.4f} px with {REST} rest frames, {single:.4f} px with one")
    methods: list[tuple[str, int, Callable[[NDArray[np.uint8], Floats], Run]]] = [
        ("haselab, defaults, neighbours", len(frames), ours(TrackOptions(model="neighbours"))),
        ("   one rest frame", len(frames), ours(TrackOptions(model="neighbours"), 1)),
        ("   affine, 21 px", len(frames), ours(TrackOptions(model="affine", subset_px=21))),
    ]
    used, *slower = _track.kernels()
    print(f"   instruction set: {used}")
    if "avx2" in slower:
        avx2 = ours(TrackOptions(model="neighbours"), kernels="avx2")
        methods.insert(1, ("   with AVX2 kernels", len(frames), avx2))
    for library in LIBRARIES:
        if library.absent:
            print(f"   {library.name}: not installed ({library.absent})")
        else:
            count = min(library.frames or len(frames), len(frames))
            methods.append((library.name, count, adapted(library)))
    runs: dict[str, list[Run]] = {label: [] for label, _, _ in methods}
    for turn in range(rounds):
        for label, count, method in methods:
            if turn == 0 or count == len(frames):  # very slow libraries get one turn
                runs[label].append(method(frames[:count], points))
    speeds = {
        label: statistics.median(count / run.seconds for run in runs[label])
        for label, count, _ in methods
    }
    print(f"{'':36s} frames/s  ours/it avx2/it  rms px  /bound  lost  std stated/true")
    for label, count, _ in methods:
        run = runs[label][0]
        error = run.found - known[:count]
        moving = error[REST:, :DOTS]
        good = moving[np.abs(moving).max(axis=2) < 1.0]
        stated = "" if run.std is None else f"{rms(run.std[REST:, :DOTS]) / rms(good):14.2f}"
        speed, own = speeds[label], speeds[methods[0][0]]
        plain = speeds.get("   with AVX2 kernels", np.nan)
        print(
            f"{label:36s} {speed:8.1f} {own / speed:8.2f} {plain / speed:7.2f} {rms(good):7.4f}"
            f" {rms(good) / bound:7.3f} {lost(error):5d} {stated}",
            flush=True,
        )


def adapted(library: Library) -> Callable[[NDArray[np.uint8], Floats], Run]:
    def run(frames: NDArray[np.uint8], points: Floats) -> Run:
        return Run(*library.run(frames, points))

    return run


def bias_table(quick: bool, cache: Path | None) -> None:
    """Mean error at sub-pixel shifts of the whole scene: what no averaging takes away."""
    repeats = 2 if quick else 12
    for speckle in (False, True):
        clip = make_clip(512, speckle=speckle)
        points = clip.points_px[:DOTS]
        tracker = PointTracker(points, TrackOptions(model="neighbours"))
        state = tracker.init([clip.frame(k) for k in range(REST)])
        worst, worst_px = 0.0, 0.0
        for shift in np.arange(0.0, 1.0, 0.1):
            ideal = clip.ideal(0, (shift, 0.0))
            errors = []
            for k in range(repeats):
                frame = clip.noisy(ideal, 10_000 + int(100 * shift) * 100 + k)
                _, found = tracker.step(state, frame)
                errors.append(found.x_px - points[:, 0] - shift)
            # the reference's own error is common to all shifts: the zero shift gives it
            mean = np.nanmean(errors, axis=0)
            if shift == 0.0:
                zero = mean
            bias = float(np.mean(mean - zero))
            if abs(bias) > worst:
                worst, worst_px = abs(bias), shift
        spread = float(np.std(mean - zero) / np.sqrt(len(points)))
        print(
            f"bias, {'speckle' if speckle else 'dots':8s} worst {worst:.5f} px at {worst_px:.1f} px"
            f" (known to {spread:.5f} px)"
        )


def stress_table(quick: bool, cache: Path | None, seeds: int = 1) -> None:
    for seed in range(1, seeds + 1):
        for speckle in (False, True):
            stress_clip(speckle, seed, cache)


def stress_clip(speckle: bool, seed: int, cache: Path | None) -> None:
    clip = stressed(1024, speckle=speckle, seed=seed)
    name = f"stress-{'speckle' if speckle else 'dots'}-1024" + (f"-{seed}" if seed > 1 else "")
    frames = load(clip, name, cache)
    points = clip.points_px
    known = np.array([clip.truth(points, k) for k in range(len(frames))])
    steps = np.linalg.norm(np.diff(known, axis=0), axis=2).max(axis=1)
    print(f"\n== {name}: {len(frames)} frames, up to {steps.max():.1f} px a frame")
    run = ours(TrackOptions(model="neighbours"))(frames, points)
    error = np.abs(run.found - known).max(axis=2)
    valid = np.isfinite(error)
    wrong = int(np.sum(error > WRONG_PX))
    print(
        f"haselab: {len(frames) / run.seconds:.0f} frames/s, marked lost"
        f" {100 * np.mean(~valid):.2f} %, wrong by > {WRONG_PX} px and valid"
        f" {wrong} of {valid.size}, lost for good {int(np.sum(~valid[-1]))},"
        f" rms {rms(error[valid]):.4f} px"
    )
    for library in LIBRARIES:
        if seed == 1 and library.stress and not library.absent:
            _, found, _ = library.run(frames, points)
            print(f"{library.name}: lost for good {lost(found - known)}", flush=True)


def field_table(quick: bool, cache: Path | None) -> None:
    """All of the sheet on a 10 px grid, 21 px subsets, six unknowns."""
    clip = make_clip(512, speckle=True)
    frames = load(clip, "speckle-512", cache)[: 60 if quick else 400]
    grid = np.arange(0.0, 512.0, 10.0)
    x, y = np.meshgrid(grid[(grid > 95) & (grid < 417)], grid[(grid > 70) & (grid < 400)])
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    known = np.array([clip.truth(points, k) for k in range(len(frames))])
    bound = bound_px(clip, points, 21, [0, 60, 110, 160][: 2 if quick else 4], REST, affine=True)
    print(f"\n== field: {len(points)} points, 21 px; bound with six unknowns {bound:.4f} px")
    for label, model in (("affine", "affine"), ("neighbours", "neighbours")):
        run = ours(TrackOptions(model=model, subset_px=21))(frames, points)
        error = (run.found - known)[REST:]
        print(
            f"haselab, {label:12s} {len(frames) * len(points) / run.seconds:10.0f} points/s  rms"
            f" {rms(error):.4f} px  /bound {rms(error) / bound:.3f}  lost"
            f" {int(np.isnan(error).any(axis=(0, 2)).sum())}",
            flush=True,
        )
    for library in LIBRARIES:
        if library.field and not library.absent:
            some = frames[: min(library.frames or 60, len(frames))]
            seconds, found, _ = library.run(some, points)
            error = (found - known[: len(some)])[REST:]
            print(
                f"{library.name:21s} {len(some) * len(points) / seconds:10.0f} points/s  rms"
                f" {rms(error):.4f} px  /bound {rms(error) / bound:.3f}"
            )


TABLES = {
    "points": points_table,
    "bias": bias_table,
    "field": field_table,
    "stress": stress_table,
}


def rows(quick: bool = False, only: Sequence[str] = tuple(TABLES)) -> list[Row]:
    """Print the tables; they have no goals."""
    for name in only:
        TABLES[name](quick, None)
    return []


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=sorted(TABLES), default=list(TABLES))
    request = parser.parse_args()
    for name in request.only:
        if name == "stress":
            stress_table(request.quick, request.cache, request.seeds)
        else:
            TABLES[name](request.quick, request.cache)


if __name__ == "__main__":
    main()
