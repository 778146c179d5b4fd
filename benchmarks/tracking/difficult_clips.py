"""Clips in which trackers fail, with exact truth, for `difficult.py`.

Frames are sums of analytic Gaussians as in `clips.py`; light, covers and lossy codecs are
applied on top. Lengths are in px, grey levels are those of 8 bits.
"""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from benchmarks.tracking.clips import _paint

Floats = NDArray[np.float64]
Frames = NDArray[np.uint8]

GROUND, DEPTH, SIGMA_PX, NOISE = 160.0, 80.0, 2.0, 2.0
REST = 10

Motion = Callable[[Floats, int], Floats]  # places at rest and the frame to places
Light = Callable[[Floats, Floats, int], Floats]  # x, y of the pixels and the frame to a gain


@dataclass(frozen=True)
class Case:
    """One clip and how it is tracked.

    Args:
        name: of the row.
        dots: all blobs at rest. Shape `(B, 2)`.
        motion: of the blobs.
        points: indices of the blobs that are tracked; all when `None`.
        side, frames: size of a frame, number of frames.
        sigma_px, depth: of the blobs.
        light: gain of each pixel.
        cover: box `x0, y0, x1, y1` that hides the scene in a frame, or nothing.
        codec: lossy codec and its quality, `("libx264", 40)`.
        dropped: frames of the motion that the camera did not record.
        reach_px: for trackpy's link, the largest motion that it may follow.
        model: requested from the tracker.
        independent: the dots do not move together.
        pattern: fixed pattern of the sensor: deviation of the pixels' offsets, in grey, and gains.
        impossible: the motion is not identifiable; the tracker must only claim nothing.
    """

    name: str
    dots: Floats
    motion: Motion
    points: NDArray[np.intp] | None = None
    side: int = 384
    frames: int = 48
    sigma_px: float = SIGMA_PX
    depth: Floats | float = DEPTH
    noise: float = NOISE
    light: Light | None = None
    cover: Callable[[int], tuple[int, int, int, int] | None] = lambda _: None
    codec: tuple[str, int] | None = None
    reach_px: float = 6.0
    model: str = "auto"
    independent: bool = False
    impossible: bool = False
    seed: int = 1
    ground: float = GROUND
    pattern: tuple[float, float] = (0.0, 0.0)
    turned: Callable[[int], Floats] | None = field(default=None)

    @property
    def tracked(self) -> NDArray[np.intp]:
        return np.arange(len(self.dots)) if self.points is None else self.points

    def truth(self) -> Floats:
        """Places of the tracked points. Shape `(F, P, 2)`."""
        return np.array([self.motion(self.dots, k)[self.tracked] for k in range(self.frames)])

    def hidden(self, half_px: float = 8.0) -> NDArray[np.bool_]:
        """Points that a subset cannot see: near the edge, outside, or covered. `(F, P)`."""
        truth = self.truth()
        low, high = half_px, self.side - 1.0 - half_px
        away = ((truth < low) | (truth > high)).any(axis=2)
        for k in range(self.frames):
            box = self.cover(k)
            if box is not None:
                x, y = truth[k].T
                x0, y0, x1, y1 = box
                away[k] |= (
                    (x > x0 - half_px)
                    & (x < x1 + half_px)
                    & (y > y0 - half_px)
                    & (y < y1 + half_px)
                )
        return np.asarray(away)

    def ideal(self, k: int) -> Floats:
        image = np.zeros((self.side, self.side))
        place = self.motion(self.dots, k)
        metric = np.eye(2)
        if self.turned is not None:
            inverse = np.linalg.inv(self.turned(k))
            metric = inverse.T @ inverse
        sigma = np.broadcast_to(np.asarray(self.sigma_px, float), len(place))
        shapes = np.array([metric[0, 0], metric[0, 1], metric[1, 1]])[None, :] / sigma[:, None] ** 2
        depth = np.broadcast_to(-np.asarray(self.depth, float), len(place)).copy()
        inside = ((place > -30) & (place < self.side + 30)).all(axis=1)
        _paint(
            image,
            *np.ascontiguousarray(place[inside].T),
            np.ascontiguousarray(shapes[inside]),
            depth[inside],
        )
        image += self.ground
        if self.light is not None:
            y, x = np.mgrid[: self.side, : self.side].astype(float)
            image *= self.light(x, y, k)
        box = self.cover(k)
        if box is not None:
            x0, y0, x1, y1 = box
            image[y0:y1, x0:x1] = 40.0
        return image

    def render(self) -> Frames:
        out = np.empty((self.frames, self.side, self.side), np.uint8)
        sensor = np.random.default_rng([self.seed, 99]).standard_normal((2, self.side, self.side))
        offset, gain = self.pattern[0] * sensor[0], 1.0 + self.pattern[1] * sensor[1]
        for k in range(self.frames):
            rng = np.random.default_rng([self.seed, k])
            noisy = gain * self.ideal(k) + offset
            noisy += self.noise * rng.standard_normal((self.side, self.side))
            out[k] = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        return out if self.codec is None else coded(out, *self.codec)


def coded(frames: Frames, codec: str, quality: int) -> Frames:
    """The frames after a lossy codec."""
    import av

    file = io.BytesIO()
    with av.open(file, "w", format="matroska") as container:
        stream = container.add_stream(codec, rate=Fraction(100))
        stream.height, stream.width = frames.shape[1:]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        if codec == "libx264":
            stream.options = {"crf": str(quality)}
        elif codec == "libx265":
            stream.options = {"x265-params": f"crf={quality}:log-level=none"}
        if codec == "mjpeg":
            stream.codec_context.options = {"qmin": str(quality), "qmax": str(quality)}
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(frame, format="gray")
            container.mux(stream.encode(picture.reformat(format=stream.pix_fmt)))
        container.mux(stream.encode())
    file.seek(0)
    with av.open(file) as container:
        read = [
            f.to_ndarray()[: frames.shape[1], : frames.shape[2]] for f in container.decode(video=0)
        ]
    return np.ascontiguousarray(np.array(read, np.uint8))


def scattered(count: int, side: int, apart: float, edge: float, seed: int) -> Floats:
    """Random places, no two nearer than `apart`."""
    rng = np.random.default_rng([seed, 77])
    kept = np.empty((0, 2))
    while len(kept) < count:
        place = rng.uniform(edge, side - edge, 2)
        if not len(kept) or ((kept - place) ** 2).sum(axis=1).min() > apart**2:
            kept = np.vstack([kept, place])
    return kept


def grid(pitch: float, count: int, side: int) -> Floats:
    line = (np.arange(count) - 0.5 * (count - 1)) * pitch + 0.5 * side + 0.3
    return np.stack(np.meshgrid(line, line), axis=-1).reshape(-1, 2)


def shifted(path: Callable[[int], tuple[float, float]]) -> Motion:
    return lambda dots, k: dots + np.asarray(path(max(k - REST + 1, 0)), float)


def to_and_fro(step: float, angle: float = 0.4) -> Motion:
    way = step * np.array([np.cos(angle), np.sin(angle)])
    return shifted(lambda k: tuple(way * (k % 2)))


def affine(side: int, matrix: Callable[[int], Floats], shift: Callable[[int], Floats]) -> Motion:
    middle = 0.5 * side

    def move(dots: Floats, k: int) -> Floats:
        t = max(k - REST + 1, 0)
        return middle + (dots - middle) @ matrix(t).T + shift(t)

    return move


def rotation(angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def no_shift(_: int) -> Floats:
    return np.zeros(2)


def brownian(dots: Floats, frames: int, step: float, seed: int) -> Motion:
    rng = np.random.default_rng([seed, 5])
    steps = rng.normal(0.0, step, (frames, len(dots), 2))
    steps[:REST] = 0.0
    walk = np.cumsum(steps, axis=0)
    return lambda _, k: dots + walk[k]


def cases(seed: int = 1) -> list[Case]:
    side = 384
    dots = scattered(60, side, 16.0, 60.0, seed)
    dense = scattered(200, side, 13.0, 60.0, seed)
    mesh = grid(16.0, 10, side)
    rng = np.random.default_rng([seed, 3])
    sine = lambda peak: shifted(  # noqa: E731 - peak px a frame, amplitude 40 px at most
        lambda k: (min(40.0, 6 * peak) * np.sin(peak / min(40.0, 6 * peak) * k), 0.0)
    )
    stretch = affine(
        side,
        lambda t: np.diag([1.0 - 0.02 * np.sin(0.1 * t), 1.0 + 0.06 * np.sin(0.1 * t)]),
        no_shift,
    )
    stretched = lambda k: np.diag(  # noqa: E731
        [
            1.0 - 0.02 * np.sin(0.1 * max(k - REST + 1, 0)),
            1.0 + 0.06 * np.sin(0.1 * max(k - REST + 1, 0)),
        ]
    )
    turn = affine(side, lambda t: rotation(np.deg2rad(10.0) * t), no_shift)
    speckle = np.concatenate([dots, rng.uniform(30, side - 30, (6000, 2))])
    speckle_depth = np.concatenate([np.full(60, 40.0), 9.0 * rng.choice([-1.0, 1.0], 6000)])
    shake = rng.uniform(-14.0, 14.0, (200, 2))
    far = rng.uniform(-32.0, 32.0, (200, 2))
    half_dots = lambda d: (d[:, 0] > side / 2)[:, None]  # noqa: E731
    wide = grid(16.0, 34, side)
    inner = np.flatnonzero((np.abs(wide - side / 2) < 90).all(axis=1))

    crowd = scattered(300, side, 11.0, 40.0, seed)
    layer = np.random.default_rng([seed, 6]).choice([-1.0, 1.0], (60, 1))

    def crawling(places: Floats, k: int) -> Floats:
        return places + 0.05 * max(k - REST + 1, 0) * np.array([1.0, 0.4])

    def wave(places: Floats, k: int) -> Floats:
        t = max(k - REST + 1, 0)
        high = 8.0 * min(t / 6.0, 1.0)
        up = high * np.sin(2.0 * np.pi * places[:, 0] / 126.0 - 0.35 * t)
        return places + np.stack([np.zeros(len(up)), up], axis=1)

    def apart(jump: float) -> Motion:
        way = np.array([0.0, 0.5 * jump])
        return lambda d, k: d + np.where(half_dots(d), way, -way) * (max(k - REST + 1, 0) % 2)

    def sliding(places: Floats, k: int) -> Floats:
        side_of = np.where(places[:, :1] < 0.5 * side, 1.0, -1.0)
        return places + np.array([0.0, 0.1 * max(k - REST, 0)]) * side_of

    def sheared(places: Floats, k: int) -> Floats:
        across = 6.0 * np.tanh((places[:, :1] - 0.5 * side) / 6.0)
        return places + np.array([0.0, 1.0]) * across * np.sin(max(k - REST, 0) / 6.0)

    def fade(x: Floats, y: Floats, k: int) -> Floats:
        t = max(k - REST, 0) / 38.0
        return (1.0 - 0.6 * t) * (1.0 + 0.5 * t * (x / side - 0.5))

    def spot(x: Floats, y: Floats, k: int) -> Floats:
        t = max(k - REST, 0)
        cx, cy = 60.0 + 7.0 * t, 190.0
        bright = 0.5 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 45.0**2))
        return (1.0 + 0.2 * np.sin(0.9 * t)) * (0.8 + bright * (k >= REST))

    def halved(level: float) -> Light:
        return lambda x, y, k: np.full_like(x, 1.0 if k < REST + 10 else level)

    def shadow(x: Floats, y: Floats, k: int) -> Floats:
        edge = 7.0 * max(k - REST, 0) - 20.0
        return 1.0 - 0.45 / (1.0 + np.exp((x - edge) / 8.0)) * (k >= REST)

    def bar(k: int) -> tuple[int, int, int, int] | None:
        return (150, 0, 220, side) if 20 <= k < 34 else None

    return [
        Case("plain: slow stretch", dots, stretch, turned=stretched),
        Case("plain: slow stretch, 200 dots", dense, stretch, turned=stretched),
        Case("jumps 10 px to and fro", dots, to_and_fro(10.0), reach_px=14.0),
        Case("jumps 8 px to and fro", dots, to_and_fro(8.0), reach_px=12.0),
        Case(
            "jumps 10 px, model neighbours",
            dots,
            to_and_fro(10.0),
            reach_px=14.0,
            model="neighbours",
        ),
        Case(
            "jumps 10 px, model translation",
            dots,
            to_and_fro(10.0),
            reach_px=14.0,
            model="translation",
        ),
        Case(
            "jumps 10 px, 3 points of 60",
            dots,
            to_and_fro(10.0),
            points=np.array([4, 17, 40]),
            reach_px=14.0,
        ),
        Case("jumps 24 px to and fro", dots, to_and_fro(24.0), reach_px=26.0),
        Case(
            "shakes 14 px each way",
            dots,
            shifted(lambda k: tuple(shake[k] * (k > 0))),
            reach_px=20.0,
        ),
        Case(
            "shakes 32 px each way", dots, shifted(lambda k: tuple(far[k] * (k > 0))), reach_px=20.0
        ),
        Case(
            "speckle jumps 10 px to and fro",
            speckle,
            to_and_fro(10.0),
            points=np.arange(60),
            depth=speckle_depth,
            sigma_px=1.6,
            reach_px=14.0,
        ),
        Case("grid 16 px, 2 px a frame", mesh, shifted(lambda k: (2.0 * k, 0.0))),
        Case("grid 16 px, 3 px a frame", mesh, shifted(lambda k: (3.0 * k, 0.0))),
        Case(
            "grid 16 px, 3 px, neighbours",
            mesh,
            shifted(lambda k: (3.0 * k, 0.0)),
            model="neighbours",
        ),
        Case("grid 16 px, jumps 10 px", mesh, to_and_fro(10.0, 0.0), reach_px=14.0),
        Case("endless grid, 2 px a frame", wide, shifted(lambda k: (2.0 * k, 0.0)), points=inner),
        Case(
            "endless grid jumps 10 px", wide, to_and_fro(10.0, 0.0), points=inner, impossible=True
        ),
        Case("sine, peak 10.4 px a frame", dots, sine(10.4), reach_px=13.0),
        Case("sine, peak 18.6 px a frame", dots, sine(18.6), reach_px=22.0),
        Case("sine, peak 24.8 px a frame", dots, sine(24.8), reach_px=26.0),
        Case("brightness to 0.4, gradient", dots, stretch, light=fade, turned=stretched),
        Case("flicker, moving bright spot", dots, stretch, light=spot, turned=stretched),
        Case("moving shadow", dots, stretch, light=shadow, turned=stretched),
        Case("gain jumps to 0.4", dots, stretch, light=halved(0.4), turned=stretched),
        Case("gain jumps to 0.3", dots, stretch, light=halved(0.3), turned=stretched),
        Case(
            "plate turns 10 deg a frame",
            scattered(60, side, 16.0, 110.0, seed),
            turn,
            reach_px=16.0,
            sigma_px=2.5,
        ),
        Case(
            "plate turns 10 deg, beads on view",
            scattered(120, side, 14.0, 100.0, seed),
            turn,
            reach_px=14.0,
            sigma_px=2.5,
            points=np.arange(60),
        ),
        Case(
            "turns 25 deg to and fro",
            scattered(60, side, 16.0, 110.0, seed),
            affine(side, lambda t: rotation(np.deg2rad(25.0) * (t % 2)), no_shift),
            reach_px=16.0,
        ),
        Case(
            "zoom 8 % to and fro",
            dots,
            affine(side, lambda t: (1.0 + 0.08 * (t % 2)) * np.eye(2), no_shift),
            reach_px=12.0,
            turned=lambda k: (1.0 + 0.08 * (max(k - REST + 1, 0) % 2)) * np.eye(2),
        ),
        Case(
            "halves move against each other",
            dots,
            apart(12.0),
            reach_px=9.0,
        ),
        Case("dense halves jump 15 px apart", dense, apart(15.0), reach_px=11.0),
        Case("fixed pattern of 5 grey", dots, crawling, pattern=(5.0, 0.0)),
        Case("fixed pattern of 10 grey", dots, crawling, pattern=(10.0, 0.0)),
        Case("fixed pattern of 6 grey and 3 %", dense, crawling, pattern=(6.0, 0.03)),
        Case("wave of 126 px, 8 px high, dense", crowd, wave, independent=True),
        Case(
            "layers that pass each other",
            dots,
            lambda d, k: d + layer * max(k - REST + 1, 0) * np.array([0.7, 0.4]),
            independent=True,
        ),
        Case(
            "dense dots that walk 0.7 px",
            dense,
            brownian(dense, 48, 0.7, seed),
            independent=True,
        ),
        Case("x265 crf 28", dots, stretch, codec=("libx265", 28), turned=stretched),
        Case("x264 crf 40", dots, stretch, codec=("libx264", 40), turned=stretched),
        Case("x264 crf 28", dots, stretch, codec=("libx264", 28), turned=stretched),
        Case("x264 crf 18", dots, stretch, codec=("libx264", 18), turned=stretched),
        Case("mjpeg", dots, stretch, codec=("mjpeg", 8), turned=stretched),
        Case("covered by a bar for 14 frames", dots, stretch, cover=bar, turned=stretched),
        Case(
            "scene gone for 8 frames, back 14 px off",
            dots,
            shifted(lambda k: (0.0, 0.0) if k < 18 else (14.0, 5.0)),
            cover=lambda k: (0, 0, side, side) if 20 <= k < 28 else None,
            reach_px=16.0,
        ),
        Case(
            "8 frames dropped at 3 px a frame",
            dots,
            shifted(lambda k: (1.0 * k + (24.0 if k > 15 else 0.0), 0.0)),
            reach_px=26.0,
        ),
        Case(
            "Brownian dots, 1 px",
            scattered(60, side, 22.0, 60.0, seed),
            brownian(scattered(60, side, 22.0, 60.0, seed), 48, 1.0, seed),
            independent=True,
            reach_px=6.0,
        ),
        *(
            Case(
                f"Brownian dots, {step:g} px",
                scattered(60, side, 22.0, 60.0, seed),
                brownian(scattered(60, side, 22.0, 60.0, seed), 48, step, seed),
                independent=True,
            )
            for step in (0.1, 0.2)
        ),
        Case("halves that slide apart by 0.2 px a frame", dots, sliding, independent=True),
        Case("shear band, 6 px to and fro", dots, sheared, independent=True),
        Case("noise 8 grey", dots, stretch, noise=8.0, turned=stretched),
        Case("faint dots, 20 grey deep", dots, stretch, depth=20.0, turned=stretched),
    ]
