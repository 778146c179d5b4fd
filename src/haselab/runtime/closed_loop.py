"""A closed loop while it runs: sensor, watchdog and controller, block by block."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from haselab import _core
from haselab.base import SafetyError
from haselab.controllers import ControllerSetting, Measurement
from haselab.controllers.motion_model import MotionModel
from haselab.rig import RigDescription
from haselab.runtime.lockin import counted_s, lockin_of, printed_chain_of
from haselab.runtime.loop import LoopSettings, RunningController
from haselab.runtime.observer import Observer
from haselab.runtime.sensors import (
    PATIENCE_BLOCKS,
    CapacitanceSensor,
    PrintedChainSensor,
    StrainSensor,
    VideoSensor,
)
from haselab.safety.guarded import GuardedRig
from haselab.safety.watchdog.loop_model import loop_model
from haselab.safety.watchdog.loop_watchdog import LoopSample, LoopWatchdog

__all__ = ["ClosedLoop", "setting_on_rig"]

_REACH_POINTS = 1001  # points of the saturation range where the loop's voltages are checked


class ClosedLoop:
    """One closed loop on a rig; the caller puts out `due_v` and passes each block to `step`.

    Args:
        rig: the bench.
        camera_recorder: of its camera.
        carrier: frequency in Hz and peak amplitude in V of the sensing signal.
        loop: controller and maps.
        name: of the experiment, for messages.
    Raises:
        InputError: The controller does not start.
        LimitError: The voltage map exceeds the drive limits within the saturation.
    """

    def __init__(
        self,
        rig: GuardedRig,
        camera_recorder: Observer,
        carrier: tuple[float, float],
        loop: LoopSettings,
        name: str,
    ) -> None:
        self._rig, self._loop, self._name = rig, loop, name
        block_s = rig.description.block_s
        setting = setting_on_rig(rig.description, carrier[0], loop)
        limits_s: tuple[float | None, float | None] = (None, None)
        if (settings := rig.safety.settings).real_time:  # the guardians act after the same times
            limits_s = settings.idle_s, settings.lease_s
        self._controller = RunningController(loop.controller, setting, *limits_s)
        self._step_name = f"The step of controller {loop.controller.kind.name!r}"
        self._in_volts = loop.controller.kind.output == "voltage"
        self._ahead = loop.controller.kind.preview_steps(block_s)
        self._sensor = _sensor(rig, camera_recorder, carrier[0], loop)
        self._watchdog = _watchdog(rig, carrier, loop)
        self._lost = self._outside = 0  # blocks
        start, limits = loop.saturation.start, (loop.saturation.low, loop.saturation.high)
        ends = (start, start) if self._in_volts else limits  # a voltage is limited at each step
        strains = np.linspace(*ends, _REACH_POINTS)
        voltages = [self._voltage(float(strain)) for strain in (*strains, start)]
        rig.description.drive_limits.check(voltages)
        self._output_v = self._voltage(start)
        self._waiting = deque([self._output_v] * loop.extra_delay_blocks)
        # the drives of the last blocks; the oldest one acts, the others are queued in the device
        queued = rig.description.queued_blocks
        self._drives_v = deque([rig.present_drive_v] * (queued + 1), queued + 1)

    @property
    def preview_blocks(self) -> int:
        """How many coming desired strains the controller gets."""
        return self._ahead

    @property
    def watches_camera(self) -> bool:
        """Whether the sensor reads the camera itself."""
        return self._sensor.watches

    def due_v(self) -> float:
        """The drive of the next block, in V."""
        self._waiting.append(self._output_v)
        return self._waiting.popleft()

    def step(
        self, codes: NDArray[np.int16], desired: float, preview: tuple[float, ...] = ()
    ) -> None:
        """Compute the drive from a block.

        Args:
            codes: the block just read.
            desired: strain; NaN: the loop is still open.
            preview: the next desired strains, `preview_blocks` of them; where one is NaN, the
                controller gets the one before.
        Raises:
            SafetyError: The sensor was lost, the watchdog found a fault, or the controller failed.
        """
        sensor, safety = self._sensor, self._rig.safety
        strain = sensor.strain(codes)
        self._drives_v.append(self._rig.present_drive_v)
        self._lost = 0 if strain == strain else self._lost + 1
        self._outside += not sensor.in_range
        if self._lost >= PATIENCE_BLOCKS:
            raise safety.trip(
                f"No strain in {self._lost} blocks of {self._name!r}. {sensor.lost()}"
            )
        if fault := self._watchdog.fault(codes, self._sample(strain, desired)):
            raise safety.trip(fault)
        if desired == desired:
            try:
                coming = [desired]
                for value in preview:
                    coming.append(value if value == value else coming[-1])
                measured = self._measured(strain, tuple(coming[1:]))
                deadlines = self._rig.deadlines
                begun_s = deadlines.now_s
                drive = self._controller.step(desired, measured)
                deadlines.spent(self._step_name, deadlines.now_s - begun_s)
            except SafetyError as error:
                raise safety.trip(str(error)) from error
            if drive is not None:
                self._output_v = drive if self._in_volts else self._voltage(drive)

    def note(self, played: int) -> str:
        """How often the loop left the range in which its strain map was fitted, or an empty text.

        Args:
            played: number of blocks.
        """
        if not self._outside:
            return ""
        low_f, high_f = self._loop.strain_map.range_f or (-math.inf, math.inf)
        return (
            f"{self._name}: in {self._outside} of {played} blocks the capacitance was outside "
            f"{low_f:.4g} to {high_f:.4g} F, where the strain map was fitted: their strain is "
            "extrapolated, the map's band does not hold"
        )

    def _sample(self, strain: float, desired: float) -> LoopSample:
        """Collect what the watchdog checks of the block just read."""
        rig, sensor, age_s = self._rig, self._sensor, None
        if sensor.frame_time_s is not None:
            age_s = rig.acquisition.time_s - sensor.frame_time_s
        return LoopSample(
            strain, sensor.capacitance_f, rig.present_drive_v, desired, sensor.fresh, age_s
        )

    def _measured(self, strain: float, preview: tuple[float, ...]) -> Measurement:
        """Collect what a controller gets of the block just read."""
        farad = self._sensor.capacitance_f
        return Measurement(
            strain=strain,
            capacitance_f=math.nan if farad is None else farad,
            voltage_v=self._drives_v[0],
            time_s=self._rig.acquisition.time_s,
            valid=not math.isnan(strain),
            in_range=self._sensor.in_range,
            preview=preview,
        )

    def _voltage(self, strain: float) -> float:
        v = self._loop.voltage_map
        return _core.voltage_from_strain(v.a1_v, v.b1, v.a2_v, v.b2, strain)


def _sensor(
    rig: GuardedRig, camera_recorder: Observer, carrier_hz: float, loop: LoopSettings
) -> StrainSensor:
    if loop.video_zero_px is not None:
        return VideoSensor(camera_recorder, loop.video_zero_px)
    if loop.printed_chain:
        return PrintedChainSensor(printed_chain_of(rig.description, carrier_hz), loop.strain_map)
    return CapacitanceSensor(lockin_of(rig.description, carrier_hz), loop.strain_map)


def setting_on_rig(rig: RigDescription, carrier_hz: float, loop: LoopSettings) -> ControllerSetting:
    """What the controller of a loop is started with on a rig.

    The delays of the camera are not known.

    Args:
        rig: nominal values.
        carrier_hz: frequency of the sensing signal.
        loop: controller and maps.
    Raises:
        InputError: The kind of the controller needs the identified actuator.
    """
    age_s = delay_s = None
    if loop.video_zero_px is None:
        age_s = 0.5 * counted_s(rig, carrier_hz)
        blocks_s = loop.extra_delay_blocks * rig.block_s
        delay_s = age_s + rig.switch_sample / rig.rate_hz + blocks_s
    limits_v = rig.drive_limits.low, rig.drive_limits.high
    return loop.setting(rig.block_s, delay_s, limits_v, age_s)


def _resonance_rad_s(loop: LoopSettings) -> float:
    """Highest natural frequency of the identified actuator in the loop's range; 0: unknown."""
    if (known := loop.actuator) is None:
        return 0.0
    ends_m = known.length_m(loop.saturation.low), known.length_m(loop.saturation.high)
    return MotionModel(known).natural_rad_s(min(ends_m), max(ends_m))


def _follows_drive(loop: LoopSettings) -> bool:
    """Whether the sensed strain follows the drive at once, as far as it is known."""
    if loop.actuator is not None:
        return loop.actuator.capacitance_follows_drive
    return loop.strain_map.feedthrough > 0.0


def _watchdog(rig: GuardedRig, carrier: tuple[float, float], loop: LoopSettings) -> LoopWatchdog:
    settings, by_video = rig.safety.settings, loop.video_zero_px is not None
    range_f = loop.strain_map.range_f or (0.0, 0.0)
    about = rig.description
    if rig.bench.whole is not None:  # what the amplifier withstands depends on the rig alone
        about = replace(about, drive_limits=rig.bench.whole)
    model = loop_model(
        about,
        loop.voltage_map,
        (loop.saturation.low, loop.saturation.high),
        (carrier[0], carrier[1] if loop.carrier_v is None else loop.carrier_v),
        settings.settle_s,
        None if by_video else loop.strain_map.coefficients,
        0.5 * (range_f[0] + range_f[1]),
        loop.controller.kind.alternates,
        _resonance_rad_s(loop),
        0.0 if loop.actuator is None else loop.actuator.slack_f,
        _follows_drive(loop) and not by_video,
    )
    return LoopWatchdog(
        model, settings.loop, settings.rating, rig.present_drive_v, rig.bench.is_settled
    )
