import numpy as np
from numpy.typing import NDArray

SLOW: int

# Structs as numpy dtypes with the same names of fields.
LOOP: np.dtype[np.void]  # plants/held.py and native/bindings/bind_loops.cpp
SUMMARY: np.dtype[np.void]  # native/loops/loops.h

class Loops:
    def __init__(self, table: NDArray[np.void], period_s: float, branches: int) -> None: ...
    def summaries(
        self,
        reference: NDArray[np.float32],
        noise: NDArray[np.float32],
        seeds: NDArray[np.uint32],
        band: float,
        ends: NDArray[np.uint64],
        out: NDArray[np.void],
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

class ExactPid:
    def __init__(
        self,
        *,
        kp: float,
        ki: float,
        kd: float,
        period_s: float,
        filter_constant: float,
        u_low: float,
        u_high: float,
    ) -> None: ...

def run_exact(
    *,
    free: NDArray[np.float64],
    push: NDArray[np.float64],
    feed: float,
    slow_decay: NDArray[np.float64],
    slow_push: NDArray[np.float64],
    state: NDArray[np.float64],
    pid: ExactPid,
    u_before: float,
    line: NDArray[np.float64],
    reference: NDArray[np.float64],
    noise: NDArray[np.float64],
    measured: NDArray[np.float64],
    u: NDArray[np.float64],
) -> None: ...
def widest() -> int: ...
