import numpy as np
from numpy.typing import NDArray

COLUMNS: int
KEPT: int
SLOW: int

def summaries(
    table: NDArray[np.float64],
    period_s: float,
    reference: NDArray[np.float32],
    slow: int,
    noise: NDArray[np.float32],
    band: float,
    ends: NDArray[np.uint64],
    out: NDArray[np.float32],
    bits: int = 512,
    threads: int = 1,
) -> None: ...
def traces(
    table: NDArray[np.float64],
    period_s: float,
    reference: NDArray[np.float32],
    slow: int,
    noise: NDArray[np.float32],
    measured: NDArray[np.float32],
    u: NDArray[np.float32],
    bits: int = 512,
    threads: int = 1,
) -> None: ...
def widest() -> int: ...
