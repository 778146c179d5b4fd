from typing import Any

import numpy as np
from numpy.typing import NDArray

SEGMENTS: int
ROOM: int
PART_COLUMNS: int

# Structs of native/sensing as numpy dtypes with the same names of fields.
RESULT: np.dtype[np.void]
CHOICE: np.dtype[np.void]
SUMS: np.dtype[np.void]
PART: np.dtype[np.void]
PARTS_RESULT: np.dtype[np.void]
PAPER_RESULT: np.dtype[np.void]

class Plan:
    def __init__(
        self,
        *,
        samples: int,
        cosine: NDArray[np.float64],
        sine: NDArray[np.float64],
        table: NDArray[np.float64],
        turn: NDArray[np.float64],
        local: NDArray[np.float64],
        whitening: NDArray[np.float64],
        choices: NDArray[np.void],
        period_s: float,
        omega_rad_s: float,
        full_scale: float,
        current_limit: float,
        vectors: int = 512,
    ) -> None: ...

def vectors() -> int: ...
def sum_segments(
    x: NDArray[np.float32],
    cosine: NDArray[np.float32],
    sine: NDArray[np.float32],
    bits: int,
    out: NDArray[np.void],
) -> None: ...
def blocks(plan: Plan, readings: NDArray[Any], out: NDArray[np.void], threads: int = 0) -> None: ...
def channels(
    plan: Plan,
    voltage: NDArray[Any],
    current: NDArray[Any],
    out: NDArray[np.void],
    threads: int = 0,
) -> None: ...
def parts(
    y: NDArray[np.float64],
    tables: list[NDArray[np.float64]],
    limits: list[int],
    prices: list[float],
    parts: NDArray[np.void],
    result: NDArray[np.void],
) -> None: ...

class Impedance:
    def __init__(
        self,
        scale_re: float,
        scale_im: float,
        stray_re: float,
        stray_im: float,
        omega_rad_s: float,
        min_amplitude: float,
        quadrature: float,
    ) -> None: ...
    def __call__(self, plan: Plan, block: NDArray[Any]) -> tuple[float, float, int]: ...

class Paper:
    def __init__(
        self,
        sections: NDArray[np.float64],
        rest: NDArray[np.float64],
        wave: NDArray[np.float64],
    ) -> None: ...
    def step(self, blocks: NDArray[np.float64], out: NDArray[np.void]) -> None: ...
