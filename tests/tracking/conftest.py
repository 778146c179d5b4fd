"""Synthetic sheets of Gaussian dots: a sum of analytic functions, so the truth is exact."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import pytest

GROUND, DEPTH, SIGMA = 160.0, 90.0, 2.0
NO_STRETCH = np.zeros((2, 2))
NOISE_AT_GROUND = 2.0  # grey; the variance is proportional to the grey level


@dataclass
class Sheet:
    """Dots that move and deform with an affine map `x = middle + F (X - middle) + shift`.

    `rest_px` are the dots at rest; the frame is 240 x 260 px by default.
    """

    rest_px: np.ndarray
    shape: tuple[int, int] = (240, 260)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(7))

    def place(self, gradient=NO_STRETCH, shift=(0.0, 0.0)) -> np.ndarray:
        middle = np.array(self.shape[::-1]) / 2.0
        return middle + (self.rest_px - middle) @ (np.eye(2) + gradient).T + shift

    def ideal(self, gradient=NO_STRETCH, shift=(0.0, 0.0)) -> np.ndarray:
        """The image without noise."""
        image = np.full(self.shape, GROUND)
        inverse = np.linalg.inv(np.eye(2) + gradient)
        for x, y in self.place(gradient, shift):
            if max(-x, -y, x - self.shape[1], y - self.shape[0]) > 13.0:
                continue
            left, top = max(int(x) - 14, 0), max(int(y) - 14, 0)
            cut = np.s_[top : min(top + 29, self.shape[0]), left : min(left + 29, self.shape[1])]
            dy, dx = np.mgrid[cut]
            offset = np.stack([dx - x, dy - y], axis=-1) @ inverse.T
            image[cut] -= DEPTH * np.exp(-(offset**2).sum(axis=-1) / (2 * SIGMA**2))
        return image

    def noisy(self, ideal: np.ndarray) -> np.ndarray:
        """A camera's frame of an image: grey-dependent noise, rounded to 8 bits."""
        spread = NOISE_AT_GROUND * np.sqrt(np.maximum(ideal, 1.0) / GROUND)
        return np.clip(np.rint(self.rng.normal(ideal, spread)), 0, 255).astype(np.uint8)

    def frame(self, gradient=NO_STRETCH, shift=(0.0, 0.0)) -> np.ndarray:
        return self.noisy(self.ideal(gradient, shift))


@pytest.fixture
def sheet() -> Callable[..., Sheet]:
    """Builds a sheet with a jittered grid of dots, `columns` x `rows`."""

    def build(columns: int = 7, rows: int = 7, seed: int = 11) -> Sheet:
        rng = np.random.default_rng(seed)
        x, y = np.meshgrid(np.linspace(40, 220, columns), np.linspace(40, 200, rows))
        grid = np.stack([x.ravel(), y.ravel()], axis=1)
        return Sheet(grid + rng.uniform(-2, 2, grid.shape), rng=rng)

    return build
