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

def widest() -> int: ...
