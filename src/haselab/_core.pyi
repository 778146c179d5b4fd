import numpy as np
from numpy.typing import NDArray

class Pid:
    def __init__(
        self,
        kp: float,
        ki: float,
        kd: float,
        period_s: float,
        derivative_filter_s: float,
        u_low: float,
        u_high: float,
    ) -> None: ...
    def reset(self, u: float) -> None: ...
    def step(self, reference: float, measurement: float) -> float: ...
    @property
    def integral(self) -> float: ...

# Structs of core/include/hs_motion.h as numpy dtypes with the same names of fields.
MOTION: np.dtype[np.void]
FORCE: np.dtype[np.void]
OBSERVER: np.dtype[np.void]

class Force:
    def __init__(self, motion: NDArray[np.void], gains: NDArray[np.void]) -> None: ...
    def step(self, reference: float, strain: float, voltage_v: float, valid: bool) -> float: ...

class Observer:
    def __init__(self, motion: NDArray[np.void], gains: NDArray[np.void]) -> None: ...
    def step(self, reference: float, strain: float, voltage_v: float, valid: bool) -> float: ...
    @property
    def load(self) -> int: ...

def exp(x: float) -> float: ...
def voltage_from_strain(a1_v: float, b1: float, a2_v: float, b2: float, strain: float) -> float: ...
def strain_from_capacitance(
    slope_per_f: float,
    offset: float,
    curvature_per_f2: float,
    cubic_per_f3: float,
    capacitance_f: float,
) -> float: ...
def limit(value: float, low: float, high: float) -> tuple[float, bool]: ...
def capacitances_from_quadrature(
    turn_re: float,
    turn_im: float,
    v_low: int,
    v_high: int,
    i_low: int,
    codes: NDArray[np.int16],
    farad: NDArray[np.float32],
    reason: NDArray[np.uint8],
) -> None: ...
