"""Write camera frames to a lossless video, exact to the grey level."""

from __future__ import annotations

import hashlib
from concurrent.futures import Future, ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path
from typing import cast

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from haselab.base import DeviceError
from haselab.store.claim import not_written

__all__ = ["VideoWriter", "frame_hash", "write_png"]

_CODECS = {
    ".mkv": ("ffv1", {"level": "3", "slices": "4", "context": "0"}),
    ".avi": ("magicyuv", {"pred": "median"}),
}
_MOST_JOBS = 8  # batches that may wait for the encoder


def frame_hash(image: NDArray[np.uint8]) -> str:
    """BLAKE2b of 128 bits over the grey levels, row by row.

    Args:
        image: shape `(H, W)`.
    Example:
        >>> frame_hash(np.zeros((2, 2), np.uint8))
        '11d2df4e979aa105cf552e9544ebd2b5'
    """
    return hashlib.blake2b(np.ascontiguousarray(image).data, digest_size=16).hexdigest()


def write_png(path: Path, image: NDArray[np.uint8]) -> None:
    """Write one grey picture, shape `(H, W)`.

    Raises:
        DeviceError: the disk refuses.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(image).save(path)
    except OSError as error:
        raise not_written(path, error, "The picture cannot be written") from None


class VideoWriter:
    """Writes 8-bit frames in the background, and their times to a CSV file beside the video.

    Args:
        path: of the new file: `.mkv` for FFV1, the standard for archives, or `.avi` for MagicYUV,
            which takes a seventh of the time and a tenth more space (ADR 18).
        rate_hz: nominal frame rate, for players.
        hashed: also write the hash of each frame to the table.
    Raises:
        DeviceError: the disk refuses.
    """

    def __init__(self, path: Path, rate_hz: float, *, hashed: bool = False) -> None:
        self._path = path
        self._hashed = hashed
        self._times_s: list[float] = []
        self._hashes: list[str] = []
        self._jobs: list[Future[None]] = []
        self._encoder = ThreadPoolExecutor(1)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.with_suffix(".csv").unlink(missing_ok=True)  # the times of an older video
            self._container = av.open(str(path), "w")
        except OSError as error:
            raise self._failed(error) from None
        codec, options = _CODECS[path.suffix]
        stream = self._container.add_stream(codec, rate=Fraction(rate_hz).limit_denominator())
        self._stream = cast(av.VideoStream, stream)
        self._stream.pix_fmt = "gray"
        self._stream.options = {**options}

    def _failed(self, error: OSError) -> DeviceError:
        return not_written(self._path, error, "The video cannot be written")

    def append(self, images: NDArray[np.uint8], time_s: NDArray[np.float64]) -> None:
        """Add frames `(F, H, W)` with the middle of their exposures `(F,)`.

        Raises:
            DeviceError: an earlier frame could not be written.
        """
        while self._jobs and (self._jobs[0].done() or len(self._jobs) > _MOST_JOBS):
            self._wait(self._jobs.pop(0))
        if len(images):
            self._jobs.append(self._encoder.submit(self._encode, images, time_s))

    def _encode(self, images: NDArray[np.uint8], time_s: NDArray[np.float64]) -> None:
        if not self._times_s:
            self._stream.height, self._stream.width = images.shape[1:]
        for image, time in zip(images, time_s, strict=True):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="gray")
            frame.pts = len(self._times_s)
            self._container.mux(self._stream.encode(frame))
            self._times_s.append(float(time))
            if self._hashed:
                self._hashes.append(frame_hash(image))

    def _wait(self, job: Future[None]) -> None:
        try:
            job.result()
        except OSError as error:
            raise self._failed(error) from None

    def close(self) -> None:
        """Finish the file and write the table of times.

        A file without any frame is removed.

        Raises:
            DeviceError: a frame or the table could not be written.
        """
        try:
            self._finish()
        except OSError as error:
            raise self._failed(error) from None
        if not self._times_s:
            self._path.unlink(missing_ok=True)

    def _finish(self) -> None:
        try:
            for job in self._jobs:
                job.result()
            if self._times_s:
                self._container.mux(self._stream.encode())
                head = "frame,time_s" + ",hash" * self._hashed
                hashes = [f",{text}" for text in self._hashes] or [""] * len(self._times_s)
                pairs = zip(self._times_s, hashes, strict=True)
                rows = [f"{k},{time!r}{text}" for k, (time, text) in enumerate(pairs)]
                table = "\n".join([head, *rows]) + "\n"
                self._path.with_suffix(".csv").write_text(table)
        finally:
            self._jobs = []
            self._encoder.shutdown(cancel_futures=True)
            self._container.close()
