r"""Fixed-pattern noise: offsets that stay with the pixels while the scene moves.

Matching treats them as static texture, which biases slow points. In the mean
$R = f + p$ of the rest frames, only white $p$ contributes to the highest spatial frequencies,
which no lens transmits; its variance there, minus the camera's noise, is $\sigma_p^2$. With it,
the scene $f$ is the denoised $R$, and $R - f$ is subtracted from all frames. Whether the
pattern belongs to the sensor or is fine texture of the scene is decided after the points moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn

from haselab.tracking.options import Floats, Frame

__all__ = ["FixedPattern", "find_pattern", "stays_with_pixels"]

_CORNER = 0.75  # of the highest frequency along each axis; a dot of 1 px deviation has 1e-4 there
_MOST_SIDE = 1024  # px of a frame that are used
_LEAST_SHARE = 0.25  # of the noise's variance; below, the pattern is negligible
_LEAST_VARIANCE = 0.25  # grey levels squared; rounding of a frame without noise has 1/12
_BLOCK, _STEP = 8, 2  # px, side and spacing of the denoised blocks
_CUT = 2.7  # standard deviations below which a coefficient is noise
_STAYS = 0.25  # of the pattern's contrast: more means that it stays


@dataclass(frozen=True)
class FixedPattern:
    """Fixed-pattern noise of a sensor.

    Args:
        levels: offset of each pixel. Shape `(H, W)`.
        variance: of the offsets, in grey levels squared.
        scale: grey levels of a corrected frame per grey level of the camera.
    """

    levels: NDArray[np.float32]
    variance: float
    scale: int

    def removed(self, frame: Frame) -> NDArray[np.uint16]:
        """The frame with the pattern subtracted."""
        clean = np.float32(self.scale) * (frame - self.levels)
        most = min(self.scale * int(np.iinfo(frame.dtype).max), 65535)
        return np.asarray(np.clip(np.rint(clean), 0, most), np.uint16)


def _middle(image: Floats) -> Floats:
    cut = tuple(
        slice((size - min(size, _MOST_SIDE)) // 2, (size + min(size, _MOST_SIDE)) // 2)
        for size in image.shape
    )
    return image[cut]


def _corner_variance(image: Floats) -> float:
    """Variance of the white noise in an image, from its highest frequencies along both axes."""
    power = dctn(_middle(image), norm="ortho") ** 2
    first = [int(_CORNER * size) for size in power.shape]
    return float(power[first[0] :, first[1] :].mean())


def find_pattern(rest_frames: Sequence[Frame]) -> FixedPattern | None:
    """Find the fixed pattern in rest frames, if it is relevant.

    Args:
        rest_frames: two or more frames `(H, W)`, without motion.

    Returns:
        The pattern; `None` where it is hidden by noise, or stronger than the scene.

    Source: Dabov et al. 2007 (hard threshold, then Wiener filter; here without matching of blocks).
    """
    if len(rest_frames) < 2 or min(rest_frames[0].shape) < 4 * _BLOCK:
        return None
    mean = np.mean(rest_frames, axis=0, dtype=float)
    difference = rest_frames[0].astype(float) - rest_frames[-1]
    noise = 0.5 * _corner_variance(difference)
    white = _corner_variance(mean)
    variance = white - noise / len(rest_frames)
    if variance < max(_LEAST_SHARE * noise, _LEAST_VARIANCE):
        return None
    scene = _denoised(mean, white, None)
    scene = _denoised(mean, white, scene)
    scale = 4 if rest_frames[0].dtype == np.uint8 else 1
    return FixedPattern((mean - scene).astype(np.float32), variance, scale)


def _denoised(image: Floats, variance: float, guide: Floats | None) -> Floats:
    """Average over overlapping blocks with thresholded, or Wiener-weighted, coefficients."""
    edge = _BLOCK + _STEP
    padded = np.pad(image, edge, mode="reflect")
    known = None if guide is None else np.pad(guide, edge, mode="reflect")
    total, weights = np.zeros_like(padded), np.zeros_like(padded)
    phases = _BLOCK // _STEP
    for top in range(0, padded.shape[0] - _BLOCK + 1, _STEP):
        rows = slice(top, top + _BLOCK)
        coefficients = _spectra(padded[rows])
        if known is None:
            kept = (coefficients**2 > _CUT**2 * variance).astype(float)
        else:
            power = _spectra(known[rows]) ** 2
            kept = power / (power + variance)
        kept[:, 0, 0] = 1.0
        weight = 1.0 / (kept**2).sum(axis=(1, 2))
        blocks = weight[:, None, None] * idctn(coefficients * kept, axes=(1, 2), norm="ortho")
        for phase in range(phases):  # blocks of one phase do not overlap
            part = blocks[phase::phases].transpose(1, 0, 2).reshape(_BLOCK, -1)
            columns = slice(phase * _STEP, phase * _STEP + part.shape[1])
            total[rows, columns] += part
            weights[rows, columns] += np.repeat(weight[phase::phases], _BLOCK)
    inside = np.s_[edge:-edge, edge:-edge]
    return total[inside] / weights[inside]


def _spectra(strip: Floats) -> Floats:
    """Cosine spectra of the blocks of a strip. Shape `(N, B, B)`."""
    blocks = np.lib.stride_tricks.sliding_window_view(strip, _BLOCK, axis=1)[:, ::_STEP]
    return np.asarray(dctn(blocks.transpose(1, 0, 2), axes=(1, 2), norm="ortho"))


def stays_with_pixels(
    pattern: FixedPattern, frame: Frame, rest_px: Floats, now_px: Floats, side: int
) -> bool:
    """Whether the pattern stays at the rest positions, rather than moving with the points.

    Args:
        pattern: pattern found at rest.
        frame: the frame, as recorded.
        rest_px, now_px: points that have moved, in px. Shape `(P, 2)`.
        side: of the square around a point that is compared, in px.
    """
    half = side // 2
    last = np.array(frame.shape[::-1]) - 1 - half
    rest, now = np.rint(rest_px).astype(int), np.rint(now_px).astype(int)
    both = np.hstack([rest, now])
    inside = ((both >= half) & (both <= np.tile(last, 2))).all(axis=1)
    offset = np.arange(-half, half + 1)

    def squares(image: NDArray[np.float32] | Frame, centres: NDArray[np.intp]) -> Floats:
        x, y = centres[inside].T
        rows, columns = y[:, None, None] + offset[:, None], x[:, None, None] + offset
        found = image[rows, columns].astype(float)
        return np.asarray(found - found.mean(axis=(1, 2), keepdims=True))

    known = squares(pattern.levels, rest)
    power = float((known**2).sum())
    fixed, moved = (float((known * squares(frame, at)).sum()) for at in (rest, now))
    return fixed > _STAYS * power and fixed > moved
