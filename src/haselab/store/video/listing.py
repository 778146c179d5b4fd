"""Find the videos below a folder."""

from __future__ import annotations

import os
from pathlib import Path

from haselab.store.video.stills import IMAGES, TIFF, natural_order

__all__ = ["list_videos"]

_VIDEOS = frozenset(
    (
        *(".mkv", ".avi", ".mp4", ".mov", ".m4v", ".webm", ".mpg", ".mpeg", ".wmv", ".mxf"),
        *(".cine", ".mraw", *TIFF),
    )
)
_FEWEST_IMAGES = 2


def list_videos(folder: Path, most: int) -> list[str]:
    """List what `open_video` can read below a folder, by its name.

    These are files with the ending of a video, and folders of images. Links and hidden files are
    left out.

    Args:
        folder: to search; it need not exist.
        most: number of names after which the search ends.

    Returns:
        Paths in the folder with `/`, in natural order.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as place:
        ...     for name in ("run-10.mkv", "run-9.mkv", "notes.txt"):
        ...         (Path(place) / name).touch()
        ...     list_videos(Path(place), most=100)
        ['run-9.mkv', 'run-10.mkv']
    """
    found: list[str] = []
    for place, folders, files in os.walk(folder):
        here = Path(place)
        folders[:] = [name for name in folders if not name.startswith(".")]
        plain = [name for name in files if not (name.startswith(".") or (here / name).is_symlink())]
        images = [name for name in plain if Path(name).suffix.lower() in IMAGES]
        if len(images) >= _FEWEST_IMAGES and here != folder:
            found.append(here.relative_to(folder).as_posix())
            plain = [name for name in plain if name not in images]
        found += [
            (here / name).relative_to(folder).as_posix()
            for name in plain
            if Path(name).suffix.lower() in _VIDEOS
        ]
        if len(found) >= most:
            break
    return sorted(found[:most], key=natural_order)
