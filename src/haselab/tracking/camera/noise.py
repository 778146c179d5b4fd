"""The camera's noise law: variance of a pixel as an affine function of its grey level."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from haselab.base import InputError
from haselab.tracking.options import Floats, Frame

__all__ = ["NoiseLaw", "measure_noise"]

_ROUNDING_VARIANCE = 1.0 / 12.0
_MOST_SAMPLES = 200_000
_BINS = 32


@dataclass(frozen=True)
class NoiseLaw:
    r"""Variance of one pixel, $\sigma^2(g) = a + b\,g$.

    Args:
        floor: $a$, in grey levels squared (read noise and rounding).
        slope: $b$, in grey levels (shot noise: grey levels per electron).

    Example:
        >>> float(NoiseLaw(1.0, 0.02).variance(100.0))
        3.0
    """

    floor: float
    slope: float

    def variance(self, grey: float | Floats) -> Floats:
        """Variance at grey level `grey`, in grey levels squared, at least that of rounding."""
        return np.maximum(self.floor + self.slope * np.asarray(grey, float), _ROUNDING_VARIANCE)


def _bin_medians(grey: Floats, squares: Floats) -> tuple[Floats, Floats, Floats]:
    """Mean grey, mean variance and count of equal-population grey bins, outliers cut."""
    order = np.argsort(grey, kind="stable")
    levels, variances, counts = [], [], []
    for part in np.array_split(order, _BINS):
        values = squares[part]
        scale = values.mean()
        for _ in range(4):  # cut at 4 sigma: pixels that changed between the two frames
            values = values[values <= 16.0 * scale]
            if not values.size:
                break
            scale = values.mean()
        if values.size:
            levels.append(grey[part].mean())
            variances.append(scale)
            counts.append(values.size)
    return np.array(levels), np.array(variances), np.array(counts, float)


def measure_noise(rest_frames: Sequence[Frame]) -> NoiseLaw:
    r"""Measure the noise law from frames of a static scene.

    Half the mean square difference of consecutive frames, in bins of grey level, fitted by
    $a + b\,g$ with weights $n / \sigma^4$. Pixels at either end of the range are excluded, as are
    differences beyond 4 standard deviations (motion). Each frame is first scaled to the
    mean brightness of all, so that a flickering lamp does not count as noise.

    Args:
        rest_frames: at least two frames of one shape `(H, W)`, uint8 or uint16, without motion.

    Returns:
        The law; its slope and floor are never negative.

    Raises:
        InputError: fewer than two frames, or too few pixels inside the range.

    Source: EMVA Standard 1288, the photon transfer method.

    Example:
        >>> rng = np.random.default_rng(1)
        >>> scene = np.tile(np.linspace(20, 230, 256), (128, 1))
        >>> noisy = lambda: np.rint(scene + rng.normal(0, np.sqrt(1 + 0.02 * scene)))
        >>> law = measure_noise([noisy().astype(np.uint8) for _ in range(4)])
        >>> abs(float(law.variance(100.0)) - 3.0 - 1 / 12) < 0.1
        True
    """
    if len(rest_frames) < 2:
        raise InputError(
            f"The noise law needs at least 2 rest frames, not {len(rest_frames)}. Record 10 or "
            "more."
        )
    top = float(np.iinfo(rest_frames[0].dtype).max)
    step = max(1, rest_frames[0].size * (len(rest_frames) - 1) // _MOST_SAMPLES)
    stack = [frame.reshape(-1)[::step].astype(float) for frame in rest_frames]
    mean = np.mean(stack, axis=0)
    inside = (np.min(stack, axis=0) > 0) & (np.max(stack, axis=0) < top)
    if inside.sum() < 10 * _BINS:
        raise InputError(
            f"Only {int(inside.sum())} sampled pixels are inside the camera's range; at least "
            f"{10 * _BINS} are required. Change the exposure."
        )
    whole = float(mean[inside].mean())
    steady = [frame[inside] * (whole / frame[inside].mean()) for frame in stack]
    pairs = [0.5 * (b - a) ** 2 for a, b in pairwise(steady)]
    grey, variance, count = _bin_medians(np.tile(mean[inside], len(pairs)), np.concatenate(pairs))
    weight = np.sqrt(count) / np.maximum(variance, _ROUNDING_VARIANCE)
    design = np.stack([np.ones_like(grey), grey], axis=1)
    floor, slope = np.linalg.lstsq(design * weight[:, None], variance * weight, rcond=None)[0]
    if slope < 0.0 or np.ptp(grey) < 1.0:
        floor, slope = np.average(variance, weights=weight**2), 0.0
    elif floor < 0.0:
        floor, slope = 0.0, np.average(variance / np.maximum(grey, 1.0), weights=weight**2)
    return NoiseLaw(float(floor), float(slope))
