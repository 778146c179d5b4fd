"""Video in: whatever FFmpeg reads, image folders, TIFF stacks, `.cine`, `.mraw`."""

from __future__ import annotations

from pathlib import Path

from haselab.store.video.cine import CineReader
from haselab.store.video.container import ContainerReader
from haselab.store.video.mraw import MrawReader
from haselab.store.video.reader import VideoReader, broken
from haselab.store.video.stills import TIFF, FolderReader, TiffReader

__all__ = ["VideoReader", "open_video"]


def open_video(path: Path | str) -> VideoReader:
    """Open a video, a folder of images (in natural name order), a TIFF stack, `.cine` or `.mraw`.

    Grey levels are as stored: plane 0 (luma) of YUV and grey video, in whichever range, limited
    or full, the file carries, never stretched. A constant stretch does not move a point. Colour
    coded as RGB is converted to luma (ITU-R BT.601 weights, full range). `levels` states which.

    Args:
        path: of the file or folder.

    Returns:
        A reader; use it in a `with` statement.

    Raises:
        InputError: no such file, or it cannot be read.

    Example:
        >>> import tempfile, numpy as np, tifffile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = Path(folder) / "stack.tif"
        ...     tifffile.imwrite(path, np.zeros((3, 4, 5), np.uint8), photometric="minisblack")
        ...     with open_video(path) as video:
        ...         [frame.shape for frame in video]
        [(4, 5), (4, 5), (4, 5)]
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if path.is_dir():
        return FolderReader(path)
    if not path.is_file():
        raise broken("There is no such video file or folder of images", "Check the name.", path)
    if path.stat().st_size == 0:
        raise broken("The video file is empty", "Record or copy it again.", path)
    try:
        path.open("rb").close()
    except OSError as error:
        raise broken(
            f"The video cannot be read ({error.strerror})", "Check its permissions.", path
        ) from None
    if suffix == ".cine":
        return CineReader(path)
    if suffix in (".cih", ".cihx"):
        raise broken(
            f"{path.name} is the header of a Photron recording, not its frames",
            f"Give the frames: {path.with_suffix('.mraw').name}.",
            path,
        )
    if suffix == ".mraw":
        return MrawReader(path)
    return TiffReader(path) if suffix in TIFF else ContainerReader(path)
