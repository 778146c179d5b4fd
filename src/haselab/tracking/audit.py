"""Expected number of wrong positions, from their standard deviations."""

from __future__ import annotations

from math import sqrt

import numpy as np
from numpy.typing import NDArray
from scipy.special import erfc

from haselab.tracking.attempt import Attempt
from haselab.tracking.options import Floats, TrackOptions

__all__ = [
    "LEAST_WRONG",
    "LOOKALIKES",
    "expected_wrong",
    "may_be_uncertain",
    "uncertain_points",
    "wrong_share",
]

LEAST_WRONG = 1e-4  # smaller shares are not credible
LOOKALIKES = 5e-3  # wrong positions per lost one, under covers with similar dots
_SURELY = 3.6  # standard deviations that contain a position with probability 0.999


def may_be_uncertain(attempt: Attempt, scatter: float, options: TrackOptions) -> bool:
    """Cheap test whether any standard deviation, widened by the scatter, is relevant."""
    # the light correction has also widened them, by less than a half
    largest = 1.5 * attempt.summary.largest_std_px * sqrt(scatter)
    return attempt.believed > 0 and largest >= options.wrong_px / _SURELY


def uncertain_points(attempt: Attempt, options: TrackOptions) -> NDArray[np.bool_]:
    """Mark the least certain points, so that the others meet the limit of wrong positions."""
    std = attempt.std_px
    valid = attempt.reason == 0
    out = np.zeros(len(valid), bool)
    if not valid.any():
        return out
    wrong = expected_wrong(std[:, valid], options.wrong_px)
    order = np.argsort(wrong, kind="stable")
    share = np.cumsum(wrong[order]) / np.arange(1, len(order) + 1)
    out[np.flatnonzero(valid)[order[share > options.most_wrong]]] = True
    return out


def expected_wrong(std_px: Floats, wrong_px: float) -> Floats:
    """Probability that a position is wrong by more than `wrong_px` along x or y.

    Args:
        std_px: standard deviations along x and y. Shape `(2, ...)`.
        wrong_px: in px.
    """
    beyond = np.asarray(erfc(wrong_px / np.maximum(np.sqrt(2.0) * std_px, 1e-12)), float)
    return np.asarray(np.minimum(beyond.sum(axis=0), 1.0))


def wrong_share(wrong: float, valid: int, count: int) -> float:
    """Share of the valid positions that is expected to be wrong, with its lower limit.

    The standard deviations do not include confusion with a similar dot. That happens where
    points are covered, so the share is at least 1e-4 and at least 0.005 of the share of lost
    positions (measured: 0.001 to 0.006).

    Args:
        wrong: sum of `expected_wrong` over the valid positions.
        valid: number of valid positions.
        count: number of all positions.

    Example:
        >>> wrong_share(1e-30, 800, 1000)
        0.001
    """
    lost = (count - valid) / max(count, 1)
    return min(max(wrong / max(valid, 1), LEAST_WRONG, LOOKALIKES * lost), 1.0)
