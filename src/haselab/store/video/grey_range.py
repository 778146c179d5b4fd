"""Grey levels of a picture that a frame is shown in."""

from __future__ import annotations

import numpy as np

from haselab.store.video.reader import Frame

__all__ = ["grey_range"]


def grey_range(frame: Frame) -> tuple[float, float]:
    """Grey levels that become black and white in a picture of this frame.

    Args:
        frame: uint8 or uint16. Shape `(H, W)`.
    Returns:
        Both levels; one grey level lies between them at least.
    """
    low, high = np.percentile(frame[::4, ::4], (0.5, 99.5))
    return float(low), float(max(high, low + 1.0))
