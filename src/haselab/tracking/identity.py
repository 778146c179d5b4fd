"""Identification of points: joint motion of all points, and whether it is unique.

Dots look alike, so a match gives a position but not its identity; the pattern of all points does.
The templates of all points at their positions form one pattern. Its correlation with
the whole frame has its peak at the joint motion, however large it is, and a second peak
of equal height if the pattern repeats.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft2, next_fast_len, rfft2
from scipy.ndimage import maximum_filter, uniform_filter

from haselab.models.filters import fftconvolve
from haselab.tracking.options import Floats, Frame, Poses
from haselab.tracking.subsets import Subsets

__all__ = ["Hypothesis", "JointSearch", "lookalikes", "repeats"]

_MOST_SIDE_PX = 512  # of the image that is correlated; larger frames are binned
_APART_PX = 3.0  # smallest distance between two peaks
_PEAKS = 4
_FLOOR = 4.0  # grey levels of 8 bits: smaller standard deviations count as uniform grey
_SAME = 0.6  # of the pattern's own peak: higher ones are repeats
_MOST_REPEATS = 12
# rotations and scalings from one frame to the next, the most likely first
_TURNS_DEG = tuple(s * a for a in (4, 8, 12, 16, 20, 25, 30, 36, 42) for s in (1, -1))
_SIZES = (0.97, 1.03, 0.94, 1.06, 0.91, 1.09, 0.87, 1.13)

Singles = NDArray[np.float32]


@dataclass(frozen=True)
class Hypothesis:
    """One joint motion.

    Args:
        matrix: rotation or scaling about the centre of the points. Shape `(2, 2)`.
        shift_px: translation of that centre. Shape `(2,)`.
        height: of the correlation's peak, approximately the number of points that it explains.
    """

    matrix: Floats
    shift_px: Floats
    height: float

    def moved(self, poses: Poses, middle: Floats) -> Poses:
        """Poses after this motion. Shape `(P, 6)`."""
        after = np.empty_like(poses)
        away = poses["centre_px"] - middle
        after["centre_px"] = middle + away @ self.matrix.T + self.shift_px
        after["deformation"] = self.matrix @ poses["deformation"]
        return after


def _binned(image: Singles, by: int) -> Singles:
    if by == 1:
        return image
    rows, columns = (size // by * by for size in image.shape)
    parts = image[:rows, :columns].reshape(rows // by, by, columns // by, by)
    return np.asarray(parts.sum(axis=(1, 3)), np.float32)


def _normalised(image: Singles, side: int, floor: float) -> Singles:
    """Each pixel minus the mean of the square around it, over the square's norm."""
    mean = uniform_filter(image, side, mode="nearest")
    power = uniform_filter(image * image, side, mode="nearest") - mean * mean
    return np.asarray((image - mean) / (side * np.sqrt(np.maximum(power, 0.0) + floor**2)))


class JointSearch:
    """Correlates the pattern of all points with whole frames.

    Args:
        subsets: templates of the points.
        shape: `(H, W)` of the frames.
        bits: number of bits of a pixel that are used.
    """

    def __init__(self, subsets: Subsets, shape: tuple[int, int], bits: int) -> None:
        self._side, self._shape = subsets.side, shape
        pixels = subsets.side**2
        self._templates = subsets.shape[:, :pixels].reshape(-1, subsets.side, subsets.side)
        self._bin = -(-max(shape) // _MOST_SIDE_PX)
        self._floor = _FLOOR * 2.0 ** (bits - 8)
        self._size = tuple(next_fast_len(size // self._bin, real=True) for size in shape)

    def spectrum(self, frame: Frame | Floats) -> NDArray[np.complex64]:
        """Spectrum of a frame, normalised in squares of a subset's size."""
        grey = _binned(np.asarray(frame, np.float32), self._bin)
        side = max(self._side // self._bin, 3)
        return np.asarray(rfft2(_normalised(grey, side, self._floor * self._bin**2), self._size))

    def _pattern(self, poses: Poses, matrix: Floats) -> Singles:
        """All templates at their positions, transformed by the matrix."""
        half = self._side // 2
        offsets = np.mgrid[-half : half + 1, -half : half + 1][::-1].reshape(2, -1)
        source = np.rint(np.linalg.inv(matrix) @ offsets).astype(int)
        inside = (np.abs(source) <= half).all(axis=0)
        values = self._templates[:, source[1, inside] + half, source[0, inside] + half]
        middle_x, middle_y = np.rint(poses["centre_px"]).astype(int).T[:, :, np.newaxis]
        x, y = middle_x + offsets[0, inside], middle_y + offsets[1, inside]
        height, width = self._shape
        seen = (x >= 0) & (y >= 0) & (x < width) & (y < height)
        flat = np.bincount((y * width + x)[seen], values[seen], minlength=height * width)
        return _binned(flat.reshape(height, width).astype(np.float32), self._bin)

    def _peaks(
        self, spectrum: NDArray[np.complex64], pattern: Singles, count: int
    ) -> list[tuple[float, Floats]]:
        """Highest correlations, with their translations in px."""
        product = spectrum * np.conj(rfft2(pattern, self._size))
        plane = irfft2(product, self._size)
        near = 2 * max(round(_APART_PX / self._bin), 1) + 1
        tops = np.flatnonzero(plane == maximum_filter(plane, near, mode="wrap"))
        best = tops[np.argsort(-plane.ravel()[tops])[:count]]
        where = np.stack(np.unravel_index(best, plane.shape), axis=1).astype(float)
        size = np.array(plane.shape)
        where -= np.where(where > size / 2, size, 0)
        return [
            (float(plane.ravel()[index]), self._bin * place[::-1])
            for index, place in zip(best, where, strict=True)
        ]

    def shifts(
        self, spectrum: NDArray[np.complex64], poses: Poses, count: int = _PEAKS
    ) -> list[Hypothesis]:
        """The most likely translations of all points together, best first."""
        pattern = self._pattern(poses, np.eye(2))
        return [
            Hypothesis(np.eye(2), shift, height)
            for height, shift in self._peaks(spectrum, pattern, count)
        ]

    def turns(self, spectrum: NDArray[np.complex64], poses: Poses) -> list[Hypothesis]:
        """The most likely rotations and scalings with a translation, best first."""
        middle = poses["centre_px"].mean(axis=0)
        found = []
        for matrix in _matrices():
            moved = Hypothesis(matrix, np.zeros(2), 0.0).moved(poses, middle)
            ((height, shift),) = self._peaks(spectrum, self._pattern(moved, matrix), 1)
            found.append(Hypothesis(matrix, shift, height))
        return sorted(found, key=lambda h: -h.height)[:_PEAKS]


def _matrices() -> Iterator[Floats]:
    for angle in np.deg2rad(_TURNS_DEG):
        yield np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for size in _SIZES:
        yield size * np.eye(2)


def lookalikes(picture: Frame | Floats, subsets: Subsets, reach_px: int, least: float) -> Floats:
    """Distance from each point to the nearest similar place in the reference.

    Args:
        picture: the reference. Shape `(H, W)`.
        subsets: templates of the points.
        reach_px: how far to look, in px.
        least: correlation (ZNCC) from which a place is similar.

    Returns:
        Distances, in px; infinite if there is none. Shape `(P,)`.
    """
    side, half = subsets.side, subsets.side // 2
    edge = reach_px + half
    around = np.pad(np.asarray(picture, float), edge, mode="edge")
    offset = np.arange(-reach_px, reach_px + 1)
    away = np.hypot(offset[:, None], offset[None, :])
    out = np.full(len(subsets.shape), np.inf)
    for index, (x, y) in enumerate(subsets.centres_px.astype(int)):
        window = around[y : y + 2 * edge + 1, x : x + 2 * edge + 1]
        window = window - window.mean()
        template = subsets.shape[index, : side**2].reshape(side, side)
        score = fftconvolve(window, template[::-1, ::-1], "valid")
        cut = slice(half, -half)
        mean = uniform_filter(window, side)[cut, cut]
        power = side**2 * (uniform_filter(window**2, side)[cut, cut] - mean**2)
        passes = score > least * np.sqrt(np.maximum(power, 1e-9))
        passes &= (score == maximum_filter(score, 3)) & (away > _APART_PX)
        if passes.any():
            out[index] = away[passes].min()
    return out


def repeats(search: JointSearch, picture: Frame | Floats, poses: Poses) -> Floats:
    """Translations that move the pattern of the points onto a similar pattern.

    Args:
        search: joint search of the points.
        picture: the reference. Shape `(H, W)`.
        poses: poses of the points in it. Shape `(P,)`.

    Returns:
        The translations, in px, the shortest first. Shape `(R, 2)`; none for scattered dots.
    """
    found = search.shifts(search.spectrum(picture), poses, 8 * _MOST_REPEATS)
    own = found[0].height
    kept = [
        h.shift_px
        for h in found[1:]
        if h.height > _SAME * own and np.abs(h.shift_px - found[0].shift_px).max() > _APART_PX
    ]
    kept.sort(key=lambda shift: float(np.hypot(*shift)))
    return np.array(kept[:_MOST_REPEATS]).reshape(-1, 2)
