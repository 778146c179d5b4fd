import numpy as np
from numpy.typing import NDArray

BINS: int
BIN_NS: int

def idle(period_ns: int, n_ticks: int, priority: int, spin_ns: int) -> tuple[int, int]: ...

class Control:
    def __init__(
        self,
        *,
        samples: int,
        first: int,
        cosine: NDArray[np.float32],
        sine: NDArray[np.float32],
        inverse: NDArray[np.float32],
        impedance: NDArray[np.float32],
        strain_map: NDArray[np.float32],
        pid: NDArray[np.float32],
        voltage_map: NDArray[np.float32],
        limits: NDArray[np.float32],
        full_scale: int,
    ) -> None: ...
    def reset(self) -> None: ...
    def step(
        self, codes: NDArray[np.int16], reference: float
    ) -> tuple[float, float, float, int]: ...

class Loop:
    def __init__(
        self,
        control: Control,
        parameters: int,
        state: int,
        load_n: float,
        switch_sample: int,
        reference: NDArray[np.float32],
        slots: int,
        patience: int,
        patience_missed: int,
        priority: int,
        spin_ns: int,
    ) -> None: ...
    def start(self) -> None: ...
    def stop(self) -> None: ...
    def join(self) -> None: ...
    def take(self, codes: NDArray[np.int16], rows: NDArray[np.float64]) -> int: ...
    def counts(self) -> dict[str, int]: ...
    def histogram(self, of_work: bool, out: NDArray[np.float64]) -> None: ...
    @property
    def outcome(self) -> int: ...
