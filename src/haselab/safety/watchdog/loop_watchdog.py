"""Monitor a closed loop block by block: its signals, the actuator's response and the output."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import Limits
from haselab.rig import RigDescription
from haselab.safety.watchdog.loop_model import LoopModel
from haselab.safety.watchdog.loop_signals import WINDOW_S, Delay, Jumps, Plausible, Repeats, Swings
from haselab.safety.watchdog.plant_direction import POINTS, Reaction
from haselab.safety.watchdog.settings import FieldRating, WatchdogSettings

__all__ = ["LoopSample", "LoopWatchdog", "OutputWatchdog"]


@dataclass(frozen=True, slots=True)
class LoopSample:
    """One block of a closed loop.

    Args:
        strain: measured; NaN if there is none.
        capacitance_f: from which it was computed; None with another sensor.
        drive_v: in force during the block, at the amplifier's input.
        reference: desired strain; NaN in open loop.
        fresh: whether the strain is new; False while the last camera frame is reused.
        age_s: age of the frame at the end of the block; None with another sensor.
    """

    strain: float
    capacitance_f: float | None
    drive_v: float
    reference: float
    fresh: bool = True
    age_s: float | None = None


def _blocks(block_s: float, settings: WatchdogSettings) -> Repeats:
    advice = "The acquisition is frozen. Check its link."
    return Repeats("Block", block_s, settings.repeat_s, advice)


class OutputWatchdog:
    """Watches a rig that closes its own loop and reports blocks and its output, but no strain.

    Args:
        rig: nominal values.
        strain_limits: of its reference.
        settings: limits.
    """

    def __init__(
        self, rig: RigDescription, strain_limits: Limits, settings: WatchdogSettings
    ) -> None:
        self._blocks = _blocks(rig.block_s, settings)
        reach_v = max(abs(rig.drive_limits.low), abs(rig.drive_limits.high))
        range_ = strain_limits.high - strain_limits.low
        self._swings = Swings(rig.block_s, reach_v, rig.amplifier_gain, range_, settings)

    def fault(self, codes: NDArray[np.int16], drive_v: float, reference: float) -> str:
        """Return why the loop must stop after this block, or an empty text.

        Args:
            codes: of the block.
            drive_v: reported by the rig, at the amplifier's input.
            reference: desired strain.
        """
        return self._blocks.fault(hash(codes.tobytes())) or self._swings.fault(
            drive_v, reference, None
        )


class LoopWatchdog:
    """Compares each block of one closed loop with what an actuator and its bench can do.

    Args:
        model: of the loop.
        settings: limits.
        rating: of the dielectric; None if it is unknown.
        before_v: drive before the loop closes; None: unknown.
        settled: the actuator was in equilibrium with it; else it may still ring.
    """

    def __init__(
        self,
        model: LoopModel,
        settings: WatchdogSettings,
        rating: FieldRating | None = None,
        before_v: float | None = None,
        settled: bool = True,
    ) -> None:
        self._model, self._settings, self._rating = model, settings, rating
        self._map: tuple[list[float], list[float]] = (
            model.map_drive_v.tolist(),
            model.map_strain.tolist(),
        )
        self._plausible = Plausible(model, settings)
        self._blocks = _blocks(model.block_s, settings)
        self._strains = Repeats(
            "Strain",
            model.block_s,
            settings.repeat_s,
            "The sensor is frozen, or its steps are too coarse. Check camera, monitors and cables.",
        )
        rest = None if before_v is None else self._static(before_v)
        self._jumps = Jumps(model, settings, rest)
        # The loop's first output is a step from equilibrium. A sensing chain without blanking
        # mistakes that step for a change of strain, in the block in which it leaves the queue.
        self._stepping = model.queued + 1
        self._swings = Swings(
            model.block_s, model.drive_reach_v, model.gain, model.range, settings, model.alternates
        )
        self._before_v = 0.0
        self._delay = Delay(model, settings)
        self._reaction = Reaction(
            model.range,
            settings.move_share,
            settings.response_share,
            settings.direction_ratio,
            max(1, round(WINDOW_S / POINTS / model.block_s)),
            rest,
            settled,
        )
        self._lost: deque[bool] = deque(maxlen=max(round(WINDOW_S / model.block_s), 2))
        self._held = 1

    def fault(self, codes: NDArray[np.int16], sample: LoopSample) -> str:
        """Return why the loop must stop after this block, or an empty text.

        Args:
            codes: of the block, shape `(block_samples, 2)`.
            sample: values that the loop computed from it.
        """
        return (
            self._blocks.fault(hash(codes.tobytes()))
            or self._sensor(sample)
            or self._swings.fault(sample.drive_v, sample.reference, sample.capacitance_f)
            or self._delay.fault(codes, sample.drive_v)
            or self._field(sample)
        )

    def _sensor(self, sample: LoopSample) -> str:
        strain, static = sample.strain, self._static(sample.drive_v)
        self._jumps.driven(static)
        if self._changes_sign(sample.drive_v):
            self._held += 1
            self._lost.append(True)
            return self._gaps() or self._late(sample)
        stepping, self._stepping = self._stepping > 0, max(self._stepping - 1, 0)
        self._lost.append(math.isnan(strain))
        if self._lost[-1]:
            self._jumps.clear()
            self._reaction.clear()
            return self._gaps()
        fault = self._plausible.fault(strain, sample.capacitance_f)
        if not fault and sample.fresh:
            fault = self._strains.fault(strain)
            if not fault and not stepping:
                fault = self._jumps.fault(strain, self._held)
        self._held = 1 if sample.fresh else self._held + 1
        return fault or self._late(sample) or self._reaction.fault(static, strain)

    def _changes_sign(self, drive_v: float) -> bool:
        """Whether an alternating voltage passes zero in this block, so that it gives no strain."""
        before_v, self._before_v = self._before_v, drive_v
        return self._model.alternates and drive_v * before_v < 0.0

    def _static(self, drive_v: float) -> float:
        """Static strain of a drive, by the voltage map."""
        acting_v = abs(drive_v) if self._model.alternates else drive_v
        volts, strains = self._map  # np.interp would let another thread run, and wait for it
        if not volts[0] <= acting_v < volts[-1]:
            return math.nan if math.isnan(acting_v) else strains[0 if acting_v < volts[0] else -1]
        k = bisect_right(volts, acting_v) - 1
        slope = (strains[k + 1] - strains[k]) / (volts[k + 1] - volts[k])
        return slope * (acting_v - volts[k]) + strains[k]

    def _gaps(self) -> str:
        lost, window = sum(self._lost), self._lost.maxlen or 1
        if lost <= self._settings.lost_share * window:
            return ""
        return (
            f"Strain lost in {lost} of the last {len(self._lost)} blocks (limit "
            f"{math.floor(self._settings.lost_share * window)}). Check the carrier, the monitors "
            "and the camera."
        )

    def _late(self, sample: LoopSample) -> str:
        if sample.age_s is None or sample.age_s <= self._settings.frame_age_s:
            return ""
        return (
            f"Frame too old: taken {sample.age_s:.3g} s before the end of the block (limit "
            f"{self._settings.frame_age_s:g} s). Check the camera's link, and close other programs."
        )

    def _field(self, sample: LoopSample) -> str:
        rating, farad = self._rating, sample.capacitance_f
        if rating is None or farad is None or not farad > 0.0:
            return ""
        volt = (abs(sample.drive_v) + self._model.carrier_v) * self._model.gain
        field = rating.field_v_per_m(volt, farad)
        if field <= rating.limit_v_per_m:
            return ""
        return (
            f"Field too high: {field / 1e6:.3g} MV/m at {volt:.4g} V and {farad:.3g} F (limit "
            f"{rating.limit_v_per_m / 1e6:.3g} MV/m). Lower the voltage or the load."
        )
