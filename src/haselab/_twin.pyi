from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

OFFSETS: dict[str, int]
SIZES: tuple[int, int]

class Ensemble:
    def __init__(
        self,
        benches: tuple[Bench, ...],
        switch_at: Sequence[int],
        slots: int,
        window: tuple[int, int, int],
    ) -> None: ...
    def reset(self, slots: NDArray[np.int64], benches: NDArray[np.int64]) -> None: ...
    def update(
        self,
        before_v: NDArray[np.float64],
        after_v: NDArray[np.float64],
        load_n: NDArray[np.float64],
        capacitances_f: NDArray[np.float64],
        lengths_m: NDArray[np.float64],
    ) -> None: ...
    def fault(self, slot: int) -> int: ...
    @property
    def any_fault(self) -> bool: ...

class Bench:
    inertia_kg: float
    carrier_v: float
    carrier_rad_s: float
    def __init__(
        self,
        values: Mapping[str, float],
        motion: NDArray[np.void],
        length_m: float,
        seed: int,
        low_m: float,
        step_m: float,
        step_v: float,
        elastic_n: NDArray[np.float64],
        gap_m: NDArray[np.float64],
        capacitance_f: NDArray[np.float64],
        pull_n_v2: NDArray[np.float64],
    ) -> None: ...
    def acquire(
        self,
        before_v: float,
        after_v: float,
        switch_at: int,
        load_n: float,
        codes: NDArray[np.int16],
        lengths: NDArray[np.float64],
    ) -> None: ...
    def move(
        self,
        drive_v: NDArray[np.float64],
        steps_per_value: int,
        load_n: float,
        lengths: NDArray[np.float64],
    ) -> None: ...
    def update(
        self,
        before_v: float,
        after_v: float,
        load_n: float,
        timing: tuple[int, int, int, int],
        lengths: NDArray[np.float64],
        at: int,
    ) -> float: ...
    def connect(self, farad: float, series_ohm: float) -> None: ...
    def elastic_force(self, length_m: float) -> float: ...
    def capacitance(self, length_m: float, voltage_v: float = 0.0) -> float: ...
    def gap(self, length_m: float) -> float: ...
    @property
    def addresses(self) -> tuple[int, int]: ...
    @property
    def length_m(self) -> float: ...
    @property
    def time_s(self) -> float: ...
    @property
    def output_v(self) -> float: ...
    @property
    def field_v_m(self) -> float: ...
    @property
    def broken(self) -> bool: ...
    @property
    def outside(self) -> bool: ...
    @property
    def limited_samples(self) -> int: ...
