r"""Uneven light: what a slope of the brightness across a subset moves, and how to take it out.

Light that changes by a relative slope $b$ per px adds $b\,\xi\,w$ to a subset $w$, with $\xi$ the
distance from its centre. Gauss-Newton takes a part of that for motion: $\delta = B\,b$ with
$B = A^{-1}\,(g \cdot \xi w)$. The other part stays in the residual and gives the slope itself. Grey
level 0 is taken for darkness.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.tracking.options import Floats
from haselab.tracking.subsets import Subsets, descent_rows, project_out

Singles = NDArray[np.float32]

__all__ = ["LightSlopes", "Unevenness", "build_slopes"]

_SIGNIFICANT = 3.0  # standard deviations of the mean square of slopes that are noise


@dataclass(frozen=True)
class Unevenness:
    """What uneven light did to the points of one frame.

    Args:
        shift_px: what is to be added to the positions, in px. Shape `(P, 2)`.
        variance_px2: of that, along x and y, in px². Shape `(P, 2)`.
    """

    shift_px: Floats
    variance_px2: Floats


@dataclass(frozen=True)
class LightSlopes:
    """Slopes of the light from the samples of all subsets.

    Args:
        subsets: templates of the points.
        moved: displacement that a relative slope of 1 per px along x, y looks like, in px².
            Shape `(P, 2, 2)`.
        reader: gives the slopes from a residual over the amplitude. Shape `(P, 2, N)`.
        variance: of the slopes for a pixel variance of 1 and an amplitude of 1. `(P, 2, 2)`.
    """

    subsets: Subsets
    moved: Floats
    reader: Floats
    variance: Floats

    def unevenness(
        self, samples: Singles, matrices: Floats, noise: Floats | None, used: NDArray[np.bool_]
    ) -> Unevenness | None:
        """Empirical Bayes: slopes are believed as far as they scatter more than noise.

        Args:
            samples: grey levels of the subsets, any constant added. Shape `(P, S)`.
            matrices: deformation of each subset. Shape `(P, 2, 2)`.
            noise: variance of a pixel in each subset, in grey levels squared. Shape `(P,)`. `None`
                to take it from what the match leaves.
            used: points that were found. Shape `(P,)`.

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
    """The linear readers of all templates.

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
