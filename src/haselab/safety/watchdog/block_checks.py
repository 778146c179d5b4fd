"""Checks of each block: current, collapse of the output, format, gaps."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError
from haselab.rig import RigDescription
from haselab.safety.state_machine import SafetySettings

__all__ = ["BlockWatch"]

# fraction of the samples that may be outside: sparks in the wires, not in the actuator
_GLITCHES = 0.05
_PINNED_S = 1e-3  # a current at the end of the converter's range for longer is not a charging edge
_END_CODE = 32766
_PEAKING = 2.0  # largest gain of the carrier by an amplifier with a damping of 0.3


class BlockWatch:
    """Compares each block with the requested output.

    The voltage monitor must stay between the outputs that were in force during the last
    `settle_s`, within `follow` of the drive's range and the carrier's amplitude. Once the output
    has settled, the mean current must not exceed `current_limit_a`.

    Args:
        rig: nominal values of the bench.
        settings: limits.
    """

    def __init__(self, rig: RigDescription, settings: SafetySettings) -> None:
        self._rig, self._settings = rig, settings
        self._settled = min(
            rig.switch_in_block + math.ceil(settings.settle_s * rig.rate_hz), rig.block_samples
        )
        # Outputs, newest request last: those before, the one in force, those still queued.
        self._queued = rig.queued_blocks
        kept = self._queued + 2 + math.ceil(settings.settle_s / rig.block_s)
        self._requested_v: deque[float] = deque([0.0] * kept, maxlen=kept)
        self._code_per_v = rig.amplifier_gain * rig.v_monitor_v_per_v / rig.volt_per_code
        self._tolerance_v = settings.follow * rig.drive_reach_v
        self._carrier_v = 0.0  # largest peak of the sensing signal at the amplifier's input
        self._carrier_hz = math.inf  # its lowest frequency

    def add_carrier(self, frequency_hz: float, amplitude_v: float) -> None:
        """Allow this sensing signal from now on, besides the earlier ones."""
        self._carrier_v = max(self._carrier_v, amplitude_v)
        self._carrier_hz = min(self._carrier_hz, frequency_hz)

    def rest(self, output_v: float) -> None:
        """Note that no block was read for a while, during which the output was constant."""
        self._requested_v.extend([output_v] * (self._requested_v.maxlen or 1))

    def check_form(self, codes: NDArray[np.int16], passed_s: float | None) -> None:
        """Refuse a block that does not fit this rig, or that is not the next one.

        Args:
            codes: from the acquisition.
            passed_s: time that passed on the acquisition's clock, in s; None: not checked.
        Raises:
            DeviceError: Shape or type is wrong, or there is a gap.
        """
        wanted = (self._rig.block_samples, 2)
        shape = getattr(codes, "shape", None)
        if shape != wanted or codes.dtype != np.int16:
            kind = getattr(codes, "dtype", type(codes).__name__)
            raise DeviceError(
                f"The acquisition returned a block of shape {shape}, type {kind}, but this rig "
                f"needs {wanted}, int16. Check the link to the acquisition and its channels."
            )
        if passed_s is None:
            return
        samples = passed_s * self._rig.rate_hz
        if not abs(samples - self._rig.block_samples) < 0.5:
            raise DeviceError(
                f"Gap in the recording: the clock advanced by {samples:.6g} samples in one block "
                f"instead of {self._rig.block_samples}. Check the link, the buffer and the CPU "
                "load. If your own program waited between two blocks, call begin() of the armed "
                "rig after the wait."
            )

    def fault(self, codes: NDArray[np.int16], requested_v: float, *, follows: bool = True) -> str:
        """Return why the bench must stop after this block, or an empty text.

        Args:
            codes: of the block, shape `(block_samples, 2)`.
            requested_v: drive requested before the block, in V.
            follows: whether the block is the next one. If some may have been skipped, queued
                outputs may already be in force, and any recently requested one is accepted.
        """
        self._requested_v.append(requested_v)
        held = list(self._requested_v)[: len(self._requested_v) - self._queued * follows]
        settled = 0
        if min(held) != max(held):  # still settling; if blocks were skipped, at an unknown time
            settled = self._settled if follows else self._rig.block_samples
        volt, current = codes[:, 0], codes[:, 1]
        wrong_v = self._outside_range(volt[settled:], held[-1], held[-1])
        mean_a = self._mean_a(current[settled:])
        if abs(mean_a) > self._settings.current_limit_a:
            return self._over_current(mean_a, wrong_v, held[-1])
        if wrong_v is None:
            wrong_v = self._off_centre(volt[settled:], held[-1])
        if wrong_v is None:
            wrong_v = self._outside_range(volt[:settled], min(held), max(held))
        if wrong_v is not None:
            wanted = " or ".join(f"{self._output(v):.4g}" for v in sorted(set(held[-2:])))
            return (
                f"Output does not follow: {wrong_v:.4g} V read back, requested {wanted} V (limit "
                f"±{self._output(self._tolerance_v):.4g} V). Check the amplifier, the monitor "
                "cables and the actuator (breakdown, short circuit)."
            )
        return self._pinned(current)

    def _mean_a(self, current: NDArray[np.int16]) -> float:
        if current.size == 0:
            return 0.0
        mean = float(np.add.reduce(current, dtype=np.int64)) / current.size  # exact
        return mean * self._rig.volt_per_code / self._rig.i_monitor_v_per_a

    def _over_current(self, mean_a: float, wrong_v: float | None, output_v: float) -> str:
        limit = f"{1e3 * self._settings.current_limit_a:.3g} mA"
        if wrong_v is not None and abs(wrong_v) < abs(self._output(output_v)):
            return (
                f"Breakdown: output collapsed to {wrong_v:.4g} V of "
                f"{self._output(output_v):.4g} V at {1e3 * mean_a:.3g} mA (limit {limit}). "
                "Look for an arc; replace the actuator if it broke down."
            )
        return (
            f"Over-current: {1e3 * mean_a:.3g} mA with the output settled (limit {limit}). "
            "Look for a leakage path or an arc; lower the voltage."
        )

    def _pinned(self, current: NDArray[np.int16]) -> str:
        lowest, highest = np.minimum.reduce(current), np.maximum.reduce(current)
        if max(int(highest), -int(lowest)) < _END_CODE:
            return ""
        pinned = int(np.count_nonzero((current >= _END_CODE) | (current <= -_END_CODE)))
        if pinned <= _PINNED_S * self._rig.rate_hz:
            return ""
        return (
            f"Over-current: the current monitor was at the end of its range for "
            f"{1e3 * pinned / self._rig.rate_hz:.3g} ms (limit {1e3 * _PINNED_S:.3g} ms). "
            "Look for a short circuit; make the steps smaller."
        )

    def _outside_range(self, volt: NDArray[np.int16], low_v: float, high_v: float) -> float | None:
        """Median of the outputs outside the range, in V; None if only a few samples are outside."""
        if volt.size == 0 or not self._settings.compare_output:
            return None
        spread_v = self._tolerance_v + _PEAKING * self._carrier_v
        low, high = (low_v - spread_v) * self._code_per_v, (high_v + spread_v) * self._code_per_v
        if low <= int(np.minimum.reduce(volt)) and int(np.maximum.reduce(volt)) <= high:
            return None
        outside = (volt < low) | (volt > high)
        if np.count_nonzero(outside) <= _GLITCHES * volt.size:
            return None
        return self._output(float(np.median(volt[outside])) / self._code_per_v)

    def _off_centre(self, volt: NDArray[np.int16], drive_v: float) -> float | None:
        """Centre of the settled output, in V, if a large carrier could hide that it is wrong.

        The median of a sine is its centre. An incomplete period, few samples per period and
        glitches move it to another quantile q of the sine, $A \\sin(\\pi q)$ away from the centre.
        """
        swing_v = _PEAKING * self._carrier_v
        if volt.size == 0 or not self._settings.compare_output or swing_v <= self._tolerance_v:
            return None
        samples = self._rig.rate_hz / self._carrier_hz  # of one period
        quantile = 0.25 * samples / volt.size + 0.5 / samples + 0.5 * _GLITCHES
        spread_v = self._tolerance_v + swing_v * math.sin(math.pi * min(quantile, 0.5))
        centre_v = float(np.median(volt)) / self._code_per_v
        return None if abs(centre_v - drive_v) <= spread_v else self._output(centre_v)

    def _output(self, drive_v: float) -> float:
        return drive_v * self._rig.amplifier_gain

    def residual_v(self, codes: NDArray[np.int16]) -> float:
        """Peak output in the last quarter of a block, in V: the residual after 0 V was requested.

        Mean plus the amplitude of a sine with this rms, so that a carrier left on counts.
        """
        last = codes[-(len(codes) // 4) :, 0].astype(np.float64)
        peak = abs(float(last.mean())) + math.sqrt(2.0) * float(last.std())
        return self._output(peak / self._code_per_v)
