"""Tell failures in packages that extend haselab from those in haselab itself."""

from __future__ import annotations

import importlib.metadata
import sys
import threading
import traceback
from dataclasses import dataclass
from types import FrameType

__all__ = ["ForeignFailure", "foreign_failure", "packages_of_threads"]

_OWN = __name__.partition(".")[0]


@dataclass(frozen=True)
class ForeignFailure:
    """Where another package failed.

    Args:
        place: class and method, or function.
        package: that can be imported.
        groups: of its entry points, such as "haselab.actuators".
    """

    place: str
    package: str
    groups: frozenset[str]


def foreign_failure(error: BaseException) -> ForeignFailure | None:
    """Find the package whose code raised an error, or passed wrong values to a library.

    Args:
        error: as it was caught.
    Returns:
        The package; None for code of haselab, and if no package of an extension point is involved.
    """
    extensions = _extensions()
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    for frame in reversed(frames):
        package = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if package in extensions:
            return ForeignFailure(_place(frame), package, frozenset(extensions[package]))
        if package == _OWN:
            return None
    return None


def packages_of_threads() -> list[str]:
    """Find the packages of extension points whose threads keep this program from ending.

    Returns:
        Names, in alphabetical order; none if only daemon threads and those of haselab run.
    """
    main = threading.main_thread()
    lasting = [one for one in threading.enumerate() if one is not main and not one.daemon]
    if not lasting:
        return []
    extensions, frames = _extensions(), sys._current_frames()
    found: set[str] = set()
    for thread in lasting:
        frame = frames.get(thread.ident or 0)
        while frame is not None:
            found.add(str(frame.f_globals.get("__name__", "")).partition(".")[0])
            frame = frame.f_back
    return sorted(found & set(extensions))


def _extensions() -> dict[str, set[str]]:
    """Groups of entry points of haselab, by the package that has objects in them."""
    found: dict[str, set[str]] = {}
    points = (each for one in importlib.metadata.distributions() for each in one.entry_points)
    for point in points:
        package = point.value.partition(":")[0].partition(".")[0]
        if point.group.startswith(f"{_OWN}.") and package != _OWN:
            found.setdefault(package, set()).add(point.group)
    return found


def _place(frame: FrameType) -> str:
    name, owner = frame.f_code.co_name, frame.f_locals.get("self")
    return name if owner is None else f"{type(owner).__qualname__}.{name}"
