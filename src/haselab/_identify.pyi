"""Fits that are too slow in Python; the manuals are the headers of native/."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Found = tuple[Floats, Floats, list[Floats], float, bool]

class Record:
    """struct held_record."""

    def __init__(
        self,
        u: Floats,
        input_rate_hz: float,
        before: float,
        first_order: bool,
        y: Floats,
        time_s: Floats,
        margin_s: float,
    ) -> None: ...
    def __len__(self) -> int: ...

class Transfer:
    """struct transfer_problem."""

    def __init__(
        self,
        *,
        pairs: int,
        reals: int,
        zeros: int,
        slow: int,
        initial_state: bool,
        offset: bool,
        numbers: Sequence[float],
        factors: Sequence[float],
        records: list[Record],
    ) -> None: ...
    def project(self, search: Sequence[float]) -> Found: ...
    def minimise(
        self,
        search: Sequence[float],
        low: Sequence[float],
        high: Sequence[float],
        iterations: int,
        gain: float,
    ) -> Found: ...
    def columns(self, search: Sequence[float]) -> tuple[Floats, Floats]: ...
    def predict(
        self, search: Sequence[float], shared: Sequence[float], own: Sequence[Sequence[float]]
    ) -> Floats: ...

def follow_slowly(wanted: Floats, before: float, most: float) -> Floats: ...
def autocovariance(residuals: Sequence[Floats], lags: int) -> Floats: ...
def autoregression(covariance: Sequence[float], count: int) -> tuple[Floats, float]: ...

OSCILLATOR: dict[str, int]  # place of each number of native/identification/oscillator.h

def oscillate(
    u: Floats,
    input_rate_hz: float,
    before: float,
    first_order: bool,
    time_s: Floats,
    numbers: Sequence[float],
    largest: float,
) -> tuple[Floats, Floats, bool]: ...
