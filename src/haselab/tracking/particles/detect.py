"""Detection of trackable points: small particles and large fiducial dots."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Literal, TypeVar

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.fft import dctn, idct
from scipy.ndimage import gaussian_laplace, map_coordinates
from scipy.spatial import cKDTree

from haselab.actuators.threads import in_threads
from haselab.base import InputError, ResultError
from haselab.tracking.options import Floats

__all__ = [
    "DotProfile",
    "Particles",
    "Polarity",
    "detect_dot_near",
    "detect_fiducials",
    "detect_particles",
    "find_profile",
    "locate_particles",
    "spread_out",
]

Polarity = Literal["dark", "bright"]
T = TypeVar("T")

_PARTICLE_SIGMAS_PX = (1.0, 1.4, 2.0, 2.8, 4.0, 5.6)
_STRONGEST = 50  # strongest dots, used to choose the scale
_NOISE_FACTOR = 6.0
_AT_ONCE = 4096  # points compared at once, to limit memory
_WORKERS = os.cpu_count() or 1
_ROUNDING = 12.0**-0.5
_FAINTEST = 0.25  # of the strong dots' median response: faintest dot
_LEAST_ROUND = 0.5  # ratio of the two curvatures of a dot at its own scale
_LEAST_COMPACT = 0.3  # the same for a particle, which may touch another; an edge has 0.1
_SAME_SIZE = 0.6
_NEIGHBOURS = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if (y, x) != (0, 0)]
_AROUND_PX = 48  # seen around a place: to 4.5 standard deviations of a dot of 10 px
_LEAST_COMPARED = 12  # dots that show how uneven the ground usually is
_UNEVEN_TIMES = 5.0  # step of the ground that is an edge, relative to the most even quarter's
_UNEVEN_DEPTH = 0.5  # and relative to the depth of a dot
_NO_CONTENT = 40.0  # exponent beyond which a frequency is lost in rounding (e^-40 = 4e-18)
_EVEN = 0.2  # largest unevenness around a fiducial, relative to its depth


def _check_image(image: NDArray[np.generic], polarity: str) -> Floats:
    if image.ndim != 2 or min(image.shape) < 16:
        raise InputError(
            f"The image has shape {image.shape}, expected (H, W) of at least 16 x 16 pixels."
        )
    if polarity not in ("dark", "bright"):
        raise InputError(f"polarity = {polarity!r} is unknown. Choose dark or bright.")
    return image.astype(float)


def _response(image: Floats, sigma_px: float, polarity: str) -> Floats:
    """Laplacian of Gaussian times sigma²: the response to a dot of that sigma is half its depth."""
    sign = 1.0 if polarity == "dark" else -1.0
    return np.asarray(sign * sigma_px**2 * gaussian_laplace(image, sigma_px, mode="nearest"))


def _pixel_noise(image: Floats) -> float:
    """Standard deviation of a pixel, from the median of second differences along both axes."""
    twice = np.diff(np.diff(image, 2, axis=0), 2, axis=1)
    return max(1.4826 * float(np.median(np.abs(twice))) / 6.0, _ROUNDING)


def _peaks(
    response: Floats, sigma_px: float, noise: float, radius_px: float, margin_px: int
) -> NDArray[np.intp]:
    """Local maxima `[y, x]` above the noise, strongest first. Shape `(N, 2)`.

    The response to white noise of 1 grey level has the standard deviation 1 / (sqrt(2 pi) sigma).
    """
    least = _NOISE_FACTOR * noise / (np.sqrt(2.0 * np.pi) * sigma_px)
    edge = max(1, margin_px)
    inner = response[edge:-edge, edge:-edge]
    along = response[edge:-edge]  # these two leave few pixels for the other neighbours
    highest = (inner > least) & (inner >= along[:, edge - 1 : -edge - 1])
    highest &= inner >= along[:, edge + 1 : response.shape[1] - edge + 1]
    y, x = (index + edge for index in np.nonzero(highest))
    for down, right in _NEIGHBOURS:
        highest = response[y, x] >= response[y + down, x + right]
        y, x = y[highest], x[highest]
    found: NDArray[np.intp] = np.stack([y, x], axis=1)
    if not len(found):
        return found
    radius = max(1, round(radius_px))
    pad = max(0, radius - edge)  # for windows beyond the image; padding a large one takes long
    padded = np.pad(response, pad, constant_values=-np.inf) if pad else response
    around = sliding_window_view(padded, (2 * radius + 1,) * 2)
    shift = pad - radius
    largest = [
        around[part[:, 0] + shift, part[:, 1] + shift].max(axis=(1, 2))
        for part in np.split(found, range(_AT_ONCE, len(found), _AT_ONCE))
    ]
    found = found[response[found[:, 0], found[:, 1]] == np.concatenate(largest)]
    order = np.argsort(-response[found[:, 0], found[:, 1]], kind="stable")
    return found[order]


def _paraboloids(response: Floats, peaks: NDArray[np.intp]) -> tuple[Floats, Floats, Floats]:
    """Paraboloids through 3 x 3 pixels: shift and curvature along `[x, y]`, roundness 0 to 1."""
    y, x = peaks.T
    here = response[y, x]
    gx = 0.5 * (response[y, x + 1] - response[y, x - 1])
    gy = 0.5 * (response[y + 1, x] - response[y - 1, x])
    hxx = response[y, x + 1] + response[y, x - 1] - 2.0 * here
    hyy = response[y + 1, x] + response[y - 1, x] - 2.0 * here
    hxy = 0.25 * (
        response[y + 1, x + 1]
        - response[y + 1, x - 1]
        - response[y - 1, x + 1]
        + response[y - 1, x - 1]
    )
    determinant = hxx * hyy - hxy**2
    safe = np.where(determinant > 0.0, determinant, 1.0)
    shift = np.stack([-(hyy * gx - hxy * gy) / safe, -(hxx * gy - hxy * gx) / safe], axis=1)
    shift[(determinant <= 0.0) | (np.abs(shift).max(axis=1) > 1.0)] = 0.0
    mean, half = 0.5 * (hxx + hyy), np.hypot(0.5 * (hxx - hyy), hxy)
    flat, steep = np.abs(mean + half), np.abs(mean - half)
    roundness = np.where(determinant > 0.0, flat / np.maximum(steep, 1e-12), 0.0)
    return shift, np.stack([hxx, hyy], axis=1), roundness


@dataclass(frozen=True)
class DotProfile:
    """Profile of the dots of an image.

    Args:
        sigma_px: standard deviation of the Gaussian nearest to a dot's profile, in px.
        polarity: `"dark"` or `"bright"`.
    """

    sigma_px: float
    polarity: Polarity


def find_profile(image: NDArray[np.generic], polarity: Polarity | None = None) -> DotProfile:
    """Find the scale and sign with the largest response to the strongest dots of an image.

    Args:
        image: grey levels. Shape `(H, W)`.
        polarity: polarity of the dots, if known.

    Returns:
        The profile.

    Raises:
        InputError: not an image, or an unknown polarity.

    Source: Lindeberg 1998 (scale selection by the normalised Laplacian).

    Example:
        >>> y, x = np.mgrid[:60, :60]
        >>> find_profile(100 + 50 * np.exp(-((x - 30) ** 2 + (y - 30) ** 2) / (2 * 2.8**2)))
        DotProfile(sigma_px=2.8, polarity='bright')
    """
    grey = _check_image(image, polarity or "dark")
    noise = _pixel_noise(grey)
    signs: tuple[Polarity, ...] = ("dark", "bright") if polarity is None else (polarity,)

    def scores(sigma: float) -> list[tuple[float, DotProfile]]:
        dark, found = _response(grey, sigma, "dark"), []
        for sign in signs:
            response = dark if sign == "dark" else -dark
            peaks = _peaks(response, sigma, noise, sigma, round(3 * sigma))[:_STRONGEST]
            compact = _paraboloids(response, peaks)[2] > _LEAST_COMPACT
            strength = response[peaks[:, 0], peaks[:, 1]][compact]
            # squares: the faint ring around each dot has a response of opposite sign
            found.append((float(np.sum(strength**2)), DotProfile(sigma, sign)))
        return found

    scored = chain.from_iterable(in_threads(scores, _PARTICLE_SIGMAS_PX, _WORKERS))
    return max(scored, key=lambda each: each[0])[1]


@dataclass(frozen=True)
class Particles:
    """Dots of one image.

    Args:
        points_px: centres `[x, y]`, in px. Shape `(N, 2)`.
        std_px: standard deviations of the centres from the pixel noise, in px. Shape `(N, 2)`.
        strength: response: half a dot's depth in grey levels. Shape `(N,)`.
    """

    points_px: Floats
    std_px: Floats
    strength: Floats


def spread_out(points: Floats, strength: Floats, count: int) -> NDArray[np.intp]:
    """Select `count` points, strong and well separated; return their indices.

    Each point's radius reaches to the nearest point at least as strong as itself by 10 %; the
    largest radii win (adaptive non-maximal suppression, Brown, Szeliski and Winder 2005).
    """
    order = np.argsort(-strength, kind="stable")
    radius = np.full(len(points), np.inf)
    tree = cKDTree(points[order])
    for rank, index in enumerate(order):
        reach = 64
        while rank and reach <= 2 * len(points):
            distance, near = tree.query(points[index], min(reach, len(points)))
            stronger = strength[order[near]] * 0.9 > strength[index]
            if stronger.any():
                radius[index] = float(distance[stronger].min())
                break
            reach *= 4
    return np.argsort(-radius, kind="stable")[:count]


def locate_particles(
    image: NDArray[np.generic], profile: DotProfile, *, margin_px: int = 12
) -> Particles:
    r"""Locate all dots of a known profile.

    The centre is the vertex of a paraboloid through the Laplacian's peak. White noise of
    variance $s^2$ gives the slope there the variance
    $s^2\,[2 - e^{-u}(2 - 4u + u^2)]\,u / 8\pi$ with $u = \sigma^{-2}$ (half the difference of
    the filtered noise's autocorrelation at 0 and 2 px); divided by the curvature, this gives the
    shift.

    Args:
        image: grey levels. Shape `(H, W)`.
        profile: scale and sign of the dots.
        margin_px: width of the excluded margin, in px.

    Returns:
        Dots from the strongest to the faintest; empty if none is above the noise.

    Raises:
        InputError: not an image, or an unknown polarity.

    Source: Lindeberg 1998; the standard deviation by propagation of white noise.

    Example:
        >>> locate_particles(np.full((40, 40), 7.0), DotProfile(2.0, "dark")).points_px.shape
        (0, 2)
    """
    grey, sigma = _check_image(image, profile.polarity), profile.sigma_px
    noise = _pixel_noise(grey)
    response = _response(grey, sigma, profile.polarity)
    peaks = _peaks(response, sigma, noise, 1.5 * sigma, margin_px)
    strength = response[peaks[:, 0], peaks[:, 1]]
    if len(peaks):
        strong = strength > _FAINTEST * np.median(strength[:_STRONGEST])
        peaks, strength = peaks[strong], strength[strong]
    shift, curvature, roundness = _paraboloids(response, peaks)
    compact = roundness > _LEAST_COMPACT
    peaks, strength = peaks[compact], strength[compact]
    shift, curvature = shift[compact], curvature[compact]
    u = sigma**-2
    slope_variance = noise**2 * (2.0 - np.exp(-u) * (2.0 - 4.0 * u + u**2)) * u / (8.0 * np.pi)
    std = np.sqrt(slope_variance) / np.maximum(-curvature, 1e-9)
    return Particles(peaks[:, ::-1] + shift, std, strength)


def detect_particles(
    image: NDArray[np.generic],
    *,
    polarity: Polarity | None = None,
    count: int | None = None,
    sigma_px: float | None = None,
    margin_px: int = 12,
    subset_px: int | None = None,
) -> Floats:
    """Detect small dots with sub-pixel accuracy.

    Args:
        image: grey levels. Shape `(H, W)`.
        polarity: `"dark"` dots on a bright background or `"bright"` dots on a dark one; `None` to
            choose the stronger ones.
        count: largest number, strong and well spread over the image; `None` for all.
        sigma_px: standard deviation of a dot's profile, in px; `None` to find it.
        margin_px: width of the excluded margin, in px.
        subset_px: leave out dots whose subset of this side contains the edge of something else,
            such as a clamp, which moves in another way; `None` to keep them.

    Returns:
        Centres `[x, y]`, in px, from the top down. Shape `(N, 2)`.

    Raises:
        InputError: not an image, or an unknown polarity.
        ResultError: no dot is above the noise.

    Source: Lindeberg 1998 (scale selection by the normalised Laplacian).

    Example:
        >>> y, x = np.mgrid[:40, :60]
        >>> image = 200 - 90 * np.exp(-((x - 30.3) ** 2 + (y - 19.8) ** 2) / 8)
        >>> detect_particles(image).round(1)
        array([[30.3, 19.8]])
    """
    if sigma_px is None or polarity is None:
        profile = find_profile(image, polarity)
        sigma_px, polarity = sigma_px or profile.sigma_px, profile.polarity
    profile = DotProfile(float(sigma_px), polarity)
    found = locate_particles(image, profile, margin_px=margin_px)
    points, strength = found.points_px, found.strength
    if subset_px is not None:
        even = _is_even_around(image.astype(float), points, subset_px, strength)
        points, strength = points[even], strength[even]
    if not len(points):
        raise ResultError(
            f"No {profile.polarity} dot exceeds the noise by {_NOISE_FACTOR:g} standard "
            "deviations. Try the other polarity, or give the points manually."
        )
    if count is not None and count < len(points):
        points = points[spread_out(points, strength, count)]
    return np.asarray(points[np.lexsort((points[:, 0], points[:, 1]))])


def _is_even_around(
    image: Floats, points: Floats, subset_px: int, strength: Floats
) -> NDArray[np.bool_]:
    """Whether the ground on opposite sides of each subset is equally bright. Shape `(N,)`.

    The levels are medians of two rows or columns of pixels just outside the subset. What counts as
    an edge follows from the most even quarter of the dots, so that a dense pattern is none.
    """
    if len(points) < _LEAST_COMPARED:
        return np.ones(len(points), dtype=bool)
    half = subset_px // 2 + 2
    padded = np.pad(image, half, mode="edge")
    windows = sliding_window_view(padded, (2 * half + 1,) * 2)
    x, y = np.rint(points).astype(int).T
    unequal = np.empty(len(points))
    for part in np.split(np.arange(len(points)), range(_AT_ONCE, len(points), _AT_ONCE)):
        around = windows[y[part], x[part]]
        sides = (around[:, :2], around[:, -2:], around[:, :, :2], around[:, :, -2:])
        top, bottom, left, right = (np.median(each, axis=(1, 2)) for each in sides)
        unequal[part] = np.maximum(np.abs(top - bottom), np.abs(left - right))
    usual, depth = float(np.quantile(unequal, 0.25)), 2.0 * float(np.median(strength))
    return np.asarray(unequal <= max(_UNEVEN_TIMES * usual, _UNEVEN_DEPTH * depth))


def _scale_space(image: Floats, polarity: str) -> Iterator[tuple[float, Floats]]:
    """Responses from sigma 2 px to a sixteenth of the shorter side, in eighths of an octave."""
    largest = max(3.0, min(image.shape) / 16.0)
    steps = int(np.ceil(4 * np.log2(largest / 2.0))) + 1
    sign = 1.0 if polarity == "dark" else -1.0
    # In the cosine transform (mirrored edges) every scale costs the same.
    down, across = ((np.pi * np.arange(size) / size) ** 2 for size in image.shape)
    content = dctn(image, norm="ortho", workers=_WORKERS) * -(down[:, None] + across) * sign

    for sigma in 2.0 * 2.0 ** (np.arange(steps) / 4.0):
        half = 0.5 * sigma**2
        rows, columns = (int(np.sum(half * each < _NO_CONTENT)) for each in (down, across))
        smooth = sigma**2 * np.exp(-half * down[:rows])[:, None] * np.exp(-half * across[:columns])
        lines = idct(content[:rows, :columns] * smooth, n=image.shape[1], axis=1, norm="ortho",
                     workers=_WORKERS)  # fmt: skip
        response = idct(lines, n=image.shape[0], axis=0, norm="ortho", workers=_WORKERS)
        yield float(sigma), np.asarray(response)


def _with_neighbours(levels: Iterable[T]) -> Iterator[tuple[T | None, T, T | None]]:
    """Each level with the ones before and after it; only three are in memory."""
    below, here = None, None
    for above in levels:
        if here is not None:
            yield below, here, above
        below, here = here, above
    if here is not None:
        yield below, here, None


def _candidates(image: Floats, polarity: str) -> tuple[Floats, Floats, Floats]:
    """Round dots at their own scale: centres, sigmas, responses, with overlapping ones merged."""
    noise = _pixel_noise(image)
    points, sigmas, strengths = [], [], []
    for below, (sigma, response), above in _with_neighbours(_scale_space(image, polarity)):
        peaks = _peaks(response, sigma, noise, sigma, round(2 * sigma))[:200]
        shift, _, roundness = _paraboloids(response, peaks)
        y, x = peaks.T
        best = np.ones(len(peaks), bool)
        for other in (below, above):
            if other is not None:
                best &= response[y, x] >= other[1][y, x]
        best &= roundness > _LEAST_ROUND
        points.append((peaks[:, ::-1] + shift)[best])
        sigmas.append(np.full(int(best.sum()), sigma))
        strengths.append(response[y, x][best])
    return np.concatenate(points), np.concatenate(sigmas), np.concatenate(strengths)


def _is_isolated(
    image: Floats, points: Floats, sigmas: Floats, strengths: Floats
) -> NDArray[np.bool_]:
    """Whether the ring around a dot, 3.5 to 4.5 sigma away, is uniform, unlike for a clump."""
    angle = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    ring = np.concatenate(
        [r * np.stack([np.cos(angle), np.sin(angle)]) for r in (3.5, 4.5)], axis=1
    )
    x = points[:, 0, None] + sigmas[:, None] * ring[0]
    y = points[:, 1, None] + sigmas[:, None] * ring[1]
    inside = (x >= 0) & (y >= 0) & (x <= image.shape[1] - 1) & (y <= image.shape[0] - 1)
    levels = map_coordinates(image, [y, x], order=1, mode="nearest")
    return np.asarray(inside.all(axis=1) & (levels.std(axis=1) < _EVEN * 2.0 * strengths))


def _in_rows(points: Floats, rows: int) -> Floats:
    """Sort into equal rows from the top down, each from left to right."""
    down = points[np.argsort(points[:, 1], kind="stable")]
    return np.concatenate([row[np.argsort(row[:, 0])] for row in np.array_split(down, rows)])


def detect_fiducials(
    image: NDArray[np.generic],
    count: int = 6,
    *,
    rows: int = 2,
    polarity: Polarity = "dark",
) -> Floats:
    """Detect the large round fiducial dots, for example on the clamps, with sub-pixel accuracy.

    Selects the `count` largest dots of similar size that are significant at their own scale; small
    particles of the same contrast are ignored.

    Args:
        image: grey levels. Shape `(H, W)`.
        count: number of dots to find.
        rows: number of rows of dots.
        polarity: `"dark"` or `"bright"` dots.

    Returns:
        Centres `[x, y]`, in px, row by row from the top, each from left to right. Shape
        `(count, 2)`.

    Raises:
        InputError: not an image, an unknown polarity, or `count` is not a multiple of `rows`.
        ResultError: fewer than `count` dots of similar size.

    Source: Lindeberg 1998 (scale selection by the normalised Laplacian).

    Example:
        >>> y, x = np.mgrid[:120, :120]
        >>> image = np.full((120, 120), 200.0)
        >>> for cx, cy in ((30, 30), (90, 30), (30, 90), (90, 90)):
        ...     image -= 90 * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * 5.0**2))
        >>> detect_fiducials(image, 4).round(2).tolist()
        [[30.0, 30.0], [90.0, 30.0], [30.0, 90.0], [90.0, 90.0]]
    """
    grey = _check_image(image, polarity)
    if count < 1 or rows < 1 or count % rows:
        raise InputError(f"count = {count} dots do not form {rows} equal rows.")
    points, sigmas, strengths = _candidates(grey, polarity)
    alone = _is_isolated(grey, points, sigmas, strengths)
    points, sigmas, strengths = points[alone], sigmas[alone], strengths[alone]
    strong = strengths > 0.35 * np.max(strengths, initial=0.0)
    points, sigmas, strengths = points[strong], sigmas[strong], strengths[strong]
    order = np.lexsort((-strengths, -sigmas))
    for start in range(len(order) - count + 1):
        chosen = order[start : start + count]
        alike = sigmas[chosen].min() >= _SAME_SIZE * sigmas[chosen].max()
        even = strengths[chosen].min() >= 0.5 * strengths[chosen].max()
        if alike and even:
            return _in_rows(points[chosen], rows)
    raise ResultError(
        f"Found {len(order)} significant {polarity} dots, but not {count} of similar size and "
        "contrast. Give the points manually, or check focus and light."
    )


def detect_dot_near(
    image: NDArray[np.generic],
    place_px: Floats,
    *,
    reach_px: float,
    least_sigma_px: float,
    polarity: Polarity = "dark",
) -> Floats | None:
    """Detect the large round dot nearest to a place, as `detect_fiducials` does.

    Args:
        image: grey levels. Shape `(H, W)`.
        place_px: `[x, y]`, in px.
        reach_px: largest distance of the dot's centre from the place, in px.
        least_sigma_px: smallest standard deviation of the dot's profile, in px.
        polarity: `"dark"` or `"bright"` dots.

    Returns:
        Its centre `[x, y]`, in px; `None`: there is none.

    Raises:
        InputError: not an image, or an unknown polarity.

    Source: Lindeberg 1998 (scale selection by the normalised Laplacian).

    Example:
        >>> y, x = np.mgrid[:120, :120]
        >>> image = 200 - 90 * np.exp(-((x - 60.3) ** 2 + (y - 49.8) ** 2) / (2 * 5.0**2))
        >>> place = np.array([66.0, 46.0])
        >>> detect_dot_near(image, place, reach_px=12, least_sigma_px=3).round(1).tolist()
        [60.3, 49.8]
    """
    _check_image(image, polarity)
    around = round(reach_px) + _AROUND_PX
    low = np.maximum(np.rint(place_px).astype(int) - around, 0)
    high = np.rint(place_px).astype(int) + around + 1
    part = image[low[1] : max(high[1], 0), low[0] : max(high[0], 0)].astype(float)
    if min(part.shape) < 16:
        return None
    points, sigmas, strengths = _candidates(part, polarity)
    good = _is_isolated(part, points, sigmas, strengths) & (sigmas >= least_sigma_px)
    away = np.linalg.norm(points + low - place_px, axis=1)
    good &= away <= reach_px
    if not good.any():
        return None
    return np.asarray(points[np.argmin(np.where(good, away, np.inf))] + low)
