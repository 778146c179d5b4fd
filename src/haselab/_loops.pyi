import numpy as np
from numpy.typing import NDArray

COLUMNS: int
KEPT: int
SLOW: int

class Loops:
    def __init__(self, table: NDArray[np.float64], period_s: float, branches: int) -> None: ...
    def summaries(
        self,
        reference: NDArray[np.float32],
        noise: NDArray[np.float32],
        seeds: NDArray[np.uint32],
        band: float,
        ends: NDArray[np.uint64],
        out: NDArray[np.float32],
        bits: int = 512,
        threads: int = 0,
    ) -> None: ...
    def traces(
        self,
        reference: NDArray[np.float32],
        noise: NDArray[np.float32],
        seeds: NDArray[np.uint32],
        measured: NDArray[np.float32],
        u: NDArray[np.float32],
        bits: int = 512,
        threads: int = 0,
    ) -> None: ...

def run_exact(
    plant: NDArray[np.float64],
    decay: NDArray[np.float64],
    push: NDArray[np.float64],
    state: NDArray[np.float64],
    pid: NDArray[np.float64],
    u_before: float,
    line: NDArray[np.float64],
    reference: NDArray[np.float64],
    noise: NDArray[np.float64],
    measured: NDArray[np.float64],
    u: NDArray[np.float64],
) -> None: ...
def widest() -> int: ...
