"""Strain sensors of a closed loop: the capacitance, or the camera."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from haselab import _core
from haselab.models.actuator.strain_map import StrainMap
from haselab.runtime.observer import Observer
from haselab.sensing import Lockin, PaperChain, reason_text

__all__ = [
    "PATIENCE_BLOCKS",
    "CapacitanceSensor",
    "PrintedChainSensor",
    "StrainSensor",
    "VideoSensor",
]

PATIENCE_BLOCKS = 5  # blocks in a row without a strain that trip the loop


class StrainSensor(Protocol):
    """Gives one strain per block."""

    watches: bool  # whether it reads the camera itself
    capacitance_f: float | None  # of the last block, if the strain is computed from it
    frame_time_s: float | None  # of the last frame, if the strain comes from the camera
    fresh: bool  # whether the last strain is new rather than reused
    in_range: bool  # whether the strain map was fitted at the capacitance of the last block

    def strain(self, codes: NDArray[np.int16]) -> float:
        """Strain of the block just read; NaN if there is none."""

    def lost(self) -> str:
        """Why the last block had no strain, and what to check."""


def _no_capacitance(reason: int) -> str:
    return (
        f"No capacitance ({reason_text(reason)}). Check the function generator and the monitors' "
        "cables."
    )


class CapacitanceSensor:
    """Self-sensing: from the monitors to capacitance to strain.

    Args:
        lockin: for the rig's blocks.
        to_strain: capacitance to strain.
    """

    watches = False
    frame_time_s: float | None = None
    fresh = True

    def __init__(self, lockin: Lockin, to_strain: StrainMap) -> None:
        self._lockin, self._map = lockin, to_strain
        self._usable_f = to_strain.usable_f
        self._fitted_f = to_strain.range_f or (-math.inf, math.inf)
        self.capacitance_f: float | None = None
        self.in_range = True
        self._reason = 0

    def strain(self, codes: NDArray[np.int16]) -> float:
        """See `StrainSensor`."""
        capacitance_f, _, valid = self._lockin.step(codes)
        self.capacitance_f = capacitance_f if valid else None
        self.in_range, self._reason = True, 0
        if not valid:
            self._reason = int(self._lockin.sense(codes[np.newaxis]).reason[0])
            return float("nan")
        low_f, high_f = self._fitted_f
        self.in_range = low_f <= capacitance_f <= high_f
        low_f, high_f = self._usable_f
        if not low_f <= capacitance_f <= high_f:
            return float("nan")
        return _core.strain_from_capacitance(*self._map.coefficients, capacitance_f)

    def lost(self) -> str:
        """See `StrainSensor`."""
        if self._reason or self.capacitance_f is None or self._map.range_f is None:
            return _no_capacitance(self._reason)
        (low_f, high_f), (least_f, most_f) = self._map.range_f, self._usable_f
        return (
            f"Capacitance = {self.capacitance_f:.4g} F is outside {least_f:.4g} to {most_f:.4g} F, "
            f"too far from {low_f:.4g} to {high_f:.4g} F, where the strain map was fitted. Fit a "
            "record in which the length follows the capacitance there, or limit the controller's "
            "output. If the strain oscillated, the loop may be unstable: check it with haselab "
            "margins."
        )


class PrintedChainSensor:
    """Self-sensing by the reference study's own chain, block by block.

    Args:
        chain: for the rig's blocks; its low-pass filter continues from block to block.
        to_strain: capacitance to strain.
    """

    watches = False
    frame_time_s: float | None = None
    fresh = True
    in_range = True  # the printed chain knows no range

    def __init__(self, chain: PaperChain, to_strain: StrainMap) -> None:
        self._chain, self._map = chain, to_strain
        self.capacitance_f: float | None = None
        self._reason = 0

    def strain(self, codes: NDArray[np.int16]) -> float:
        """See `StrainSensor`."""
        sensed = self._chain.sense(codes[np.newaxis])
        valid = bool(sensed.valid[0])
        self._reason = int(sensed.reason[0])
        self.capacitance_f = float(sensed.capacitance_f[0]) if valid else None
        return float(self._map.strain(sensed.capacitance_f)[0]) if valid else float("nan")

    def lost(self) -> str:
        """See `StrainSensor`."""
        return _no_capacitance(self._reason)


class VideoSensor:
    """Camera: strain from the length between the fiducials in the last frame that has arrived.

    A strain is reused until the next frame; after `PATIENCE_BLOCKS` without one it is lost.

    Args:
        observer: tracks the fiducials.
        zero_px: length at zero strain, in px.
    """

    watches = True
    capacitance_f: float | None = None
    in_range = True

    def __init__(self, observer: Observer, zero_px: float) -> None:
        self._observer, self._zero_px = observer, zero_px
        self._strain = float("nan")
        self._old = 0
        self.frame_time_s: float | None = None
        self.fresh = False

    def strain(self, codes: NDArray[np.int16]) -> float:
        """See `StrainSensor`."""
        del codes
        seen = self._observer.look()
        self._old = 0 if seen is not None else self._old + 1
        self.fresh = seen is not None
        if seen is not None:
            self.frame_time_s = seen.time_s
            self._strain = seen.length_px / self._zero_px - 1.0
        return self._strain if self._old < PATIENCE_BLOCKS else float("nan")

    def lost(self) -> str:
        """See `StrainSensor`."""
        if self._old >= PATIENCE_BLOCKS:
            return f"No frame in {self._old} blocks. Check the camera, or raise its frame rate."
        return "A fiducial is not visible. Check the light, and clear the view of the camera."
