import numpy as np
from numpy.typing import NDArray

PARAMETERS: np.dtype[np.void]
STATE: np.dtype[np.void]
INPUT: np.dtype[np.void]
BRANCHES: int
ROWS: int
START: int
DAMPING: int
INERTIA: int
SOFTENING_SHARE: int
SOFTENING_STRETCH: int
SOFTENING_WIDTH: int
CHARGE_SHARE: int
CHARGE_S: int
HYSTERESIS_N: int
HYSTERESIS_WIDTH: int
ELASTIC_DRIFT: int
ELECTRIC_DRIFT: int
VOLTAGE_SCALE: int
BRANCH_SHARE: int
BRANCH_S: int

class Law:
    def __init__(
        self,
        low_m: float,
        step_m: float,
        step_v: float,
        elastic_n: NDArray[np.float64],
        gap_m: NDArray[np.float64],
        capacitance_f: NDArray[np.float64],
        pull_n_v2: NDArray[np.float64],
    ) -> None: ...

def play(
    law: Law,
    parameters: NDArray[np.void],
    state: NDArray[np.void],
    edge_s: NDArray[np.float64],
    input: NDArray[np.void],
    mass_kg: NDArray[np.float64],
    sensed: NDArray[np.uint8],
    time_s: NDArray[np.float64],
    length_m: NDArray[np.float64],
    speed_m_s: NDArray[np.float64],
    mean_f: NDArray[np.float64],
    drift_f_s: NDArray[np.float64],
    kind: NDArray[np.int32],
    elastic: NDArray[np.float64],
    pull: NDArray[np.float64],
    capacitance: NDArray[np.float64],
    free_m: NDArray[np.float64],
    rows: NDArray[np.float64],
    length_by: NDArray[np.float64],
    mean_by: NDArray[np.float64],
) -> None: ...
