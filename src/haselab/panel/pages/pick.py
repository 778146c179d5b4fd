"""What the page Pick requests: frames of a video, dots near a click, and a table of points."""

from __future__ import annotations

import base64
import io
import math
import shlex
import threading
from collections.abc import Callable, Hashable, Mapping
from concurrent.futures import Future, wait
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from PIL import Image

from haselab.base import InputError, JsonObject, ResultError
from haselab.pipelines.tracking.points import Points, find_points, points_table
from haselab.pipelines.tracking.scale import ScaleOptions, scale_of
from haselab.store.claim import is_occupied, move_aside
from haselab.store.folder import write_new
from haselab.store.manifest import MANIFEST
from haselab.store.video.grey_range import grey_range
from haselab.store.video.listing import list_videos
from haselab.store.video.opening import open_video
from haselab.tracking import PointTracker, TrackOptions
from haselab.tracking.options import Floats, Frame
from haselab.tracking.particles.detect import DotProfile, detect_dot_near, find_profile

__all__ = ["PICK_REQUESTS", "Videos"]

_MOST_VIDEOS = 2000
_MOST_POINTS = 5000
_ALL_DOTS = 1 << 30
_LONGEST_NAME = 200
_MOST_SEARCHES = 4  # whose results are kept
_LOOK_S = 0.1  # between two looks whether the program ends
_LARGE = 1.4  # times the particles' standard deviation: a large dot
_LARGE_REACH_PX = 6.0  # a large dot is chosen before a particle that is nearer by less than this
T = TypeVar("T")


@dataclass(frozen=True)
class Videos:
    """Videos that the page may open.

    Args:
        folder: they are below it.
        only: the only one; None: all below the folder.
        out: table of points of the only one; None: a name beside the video.
    """

    folder: Path
    only: Path | None = None
    out: Path | None = None

    def names(self) -> list[str]:
        """Names of the videos, for `path`."""
        if self.only is not None:
            return [str(self.only)]
        return list_videos(self.folder, _MOST_VIDEOS)

    def path(self, name: str) -> Path:
        """Path of a video by its name.

        Raises:
            InputError: it is not one of these videos.
        """
        if self.only is not None and name == str(self.only):
            return self.only
        path = self.folder / name
        try:
            below = path.resolve().is_relative_to(self.folder.resolve())
        except (OSError, ValueError):  # a loop of links, or a zero byte
            below = False
        if self.only is not None or not below:
            raise InputError(
                f"The video {name[:_LONGEST_NAME]!r} is not in the list of this page. "
                "Choose one from the list."
            )
        return path

    def table(self, name: str, file_name: str = "") -> Path:
        """Path of the table of points of a video.

        It is beside the video; for a video of a run, it is beside its folder `video`, whose files
        are sealed.

        Args:
            name: of the video.
            file_name: of the table; empty: `VIDEO-points.csv`.
        Raises:
            InputError: the name of the table is more than a name, or does not end in `.csv`.
        """
        if self.out is not None:
            return self.out
        path = self.path(name)
        stem = path.name if path.is_dir() else path.stem
        file_name = file_name or f"{stem}-points.csv"
        plain = Path(file_name).name == file_name and "\\" not in file_name
        if not plain or not file_name.isprintable() or not file_name.lower().endswith(".csv"):
            raise InputError(
                f"The file is named {file_name[:_LONGEST_NAME]!r}. Use a name that ends in .csv, "
                "without a folder."
            )
        folder = path.parent
        if folder.name == "video" and (folder.parent / MANIFEST).is_file():
            folder = folder.parent
        return folder / file_name


def _value(values: Mapping[str, Any], name: str, kind: type[T]) -> T:
    """A value of a request.

    Raises:
        InputError: it is missing or of another type.
    """
    found = values.get(name)
    if not isinstance(found, kind) or (isinstance(found, bool) and kind is not bool):
        raise InputError(f"The value of {name!r} is not valid. Correct it, or reload this page.")
    return found


def _numbers(found: Any, name: str, count: int) -> list[float]:
    """Finite numbers of a request.

    Raises:
        InputError: there are others, or not as many.
    """
    given = found if isinstance(found, list) else [found]
    if len(given) != count or not all(
        isinstance(one, int | float) and not isinstance(one, bool) and abs(one) < 1e9
        for one in given
    ):
        raise InputError(f"{name} must be {count} finite numbers. Load this page again.")
    return [float(one) for one in given]


def _stamp(path: Path) -> tuple[int, int]:
    try:
        found = path.stat()
    except (OSError, ValueError):
        return 0, 0
    return found.st_mtime_ns, found.st_size


@lru_cache(maxsize=4)
def _frame(path: Path, stamp: tuple[int, int], number: int) -> tuple[Frame, int, float]:
    """A frame, how many there are, and its time in s.

    Raises:
        InputError: the video cannot be read, or has no such frame.
    """
    with open_video(path) as video:
        time_s, frame = video.frame(number)
        return frame, video.frame_count, time_s


class _Searches:
    """Long searches: equal requests share one, and the program may end while one runs."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: dict[Hashable, Future[Any]] = {}

    def result(self, key: Hashable, search: Callable[[], T]) -> T:
        """The result of a search, which is made once for each key.

        The search is in a daemon thread, and its request does not outlive the main thread, so that
        neither keeps the program from ending.

        Raises:
            ResultError: the program ends.
        """
        found = self.begin(key, search)
        while not wait([found], _LOOK_S).done:
            if not threading.main_thread().is_alive():
                raise ResultError("The program has ended.")
        result: T = found.result()
        return result

    def begin(self, key: Hashable, search: Callable[[], T]) -> Future[T]:
        """Begin a search, unless its result is known or it is already running."""
        with self._lock:
            found: Future[T] | None = self._known.pop(key, None)
            if found is None or (found.done() and found.exception() is not None):
                found = Future()
                threading.Thread(target=self._run, args=(found, search), daemon=True).start()
            self._known[key] = found
            while len(self._known) > _MOST_SEARCHES:
                self._known.pop(next(iter(self._known)))
        return found

    @staticmethod
    def _run(found: Future[T], search: Callable[[], T]) -> None:
        try:
            found.set_result(search())
        except BaseException as error:
            found.set_exception(error)


_SEARCHES = _Searches()


def _find_dots(path: Path, stamp: tuple[int, int], number: int) -> tuple[Points, DotProfile]:
    """All dots of a frame, as `haselab track --auto` finds them, and the profile of particles."""
    frame = _frame(path, stamp, number)[0]
    profile = find_profile(frame)
    try:
        return find_points(frame, _ALL_DOTS, None, profile), profile
    except ResultError:
        return Points([], np.zeros((0, 2)), 0), profile


def _dots(path: Path, stamp: tuple[int, int], number: int) -> tuple[Points, DotProfile]:
    """The same, searched once for each frame."""
    return _SEARCHES.result(*_dots_search(path, stamp, number))


def _dots_search(
    path: Path, stamp: tuple[int, int], number: int
) -> tuple[Hashable, Callable[[], tuple[Points, DotProfile]]]:
    """Key and search of the dots of a frame, for `_SEARCHES`."""
    key = (path, stamp, number)
    return key, lambda: _find_dots(*key)


def _large_dot(
    frame: Frame, profile: DotProfile, place_px: Floats, reach_px: float
) -> Floats | None:
    """The nearest dot within reach that is too large to be a particle.

    `find_points` locates its centre at the scale of the particles, with an error of up to a pixel
    on a dot that is several times as large.
    """
    found = [
        detect_dot_near(
            frame, place_px, reach_px=reach_px, least_sigma_px=_LARGE * profile.sigma_px,
            polarity=polarity,
        )
        for polarity in sorted({profile.polarity, "dark"})
    ]  # fmt: skip
    near = [centre for centre in found if centre is not None]
    return min(near, key=lambda centre: float(np.hypot(*(centre - place_px))), default=None)


def _of(videos: Videos, values: JsonObject) -> tuple[str, Path, tuple[int, int], int]:
    """Name, path, stamp and frame number of a request."""
    name = _value(values, "video", str)
    path = videos.path(name)
    return name, path, _stamp(path), _value(values, "frame", int)


def _list(videos: Videos, values: JsonObject) -> JsonObject:
    """The videos to choose from."""
    names = videos.names()
    return {
        "videos": names,
        "more": len(names) >= _MOST_VIDEOS,
        "folder": str(videos.folder),
        "only": videos.only is not None,
    }


def _picture(videos: Videos, values: JsonObject) -> JsonObject:
    """A frame as a picture."""
    name, path, stamp, number = _of(videos, values)
    frame, count, time_s = _frame(path, stamp, number)
    if videos.only is not None and number == 0:  # the user will pick points in this frame
        _SEARCHES.begin(*_dots_search(path, stamp, number))
    low, high = grey_range(frame)
    grey = np.clip((frame - low) * (255.0 / (high - low)), 0, 255).astype(np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(grey).save(buffer, "png", compress_level=1)
    data = base64.b64encode(buffer.getvalue()).decode()
    return {
        "picture": f"data:image/png;base64,{data}",
        "width": frame.shape[1],
        "height": frame.shape[0],
        "frames": count,
        "time_s": None if math.isnan(time_s) else time_s,
        "table": videos.table(name).name if videos.only is None else str(videos.table(name)),
    }


def _snap(videos: Videos, values: JsonObject) -> JsonObject:
    """The dot nearest to a click; the click if there is none within reach."""
    _, path, stamp, number = _of(videos, values)
    (x, y) = _numbers(values.get("place"), "place", 2)
    (reach,) = _numbers(values.get("reach"), "reach", 1)
    (dots, profile), place = _dots(path, stamp, number), np.array([x, y])
    away = np.hypot(*(dots.place_px - place).T)
    nearest = int(np.argmin(away)) if away.size else -1
    large = None
    if not dots.gauge:  # the dots of clamps have their centres already
        large = _large_dot(_frame(path, stamp, number)[0], profile, place, reach)
    least = away[nearest] if away.size else np.inf
    if large is not None and np.hypot(*(large - place)) < least + _LARGE_REACH_PX:
        return {"place": large.tolist(), "snapped": True, "name": ""}
    if least > reach:
        return {"place": [x, y], "snapped": False, "name": ""}
    name = dots.names[nearest]
    return {
        "place": dots.place_px[nearest].tolist(),
        "snapped": True,
        "name": name if name.startswith(("upper", "lower")) else "",
    }


def _region(videos: Videos, values: JsonObject) -> JsonObject:
    """The points that `haselab track --auto` finds in a region of a frame."""
    _, path, stamp, number = _of(videos, values)
    corners = np.array(_numbers(values.get("corners"), "corners", 4)).reshape(2, 2)
    count = _value(values, "count", int)
    if not 1 <= count <= _MOST_POINTS:
        raise InputError(f"The number of points is {count}. Use 1 to {_MOST_POINTS}.")
    frame = _frame(path, stamp, number)[0]
    last = np.array(frame.shape[::-1]) - 1
    low = np.clip(np.ceil(corners.min(axis=0)), 0, last + 1).astype(int)
    high = np.clip(np.floor(corners.max(axis=0)), -1, last).astype(int)
    size = high - low + 1
    if size.min() < 16:
        raise InputError(
            f"The region is {max(size[0], 0)} x {max(size[1], 0)} px. Draw one of at least "
            "16 x 16 px inside the picture."
        )
    part = frame[low[1] : high[1] + 1, low[0] : high[0] + 1]
    key = (path, stamp, number, *low.tolist(), *high.tolist(), count)
    found = _SEARCHES.result(key, lambda: find_points(part, count, None))
    places = (found.place_px + low).tolist()
    return {
        "points": [[name, *place] for name, place in zip(found.names, places, strict=True)],
        "why": list(found.why),
    }


def _ruler(values: JsonObject) -> str:
    """The ruler as `--scale-points` takes it; empty if there is none."""
    if values.get("ruler") is None:
        return ""
    *ends, length = _numbers(values["ruler"], "ruler", 5)
    return ",".join([*(f"{each:.2f}" for each in ends), f"{length:g}"])


def _scale(videos: Videos, values: JsonObject) -> JsonObject:
    """The scale that a ruler gives."""
    options = ScaleOptions(None, _ruler(values) or None, None, None, None)
    found = scale_of(options, np.zeros((1, 1), np.uint8), None)
    return {"scale_mm_per_px": None if found is None else found.scaled(1e3, "mm/px")}


def _save(videos: Videos, values: JsonObject) -> JsonObject:
    """Write the table of points, and say how it is used."""
    name, path, stamp, _ = _of(videos, {**values, "frame": 0})
    listed = _value(values, "points", list)
    if len(listed) > _MOST_POINTS:
        raise InputError(f"There are {len(listed)} points. Use at most {_MOST_POINTS}.")
    rows = [row if isinstance(row, list) and len(row) == 3 else ["", None] for row in listed]
    names = [row[0].strip() if isinstance(row[0], str) else "" for row in rows]
    place = [_numbers(row[1:], "The position of a point", 2) for row in rows]
    frame = _frame(path, stamp, 0)[0]
    dots, _ = _dots(path, stamp, 0)
    points = Points(names, np.array(place).reshape(-1, 2), dots.subset_px or 15)
    table = videos.table(name, str(values.get("table") or ""))
    text = points_table(points, frame, table)
    scale = _scale(videos, values)
    refused = InputError(
        f"This file exists already; it was not changed: {table}. Type another name, or tick 'Move "
        "an existing file to NAME.previous-1'."
    )
    if is_occupied(table):
        if values.get("move") is not True:
            raise refused
        move_aside(table)
    try:
        write_new(table, text)
    except InputError:
        if is_occupied(table):  # another page has just saved it
            raise refused from None
        raise
    lost = _lost(path, stamp, points, frame)
    ruler = _ruler(values)
    words = ["haselab", "track", str(path), "--points", str(table)]
    words += ["--subset-px", str(points.subset_px)]
    words += ["--scale-points", ruler] if ruler else []
    words += ["--out", str(table.with_name(f"{table.stem.removesuffix('-points')}-tracks.csv"))]
    command = shlex.join(words)
    return {"path": str(table), "points": len(names), "command": command, "lost": lost, **scale}


def _lost(path: Path, stamp: tuple[int, int], points: Points, frame: Frame) -> list[str]:
    """Names of the points that are lost in the next frame, such as those on noise alone."""
    try:
        following = _frame(path, stamp, 1)[0]
    except InputError:  # there is but one frame
        return []
    tracker = PointTracker(points.place_px, TrackOptions(subset_px=points.subset_px))
    _, found = tracker.step(tracker.init([frame]), following)
    return [name for name, valid in zip(points.names, found.valid, strict=True) if not valid]


PICK_REQUESTS: Mapping[str, Callable[[Videos, JsonObject], JsonObject]] = {
    "pick-videos": _list,
    "pick-frame": _picture,
    "pick-snap": _snap,
    "pick-region": _region,
    "pick-scale": _scale,
    "pick-save": _save,
}
"""By name: called in a thread of a web server."""
