"""Write raw frames in real time, and convert them to lossless video after the run."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, InputError
from haselab.store.claim import not_written
from haselab.store.video.writer import VideoWriter, frame_hash

__all__ = ["RawVideoWriter", "transcode", "waiting_videos"]

_BATCH = 16  # frames


def _failed(error: OSError, path: Path) -> DeviceError:
    return not_written(path, error, "The video cannot be written")


class RawVideoWriter:
    """Writes raw 8-bit frames as fast as the disk allows; a sudden end loses none of them.

    `NAME.raw.json` has the size of the frames of `NAME.raw`, and `NAME.raw.csv` the time and the
    hash of each. `transcode` converts them to NAME.mkv later.

    Args:
        path: of the final video, `.mkv`.
        rate_hz: nominal frame rate, for players.
    Raises:
        DeviceError: the disk refuses.
    """

    def __init__(self, path: Path, rate_hz: float) -> None:
        self._path = path.with_suffix(".raw")
        self._rate_hz = rate_hz
        self._count = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            for old in (path, path.with_suffix(".csv")):
                old.unlink(missing_ok=True)
            self._frames = self._path.open("wb", buffering=0)
            self._table = self._path.with_suffix(".raw.csv").open("w", encoding="utf-8")
            self._table.write("frame,time_s,hash\n")
        except OSError as error:
            raise _failed(error, self._path) from None

    @property
    def recorded(self) -> Path | None:
        """The raw frames, for `transcode`; None: there are none so far."""
        return self._path if self._count else None

    def append(self, images: NDArray[np.uint8], time_s: NDArray[np.float64]) -> None:
        """Add frames `(F, H, W)` with the middle of their exposures `(F,)`.

        Raises:
            DeviceError: the disk refuses.
        """
        if not len(images):
            return
        try:
            if self._count == 0:
                height, width = images.shape[1:]
                size = {"height": height, "width": width, "rate_hz": self._rate_hz}
                self._path.with_suffix(".raw.json").write_text(json.dumps(size) + "\n")
            data = np.ascontiguousarray(images).reshape(-1).data
            while data:
                data = data[self._frames.write(data) :]
            for image, time in zip(images, time_s, strict=True):
                self._table.write(f"{self._count},{float(time)!r},{frame_hash(image)}\n")
                self._count += 1
            self._table.flush()
        except OSError as error:
            raise _failed(error, self._path) from None

    def close(self) -> None:
        """Close the files; remove them if there is no frame. Safe to call twice.

        Raises:
            DeviceError: the disk refuses.
        """
        try:
            self._frames.close()
            self._table.close()
            if self._count == 0:
                for suffix in (".raw", ".raw.csv"):
                    self._path.with_suffix(suffix).unlink(missing_ok=True)
        except OSError as error:
            raise _failed(error, self._path) from None


def waiting_videos(folder: Path) -> list[Path]:
    """Raw frames that are not yet converted to videos, also those of a killed run."""
    return sorted(path for path in folder.glob("*.raw") if path.with_suffix(".raw.json").is_file())


def transcode(raw: Path) -> Path:
    """Convert raw frames to a lossless video, compare every hash, then delete the raw frames.

    Args:
        raw: a file of `waiting_videos`.
    Returns:
        The video, FFV1 in Matroska, beside a table with time and hash of each frame. It does not
        exist if no frame was complete.
    Raises:
        InputError: the raw frames are not those that were recorded.
        DeviceError: the disk refuses, or the video does not give the frames back.
    """
    size = json.loads(raw.with_suffix(".raw.json").read_text(encoding="utf-8"))
    times_s, hashes = _table(raw.with_suffix(".raw.csv"))
    shape = (size["height"], size["width"])
    count = min(len(hashes), raw.stat().st_size // (shape[0] * shape[1]))
    video = raw.with_suffix(".mkv")
    if not count:  # killed within the first frame
        _drop(raw)
        return video
    writer = VideoWriter(video, size["rate_hz"])
    try:
        for first in range(0, count, _BATCH):
            last = min(first + _BATCH, count)
            images = np.fromfile(raw, np.uint8, (last - first) * shape[0] * shape[1],
                                 offset=first * shape[0] * shape[1])  # fmt: skip
            images = images.reshape(last - first, *shape)
            for k, image in enumerate(images, first):
                if frame_hash(image) != hashes[k]:
                    raise InputError(
                        f"Raw frame {k} is damaged: its hash does not match. Copy it again. {raw}"
                    )
            writer.append(images, times_s[first:last])
    finally:
        writer.close()
    found = [frame_hash(image) for image in _decoded(video)]
    if found != hashes[:count]:
        raise DeviceError(
            f"The video differs from the recorded frames, so these are kept. Try again on another "
            f"disk. {video}"
        )
    rows = [f"{k},{float(times_s[k])!r},{hashes[k]}" for k in range(count)]
    video.with_suffix(".csv").write_text("\n".join(["frame,time_s,hash", *rows]) + "\n")
    _drop(raw)
    return video


def _drop(raw: Path) -> None:
    for suffix in (".raw", ".raw.csv", ".raw.json"):
        raw.with_suffix(suffix).unlink()


def _table(path: Path) -> tuple[NDArray[np.float64], list[str]]:
    """Times and hashes; a last row that was cut does not count."""
    lines = path.read_text(encoding="utf-8").split("\n")[1:-1]
    cells = [line.split(",") for line in lines]
    return np.array([float(row[1]) for row in cells]), [row[2] for row in cells]


def _decoded(path: Path) -> Iterator[NDArray[Any]]:
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            yield frame.to_ndarray(format="gray")
