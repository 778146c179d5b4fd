"""Particles that move each for itself: found in every frame and linked."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from haselab.base import Estimate, HaselabError, InputError, JsonObject
from haselab.cli.common import progress_bar
from haselab.pipelines.tracking.stream import Clock, read_ahead
from haselab.pipelines.tracking.table import TrackRows
from haselab.store.video.opening import VideoReader
from haselab.tracking import Particles, find_profile, link_particles, locate_particles
from haselab.tracking.options import Frame

__all__ = ["link_clip"]

_FRAMES_AT_ONCE = 64


def _located(
    video: VideoReader, clock: Clock
) -> tuple[Frame, Any, list[Particles], list[float], HaselabError | None]:
    """First frame, profile, particles and times of all frames, and what broke the video off."""
    first, profile, broken_off = None, None, None
    particles: list[Particles] = []
    times_s: list[float] = []
    bar = progress_bar()
    bar.start(video.frames_expected)
    try:
        for batch in read_ahead(video, clock):
            for time_s, frame in batch:
                if first is None:
                    first, profile = frame, find_profile(frame)
                assert profile is not None
                particles.append(locate_particles(frame, profile))
                times_s.append(time_s)
            bar.advance(len(batch), "finding particles")
    except HaselabError as error:
        if not particles:
            raise
        broken_off = error
    finally:
        bar.stop()
    if first is None:
        raise InputError(f"The video contains no frame. {video.path}")
    return first, profile, particles, times_s, broken_off


def link_clip(
    video: VideoReader,
    clock: Clock,
    out: Path,
    reach_px: float,
    scale: Estimate | None,
    overlay: Path | None,
) -> tuple[JsonObject, HaselabError | None]:
    """Particles of each frame, linked, as a table; the answer, and what broke the video off."""
    if overlay is not None and overlay.suffix.lower() != ".png":
        raise InputError(f"--overlay with --link is a picture of the paths: .png. {overlay}")
    first, profile, particles, times_s, broken_off = _located(video, clock)
    linked = link_particles([found.points_px for found in particles], reach_px=reach_px)
    std = np.concatenate([found.std_px for found in particles])
    strength = np.concatenate([found.strength for found in particles])
    quality = np.minimum(strength / max(float(np.median(strength)), 1e-9), 1.0)
    numbers = np.stack([linked.x_px, linked.y_px, std[:, 0], std[:, 1], quality])
    start = np.unique(linked.particle, return_index=True)[1]
    rest_px = numbers[:2, start][:, linked.particle]
    metres = None if scale is None else scale.value
    rows = TrackRows([str(number) for number in range(len(start))], metres)
    bounds = np.searchsorted(linked.frame, np.arange(len(particles) + 1))
    times = np.array(times_s)
    numbers_of = np.array([video.number(index) for index in range(len(times_s))], np.intp)
    with out.open("wb") as file:
        file.write(rows.header())
        for k in range(0, len(particles), _FRAMES_AT_ONCE):
            part = slice(bounds[k], bounds[min(k + _FRAMES_AT_ONCE, len(particles))])
            frame = np.asarray(linked.frame[part], np.intp)
            found = np.zeros(frame.size, np.uint16)
            point = np.asarray(linked.particle[part], np.intp)
            file.write(
                rows.rows(
                    numbers_of[frame],
                    times[frame],
                    point,
                    numbers[:, part],
                    found,
                    rest_px[:, part],
                )
            )
    if overlay is not None:
        from haselab.cli.data.contact_sheet import draw_paths  # slow to load

        x_px, y_px = (np.full((len(times_s), len(start)), np.nan) for _ in range(2))
        x_px[linked.frame, linked.particle] = linked.x_px
        y_px[linked.frame, linked.particle] = linked.y_px
        draw_paths(overlay, first, x_px, y_px)
    return {
        "frames_read": len(particles),
        "particles": len(start),
        "sigma_px": profile.sigma_px,
        "polarity": profile.polarity,
        "particles_a_frame": len(linked.frame) / max(len(times_s), 1),
        "median_length_frames": float(np.median(np.bincount(linked.particle))) if len(start) else 0,
    }, broken_off
