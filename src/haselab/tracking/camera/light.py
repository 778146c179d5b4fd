r"""Uneven light: displacement error from a brightness slope across a subset, and correction.

Light that changes by a relative slope $b$ per px adds $b\,\xi\,w$ to a subset $w$, with $\xi$ the
distance from its centre. Gauss-Newton interprets part of that as motion: $\delta = B\,b$ with
$B = A^{-1}\,(g \cdot \xi w)$. The other part remains in the residual and gives the slope itself.
Grey level 0 is assumed to be darkness.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.tracking.options import Floats
from haselab.tracking.subsets import Subsets, descent_rows, project_out

Singles = NDArray[np.float32]

__all__ = ["LightSlopes", "Unevenness", "build_slopes"]

_SIGNIFICANT = 3.0  # standard deviations of the slopes' mean square above which they are not noise


@dataclass(frozen=True)
class Unevenness:
    """Effect of uneven light on the points of one frame.

    Args:
        shift_px: correction to add to the positions, in px. Shape `(P, 2)`.
        variance_px2: variance of the correction along x and y, in px². Shape `(P, 2)`.
    """

    shift_px: Floats
    variance_px2: Floats


@dataclass(frozen=True)
class LightSlopes:
    """Estimator of brightness slopes from the samples of all subsets.

    Args:
        subsets: templates of the points.
        moved: apparent displacement for a relative slope of 1 per px along x, y, in px².
            Shape `(P, 2, 2)`.
        reader: matrix from a residual over the amplitude to the slopes. Shape `(P, 2, N)`.
        variance: of the slopes for a pixel variance of 1 and an amplitude of 1. `(P, 2, 2)`.
    """

    subsets: Subsets
    moved: Floats
    reader: Floats
    variance: Floats

    def unevenness(
        self, samples: Singles, matrices: Floats, noise: Floats | None, used: NDArray[np.bool_]
    ) -> Unevenness | None:
        """Estimate the correction by empirical Bayes: slopes are shrunk by the share of noise.

        Args:
            samples: grey levels of the subsets, up to a constant. Shape `(P, S)`.
            matrices: deformation of each subset. Shape `(P, 2, 2)`.
            noise: variance of a pixel in each subset, in grey levels squared. Shape `(P,)`. `None`
                to estimate it from the residual of the match.
            used: whether each point was found. Shape `(P,)`.

        Returns:
            The correction, or `None` where the slopes do not differ from noise.

        Source: Efron and Morris 1973 (shrinkage by the excess of the scatter over the noise).
        """
        pixels = self.reader.shape[2]
        grey = samples[:, :pixels].astype(float)
        shape = self.subsets.shape[:, :pixels]
        amplitude = np.einsum("pn,pn->p", grey, shape)
        amplitude = np.where(used & (amplitude > 0.0), amplitude, 1.0)
        rest = grey - grey.mean(axis=1, keepdims=True) - amplitude[:, None] * shape
        if noise is None:
            noise = np.maximum((rest**2).mean(axis=1), 1.0 / 12.0)
        slopes = np.einsum("pmn,pn->pm", self.reader, rest) / amplitude[:, None]
        jacobian = matrices @ self.moved
        shift = np.einsum("pij,pj->pi", jacobian, slopes)
        spread = jacobian @ self.variance @ jacobian.transpose(0, 2, 1)
        variance = np.diagonal(spread, axis1=1, axis2=2) * (noise / amplitude**2)[:, None]
        excess = (shift[used] ** 2 / variance[used]).mean() - 1.0
        if not excess > _SIGNIFICANT * np.sqrt(2.0 / (2.0 * np.count_nonzero(used))):
            return None
        share = excess / (excess + 1.0)
        return Unevenness(share * shift, share * variance)


def build_slopes(subsets: Subsets) -> LightSlopes:
    """Build the estimators for all templates.

    Args:
        subsets: templates of the points.

    Returns:
        Arrays for `LightSlopes.unevenness`.
    """
    side, unknowns = subsets.side, subsets.inverse.shape[1]
    pixels = side**2
    shape = subsets.shape[:, :pixels].astype(float)
    gx, gy = subsets.gradient[:, :, :pixels].astype(float).transpose(1, 0, 2)
    rows = project_out(descent_rows(gx, gy, side, unknowns), shape)
    picture = (subsets.level / subsets.norm)[:, None] + shape
    tilted = project_out(subsets.place[None, :, :pixels] * picture[:, None, :], shape)
    full = subsets.inverse.astype(float) @ (rows @ tilted.transpose(0, 2, 1))
    left = tilted - full.transpose(0, 2, 1) @ rows
    reader = np.asarray(np.linalg.solve(left @ tilted.transpose(0, 2, 1), left), float)
    v = unknowns // 2
    return LightSlopes(subsets, full[:, [0, v]], reader, reader @ reader.transpose(0, 2, 1))
