"""The reference that frames are compared with, and its renewal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from haselab import _track
from haselab.base import InputError
from haselab.tracking.camera.light import LightSlopes, build_slopes
from haselab.tracking.camera.noise import NoiseLaw, measure_noise
from haselab.tracking.identity import JointSearch, lookalikes, repeats
from haselab.tracking.neighbours import Neighbourhood, build_neighbourhood
from haselab.tracking.options import Floats, Frame, Poses, TrackOptions
from haselab.tracking.subsets import Subsets, build_subsets

__all__ = ["JUMP_PX", "Reference", "first_reference", "poses_at", "renewed_reference"]

JUMP_PX = 1.0  # largest distance of a point from the position predicted by its neighbours
_MOST_RESIDUAL = 8.0  # largest mean square residual over the noise's, relative to the median point
_MOST_GAIN = 2.0  # largest ratio of contrast to that of the median point, or its inverse
_UNIT_LAW = NoiseLaw(1.0, 0.0)  # used with one rest frame; the residual scales it
_HEADROOM = 1.5  # of a 16-bit frame's grey levels over the reference's largest


@dataclass(frozen=True)
class Reference:
    """The reference that frames are compared with.

    Args:
        subsets: templates of the points.
        points_px: the points at rest. Shape `(P, 2)`.
        base: inverse of the deformation gradient that each point had when its template was
            taken; the identity at rest. Shape `(P, 2, 2)`.
        covariance: the reference's contribution to that of each displacement, in px².
            Shape `(P, 2, 2)`.
        frames: how many were averaged into each template. Shape `(P,)`.
        around: neighbours of the points.
        noise: the camera's noise law, `None` with a single rest frame.
        shape: `(H, W)` of all frames.
        bits: number of bits of a pixel that are used.
        picture: mean of the rest frames, rounded. Shape `(H, W)`.
        native: the same data for the native kernel.
        rules: the tracker's options for the native kernel.
    """

    subsets: Subsets
    points_px: Floats
    base: Floats
    covariance: Floats
    frames: NDArray[np.intp]
    around: Neighbourhood
    noise: NoiseLaw | None
    shape: tuple[int, int]
    bits: int
    picture: Frame
    native: _track.Points
    rules: _track.Rules

    @cached_property
    def search(self) -> JointSearch:
        """Search for the joint motion of all points."""
        return JointSearch(self.subsets, self.shape, self.bits)

    @cached_property
    def slopes(self) -> LightSlopes:
        """Estimator of uneven light from the subsets."""
        return build_slopes(self.subsets)

    @cached_property
    def repeats_px(self) -> Floats:
        """Translations to similar patterns. Shape `(R, 2)`, the shortest first."""
        return repeats(self.search, self.picture, poses_at(self.centres_px))

    def lookalikes_px(self, reach_px: int, least: float) -> Floats:
        """Distance from each point to its nearest similar dot. Shape `(P,)`."""
        known = self._lookalikes.get((reach_px, least))
        if known is None:
            known = lookalikes(self.picture, self.subsets, reach_px, least)
            self._lookalikes[reach_px, least] = known
        return known

    @cached_property
    def _lookalikes(self) -> dict[tuple[int, float], Floats]:
        return {}

    @property
    def centres_px(self) -> Floats:
        """Rest positions of the subsets' centres. Shape `(P, 2)`."""
        return _centres_at_rest(self.points_px, self.base, self.subsets)


def _centres_at_rest(points_px: Floats, base: Floats, subsets: Subsets) -> Floats:
    return np.asarray(points_px - np.einsum("pij,pj->pi", base, subsets.offsets_px))


def poses_at(centres_px: Floats, deformation: Floats | None = None) -> Poses:
    """Poses of subsets with these centres, deformed by the identity when nothing else is given.

    Args:
        centres_px: centres `[x, y]`, in px. Shape `(P, 2)`.
        deformation: gradients. Shape `(P, 2, 2)`.

    Returns:
        The poses. Shape `(P,)`.
    """
    poses = np.empty(len(centres_px), _track.POSE)
    poses["centre_px"] = centres_px
    poses["deformation"] = np.eye(2) if deformation is None else deformation
    return poses


def first_reference(
    rest_frames: Sequence[Frame],
    points_px: Floats,
    options: TrackOptions,
    around: Neighbourhood,
) -> Reference:
    """Create a reference from the mean of rest frames.

    Args:
        rest_frames: one or more frames `(H, W)` of one shape, uint8 or uint16.
        points_px: points `[x, y]` in them, in px. Shape `(P, 2)`.
        options: tracker options.
        around: neighbours of the points.

    Returns:
        The reference; with two frames or more it contains the noise law.

    Raises:
        InputError: a point is too close to the edge, or has no texture.
    """
    count, height, width = len(points_px), *rest_frames[0].shape
    noise = measure_noise(rest_frames) if len(rest_frames) > 1 else None
    mean = np.mean(rest_frames, axis=0, dtype=float)
    subsets = build_subsets(mean, points_px, options)
    base = np.tile(np.eye(2), (count, 1, 1))
    law = noise or _UNIT_LAW
    covariance = subsets.covariance(subsets.norm, subsets.level, law) / len(rest_frames)
    frames = np.full(count, len(rest_frames))
    return Reference(
        subsets=subsets,
        points_px=points_px,
        base=base,
        covariance=covariance,
        frames=frames,
        around=around,
        noise=noise,
        shape=(height, width),
        bits=_bits_in_use(rest_frames),
        picture=np.rint(mean).astype(rest_frames[0].dtype),
        native=_native_points(subsets, points_px, base, covariance, frames, around),
        rules=_native_rules(options, noise),
    )


def renewed_reference(
    old: Reference,
    frame: Frame,
    poses: Poses,
    valid: NDArray[np.bool_],
    where: Floats,
    options: TrackOptions,
) -> tuple[Reference, Poses]:
    """Renew the templates from one frame, where its points allow it.

    A point's error in that frame has two parts. The part from the frame's noise is also in the new
    template, with the opposite sign, so displacements relative to it keep only the other part, the
    old reference's.

    Args:
        old: the current reference.
        frame: the frame, `(H, W)`.
        poses: centre and deformation gradient of each subset in it. Shape `(P,)`.
        valid: points that were found in it. Shape `(P,)`.
        where: positions of the points in it, `[x, y]`, in px. Shape `(P, 2)`.
        options: tracker options.

    Returns:
        The reference and the poses relative to it; the old ones if a subset has no texture now.
        Points that are not valid or too near to the edge keep their template.
    """
    half = options.subset_px // 2 + 1
    last = np.array([old.shape[1] - 1, old.shape[0] - 1]) - half
    new = valid & (np.where(valid[:, None], (where >= half) & (where <= last), False)).all(axis=1)
    if not new.any():
        return old, poses
    try:
        fresh = build_subsets(frame.astype(float), where[new], options)
    except InputError:  # no texture in a subset
        return old, poses
    subsets = _merged(old.subsets, fresh, new)
    stretch = poses["deformation"][new]  # deformation of the old templates
    base, covariance, frames = old.base.copy(), old.covariance.copy(), old.frames.copy()
    base[new] = old.base[new] @ np.linalg.inv(stretch)
    covariance[new] = stretch @ covariance[new] @ stretch.transpose(0, 2, 1)
    frames[new] = 1
    after = poses.copy()
    after[new] = poses_at(fresh.centres_px)
    centres = _centres_at_rest(old.points_px, base, subsets)
    around = build_neighbourhood(centres, old.points_px)
    native = _native_points(subsets, old.points_px, base, covariance, frames, around)
    reference = Reference(
        subsets=subsets,
        points_px=old.points_px,
        base=base,
        covariance=covariance,
        frames=frames,
        around=around,
        noise=old.noise,
        shape=old.shape,
        bits=old.bits,
        picture=old.picture,
        native=native,
        rules=old.rules,
    )
    return reference, after


def _merged(old: Subsets, fresh: Subsets, new: NDArray[np.bool_]) -> Subsets:
    """The old subsets with some replaced by new ones."""
    parts = {}
    for part in fields(Subsets):
        value = getattr(old, part.name)
        if part.name != "place":
            value = value.copy()
            value[new] = getattr(fresh, part.name)
        parts[part.name] = value
    return Subsets(**parts)


def _squared_cardinal_weights(fractions: Floats) -> Floats:
    """Sum of squared pixel weights of cubic-spline interpolation."""
    pixels = np.arange(-12, 14)
    pole = np.sqrt(3.0) - 2.0
    lag = np.abs(pixels[:, None] - pixels[None, :])
    inverse = -6.0 * pole / (1.0 - pole**2) * pole**lag
    distance = np.abs(fractions[:, None] - pixels[None, :])
    spline = np.where(
        distance < 1.0,
        2.0 / 3.0 - distance**2 + 0.5 * distance**3,
        np.maximum(2.0 - distance, 0.0) ** 3 / 6.0,
    )
    return np.asarray(((spline @ inverse) ** 2).sum(axis=1))


_WHITE = _squared_cardinal_weights(np.linspace(0.0, 1.0, 33)).astype(np.float32)


def _bits_in_use(frames: Sequence[Frame]) -> int:
    """8 for bytes; otherwise bits for 1.5 times the largest grey level, 8 to 16."""
    if frames[0].dtype == np.uint8:
        return 8
    largest = max(int(frame.max()) for frame in frames)
    return min(max(int(np.ceil(np.log2(_HEADROOM * largest + 1.0))), 8), 16)


def _native_points(
    subsets: Subsets,
    points_px: Floats,
    base: Floats,
    covariance: Floats,
    frames: NDArray[np.intp],
    around: Neighbourhood,
) -> _track.Points:
    """The reference in the layout of the native kernel."""
    noise = np.empty(len(frames), _track.NOISE)
    upper = (slice(None), [0, 0, 1], [0, 1, 1])
    noise["even"], noise["shaped"] = subsets.even[upper], subsets.shaped[upper]
    noise["reference"], noise["averaged"] = covariance[upper], 1.0 / frames
    noise["norm"], noise["level"] = subsets.norm, subsets.level
    noise["residual_share"] = subsets.residual_share
    return _track.Points(
        shape=subsets.shape,
        gradient=subsets.gradient,
        inverse=subsets.inverse,
        place=subsets.place,
        centre=_centres_at_rest(points_px, base, subsets),
        offset=subsets.offsets_px,
        base=np.ascontiguousarray(base.reshape(-1, 4)),
        noise=noise,
        white=_WHITE,
        near=around.index,
        lever=around.lever_px,
        weights=around.weights,
        smooth=around.smooth,
        rough=around.rough,
        side=subsets.side,
    )


def _native_rules(options: TrackOptions, noise: NoiseLaw | None) -> _track.Rules:
    law = noise or _UNIT_LAW
    return _track.Rules(
        max_iterations=options.max_iterations,
        tolerance_px=options.tolerance_px,
        minimum_quality=options.minimum_quality,
        jump_px=JUMP_PX,
        most_residual=_MOST_RESIDUAL,
        most_gain=_MOST_GAIN,
        search_px=options.search_px,
        noise_known=noise is not None,
        noise_floor=law.floor,
        noise_slope=law.slope,
    )
