"""Tracker options, and types shared by the package."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError

__all__ = [
    "Floats",
    "Frame",
    "FramePart",
    "Model",
    "PartialFrame",
    "Poses",
    "Span",
    "TrackOptions",
]

Floats = NDArray[np.float64]
Frame = NDArray[np.uint8] | NDArray[np.uint16]
Poses = NDArray[np.void]  # centre_px and deformation of each subset; native/tracking/track.h
Model = Literal["translation", "neighbours", "affine"]


Span = tuple[int, int]  # the first row or column, and the one after the last
FramePart = tuple[Span, Sequence[Span]]  # rows, and which of their columns


class PartialFrame(Protocol):
    """A frame of which only the parts that are needed are made."""

    def whole(self) -> NDArray[np.uint8]:
        """Make all of it."""

    def with_parts(self, parts: Sequence[FramePart]) -> NDArray[np.uint8]:
        """Make parts of it; the other pixels of the result are undefined."""


_LARGEST_SUBSET_PX = 101
_SMALLEST_SUBSET_PX = 7


@dataclass(frozen=True)
class TrackOptions:
    """Options of the point tracker.

    Args:
        subset_px: side of the square subset around each point, in px, odd.
        model: `"translation"` solves for 2 unknowns per point; `"neighbours"` too, with the subset
            deformed according to the neighbours' displacements, which also detects jumps;
            `"affine"` solves for 6 unknowns, for few points on a textured surface.
        search_px: radius of the whole-pixel search for a point that was lost, in px; 0 for none.
        minimum_quality: correlation (ZNCC) below which a point counts as lost.
        wrong_px: error from which a position counts as wrong, in px.
        most_wrong: largest expected share of wrong positions among the valid ones of a frame, by
            their standard deviations; the least certain points are marked invalid to meet it.
        sloped_light: the light over each subset may slope, other than in the reference, without
            moving its point. This widens the standard deviation for a dot by about 7 %. Not for
            `"affine"`.
        smoothing_px: standard deviation of the Gaussian that smooths the reference gradient, in
            px; it reduces the effect of the reference's noise.
        tolerance_px: a point has converged when its step falls below this, in px. A step leaves
            an error of about a tenth of its size.
        max_iterations: largest number of Gauss-Newton steps per point and frame.

    Raises:
        InputError: an option is outside its range.

    Example:
        >>> TrackOptions(subset_px=15).model
        'translation'
    """

    subset_px: int = 15
    model: Model = "translation"
    search_px: int = 12
    minimum_quality: float = 0.6
    wrong_px: float = 0.5
    most_wrong: float = 0.001
    sloped_light: bool = False
    smoothing_px: float = 0.6
    tolerance_px: float = 0.1
    max_iterations: int = 20

    def __post_init__(self) -> None:
        if self.subset_px % 2 == 0 or not (
            _SMALLEST_SUBSET_PX <= self.subset_px <= _LARGEST_SUBSET_PX
        ):
            raise InputError(
                f"subset_px = {self.subset_px} is not an odd number in [{_SMALLEST_SUBSET_PX}, "
                f"{_LARGEST_SUBSET_PX}]. Use an odd side that covers two or three dots."
            )
        if self.model not in ("translation", "neighbours", "affine"):
            raise InputError(
                f"model = {self.model!r} is unknown. Choose translation, neighbours or affine."
            )
        if self.sloped_light and self.model == "affine":
            raise InputError(
                'sloped_light is not possible with model = "affine". Choose "translation".'
            )
        for name, value, low, high in (
            ("search_px", self.search_px, 0, 500),
            ("minimum_quality", self.minimum_quality, 0.0, 1.0),
            ("wrong_px", self.wrong_px, 1e-3, 100.0),
            ("most_wrong", self.most_wrong, 0.0, 1.0),
            ("smoothing_px", self.smoothing_px, 0.0, 3.0),
            ("tolerance_px", self.tolerance_px, 1e-4, 0.5),
            ("max_iterations", self.max_iterations, 1, 1000),
        ):
            if not low <= value <= high:
                raise InputError(f"{name} = {value:g} is outside [{low:g}, {high:g}].")
