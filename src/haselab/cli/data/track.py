"""`haselab track`: measure displacements and strain in a video."""

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
    unverified_option,
    warn_unverified,
)
from haselab.cli.data.track_chart import track_chart
from haselab.cli.data.track_link import link_clip
from haselab.cli.data.track_pick import save_picked
from haselab.cli.data.track_pictures import overlay_to
from haselab.cli.options import shared_option
from haselab.cli.output import OutputKind, OutputRule
from haselab.cli.plot import save_plot
from haselab.pipelines.prefetch import map_in_order
from haselab.pipelines.tracking.gauge import gauge_of, strain_answer
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
    ScaleOptions,
    describe_scale,
    make_correction,
    read_lens,
    scale_of,
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
from haselab.pipelines.tracking.stretch import stretch_note
from haselab.pipelines.tracking.table import Block, TrackRows
from haselab.pipelines.tracking.track_collector import TrackCollector
from haselab.store.manifest import check_recorded
from haselab.store.video.opening import VideoReader, open_video
from haselab.tracking import TrackOptions, Tracks, frames_at_rest
from haselab.tracking.options import Frame
from haselab.tracking.particles.follow import ParticleTracker

__all__ = ["command"]

_MANY_LOST = 0.1
_GONE, _GONE_SHARE = 10, 0.05  # last frames without a point
_NAMED = 4
_TURN_S = 0.5e-3


def _beside(options: Mapping[str, Any]) -> tuple[str, ...]:
    """Endings of the files beside the table; a lens only if one is calibrated."""
    if options["pick"]:
        return ()
    return ("-strain.csv", "-lens.json") if options["lens_board"] else ("-strain.csv",)


def _kind(options: Mapping[str, Any]) -> OutputKind:
    """A table of tracks is created at once; a table of picked points when it is saved."""
    return "late" if options["pick"] else "file"


_OUTPUTS = OutputRule(kind=_kind, options=("overlay", "report"), beside=_beside)


@dataclass(frozen=True)
class _Request:
    """The options, besides those for the output."""

    points: Path | None
    count: int
    rest_frames: int
    scale: ScaleOptions
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
            f"--rest-frames is {count}, but the video has only {len(frames)} frames. Lower it. "
            f"{path}"
        )
    return frames[:count]


def _before_motion(
    rest: list[Frame], points: Points, options: TrackOptions, path: Path
) -> tuple[list[Frame], str]:
    """The rest frames before anything moves, and a warning if some are left out."""
    still = frames_at_rest(rest, points.place_px, options)
    if still == len(rest):
        return rest, ""
    line = (
        f"--rest-frames is {len(rest)}, but the points move from frame {still} on. Only the first "
        f"{still} frames were averaged as the reference. Use at most --rest-frames {still}. {path}"
    )
    click.echo(f"haselab: {line}", err=True)
    return rest[:still], line


def _with_progress(
    followed: Iterator[Block], correction: Correction, kept: TrackCollector, frames: int
) -> Iterator[Block]:
    """Correct and record the blocks, with a progress bar."""
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
    """Track points by subsets; return the answer, and the error that ended the video early."""
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
    kept = TrackCollector(
        len(points.names), np.concatenate([points.group("upper"), points.group("lower")])
    )
    overlay = overlay_to(request.overlay, video.frames_expected)
    rows = TrackRows(points.names, None if scale is None else scale.value)
    follow = blocks(opening.all(), choice.tracker, choice.state, overlay.look, video.number)
    followed = UntilBroken(follow)
    with out.open("wb") as file:
        file.write(rows.header())
        watched = _with_progress(iter(followed), correction, kept, video.frames_expected)
        for _ in map_in_order(lambda b: file.write(rows.block(b, correction.rest_px)), watched, 1):
            pass
    overlay.close()
    if not kept.frames:
        raise followed.error or InputError(f"The video contains no frame. {video.path}")
    answer = head | {"rest_frames": len(rest)} | _answer(points, choice, kept)
    answer |= describe_scale(lens, [points.names[k] for k in fixed], scale)
    gauge = gauge_of(points, correction.rest_px, kept)
    answer["strain"] = strain_answer(gauge, kept, out)
    if request.report is not None:
        from haselab.pipelines.tracking.page import write_report  # slow to load

        lines = (_loss_line(video), _gap_line(video), moving, *answer.get("notes", ()))
        warnings = [line for line in (*lines, str(followed.error or "")) if line]
        clip = (rest[0], points, correction.rest_px)
        write_report(request.report, answer, clip, kept, gauge, warnings)
        answer["report"] = str(request.report)
    return answer, followed.error


def _answer(points: Points, choice: Choice, kept: TrackCollector) -> dict[str, Any]:
    thin = kept.thinned().tracks
    held = kept.valid / kept.frames
    if 1.0 - held.mean() > _MANY_LOST:
        click.echo(
            f"haselab: {100 * (1 - held.mean()):.0f} % of the positions were lost; see the column "
            "reason. Use --link for particles that appear and disappear.",
            err=True,
        )
    noise = choice.state.noise
    lines = _stretch_line(points, choice, thin), _gone_line(points, thin)
    notes = [line for line in lines if line]
    for line in notes:
        click.echo(f"haselab: {line}", err=True)
    return {
        **({"notes": notes} if notes else {}),
        "frames_read": kept.frames,
        "points": len(points.names),
        "model": choice.options.model,
        "subset_px": choice.options.subset_px,
        "chosen": [*points.why, choice.why],
        "valid_fraction": float(held.mean()),
        "expected_wrong_fraction": kept.expected_wrong,
        "expected_wrong_basis": (
            "share of the valid positions that are wrong by more than 0.5 px, from their standard "
            "deviations; at least 1e-4, plus 0.005 of the lost share for similar points that hide "
            "the tracked ones"
        ),
        "median_std_px": float(np.median(thin.std_x_px[thin.valid])) if thin.valid.any() else None,
        "noise": None if noise is None else {"floor": noise.floor, "slope": noise.slope},
    }


def _stretch_line(points: Points, choice: Choice, tracks: Tracks) -> str:
    """A warning about subsets that do not stretch with the sheet; empty if there is no need."""
    if isinstance(choice.tracker, ParticleTracker):
        return ""
    note = stretch_note(points.place_px, tracks, choice.options)
    return f"{note} Use --model neighbours." if note else ""


def _gone_line(points: Points, tracks: Tracks) -> str:
    """A note about points that were followed, but not to the end; empty if there are none."""
    count = len(tracks.valid)
    since = np.argmax(tracks.valid[::-1], axis=0)  # frames from the last valid one to the end
    gone = np.flatnonzero(tracks.valid.any(axis=0) & (since >= max(_GONE, _GONE_SHARE * count)))
    if gone.size == 0:
        return ""
    names = ", ".join(points.names[k] for k in gone[:_NAMED]) + ", ..." * (gone.size > _NAMED)
    return (
        f"{gone.size} of {len(points.names)} points were lost and not found again until the end: "
        f"{names}. The column reason says why. If they were only covered and the sheet moves as a "
        "whole, try --model neighbours."
    )


def _loss_line(video: VideoReader) -> str:
    """A warning about lossy compression; empty if there is none."""
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
            f"{video.codec} may or may not compress with loss, and the file does not say. "
            f"Record raw, FFV1 or TIFF to be sure. {video.path}"
        )
    return ""


def _gap_line(video: VideoReader) -> str:
    """A warning about missing frames; empty if there are none."""
    missing = video.missing
    if not missing:
        return ""
    shown = ", ".join(map(str, missing[:5])) + (", ..." if len(missing) > 5 else "")
    return (
        f"{len(missing)} frames are missing among the numbered images (counted from 0: {shown}). "
        f"The times of the frames after them are kept. {video.path}"
    )


def _request(options: dict[str, Any]) -> _Request:
    """Collect the options; those of the scale go into one object."""
    names = ("mm_per_px", "points", "ruler", "board", "picture")
    scale = ScaleOptions(**{name: options.pop(f"scale_{name}") for name in names})
    return _Request(**options, scale=scale)


@click.command()
@click.argument("video", type=click.Path(path_type=Path))
@click.option(
    "--points", type=click.Path(path_type=Path), metavar="P.csv",
    help="Read the points in the first frame from this CSV file: point, x_px, y_px. Default: find "
    "them, as with --auto.",
)  # fmt: skip
@click.option("--auto", is_flag=True, help="Find the points automatically.")
@click.option(
    "--pick",
    is_flag=True,
    help="Choose the points on a page in the browser, and save them only.",
)
@shared_option("--no-browser", is_flag=True)
@shared_option("--page-port", type=click.IntRange(0, 65535), default=0, show_default=True)
@click.option("--count", type=click.IntRange(1), default=300, show_default=True,
    help="Find at most this many particles.",
)  # fmt: skip
@click.option("--rest-frames", type=click.IntRange(1), default=1, show_default=True,
    help="Average this many motionless first frames as the reference.",
)  # fmt: skip
@click.option(
    "--scale-mm-per-px", type=REAL,
    help="Set the scale in mm per pixel. Default: none, lengths stay in pixels.",
)  # fmt: skip
@click.option(
    "--scale-points", metavar="X1,Y1,X2,Y2,MM",
    help="Find the scale from two points in px and their distance in mm. Default: none.",
)  # fmt: skip
@click.option(
    "--scale-ruler", metavar="X1,Y1,X2,Y2,MM",
    help="Find the scale from a line on a ruler in px and the mm between its ticks. Default: none.",
)  # fmt: skip
@click.option(
    "--scale-board", metavar="CxR,MM",
    help="Find the scale from a checkerboard: inner corners, and side of a square in mm. Default: "
    "none.",
)  # fmt: skip
@click.option(
    "--scale-picture", type=click.Path(path_type=Path),
    help="Read the ruler or the board from this picture. Default: the first frame.",
)  # fmt: skip
@click.option(
    "--lens", type=click.Path(path_type=Path),
    help="Correct the lens with a folder of checkerboard pictures (and --lens-board), or with a "
    "lens.json made from one. Default: no correction.",
)  # fmt: skip
@click.option(
    "--lens-board", metavar="CxR,MM",
    help="Describe the checkerboard of --lens: inner corners, and side of a square in mm. Default: "
    "none.",
)  # fmt: skip
@click.option(
    "--fixed", metavar="NAMES|P.csv",
    help="Subtract the rigid motion of these points, which only move if the camera or its tripod "
    "moves. Default: none.",
)  # fmt: skip
@shared_option("--rate-hz", type=POSITIVE, detail="Default: the frame rate in the file.")
@click.option(
    "--times", type=click.Path(path_type=Path),
    help="Read the times of the frames from a CSV file (frame, time_s), or from a session.h5 with "
    "--experiment. Default: from the frame rate.",
)  # fmt: skip
@shared_option(
    "--experiment",
    detail="It selects what is read; needed if the session has several. Default: its only one.",
)
@click.option(
    "--subset-px", type=INTEGER,
    help="Set the side of a subset in px, odd. Default: 15 with --points, from the size of the "
    "dots with --auto.",
)  # fmt: skip
@shared_option(
    "--model", type=click.Choice(["auto", "translation", "neighbours", "affine"]), default="auto",
    show_default=True, detail="It describes how a subset moves and deforms.",
)  # fmt: skip
@click.option("--link", is_flag=True, help="Find particles in each frame and link them.")
@click.option("--reach-px", type=POSITIVE, default=5.0, show_default=True,
    help="Set the largest motion of a particle between frames in px, for --link.",
)  # fmt: skip
@click.option(
    "--overlay", type=click.Path(path_type=Path), metavar="FILE.mp4|png",
    help="Write the frames with the points as a video (.mp4) or as a contact sheet (.png). "
    "Default: none.",
)  # fmt: skip
@click.option(
    "--report", type=click.Path(path_type=Path), metavar="FILE.html",
    help="Write a page about the tracks. Default: none.",
)  # fmt: skip
@answer_options(
    _OUTPUTS,
    "It is a CSV file with the tracks, and required. With --pick, it is a CSV file with the "
    "points. Default with --pick: VIDEO-points.csv.",
    plot=True,
)
@unverified_option
def command(
    video: Path,
    auto: bool,
    pick: bool,
    no_browser: bool,
    page_port: int,
    link: bool,
    unverified: bool,
    as_json: bool,
    out: Path | None,
    plot: Path | None,
    **options: Any,
) -> None:
    """Measure displacements and strain in a video.

    VIDEO is any file that FFmpeg reads, a folder of images, a TIFF stack, .cine or .mraw. The
    strain is computed from the points named upper* and lower*. With --auto these are the two rows
    of three dots on the clamps, or three particles near each end. With --pick, a page on this
    computer shows the video; the command ends when the points are saved.
    """
    if pick:
        save_picked(video, out, page_port, no_browser=no_browser, as_json=as_json)
        return
    if no_browser or page_port:
        raise click.UsageError(f"--{'no-browser' if no_browser else 'page-port'} needs --pick.")
    if out is None:
        raise click.UsageError("Missing option '--out': the CSV file for the tracks.")
    request = _request(options)
    if request.points is not None and (auto or link):
        raise click.UsageError("--points excludes --auto and --link. Use only one of them.")
    if link and (request.lens or request.fixed or request.report):
        raise click.UsageError(
            "--link does not support --lens, --fixed or --report. Leave them out."
        )
    # Switch to the threads that decode and write sooner than after Python's default of 5 ms.
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
        warn_unverified(clock.doubt, request.times)
        answer["unverified"] = True
    if doubt:
        warn_unverified(doubt, video)
        answer["unverified"] = True
    if broken_off is None:
        answer["frames"] = answer["frames_read"]
    else:
        answer["incomplete"] = str(broken_off)
    emit(answer, as_json=as_json, out=None)
    save_plot(plot, lambda: track_chart(out))
    if broken_off is not None:
        raise InputError(
            f"Only {found['frames_read']} frames were tracked; their rows are kept. {broken_off}"
        )
