import numpy as np
from numpy.typing import NDArray

class Scene:
    def __init__(
        self,
        *,
        geometry: NDArray[np.float64],
        illumination_x: NDArray[np.float32],
        illumination_y: NDArray[np.float32],
        clamp_x: NDArray[np.float32],
        blobs: NDArray[np.float64],
        noise: NDArray[np.float32],
        normal_table: NDArray[np.float32],
        seed: int,
    ) -> None: ...
    def expect(self, lengths_px: NDArray[np.float64], out: NDArray[np.float32]) -> None: ...
    def render(
        self, lengths_px: NDArray[np.float64], first_index: int, out: NDArray[np.uint8]
    ) -> None: ...
