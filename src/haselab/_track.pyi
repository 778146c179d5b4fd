import numpy as np
from numpy.typing import NDArray

class Templates:
    def __init__(
        self,
        shape: NDArray[np.float32],
        gradient: NDArray[np.float32],
        weight: NDArray[np.float32],
        inverse: NDArray[np.float32],
        side: int,
    ) -> None: ...

def refine(
    templates: Templates,
    frame: NDArray[np.uint8] | NDArray[np.uint16],
    poses: NDArray[np.float64],
    results: NDArray[np.float32],
    which: NDArray[np.int32],
    max_iterations: int,
    tolerance_px: float,
) -> None: ...
def search(
    templates: Templates,
    frame: NDArray[np.uint8] | NDArray[np.uint16],
    poses: NDArray[np.float64],
    results: NDArray[np.float32],
    which: NDArray[np.int32],
    radius: int,
) -> None: ...
