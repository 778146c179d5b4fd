from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

BLOB: np.dtype[np.void]  # struct camera_blob of native/twin/camera.h

class Geometry:
    def __init__(
        self,
        *,
        top_px: float,
        mid_px: float,
        half_width_px: float,
        free_length_px: float,
        neck: float,
        edge_px: float,
        clamp_inside_px: float,
        clamp_outside_px: float,
        background_grey: float,
        sheet_grey: float,
        clamp_grey: float,
    ) -> None: ...

class Scene:
    def __init__(
        self,
        *,
        geometry: Geometry,
        illumination_x: NDArray[np.float32],
        illumination_y: NDArray[np.float32],
        clamp_x: NDArray[np.float32],
        blobs: NDArray[np.void],
        shot_gain_grey: float,
        read_noise_grey: float,
        normal_table: NDArray[np.float32],
        seed: int,
    ) -> None: ...
    def expect(self, lengths_px: NDArray[np.float64], out: NDArray[np.float32]) -> None: ...
    def render(
        self,
        lengths_px: NDArray[np.float64],
        first_index: int,
        out: NDArray[np.uint8],
        rows: tuple[int, int],
        columns: Sequence[tuple[int, int]],
    ) -> None: ...
