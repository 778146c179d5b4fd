import numpy as np
from numpy.typing import NDArray

class Impedance:
    def __init__(
        self, v_per_i: float, omega_rad_s: float, skew_s: float, min_amplitude: float
    ) -> None: ...
    def __call__(
        self, v_re: float, v_im: float, i_re: float, i_im: float
    ) -> tuple[float, float, bool]: ...

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

def demodulate(
    codes: NDArray[np.int16], weights: NDArray[np.float32]
) -> tuple[float, float, float, float]: ...
def demodulate_blocks(
    codes: NDArray[np.int16],
    weights: NDArray[np.float32],
    basis: NDArray[np.float64],
    inverse: NDArray[np.float64],
    phasors: NDArray[np.float64],
    variance: NDArray[np.float64],
) -> None: ...
def demodulate_floats(
    readings: NDArray[np.float64],
    basis: NDArray[np.float64],
    inverse: NDArray[np.float64],
    phasors: NDArray[np.float64],
    variance: NDArray[np.float64],
) -> None: ...
def exp(x: float) -> float: ...
def voltage_from_strain(a1_v: float, b1: float, a2_v: float, b2: float, strain: float) -> float: ...
def strain_from_capacitance(
    slope_per_f: float, offset: float, curvature_per_f2: float, capacitance_f: float
) -> float: ...
def limit(value: float, low: float, high: float) -> tuple[float, bool]: ...
