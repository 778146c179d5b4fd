"""Scale from pixels to metres, and correction for lens and a moving stand."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, InputError, JsonObject
from haselab.pipelines.tracking.points import Points, read_points
from haselab.pipelines.tracking.table import Block
from haselab.store.folder import read_json, write_json
from haselab.store.video.opening import open_video
from haselab.tracking import LossReason
from haselab.tracking.camera.lens import Lens, calibrate_lens, find_checkerboard
from haselab.tracking.camera.rigid import fit_rigid_motion
from haselab.tracking.camera.scale import (
    scale_from_checkerboard,
    scale_from_points,
    scale_from_ruler,
)
from haselab.tracking.options import Floats, Frame

__all__ = [
    "Correction",
    "ScaleOptions",
    "describe_scale",
    "make_correction",
    "read_lens",
    "scale_of",
    "with_fixed",
]

_MM = 1e-3


@dataclass(frozen=True)
class ScaleOptions:
    """The options for the scale, as typed; at most one of the first four.

    Args:
        mm_per_px: a known scale.
        points: `x1,y1,x2,y2,MM`.
        ruler: `x1,y1,x2,y2,MM` with the length from tick to tick.
        board: `COLUMNSxROWS,MM` with the side of a square.
        picture: of ruler or board; None: the first frame.
    """

    mm_per_px: float | None
    points: str | None
    ruler: str | None
    board: str | None
    picture: Path | None


def _numbers(option: str, text: str, form: str) -> list[float]:
    """Parse the numbers of an option, as many as its form has."""
    count = form.count(",") + 1
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise InputError(
            f"{option} {text!r} is not of the form {form}: {count} numbers with commas."
        )
    return values


def _board(option: str, text: str) -> tuple[int, int, float]:
    """Parse `9x6,5`: inner corners along both sides, side of a square in mm."""
    corners, _, side = text.partition(",")
    columns, _, rows = corners.lower().partition("x")
    try:
        return int(columns), int(rows), float(side)
    except ValueError:
        raise InputError(
            f"{option} {text!r} is not of the form COLUMNSxROWS,MM: inner corners along both "
            "sides and the side of a square, such as 9x6,5."
        ) from None


def _picture(path: Path | None, first: Frame) -> Frame:
    if path is None:
        return first
    with open_video(path) as video:
        return next(iter(video))


def scale_of(wish: ScaleOptions, first: Frame, lens: Lens | None) -> Estimate | None:
    """Find the metres per pixel; `None` if no scale was requested.

    Args:
        wish: the options.
        first: frame of the video.
        lens: for correcting points and corners, but not a ruler.

    Raises:
        InputError: more than one scale is given, or one that is not positive.
        ResultError: no ruler or board is found.
    """
    given = {
        "--scale-mm-per-px": wish.mm_per_px, "--scale-points": wish.points,
        "--scale-ruler": wish.ruler, "--scale-board": wish.board,
    }  # fmt: skip
    names = [name for name, value in given.items() if value is not None]
    if len(names) > 1:
        raise InputError(f"{' and '.join(names)} exclude each other. Use only one of them.")
    if wish.mm_per_px is not None:
        if not (math.isfinite(wish.mm_per_px) and wish.mm_per_px > 0.0):
            raise InputError(
                f"--scale-mm-per-px is {wish.mm_per_px:g}. Use a positive number, the length of a "
                "pixel in mm."
            )
        return Estimate.normal(wish.mm_per_px * _MM, 0.0, "m/px")
    if wish.points is not None:
        *place, length = _numbers("--scale-points", wish.points, "X1,Y1,X2,Y2,MM")
        ends = _without_lens(np.array(place).reshape(2, 2), lens)
        return scale_from_points(ends[0], ends[1], length * _MM)
    if wish.ruler is not None:
        *place, tick = _numbers("--scale-ruler", wish.ruler, "X1,Y1,X2,Y2,MM")
        a, b = np.array(place).reshape(2, 2)
        return scale_from_ruler(_picture(wish.picture, first), a, b, tick * _MM)
    if wish.board is not None:
        columns, rows, side = _board("--scale-board", wish.board)
        corners = find_checkerboard(_picture(wish.picture, first), columns, rows)
        return scale_from_checkerboard(_without_lens(corners, lens), side * _MM)
    return None


def _without_lens(points_px: Floats, lens: Lens | None) -> Floats:
    if lens is None:
        return points_px
    return np.stack(lens.undistort(points_px[..., 0], points_px[..., 1]), axis=-1)


def read_lens(path: Path | None, board: str | None, out: Path) -> Lens | None:
    """Read a lens from its file, or calibrate it from pictures and write it beside the answer.

    Args:
        path: lens.json, or a folder of pictures of a checkerboard.
        board: `COLUMNSxROWS,MM`, for a folder.
        out: of the answer.

    Raises:
        InputError: no such file, not a lens, or no board given.
        ResultError: too few pictures show the board.
    """
    if path is None:
        return None
    if not path.is_dir():
        return _lens_of(read_json(path), path)
    if board is None:
        raise InputError(f"--lens with a folder needs --lens-board COLUMNSxROWS,MM. {path}")
    columns, rows, _ = _board("--lens-board", board)
    with open_video(path) as pictures:
        frames = list(pictures)
    height, width = frames[0].shape
    lens = calibrate_lens([find_checkerboard(f, columns, rows) for f in frames], (width, height))
    write_json(out.with_name(out.stem + "-lens.json"), asdict(lens))
    return lens


def _lens_of(data: Any, path: Path) -> Lens:
    try:
        width, height = (int(size) for size in data["size_px"])
        focal, centre, five = (
            np.array(data[name], float) for name in ("focal_px", "centre_px", "coefficients")
        )
        lens = Lens(
            focal_px=focal,
            centre_px=centre,
            coefficients=five,
            size_px=(width, height),
            rms_px=float(data["rms_px"]),
        )
        if (focal.shape, centre.shape, five.shape) != ((2,), (2,), (5,)):
            raise ValueError("numbers are missing")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"The file is not a lens of haselab ({error}). Calibrate the lens again. {path}"
        ) from None
    return lens


def with_fixed(points: Points, fixed: str | None, frame: Frame) -> tuple[Points, NDArray[np.intp]]:
    """Add the fixed points to the tracked ones, and return which they are.

    Args:
        points: that are tracked.
        fixed: names with commas, or a table of further points.
        frame: the first.

    Raises:
        InputError: an unknown name, or a table that cannot be used.
    """
    if fixed is None:
        return points, np.zeros(0, np.intp)
    if not fixed.lower().endswith(".csv"):
        return points, points.named([name.strip() for name in fixed.split(",")])
    more = read_points(Path(fixed), frame)
    twice = sorted(set(more.names) & set(points.names))
    if twice:
        raise InputError(f"Two points have the name {twice[0]!r}. Rename one of them. {fixed}")
    first = len(points.names)
    together = replace(
        points,
        names=points.names + more.names,
        place_px=np.concatenate([points.place_px, more.place_px]),
    )
    return together, np.arange(first, len(together.names), dtype=np.intp)


@dataclass(frozen=True)
class Correction:
    """Corrects blocks of tracks for the lens and the motion of the stand.

    Args:
        lens: if it is known.
        fixed: indices of the fixed points.
        rest_px: all points in the first frame, corrected for the lens. Shape `(P, 2)`.
    """

    lens: Lens | None
    fixed: NDArray[np.intp]
    rest_px: Floats

    def block(self, block: Block) -> Block:
        """Correct the positions; points are lost in frames without any fixed point."""
        if self.lens is None and not self.fixed.size:
            return block
        t = block.tracks
        x, y, std_x, std_y = t.x_px, t.y_px, t.std_x_px, t.std_y_px
        if self.lens is not None:
            grow_x, grow_y = self.lens.magnification(x, y)
            x, y = self.lens.undistort(x, y)
            std_x, std_y = std_x * grow_x, std_y * grow_y
        if self.fixed.size:
            at = self.fixed
            motion = fit_rigid_motion(
                self.rest_px[at], x[:, at], y[:, at], std_x[:, at], std_y[:, at]
            )
            x, y, std_x, std_y = motion.undo(x, y, std_x, std_y)
        valid = t.valid & np.isfinite(x)
        untied = np.where(t.valid & ~valid, np.uint16(LossReason.UNTIED), np.uint16(0))
        tracks = replace(
            t,
            x_px=x,
            y_px=y,
            std_x_px=std_x,
            std_y_px=std_y,
            valid=valid,
            reason=untied if t.reason is None else t.reason | untied,
        )
        return replace(block, tracks=tracks)


def make_correction(
    lens: Lens | None, fixed: NDArray[np.intp], place_px: Floats, frame: Frame
) -> Correction:
    """Make the correction for a video.

    Raises:
        InputError: the lens was calibrated with pictures of another size.
    """
    height, width = frame.shape
    if lens is not None and lens.size_px != (width, height):
        raise InputError(
            f"The lens was calibrated with pictures of {lens.size_px[0]} x {lens.size_px[1]} px, "
            f"but the video has {width} x {height} px. Calibrate with pictures of the same size."
        )
    return Correction(lens, fixed, _without_lens(place_px, lens))


def describe_scale(lens: Lens | None, fixed: Sequence[str], scale: Estimate | None) -> JsonObject:
    """Summarise lens, fixed points and scale for the answer."""
    return {
        "scale_mm_per_px": None if scale is None else scale.scaled(1e3, "mm/px"),
        "lens": None if lens is None else {"rms_px": lens.rms_px},
        "fixed": list(fixed),
    }
