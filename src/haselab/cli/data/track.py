"""`haselab track`: video to displacements and strain."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from haselab.base import HaselabError, InputError
from haselab.cli.common import (
    INTEGER,
    POSITIVE,
    REAL,
    answer_options,
    emit,
    progress_bar,
    tell_doubt,
    unverified_option,
)
from haselab.cli.data.track_chart import track_chart
from haselab.cli.data.track_link import link_clip
from haselab.cli.data.track_pictures import overlay_to
from haselab.cli.output import OutputRule
from haselab.cli.plot import save_plot
from haselab.pipelines.prefetch import in_order
from haselab.pipelines.tracking.gauge import gauge_of, strain_answer
from haselab.pipelines.tracking.kept import Kept
from haselab.pipelines.tracking.points import (
    PILOT_FRAMES,
    Choice,
    Points,
    choose_tracker,
    find_points,
    name_gauge,
    read_points,
    without_gauge,
)
from haselab.pipelines.tracking.scale import (
    Correction,
    ScaleWish,
    make_correction,
    read_lens,
    scale_of,
    told,
    with_fixed,
)
from haselab.pipelines.tracking.stream import (
    Clock,
    Opening,
    UntilBroken,
    blocks,
    read_ahead,
    read_clock,
)
from haselab.pipelines.tracking.table import Block, TrackRows
from haselab.store.manifest import check_recorded
from haselab.store.video.opening import VideoReader, open_video
from haselab.tracking import TrackOptions, frames_at_rest
from haselab.tracking.options import Frame
from haselab.tracking.particles.follow import ParticleTracker

__all__ = ["command"]

_MANY_LOST = 0.1
_TURN_S = 0.5e-3


def _beside(wishes: Mapping[str, Any]) -> tuple[str, ...]:
    """Endings of the files beside the table: a lens only where one is calibrated."""
    return ("-strain.csv", "-lens.json") if wishes["lens_board"] else ("-strain.csv",)


_OUTPUTS = OutputRule(options=("overlay", "report"), beside=_beside)


@dataclass(frozen=True)
class _Request:
    """What the user asked for, beyond the video and the answer's place."""

    points: Path | None
    count: int
    rest_frames: int
    scale: ScaleWish
    lens: Path | None
    lens_board: str | None
    fixed: str | None
    rate_hz: float | None
    times: Path | None
    experiment: str | None
    subset_px: int | None
    model: str
    reach_px: float
    overlay: Path | None
    report: Path | None


def _rest(opening: Opening, count: int, path: Path) -> list[Frame]:
    frames = opening.frames
    if len(frames) < count:
        raise InputError(
            f"--rest-frames {count}, but only {len(frames)} frames can be read. Lower it. {path}"
        )
    return frames[:count]


def _before_motion(
    rest: list[Frame], points: Points, options: TrackOptions, path: Path
) -> tuple[list[Frame], str]:
    """The rest frames before anything moves, and a warning where some are left out."""
    still = frames_at_rest(rest, points.place_px, options)
    if still == len(rest):
        return rest, ""
    line = (
        f"--rest-frames {len(rest)}, but the points move from frame {still} on. Only the first "
        f"{still} frames are the reference. Give at most --rest-frames {still}. {path}"
    )
    click.echo(f"haselab: {line}", err=True)
    return rest[:still], line


def _watched(
    followed: Iterator[Block], correction: Correction, kept: Kept, frames: int
) -> Iterator[Block]:
    """The blocks, corrected and noted, with a progress bar."""
    bar = progress_bar()
    bar.start(frames)
    try:
        for found in followed:
            block = correction.block(found)
            kept.add(block)
            bar.advance(len(block.time_s), "tracking")
            yield block
    finally:
        bar.stop()


def _track(
    video: VideoReader, request: _Request, clock: Clock, out: Path, head: dict[str, Any]
) -> tuple[dict[str, Any], HaselabError | None]:
    """Points followed by subsets; the answer for the user, and what broke the video off."""
    opening = Opening(read_ahead(video, clock), max(request.rest_frames, PILOT_FRAMES))
    rest = _rest(opening, request.rest_frames, video.path)
    if request.points is None:
        points = find_points(rest[0], request.count, request.subset_px)
    else:
        points = read_points(request.points, rest[0])
    points, fixed = with_fixed(points, request.fixed, rest[0])
    options = TrackOptions(subset_px=request.subset_px or points.subset_px)
    rest, moving = _before_motion(rest, points, options, video.path)
    lens = read_lens(request.lens, request.lens_board, out)
    scale = scale_of(request.scale, rest[0], lens)
    correction = make_correction(lens, fixed, points.place_px, rest[0])
    choice = choose_tracker(
        opening.frames, rest, points, options, request.model, lossy=bool(video.lossy)
    )
    if request.points is None and isinstance(choice.tracker, ParticleTracker):
        points = without_gauge(points)
    elif request.points is None and choice.together:
        points = name_gauge(points)
    kept = Kept(len(points.names), np.concatenate([points.group("upper"), points.group("lower")]))
    overlay = overlay_to(request.overlay, video.frames_expected)
    rows = TrackRows(points.names, None if scale is None else scale.value)
    follow = blocks(opening.all(), choice.tracker, choice.state, overlay.look, video.number)
    followed = UntilBroken(follow)
    with out.open("wb") as file:
        file.write(rows.header())
        watched = _watched(iter(followed), correction, kept, video.frames_expected)
        for _ in in_order(lambda b: file.write(rows.block(b, correction.rest_px)), watched, 1):
            pass
    overlay.close()
    if not kept.frames:
        raise followed.error or InputError(f"The video holds no frame. {video.path}")
    answer = head | {"rest_frames": len(rest)} | _answer(points, choice, kept)
    answer |= told(lens, [points.names[k] for k in fixed], scale)
    gauge = gauge_of(points, correction.rest_px, kept)
    answer["strain"] = strain_answer(gauge, kept, out)
    if request.report is not None:
        from haselab.pipelines.tracking.page import write_report  # slow to load

        warnings = [
            line
            for line in (_loss_line(video), _gap_line(video), moving, str(followed.error or ""))
            if line
        ]
        clip = (rest[0], points, correction.rest_px)
        write_report(request.report, answer, clip, kept, gauge, warnings)
        answer["report"] = str(request.report)
    return answer, followed.error


def _answer(points: Points, choice: Choice, kept: Kept) -> dict[str, Any]:
    thin = kept.thinned().tracks
    held = kept.valid / kept.frames
    if 1.0 - held.mean() > _MANY_LOST:
        click.echo(
            f"haselab: {100 * (1 - held.mean()):.0f} % of the positions were lost; the column "
            "reason says why. --link gives the paths of particles that come and go.",
            err=True,
        )
    noise = choice.state.noise
    return {
        "frames_read": kept.frames,
        "points": len(points.names),
        "model": choice.options.model,
        "subset_px": choice.options.subset_px,
        "chosen": [*points.why, choice.why],
        "valid_fraction": float(held.mean()),
        "expected_wrong_fraction": kept.expected_wrong,
        "expected_wrong_basis": (
            "share of the valid positions wrong by more than 0.5 px, by their standard deviations; "
            "at least 1e-4, and 0.005 of the lost share for look-alikes in front of the points"
        ),
        "median_std_px": float(np.median(thin.std_x_px[thin.valid])) if thin.valid.any() else None,
        "noise": None if noise is None else {"floor": noise.floor, "slope": noise.slope},
    }


def _loss_line(video: VideoReader) -> str:
    """What compression does, in words; nothing where it does nothing."""
    if video.lossy:
        return (
            f"The video is compressed with loss ({video.codec}). The standard deviations are "
            "widened by the scatter between neighbouring points, and positions that are too "
            "uncertain are not valid. An error common to a whole region is not detected. Record "
            "raw, FFV1 or TIFF. "
            f"{video.path}"
        )
    if video.lossy is None:
        return (
            f"{video.codec} compresses with loss or without, and the file does not say which. "
            f"Record raw, FFV1 or TIFF to be sure. {video.path}"
        )
    return ""


def _gap_line(video: VideoReader) -> str:
    """Which frames are missing, in words; nothing where none is."""
    missing = video.missing
    if not missing:
        return ""
    shown = ", ".join(map(str, missing[:5])) + (", ..." if len(missing) > 5 else "")
    return (
        f"{len(missing)} frames are missing among the numbered images (counted from 0: {shown}). "
        f"The times of the frames after them are kept. {video.path}"
    )


def _request(wishes: dict[str, Any]) -> _Request:
    """The options; those of the scale together."""
    names = ("mm_per_px", "points", "ruler", "board", "picture")
    scale = ScaleWish(**{name: wishes.pop(f"scale_{name}") for name in names})
    return _Request(**wishes, scale=scale)


@click.command()
@click.argument("video", type=click.Path(path_type=Path))
@click.option("--points", type=click.Path(path_type=Path), help="CSV: point, x_px, y_px.")
@click.option("--auto", is_flag=True, help="Find the points (the default without --points).")
@click.option("--count", type=click.IntRange(1), default=300, show_default=True,
    help="Find at most this many particles.",
)  # fmt: skip
@click.option("--rest-frames", type=click.IntRange(1), default=1, show_default=True,
    help="Average this many motionless first frames as the reference.",
)  # fmt: skip
@click.option("--scale-mm-per-px", type=REAL, help="Length of a pixel.")
@click.option("--scale-points", metavar="X1,Y1,X2,Y2,MM", help="Two points, their distance.")
@click.option(
    "--scale-ruler", metavar="X1,Y1,X2,Y2,MM", help="A line on a ruler, MM from tick to tick."
)
@click.option("--scale-board", metavar="CxR,MM", help="A checkerboard's inner corners, its square.")
@click.option(
    "--scale-picture",
    type=click.Path(path_type=Path),
    help="Of ruler or board; without it they are in the first frame.",
)
@click.option(
    "--lens",
    type=click.Path(path_type=Path),
    help="A folder of checkerboard pictures (with --lens-board), or a lens.json made of one.",
)
@click.option("--lens-board", metavar="CxR,MM", help="The checkerboard of --lens.")
@click.option(
    "--fixed",
    metavar="NAMES|P.csv",
    help="Points that should stand still: rigid motion of camera and stand is taken out.",
)
@click.option("--rate-hz", type=POSITIVE, help="Frame rate, in place of the file's.")
@click.option(
    "--times",
    type=click.Path(path_type=Path),
    help="Times of the frames: CSV frame,time_s, or session.h5 with --experiment.",
)
@click.option("--experiment", help="Of the session given by --times.")
@click.option(
    "--subset-px",
    type=INTEGER,
    help="Side of a subset, odd. Default: 15 with --points, by the dots' size with --auto.",
)
@click.option(
    "--model",
    type=click.Choice(["auto", "translation", "neighbours", "affine"]),
    default="auto",
    show_default=True,
    help="How a subset may move and deform.",
)
@click.option("--link", is_flag=True, help="Find particles in each frame and link them.")
@click.option("--reach-px", type=POSITIVE, default=5.0, show_default=True,
    help="With --link: the farthest that a particle moves between frames.",
)  # fmt: skip
@click.option(
    "--overlay",
    type=click.Path(path_type=Path),
    help=".mp4: the points on the frames; .png: a contact sheet.",
)
@click.option("--report", type=click.Path(path_type=Path), help="HTML: one page of the tracks.")
@answer_options(_OUTPUTS, plot=True)
@unverified_option
def command(
    video: Path,
    auto: bool,
    link: bool,
    unverified: bool,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
    **wishes: Any,
) -> None:
    """Video to displacements and strain.

    VIDEO is anything FFmpeg reads, a folder of images, a TIFF stack, .cine or .mraw. Points
    named upper* and lower* (with --auto: the clamps' two rows of three dots, or three particles
    near either end) give the strain.
    """
    if out is None:
        raise click.UsageError("--out OUT.csv is needed: the table of tracks goes there.")
    request = _request(wishes)
    if request.points is not None and (auto or link):
        raise click.UsageError("--points excludes --auto and --link; give one of them.")
    if link and (request.lens or request.fixed or request.report):
        raise click.UsageError("--link takes no --lens, --fixed or --report; leave them out.")
    # Threads that wait to decode or to write get their turn sooner than after Python's 5 ms.
    sys.setswitchinterval(_TURN_S)
    clock = read_clock(request.rate_hz, request.times, request.experiment, unverified=unverified)
    doubt = check_recorded(video, unverified=unverified)
    out.parent.mkdir(parents=True, exist_ok=True)
    with open_video(video) as reader:
        for warning in (_loss_line(reader), _gap_line(reader)):
            if warning:
                click.echo(f"haselab: {warning}", err=True)
        head = {
            "video": str(video),
            "frames": reader.frames_expected,
            "missing_frames": list(reader.missing),
            "rate_hz": clock.rate_hz or reader.rate_hz,
            "levels": reader.levels,
            "bit_depth": reader.bit_depth,
            "codec": reader.codec,
            "lossy": reader.lossy,
        }
        if link:
            first = next(iter(reader))
            scale = scale_of(request.scale, first, None)
            found, broken_off = link_clip(
                reader, clock, out, request.reach_px, scale, request.overlay
            )
        else:
            found, broken_off = _track(reader, request, clock, out, head)
    answer = {**head, **found, "table": str(out)}
    if clock.doubt and request.times is not None:
        tell_doubt(clock.doubt, request.times)
        answer["unverified"] = True
    if doubt:
        tell_doubt(doubt, video)
        answer["unverified"] = True
    if broken_off is None:
        answer["frames"] = answer["frames_read"]
    else:
        answer["incomplete"] = str(broken_off)
    emit(answer, as_json=as_json, out=None)
    save_plot(plot, lambda: track_chart(out))
    if broken_off is not None:
        raise InputError(
            f"Only {found['frames_read']} frames were tracked, their rows are kept. {broken_off}"
        )
