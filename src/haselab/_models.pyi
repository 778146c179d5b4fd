import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

class Plays:
    """Play operators with common settings; `state` is changed in place."""

    def __init__(
        self,
        thresholds: Floats,
        weights: Floats,
        gain: float,
        rate_dependence_s: float,
        pull: float,
        rate_hz: float,
        /,
    ) -> None: ...
    def run(self, state: Floats, u: Floats, y: Floats, /) -> None: ...
    def invert(self, state: Floats, y: Floats, u: Floats, /) -> None: ...
    def columns(
        self, state: Floats, u: Floats, plays: Floats, by_threshold: Floats, by_rate: Floats, /
    ) -> None: ...

def run_bouc_wen(
    sharpness: float, sigma: float, exponent: float, state: Floats, u: Floats, w: Floats, /
) -> None: ...
def invert_bouc_wen(
    sharpness: float,
    sigma: float,
    exponent: float,
    gain: float,
    weight: float,
    state: Floats,
    y: Floats,
    u: Floats,
    /,
) -> None: ...
