"""Draws pictures for docs/measure/tracking.md: `python -m benchmarks.tracking.pictures DATA OUT`.

DATA holds `video/bulk-water.mov` and `video/dic-challenge-14/` (their public sources are named in
docs/measure/tracking.md); OUT is docs/pictures.
"""

import sys
from itertools import islice
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import scipy.io
import tifffile

from haselab.store.video.opening import open_video
from haselab.tracking import (
    PointTracker,
    TrackOptions,
    find_profile,
    link_particles,
    locate_particles,
)

FRAMES = 120
LONG = 60


def draw_particles(data: Path, out: Path) -> None:
    with open_video(data / "video/bulk-water.mov") as video:
        frames = list(islice(video, FRAMES))
    profile = find_profile(frames[0])
    found = [locate_particles(frame, profile).points_px for frame in frames]
    linked = link_particles(found, reach_px=5.0)
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.2, 3.6), width_ratios=(1.5, 1))
    left.imshow(frames[0], cmap="gray", interpolation="nearest")
    square = np.zeros(12)
    count = np.zeros(12)
    for number in np.flatnonzero(np.bincount(linked.particle) >= LONG):
        rows = linked.particle == number
        x, y, frame = linked.x_px[rows], linked.y_px[rows], linked.frame[rows]
        left.plot(x, y, linewidth=0.7)
        for lag in range(1, 13):
            same = frame[lag:] - frame[:-lag] == lag
            square[lag - 1] += np.sum((x[lag:] - x[:-lag])[same] ** 2)
            count[lag - 1] += same.sum()
    left.set(xticks=[], yticks=[], title=f"paths of {LONG} frames and more")
    right.plot(np.arange(1, 13), square / count, "o-", markersize=4)
    right.set(xlabel="frames between", ylabel="mean square of Δx, px²", title="diffusion and drift")
    right.set_xlim(0)
    right.set_ylim(0)
    right.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(out / "tracking-particles.png", dpi=80)


def draw_dic(data: Path, out: Path) -> None:
    folder = data / "video/dic-challenge-14"
    reference = tifffile.imread(folder / "reference.tif")
    exact = next(v for k, v in scipy.io.loadmat(folder / "exact.mat").items() if k[0] != "_")
    x, y = np.meshgrid(np.arange(30.0, 2018.0, 10.0), np.arange(30.0, 559.0, 10.0))
    points = np.stack([x.ravel(), y.ravel()], axis=1)
    figure, axes = plt.subplots(2, 1, figsize=(8.0, 4.6), sharex=True, sharey=True)
    for axis, name, column in zip(axes, ("L1", "L3"), (1, 3), strict=True):
        tracker = PointTracker(points, TrackOptions(subset_px=21))
        _, found = tracker.step(tracker.init([reference]), tifffile.imread(folder / f"{name}.tif"))
        truth = np.interp(points[:, 0], exact[:, 0], exact[:, column])
        moved = found.x_px - points[:, 0]
        rms = np.sqrt(np.mean((moved - truth) ** 2))
        stated = np.sqrt(np.mean(found.std_x_px**2))
        axis.plot(points[:, 0], moved, ".", markersize=1, color="0.65", label="each point")
        mean = moved.reshape(x.shape).mean(axis=0)
        axis.plot(x[0], mean, "o", markersize=3, label="mean of a column")
        axis.plot(exact[:, 0], exact[:, column], color="tab:red", linewidth=1, label="exact")
        axis.set(ylabel="u, px")
        axis.set_title(f"{name}: rms error {rms:.4f} px, stated {stated:.4f} px", fontsize=10)
        print(f"{name}: {len(points)} points, rms {rms:.5f} px, stated {stated:.5f} px")
    axes[0].legend(loc="upper right", ncols=3, fontsize=8, markerscale=2)
    axes[1].set(xlabel="x, px", ylim=(-0.2, 0.2))
    figure.tight_layout()
    figure.savefig(out / "tracking-dic-challenge.png", dpi=80)


if __name__ == "__main__":
    source, target = map(Path, sys.argv[1:3])
    target.mkdir(parents=True, exist_ok=True)
    draw_particles(source, target)
    draw_dic(source, target)
