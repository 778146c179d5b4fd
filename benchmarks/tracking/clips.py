"""Clips of a stretching sheet with exact truth, for `points.py`. Not the twin's camera.

Every frame is a sum of analytic Gaussians, each deformed by the sheet's gradient at its centre and
averaged over the exposure, so no image is ever interpolated. All lengths are in px, grey levels are
those of 8 bits.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

GROUND, DOT_DEPTH, DOT_SIGMA_PX, CLAMP_SIGMA_PX = 160.0, 90.0, 2.0, 3.0
NOISE_AT_GROUND = 2.0  # grey; variance in proportion to the grey level
ROUNDING_VARIANCE = 1.0 / 12.0
NARROWING = 0.30
ILLUMINATION = 0.05
SPECKLE_DENSITY, SPECKLE_GREY, SPECKLE_SIGMA_PX = 0.08, 9.0, (1.2, 1.8)
EXPOSURE, EXPOSURE_STEPS = 0.5, 5
RATE_HZ = 400.0
CYCLE_STEPS = 360.0  # the strain is 0 again, where a fast clip begins anew
DOTS, CLAMP_DOTS = 300, 3


@dataclass(frozen=True)
class Motion:
    """Strain, rigid rotation and light of the sheet over the frames.

    Args:
        frames, rest: number of frames, and of those at rest before.
        stride: frames of the base motion from one frame to the next (8: 18 px a frame).
        skip: frames that the camera dropped.
        turn_rad: rotation about the middle, reached in the last frame.
        flicker, fade: amplitude of the lamp's gain, contrast lost in the last frame.
        cover: frames in which `cover_px` (x0, y0, x1, y1) hides the scene.
    """

    frames: int = 400
    rest: int = 10
    stride: int = 1
    skip: tuple[int, ...] = ()
    turn_rad: float = 0.0
    flicker: float = 0.0
    fade: float = 0.0
    cover: tuple[int, int] = (0, 0)
    cover_px: tuple[int, int, int, int] = (0, 0, 0, 0)

    def step(self, frame: int) -> float:
        """Frame number of the base motion, 0 at the end of the rest."""
        later = sum(1 for lost in self.skip if lost <= frame)
        step = float(max(frame + later - self.rest, 0) * self.stride)
        return step % CYCLE_STEPS if self.stride > 1 else step

    def strain(self, step: float) -> float:
        """One raised cosine of 2 Hz to 15 %, then rings down at 5 Hz from 5 %."""
        time_s = step / RATE_HZ
        if time_s < 0.5:
            return 0.075 * (1.0 - np.cos(2 * np.pi * 2.0 * time_s))
        late_s = time_s - 0.5
        return 0.05 * np.exp(-2.0 * late_s) * np.sin(2 * np.pi * 5.0 * late_s)

    def angle(self, frame: float) -> float:
        return self.turn_rad * max(frame - self.rest, 0.0) / max(self.frames - self.rest, 1)

    def gain(self, frame: int) -> float:
        return 1.0 + self.flicker * np.sin(2 * np.pi * 0.137 * frame)

    def contrast(self, frame: int) -> float:
        return 1.0 - self.fade * frame / max(self.frames - 1, 1)


@numba.njit(cache=True, fastmath=True)
def _paint(image, x, y, shapes, depth):  # pragma: no cover - compiled
    height, width = image.shape
    for n in range(x.size):
        a, b, c = shapes[n, 0], shapes[n, 1], shapes[n, 2]  # exponent (a dx2 + 2 b dx dy + c dy2)/2
        det = a * c - b * b
        reach_x, reach_y = 4.6 * np.sqrt(c / det), 4.6 * np.sqrt(a / det)
        left, right = max(0, int(x[n] - reach_x)), min(width - 1, int(x[n] + reach_x) + 1)
        top, bottom = max(0, int(y[n] - reach_y)), min(height - 1, int(y[n] + reach_y) + 1)
        bend = np.exp(-a)
        for r in range(top, bottom + 1):
            dx, dy = left - x[n], r - y[n]
            value = depth[n] * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
            ratio = np.exp(-0.5 * (a * (2 * dx + 1) + 2 * b * dy))
            for q in range(left, right + 1):
                image[r, q] += value
                value *= ratio
                ratio *= bend


@dataclass(frozen=True)
class Clip:
    """A sheet of `side` x `side` px frames.

    Args:
        rest_px: blobs at rest, first the 300 dots, then 3 of the clamp, then speckle. `(B, 2)`.
        sigma_px, depth: of each blob. Shape `(B,)`.
    """

    side: int
    rest_px: Floats
    sigma_px: Floats
    depth: Floats
    motion: Motion = field(default_factory=Motion)
    seed: int = 1

    @property
    def points_px(self) -> Floats:
        """Where the dots are at rest. Shape `(303, 2)`."""
        return self.rest_px[: DOTS + CLAMP_DOTS]

    def place(self, points_px: Floats, step: float, frame: float) -> tuple[Floats, Floats]:
        """Positions and deformation gradients of material points. `(N, 2)`, `(N, 2, 2)`."""
        side, strain = float(self.side), self.motion.strain(step)
        top, height, middle = 0.1 * side, 0.7 * side, 0.5 * side
        h = np.clip((points_px[:, 1] - top) / height, 0.0, 1.0)
        moving = points_px[:, 1] <= top + height  # below: the rigid clamp
        pull = np.where(moving, 1.0 - NARROWING * strain * 4 * h * (1 - h), 1.0)
        bend = np.where(moving, -NARROWING * strain * 4 * (1 - 2 * h) / height, 0.0)
        x = middle + (points_px[:, 0] - middle) * pull
        y = points_px[:, 1] + strain * height * h
        zero = np.zeros_like(x)
        stretch = np.where(moving, 1.0 + strain, 1.0)
        gradient = np.stack([pull, (points_px[:, 0] - middle) * bend, zero, stretch], axis=1)
        c, s = np.cos(self.motion.angle(frame)), np.sin(self.motion.angle(frame))
        turn = np.array([[c, -s], [s, c]])
        placed = middle + (np.stack([x, y], axis=1) - middle) @ turn.T
        return placed, turn @ gradient.reshape(-1, 2, 2)

    def moments(self, frame: int) -> list[tuple[float, float]]:
        """Base steps and frame times of the exposure's samples."""
        offsets = (np.arange(EXPOSURE_STEPS) / EXPOSURE_STEPS - 0.5) * EXPOSURE
        here = self.motion.step(frame)
        moments = [(max(here + float(d), 0.0), frame + float(d)) for d in offsets]
        return moments if here > 0.0 else moments[:1]

    def truth(self, points_px: Floats, frame: int) -> Floats:
        """Mean positions over the exposure. Shape `(N, 2)`."""
        return np.mean([self.place(points_px, *moment)[0] for moment in self.moments(frame)], 0)

    def gradient(self, points_px: Floats, frame: int) -> Floats:
        """Deformation gradients in the middle of the exposure. Shape `(N, 2, 2)`."""
        return self.place(points_px, self.motion.step(frame), frame)[1]

    def ideal(self, frame: int, shift_px: tuple[float, float] = (0.0, 0.0)) -> Floats:
        """The frame without noise and rounding, the scene moved by `shift_px`. `(side, side)`."""
        image = np.zeros((self.side, self.side))
        moments = self.moments(frame)
        depth = self.depth / len(moments)
        for moment in moments:
            placed, f = self.place(self.rest_px, *moment)
            inverse = np.linalg.inv(f)
            metric = inverse.transpose(0, 2, 1) @ inverse / (self.sigma_px**2)[:, None, None]
            shapes = np.stack([metric[:, 0, 0], metric[:, 0, 1], metric[:, 1, 1]], axis=1)
            x, y = placed[:, 0] + shift_px[0], placed[:, 1] + shift_px[1]
            _paint(image, x, y, shapes, depth)
        light = 1.0 + ILLUMINATION * (np.arange(self.side) / self.side - 0.5)
        level = self.motion.gain(frame)
        image = level * light * (GROUND + self.motion.contrast(frame) * image)
        if self.motion.cover[0] <= frame < self.motion.cover[1]:
            x0, y0, x1, y1 = self.motion.cover_px
            image[y0:y1, x0:x1] = 40.0 * level
        return image

    def frame(self, frame: int) -> NDArray[np.uint8]:
        """As the camera gives it; the noise of a frame is its own, whatever was read before."""
        return self.noisy(self.ideal(frame), frame)

    def noisy(self, ideal: Floats, number: int) -> NDArray[np.uint8]:
        """The camera's picture `number` of an ideal image."""
        rng = np.random.default_rng([self.seed, number])
        noise = rng.standard_normal(ideal.shape, dtype=np.float32)
        noisy = ideal + np.sqrt(noise_variance(ideal)) * noise
        return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)

    def frames(self) -> NDArray[np.uint8]:
        """All frames. Shape `(F, side, side)`."""
        out = np.empty((self.motion.frames, self.side, self.side), np.uint8)
        for k in range(len(out)):
            out[k] = self.frame(k)
        return out


def noise_variance(ideal: Floats) -> Floats:
    """Variance of a pixel before rounding, in grey levels squared."""
    return NOISE_AT_GROUND**2 * np.maximum(ideal, 1.0) / GROUND


def _scatter(rng: np.random.Generator, side: int, count: int) -> Floats:
    """`count` places on the sheet, no two nearer than 2.2 % of the side."""
    low, high, apart = np.array([0.15, 0.1]) * side, np.array([0.85, 0.8]) * side, 0.022 * side
    low, high = low + 0.015 * side, high - 0.015 * side
    kept = np.empty((0, 2))
    while len(kept) < count:
        place = rng.uniform(low, high)
        if not len(kept) or ((kept - place) ** 2).sum(axis=1).min() > apart**2:
            kept = np.vstack([kept, place])
    return kept


def make_clip(side: int, *, speckle: bool, motion: Motion | None = None, seed: int = 1) -> Clip:
    """A sheet with 300 dots and a clamp with 3, bare or on speckle."""
    rng = np.random.default_rng([seed, side])
    clamp = np.array([[x, 0.825] for x in (0.3, 0.5, 0.7)]) * side
    rest = [_scatter(rng, side, DOTS), clamp]
    sigma = [np.full(DOTS, DOT_SIGMA_PX), np.full(CLAMP_DOTS, CLAMP_SIGMA_PX)]
    depth = [np.full(DOTS + CLAMP_DOTS, -DOT_DEPTH)]
    if speckle:
        low, high = np.array([0.15, 0.1]) * side, np.array([0.85, 0.845]) * side
        count = round(SPECKLE_DENSITY * float(np.prod(high - low)))
        rest.append(rng.uniform(low, high, (count, 2)))
        sigma.append(rng.uniform(*SPECKLE_SIGMA_PX, count))
        depth.append(SPECKLE_GREY * rng.choice([-1.0, 1.0], count))
    parts = (np.concatenate(part) for part in (rest, sigma, depth))
    return Clip(side, *parts, motion=motion or Motion(), seed=seed)


def stressed(side: int, *, speckle: bool, seed: int = 1) -> Clip:
    """All disturbances at once: fast, flickering, covered, a frame dropped, turned, faded."""
    box = tuple(int(v * side) for v in (0.40, 0.40, 0.60, 0.60))
    motion = Motion(
        frames=200,
        stride=8,
        skip=(60,),
        turn_rad=np.deg2rad(25.0),
        flicker=0.20,
        fade=0.30,
        cover=(100, 120),
        cover_px=box,
    )
    return replace(make_clip(side, speckle=speckle, seed=seed), motion=motion)


def lone_dots(clip: Clip, apart_px: float = 32.0) -> Clip:
    """The same sheet with only such dots as have no other within `apart_px`, and no speckle."""
    kept: list[int] = []
    for n, place in enumerate(clip.rest_px[:DOTS]):
        if all(np.hypot(*(place - clip.rest_px[m])) > apart_px for m in kept):
            kept.append(n)
    return replace(
        clip, rest_px=clip.rest_px[kept], sigma_px=clip.sigma_px[kept], depth=clip.depth[kept]
    )


def bound_px(
    clip: Clip,
    points_px: Floats,
    side_px: int,
    frames: list[int],
    rest: int,
    *,
    affine: bool = False,
) -> float:
    """Cramér-Rao bound on the rms of a displacement, per axis, over points and frames.

    Fisher information of the image's exact derivatives under the clip's own noise and rounding;
    the displacement's other end is a mean of `rest` frames.

    Args:
        clip: the scene.
        points_px: points at rest. Shape `(P, 2)`.
        side_px: side of the subset whose pixels may be used.
        frames: which frames to average over.
        rest: frames averaged into the reference.
        affine: whether the four deformations, gain and offset are unknown as well.
    """
    first = _inverse_information(clip, points_px, side_px, 0, affine)
    total = [
        _inverse_information(clip, points_px, side_px, k, affine) + first / rest for k in frames
    ]
    return float(np.sqrt(np.mean(total)))


def _inverse_information(
    clip: Clip, points_px: Floats, side_px: int, frame: int, affine: bool
) -> Floats:
    """Variance of each point's position, x and y, from one frame. Shape `(P, 2)`."""
    delta = 1e-3
    gx = (clip.ideal(frame, (delta, 0.0)) - clip.ideal(frame, (-delta, 0.0))) / (2 * delta)
    gy = (clip.ideal(frame, (0.0, delta)) - clip.ideal(frame, (0.0, -delta))) / (2 * delta)
    ideal = clip.ideal(frame)
    weight = 1.0 / (noise_variance(ideal) + ROUNDING_VARIANCE)
    half = (side_px - 1) / 2
    reach = int(np.ceil(1.3 * half)) + 1
    grid = np.stack(np.meshgrid(*2 * [np.arange(-reach, reach + 1)]), axis=-1).reshape(-1, 2)
    out = np.empty((len(points_px), 2))
    inverse = np.linalg.inv(clip.gradient(points_px, frame))
    for n, place in enumerate(clip.truth(points_px, frame)):
        where = np.rint(place).astype(int) + grid
        inside = ((where >= 0) & (where < clip.side)).all(axis=1)
        back = (where - place) @ inverse[n].T
        part = inside & (np.abs(back) <= half + 0.5).all(axis=1)
        at = where[part, 1], where[part, 0]
        rows = [gx[at], gy[at]]
        if affine:
            xi, eta = back[part].T
            rows += [gx[at] * xi, gx[at] * eta, gy[at] * xi, gy[at] * eta]
            rows += [ideal[at], np.ones_like(xi)]
        design = np.stack(rows)
        out[n] = np.diagonal(np.linalg.inv((design * weight[at]) @ design.T))[:2]
    return out
