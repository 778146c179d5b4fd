"""Point tracking beside OpenCV's pyramidal Lucas-Kanade, in one run: frames per second of CPU
time in one thread, and error against the twin camera's truth. `python benchmarks/tracking_speed.py`
"""

import time

import cv2
import numpy as np

from haselab.rig.twin.camera import CameraConfig, TwinCamera
from haselab.tracking import PointTracker, TrackOptions

FRAMES, REST = 200, 10
LENGTH_M, STROKE = 0.110, 0.08


def make_clip(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Frames, and the true positions `(F, P, 2)`, the clamps' dots first."""
    camera = TwinCamera(CameraConfig(), half_width_m=0.06, free_length_m=0.05, seed=seed)
    swing = np.concatenate([np.zeros(REST), np.sin(np.linspace(0, 12.0, FRAMES - REST))])
    lengths = LENGTH_M * (1.0 + STROKE * swing)
    frames = camera.render(np.repeat(lengths[:, None], 5, axis=1), first_index=0)
    truth = [
        np.concatenate([camera.true_fiducials_px(v), camera.true_particle_px(v)]) for v in lengths
    ]
    return frames, np.array(truth)[:, :306]


def run_ours(frames, points, options):
    tracker = PointTracker(points, options)
    state, rows = tracker.init(list(frames[:REST])), []
    start = time.process_time()
    for frame in frames:
        state, found = tracker.step(state, frame)
        rows.append(np.stack([found.x_px, found.y_px], axis=1))
    return len(frames) / (time.process_time() - start), np.array(rows)


def run_lucas_kanade(frames, points, side):
    start = time.process_time()
    place, rows, before = points.astype(np.float32)[:, None, :], [], frames[0]
    for frame in frames:
        place = cv2.calcOpticalFlowPyrLK(before, frame, place, None, winSize=(side, side))[0]
        rows.append(place[:, 0].copy())
        before = frame
    return len(frames) / (time.process_time() - start), np.array(rows)


def main() -> None:
    cv2.setNumThreads(1)
    frames, truth = make_clip(1)
    print(f"{FRAMES} frames {frames.shape[1]} x {frames.shape[2]}, 21 px subsets")
    for count in (3, 300):
        points, known = truth[0, -count:], truth[:, -count:]
        rows = [("OpenCV Lucas-Kanade, frame to frame", run_lucas_kanade(frames, points, 21))]
        for model in ("translation", "neighbours", "affine") if count > 3 else ("translation",):
            options = TrackOptions(subset_px=21, model=model)
            rows.append((f"haselab, {model}", run_ours(frames, points, options)))
        for name, (speed, found) in rows:
            error = np.sqrt(np.nanmean((found - known)[REST:] ** 2))
            lost = int(np.isnan(found).any(axis=2).sum())
            print(
                f"{count:4d} points  {name:38s} {speed:7.0f} frames/s  rms {error:.4f} px"
                f"  lost {lost}"
            )


if __name__ == "__main__":
    main()
