"""Tracking of many points in a frame; see track.h and track_step.h in native/tracking."""

import numpy as np
from numpy.typing import NDArray

# Structs of native/tracking as numpy dtypes.
POSE: np.dtype[np.void]  # centre_px (2,), deformation (2, 2): struct track_pose
NOISE: np.dtype[np.void]  # struct track_noise

class Rules:
    """struct track_rules."""

    def __init__(
        self,
        *,
        max_iterations: int,
        tolerance_px: float,
        minimum_quality: float,
        jump_px: float,
        most_residual: float,
        most_gain: float,
        search_px: int,
        noise_known: bool,
        noise_floor: float,
        noise_slope: float,
    ) -> None: ...

class Summary:
    """struct track_summary."""

    due: int
    believed: int
    strayed: int
    newly_lost: int
    believed_before: int
    ambiguous: int
    surprise_px: float
    most_surprise_px: float
    unevenness: float
    largest_std_px: float
    reach_px: float
    audit: tuple[float, int]

class Points:
    """struct track_points."""

    def __init__(
        self,
        *,
        shape: NDArray[np.float32],
        gradient: NDArray[np.float32],
        inverse: NDArray[np.float32],
        place: NDArray[np.float32],
        centre: NDArray[np.float64],
        offset: NDArray[np.float64],
        base: NDArray[np.float64],
        noise: NDArray[np.void],
        white: NDArray[np.float32],
        near: NDArray[np.int32],
        lever: NDArray[np.float64],
        weights: NDArray[np.float64],
        smooth: NDArray[np.float64],
        rough: NDArray[np.float64],
        side: int,
    ) -> None: ...

def step(
    points: Points,
    rules: Rules,
    frame: NDArray[np.uint8] | NDArray[np.uint16],
    bits: int,
    poses: NDArray[np.void],
    velocity: NDArray[np.float64],
    reasons: NDArray[np.uint8],
    gain: NDArray[np.float64],
    next_poses: NDArray[np.void],
    next_velocity: NDArray[np.float64],
    next_reasons: NDArray[np.uint8],
    next_gain: NDArray[np.float64],
    position: NDArray[np.float64],
    std: NDArray[np.float64],
    quality: NDArray[np.float64],
    kernels: str = "",
) -> Summary: ...
def audit(
    points: Points, position: NDArray[np.float64], std: NDArray[np.float64]
) -> tuple[float, int]: ...
def samples(
    points: Points,
    frame: NDArray[np.uint8] | NDArray[np.uint16],
    bits: int,
    poses: NDArray[np.void],
    out: NDArray[np.float32],
    kernels: str = "",
) -> None: ...
def coefficients(
    frame: NDArray[np.uint8] | NDArray[np.uint16],
    bits: int,
    out: NDArray[np.int16],
    kernels: str = "",
) -> None: ...
def kernels() -> list[str]: ...
