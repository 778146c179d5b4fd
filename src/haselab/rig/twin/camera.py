"""The twin's camera: 8-bit frames of a speckled elastomer sheet hung between two clamps.

The image is analytic (native/twin/camera.h states every term), so the position of each mark is
known exactly. x points right, y points down, pixel centres are at integers.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field, model_validator

from haselab import _camera
from haselab.base import InputError, LimitError, Limits
from haselab.rig.protocols import ImagePart
from haselab.store.toml import Section

__all__ = ["TwinCamera", "TwinCameraConfig"]

_TABLE_SIZE = 4096
_EDGE_REACH = 16.0  # edge widths at which native/twin/camera.c truncates an edge
_DOT_REACH = 5.0  # standard deviations at which it truncates a dot
_SIDE_MARGIN = 0.96  # no particle sits closer to a free side, in half-widths
_CLAMP_OVERHANG_PX = 14.0  # by which a clamp is wider than the sheet


class TwinCameraConfig(Section):
    """All settings of the twin's images except the sheet's dimensions."""

    width_px: int = Field(512, ge=64, le=4096, description="Columns of a frame")
    height_px: int = Field(512, ge=64, le=4096, description="Rows of a frame")
    scale_m_per_px: float = Field(
        0.35e-3, gt=0, le=0.01, description="Length of a pixel on the sheet"
    )
    rate_hz: float = Field(400.0, gt=0, le=1e6, description="Frames per second")
    exposure_s: float = Field(1.0e-3, gt=0, le=1.0, description="Time the shutter is open")
    exposure_samples: int = Field(5, ge=1, le=64, description="Images averaged over one exposure")
    top_px: float = Field(60.0, ge=20, le=2000, description="Row of the upper clamp line")

    particles: int = Field(350, ge=0, le=5000, description="Speckles on the sheet")
    particle_spacing: float = Field(
        0.6, ge=0, le=0.7, description="Smallest distance, in mean distances, when laid"
    )
    particle_stretch: float = Field(
        2.0, ge=0.5, le=5, description="Length at which they were laid, in free lengths"
    )
    particle_margin: float = Field(
        0.1, ge=0.01, le=0.4, description="Bare part of the length at each clamp line"
    )
    particle_sigma_low_px: float = Field(1.6, ge=0.7, le=6, description="Narrowest speckle")
    particle_sigma_high_px: float = Field(2.4, ge=0.7, le=6, description="Widest speckle")
    particle_depth_low_grey: float = Field(45.0, ge=0, le=255, description="Faintest speckle")
    particle_depth_high_grey: float = Field(90.0, ge=0, le=255, description="Darkest speckle")
    fiducial_sigma_px: float = Field(3.0, ge=0.7, le=6, description="Width of the clamps' dots")
    fiducial_depth_grey: float = Field(120.0, ge=0, le=255, description="Depth of the clamps' dots")
    fiducial_spacing_px: float = Field(
        100.0, ge=10, le=2000, description="Distance of a clamp's dots from one another"
    )

    background_grey: float = Field(190.0, ge=0, le=255, description="Level behind the sheet")
    sheet_grey: float = Field(135.0, ge=0, le=255, description="Level of the bare sheet")
    clamp_grey: float = Field(212.0, ge=0, le=255, description="Level of the clamps")
    clamp_inside_px: float = Field(
        16.0, ge=0, le=100, description="From a clamp line to the clamp's edge on the sheet"
    )
    clamp_outside_px: float = Field(
        26.0, ge=1, le=500, description="From a clamp line to the clamp's other edge"
    )
    edge_px: float = Field(0.8, ge=0.2, le=2, description="Width of all edges (logistic)")
    illumination_tilt_x: float = Field(
        0.03, ge=-0.5, le=0.5, description="Relative rise of the light from left to right"
    )
    illumination_tilt_y: float = Field(
        -0.02, ge=-0.5, le=0.5, description="Relative rise of the light from top to bottom"
    )
    illumination_vignette: float = Field(
        0.02, ge=0, le=0.5, description="Relative loss of light at the middle of each border"
    )

    neck_coefficient: float = Field(
        0.05, ge=0, le=1, description="Narrowing at mid-length per unit of stretch beyond 1"
    )
    neck_exponent: float = Field(
        2.0, ge=0, le=6, description="Growth of the relative lateral motion off the mid-line"
    )
    shot_gain_grey: float = Field(0.025, ge=0, le=10, description="Variance per level (shot noise)")
    read_noise_grey: float = Field(0.6, ge=0, le=50, description="Standard deviation in the dark")

    @model_validator(mode="after")
    def _check_pairs(self) -> TwinCameraConfig:
        if self.exposure_s * self.rate_hz > 1:
            raise ValueError(
                f"exposure_s is {self.exposure_s:g} s, longer than a frame period of "
                f"{1 / self.rate_hz:g} s. Shorten the exposure, or lower rate_hz."
            )
        for low, high in (
            ("particle_sigma_low_px", "particle_sigma_high_px"),
            ("particle_depth_low_grey", "particle_depth_high_grey"),
        ):
            if getattr(self, low) > getattr(self, high):
                raise ValueError(f"{low} is above {high}. Swap their values.")
        reach = self.fiducial_spacing_px + _DOT_REACH * self.fiducial_sigma_px
        if reach > (self.width_px - 1) / 2:
            raise ValueError(
                f"fiducial_spacing_px = {self.fiducial_spacing_px:g} px puts dots outside the "
                f"{self.width_px} columns of the image. Lower it, or raise width_px."
            )
        return self


class TwinCamera:
    """A camera that films the twin's sheet.

    A material point (S, X), S in [0, 1] along the length and X in [-1, 1] across, is seen at

    $y = y_{top} + S\\,L, \\quad x = x_{mid} + w\\,X\\,(1 - 4 c\\,S (1 - S)\\,|X|^p), \\quad
    c = k \\max(0, L / L_0 - 1)$

    so stretch is homogeneous along the length, and lateral motion grows off the mid-line.
    Rendering keeps no state and releases the interpreter's lock: frames of one recording may be
    made by any number of threads, in any order, and have the same bits. `lengths_m` is the range
    of lengths that `render` accepts.

    Args:
        config: the camera and the look of the sheet.
        half_width_m: half the sheet's width at the clamps, w, in m.
        free_length_m: length between the clamp lines at which the sheet has no neck, L0, in m.
        seed: chooses the speckle and the noise, 0 to 2^63 - 1.

    Raises:
        LimitError: The sheet is too narrow for the image, or folds at the longest visible length.

    Source: reference study, section on the strain distribution (fig. 2), for the field's form.

    Example:
        >>> camera = TwinCamera(TwinCameraConfig(), half_width_m=0.06, free_length_m=0.05, seed=1)
        >>> camera.render([[0.080, 0.0802], [0.081, 0.081]], first_index=0).shape
        (2, 512, 512)
    """

    def __init__(
        self, config: TwinCameraConfig, half_width_m: float, free_length_m: float, seed: int
    ) -> None:
        scale = config.scale_m_per_px
        Limits("camera seed", 0, 2**63 - 1, "").check(seed)
        Limits("sheet free length", scale, 10.0, "m").check(free_length_m)
        narrowest = 2 * (_EDGE_REACH * config.edge_px + 2) * scale
        if not half_width_m >= narrowest:
            raise LimitError(
                f"The actuator is {1e3 * 2 * half_width_m:.3g} mm wide, but the camera needs at "
                f"least {1e3 * 2 * narrowest:.3g} mm at camera.scale_m_per_px = {scale:g}. Lower "
                "that scale."
            )
        self.config = config
        self.lengths_m = _visible_lengths(config)
        self._half_width_px = half_width_m / scale
        self._free_length_px = free_length_m / scale
        self._check_neck()
        self._blobs = np.concatenate(
            [self._speckle(np.random.default_rng(seed)), self._fiducials()]
        )
        self._scene = self._native_scene(seed)

    def exposure_times_s(self, frame_times_s: ArrayLike) -> NDArray[np.float64]:
        """Times at which `render` needs the length; a frame's time is the middle of its exposure.

        Args:
            frame_times_s: in s. Shape `(F,)`.

        Returns:
            Times in s. Shape `(F, exposure_samples)`.

        Example:
            >>> config = TwinCameraConfig(exposure_s=1e-3, exposure_samples=2)
            >>> TwinCamera(config, 0.06, 0.05, seed=1).exposure_times_s([1.0])
            array([[0.99975, 1.00025]])
        """
        samples = self.config.exposure_samples
        offsets = ((np.arange(samples) + 0.5) / samples - 0.5) * self.config.exposure_s
        times = np.asarray(frame_times_s, dtype=np.float64)
        return np.asarray(times[:, np.newaxis] + offsets, dtype=np.float64)

    def render(
        self,
        lengths_m: ArrayLike,
        first_index: int,
        out: NDArray[np.uint8] | None = None,
        part: ImagePart | None = None,
    ) -> NDArray[np.uint8]:
        """Render consecutive frames of a recording.

        Args:
            lengths_m: length between the clamp lines at each sample of each exposure, in m.
                Shape `(F, samples)`.
            first_index: number of the first of these frames in the recording; chooses the noise.
            out: where the frames go, of the shape and type that is returned; None: a new array.
            part: what is drawn; the other pixels of `out` stay. None: the whole frame.

        Returns:
            Grey levels of mean `expected_levels` and variance `shot_gain_grey` times the mean plus
            `read_noise_grey` squared, rounded (1/12 more) and saturated.
            Shape `(F, height_px, width_px)`.

        Raises:
            LimitError: A length puts the lower clamp outside the image.
            InputError: The shape is not `(F, samples)`, or the index is negative.
        """
        if first_index < 0:
            raise InputError(f"first_index is {first_index}, but it must be at least 0.")
        lengths_px = self._lengths_px(lengths_m)
        frames = np.empty(self._shape(lengths_px), dtype=np.uint8) if out is None else out
        whole = (0, self.config.height_px), [(0, self.config.width_px)]
        self._scene.render(lengths_px, first_index, frames, *(part or whole))
        return frames

    def expected_levels(self, lengths_m: ArrayLike) -> NDArray[np.float32]:
        """Grey levels before noise, rounding and saturation; for tests only.

        Args:
            lengths_m: as in `render`, in m. Shape `(F, samples)`.

        Returns:
            Mean levels, in grey. Shape `(F, height_px, width_px)`.

        Raises:
            LimitError: A length puts the lower clamp outside the image.
            InputError: The shape is not `(F, samples)`.
        """
        lengths_px = self._lengths_px(lengths_m)
        levels = np.empty(self._shape(lengths_px), dtype=np.float32)
        self._scene.expect(lengths_px, levels)
        return levels

    def true_particle_px(self, length_m: float) -> NDArray[np.float64]:
        """Exact (x, y) of all particles, visible or not; true values for tests only.

        Args:
            length_m: length between the clamp lines, in m.

        Returns:
            Positions in px. Shape `(particles, 2)`.

        Raises:
            LimitError: The length puts the lower clamp outside the image.
        """
        return self._positions_px(length_m)[:-6]

    def true_fiducials_px(self, length_m: float) -> NDArray[np.float64]:
        """Exact (x, y) of the clamps' dots, upper row first; true values for tests only.

        Args:
            length_m: length between the clamp lines, in m.

        Returns:
            Positions in px. Shape `(6, 2)`.

        Raises:
            LimitError: The length puts the lower clamp outside the image.
        """
        return self._positions_px(length_m)[-6:]

    def _positions_px(self, length_m: float) -> NDArray[np.float64]:
        length_px = self._lengths_px([[length_m]])[0, 0]
        along, across = self._blobs["along"], self._blobs["across"]
        neck = self._contraction(length_px) * 4 * along * (1 - along)
        x_px = (self.config.width_px - 1) / 2 + self._half_width_px * (
            across - neck * self._blobs["across_necked"]
        )
        return np.column_stack([x_px, self.config.top_px + along * length_px])

    def _contraction(self, length_px: float) -> float:
        return self.config.neck_coefficient * max(0.0, length_px / self._free_length_px - 1)

    def _check_neck(self) -> None:
        """Refuse a neck so deep that neighbouring points change places."""
        longest_px = self.lengths_m.high / self.config.scale_m_per_px
        fold = self._contraction(longest_px) * (1 + self.config.neck_exponent)
        if fold >= 1:
            allowed = self.config.neck_coefficient / fold
            raise LimitError(
                f"neck_coefficient = {self.config.neck_coefficient:g} is outside [0, {allowed:g}): "
                f"the sheet would fold at {self.lengths_m.high:g} m. Lower it, or raise the "
                f"sheet's free length."
            )

    def _lengths_px(self, lengths_m: ArrayLike) -> NDArray[np.float64]:
        lengths = np.asarray(lengths_m, dtype=np.float64)
        if lengths.ndim != 2 or lengths.shape[1] == 0:
            raise InputError(
                f"lengths_m has shape {lengths.shape}, but it must be (frames, samples), with "
                "lengths at the times of exposure_times_s."
            )
        self.lengths_m.check(lengths)
        return np.ascontiguousarray(lengths / self.config.scale_m_per_px)

    def _shape(self, lengths_px: NDArray[np.float64]) -> tuple[int, int, int]:
        return (lengths_px.shape[0], self.config.height_px, self.config.width_px)

    def _speckle(self, rng: np.random.Generator) -> NDArray[np.void]:
        """The particles, by random sequential addition."""
        c = self.config
        half_x = _SIDE_MARGIN * self._half_width_px
        length = c.particle_stretch * self._free_length_px
        size = np.array([2 * half_x, (1 - 2 * c.particle_margin) * length])
        nearest = c.particle_spacing * np.sqrt(size.prod() / max(c.particles, 1))
        placed = np.empty((c.particles, 2))
        count = 0
        while count < c.particles:
            candidate = rng.uniform(size=2) * size
            if (((placed[:count] - candidate) ** 2).sum(axis=1) >= nearest**2).all():
                placed[count] = candidate
                count += 1
        x, y = placed.T
        across = (x - half_x) / self._half_width_px
        blobs = np.empty(c.particles, _camera.BLOB)
        blobs["along"], blobs["across"] = c.particle_margin + y / length, across
        blobs["sigma_px"] = rng.uniform(
            c.particle_sigma_low_px, c.particle_sigma_high_px, c.particles
        )
        blobs["depth_grey"] = rng.uniform(
            c.particle_depth_low_grey, c.particle_depth_high_grey, c.particles
        )
        blobs["across_necked"] = across * np.abs(across) ** c.neck_exponent
        return blobs

    def _fiducials(self) -> NDArray[np.void]:
        """Dots on the clamp lines, where the field is rigid."""
        c = self.config
        blobs = np.zeros(6, _camera.BLOB)
        blobs["along"] = np.repeat([0.0, 1.0], 3)
        blobs["across"] = np.tile([-1.0, 0.0, 1.0], 2) * c.fiducial_spacing_px / self._half_width_px
        blobs["sigma_px"], blobs["depth_grey"] = c.fiducial_sigma_px, c.fiducial_depth_grey
        return blobs

    def _native_scene(self, seed: int) -> _camera.Scene:
        from scipy.special import expit  # imported here so that guardians load faster

        c = self.config
        mid = (c.width_px - 1) / 2
        x = (np.arange(c.width_px) - mid) / c.width_px
        y = (np.arange(c.height_px) - (c.height_px - 1) / 2) / c.height_px
        clamp = max(self._half_width_px, c.fiducial_spacing_px) + _CLAMP_OVERHANG_PX
        geometry = _camera.Geometry(
            top_px=c.top_px,
            mid_px=mid,
            half_width_px=self._half_width_px,
            free_length_px=self._free_length_px,
            neck=c.neck_coefficient,
            edge_px=c.edge_px,
            clamp_inside_px=c.clamp_inside_px,
            clamp_outside_px=c.clamp_outside_px,
            background_grey=c.background_grey,
            sheet_grey=c.sheet_grey,
            clamp_grey=c.clamp_grey,
        )
        single = np.float32
        return _camera.Scene(
            geometry=geometry,
            illumination_x=(
                1 + c.illumination_tilt_x * x - 4 * c.illumination_vignette * x**2
            ).astype(single),
            illumination_y=(c.illumination_tilt_y * y - 4 * c.illumination_vignette * y**2).astype(
                single
            ),
            clamp_x=expit((clamp - np.abs(x) * c.width_px) / c.edge_px).astype(single),
            blobs=self._blobs,
            shot_gain_grey=c.shot_gain_grey,
            read_noise_grey=c.read_noise_grey,
            normal_table=_normal_table(),
            seed=seed,
        )


def _visible_lengths(config: TwinCameraConfig) -> Limits:
    """Lengths at which the clamps do not touch and the lower dots are fully visible."""
    dots = _DOT_REACH * config.fiducial_sigma_px
    low = 2 * max(config.clamp_inside_px + 2 * config.edge_px, dots)
    high = config.height_px - 1 - dots - config.top_px
    if high <= low:
        raise LimitError(
            f"height_px is {config.height_px}, but a sheet below top_px = {config.top_px:g} needs "
            f"at least {config.top_px + dots + low + 2:.0f} rows. "
            f"Raise height_px, or lower top_px."
        )
    return Limits("sheet length", low * config.scale_m_per_px, high * config.scale_m_per_px, "m")


def _normal_table() -> NDArray[np.float32]:
    """Equally probable values of which the sum of two is nearly normal with variance 1.

    Midpoint quantiles of the normal distribution, scaled to variance 1/2; the sum's excess
    kurtosis is half of the table's, -0.004, and its range +-5.19.
    """
    from scipy.special import ndtri

    quantiles = ndtri((np.arange(_TABLE_SIZE) + 0.5) / _TABLE_SIZE)
    return np.asarray(quantiles / (np.sqrt(2) * quantiles.std()), dtype=np.float32)
