"""The resolution of the camera, an error that repeated trials do not show."""

from __future__ import annotations

import math

from haselab.base import Estimate
from haselab.base.estimate import Z95

__all__ = ["POSITION_PX", "ZERO_PX", "with_resolution"]

POSITION_PX = 0.01  # sub-pixel bias of a tracked length, equal in all trials
# Of a zero strain from another session: both lengths at rest have an error, equal in all trials of
# a session. Measured with the twin's camera at 40 lengths: 0.007 px rms; in one study: 0.018 px.
ZERO_PX = 0.02


def with_resolution(estimate: Estimate, resolution: float) -> Estimate:
    """Add a further, independent standard deviation to an estimate.

    Args:
        estimate: with the observed scatter; NaN for a single trial.
        resolution: standard deviation that the scatter does not include, in the same unit.
    Returns:
        The estimate, its interval centred on the value.
    Example:
        >>> with_resolution(Estimate.normal(1.0, 0.03, "s"), 0.04).std
        0.05
    """
    low, high = estimate.ci95
    std = math.hypot(estimate.std, resolution) if estimate.std == estimate.std else resolution
    half = math.hypot(0.5 * (high - low), Z95 * resolution) if high == high else Z95 * std
    return Estimate(
        estimate.value, std, (estimate.value - half, estimate.value + half), estimate.unit
    )
