"""Frames of the twin's camera, which are drawn when they are needed.

Most frames of a study are tracked and not kept, and a tracker reads a small part of each. A pixel
has the same value whichever part of the frame is drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from haselab.rig import Frames
from haselab.rig.protocols import ImagePart, PartialImage
from haselab.rig.twin.camera import TwinCamera

__all__ = ["DrawnFrames"]

Floats = NDArray[np.float64]
Images = NDArray[np.uint8]


class DrawnFrames(Frames):
    """See `haselab.rig.Frames`.

    Args:
        camera: that draws them.
        draw: draws images of some lengths, from a number of the recording on.
        lengths_m: within the limits of the camera. Shape `(frames, samples)`.
        first: number of the first frame in the recording.
        time_s: shape `(frames,)`.
    """

    def __init__(
        self,
        camera: TwinCamera,
        draw: Callable[[Floats, int], Images],
        lengths_m: Floats,
        first: int,
        time_s: Floats,
    ) -> None:
        self._camera, self._draw = camera, draw
        self._lengths_m, self._first = lengths_m, first
        self._drawn: Images | None = None
        self.time_s = time_s
        self.shape_px = (camera.config.height_px, camera.config.width_px)

    @property
    def images(self) -> Images:
        """See `haselab.rig.Frames`."""
        if self._drawn is None:
            self._drawn = self._draw(self._lengths_m, self._first)
        return self._drawn

    def image(self, index: int) -> Images:
        """See `haselab.rig.Frames`."""
        return self.images[index] if self._drawn is not None else self.drawn(index, None)

    def view(self, index: int) -> Images | PartialImage:
        """See `haselab.rig.Frames`."""
        return self.images[index] if self._drawn is not None else _PartialImage(self, index)

    def drawn(self, index: int, part: ImagePart | None, on: Images | None = None) -> Images:
        """Draw one image, or a part of it on another one."""
        lengths_m = self._lengths_m[index : index + 1]
        out = None if on is None else on[np.newaxis]
        return np.asarray(self._camera.render(lengths_m, self._first + index, out, part)[0])


class _PartialImage:
    """Implements `PartialImage`."""

    def __init__(self, frames: DrawnFrames, index: int) -> None:
        self._frames, self._index = frames, index

    def whole(self) -> Images:
        """See `PartialImage`."""
        return self._frames.image(self._index)

    def with_parts(self, parts: Sequence[ImagePart]) -> Images:
        """See `PartialImage`."""
        image = np.empty(self._frames.shape_px, dtype=np.uint8)
        for part in parts:
            self._frames.drawn(self._index, part, image)
        return image
