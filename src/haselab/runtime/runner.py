"""Plays experiments on a rig, records them, and leaves the bench at 0 V whatever happens."""

from __future__ import annotations

import contextlib
import math
import textwrap
from collections import deque
from dataclasses import replace
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from haselab import _core
from haselab.base import DeviceError, HaselabError, InputError, Progress, SafetyError
from haselab.controllers import Measurement
from haselab.rig import Rig, RigDescription
from haselab.runtime.loop import LoopSettings, RunningController
from haselab.runtime.observer import Observer
from haselab.runtime.sensors import (
    PATIENCE_BLOCKS,
    CapacitanceSensor,
    PrintedChainSensor,
    StrainSensor,
    VideoSensor,
)
from haselab.safety.armed import arm_simulated
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.signals import OrderlyEnd
from haselab.safety.watchdog.loop_model import loop_model
from haselab.safety.watchdog.loop_watchdog import LoopSample, LoopWatchdog, OutputWatchdog
from haselab.sensing import Lockin, LockinConfig, PaperChain

__all__ = [
    "BLANKING_S",
    "Recorder",
    "Runner",
    "counted_s",
    "lockin_of",
    "printed_chain_of",
]

BLANKING_S = 0.5e-3  # after an output update, until amplifier and monitors have settled
_LOOK_EVERY = 20  # blocks between two looks at the camera
_STATIC_FRAMES = 40  # of each static load
_REACH_POINTS = 1001  # over the saturation, where a loop's voltages are checked
_ASIDE_S = 30.0  # that disk and camera may take at the ends of an experiment
_EVENT_LETTERS = 90  # that one event of the session holds
_EVENT_LINES = 5  # for one reason


class Recorder(Protocol):
    """Where blocks and events go."""

    def append_block(
        self, name: str, codes: NDArray[np.int16], start_s: float, drive_v: float, reference: float
    ) -> None:
        """Add one block."""

    def flush(self, name: str) -> None:
        """Let go of what is pending."""

    def event(self, time_s: float, what: str) -> None:
        """Note that something happened."""


def lockin_of(rig: RigDescription, carrier_hz: float) -> Lockin:
    """The lock-in for a rig: blanked from each block's start until its output has settled.

    What came before the update would tell of it too, but late: in a loop the delay counts more.
    """
    settled = rig.switch_in_block + round(BLANKING_S * rig.rate_hz)
    config = LockinConfig(
        rate_hz=rig.rate_hz,
        block_samples=rig.block_samples,
        carrier_hz=carrier_hz,
        skew_s=rig.skew_s,
        ohm_per_ratio=rig.i_monitor_v_per_a / rig.v_monitor_v_per_v,
        blank=(0, settled),
    )
    if (found := rig.calibration) is not None:
        volt_v, ampere_v = found.offsets_v
        config = replace(
            config,
            scale_s=complex(*found.scale_s),
            stray_s=complex(*found.stray_s),
            offsets=(volt_v / rig.volt_per_code, ampere_v / rig.volt_per_code),
        )
    return Lockin(config)


def counted_s(rig: RigDescription, carrier_hz: float) -> float:
    """How much of a block the lock-in of a rig fits: its end, from the middle twice as far."""
    last_s = (rig.block_samples - 1) / rig.rate_hz
    return 2.0 * (last_s - lockin_of(rig, carrier_hz).middle_s) + 1.0 / rig.rate_hz


def printed_chain_of(rig: RigDescription, carrier_hz: float) -> PaperChain:
    """The reference study's own chain for a rig; nothing of a block is left out."""
    return PaperChain(replace(lockin_of(rig, carrier_hz).config, blank=(0, 0)))


def _left(found: str, error: BaseException | None) -> str:
    """An output that is left, and what had ended the run."""
    why = "" if error is None else str(error)
    if error is None or (why and why in found):
        return found
    return f"{found} The run had ended by {type(error).__name__}{': ' * bool(why)}{why}"


def _outside(blocks: int, played: int, loop: LoopSettings) -> str:
    """How often a loop left the range in which its strain map was fitted."""
    low_f, high_f = loop.strain_map.range_f or (-math.inf, math.inf)
    return (
        f"in {blocks} of {played} blocks the capacitance was outside {low_f:.4g} to {high_f:.4g} F,"
        " where the strain map was fitted: their strain is extrapolated, the map's band does not "
        "hold"
    )


class Runner:
    """One session on one rig. Use as a context: every way out of it ends at 0 V, read back.

    Args:
        rig: the bench, guarded and armed by its user (`haselab.safety.armed`). Only one that is
            simulated in this process may come plain: it is guarded and armed here, with the
            default limits.
        session: where blocks go.
        camera_recorder: the camera's part.
        carrier_hz: of the sensing signal.
        carrier_v: peak amplitude of the sensing signal ahead of the amplifier.
        progress: told in rig seconds.
    Raises:
        SafetyError: a bench that is neither armed nor simulated in this process; or at the end, an
            output that is not at 0 V, or not known to be.
    """

    def __init__(
        self,
        rig: Rig,
        session: Recorder,
        camera_recorder: Observer,
        carrier_hz: float,
        carrier_v: float,
        progress: Progress,
    ) -> None:
        self._arms = not isinstance(rig, GuardedRig)
        self._rig = rig if isinstance(rig, GuardedRig) else guard(rig)
        self._signals = OrderlyEnd(self._end_of_block)
        self._entered = False  # the start was not broken off
        self._left = ""  # at the output, where the start was broken off
        self._safety = self._rig.safety
        self._session = session
        self._camera_recorder = camera_recorder
        self._progress = progress
        self._carrier = (carrier_hz, carrier_v)
        self._missed = self._rig.missed_outputs
        self._missed_row = 0  # blocks in a row with outputs that were left out
        self._at_zero = False  # read back at the end
        self._output = ""  # what was read back at the end

    @property
    def mass_kg(self) -> float:
        """The rig's own weight, in kg."""
        return self._rig.description.mass_kg

    @property
    def standing_v(self) -> float:
        """The drive that is put out now, in V."""
        return self._rig.standing_v

    def __enter__(self) -> Self:
        self._safety.record_with(self._note)
        if self._arms:
            arm_simulated(self._rig)
        self._safety.run()
        self._entered = False
        self._signals.__enter__()
        try:
            if not self._arms:
                self._rig.check_at_rest()
                self._safety.sign_of_life(_ASIDE_S)  # instruments are set up, at 0 V still
            self._rig.generator.sine(*self._carrier)
            self._entered = True
            return self
        except BaseException as error:
            self._signals.__exit__(None, error, None)
            if isinstance(error, DeviceError):
                self._safety.trip(str(error))
            if self._left:
                raise SafetyError(_left(self._left, error)) from error
            raise

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._signals.__exit__(kind, error, trace)

    def _end_of_block(self, error: BaseException | None) -> None:
        if self._entered:
            try:
                self._finish(error)
            except KeyboardInterrupt as stop:  # the reason and the output must not be lost by it
                told = str(error or ""), self._output or "0 V commanded, not read back."
                for note in told:
                    if note and note not in getattr(stop, "__notes__", []):
                        stop.add_note(note)
                raise
            return
        try:
            self._rig.command_zero()
            self._left = self._read_back()
        finally:
            self._safety.end_run()

    def _finish(self, error: BaseException | None) -> None:
        """0 V, read back, and the reason recorded."""
        stopped, found, before = error, "", self._safety.reason
        others = self._safety.revoked_by_others
        try:
            self._rig.command_zero()
        except BaseException as interrupt:
            stopped = error or interrupt
            raise
        finally:
            try:
                found = self._read_back()
            finally:
                self._safety.end_run()
                if stopped is not None:
                    self._ended_by(stopped, found)
        reason = self._safety.reason
        if found:  # whatever ended the run: this matters more
            raise SafetyError(_left(found, error)) from error
        if others and isinstance(error, DeviceError):  # what the driver met then is no cause
            raise SafetyError(others) from error
        if error is None and reason != before:
            raise SafetyError(reason)

    def _read_back(self) -> str:
        """Whether the output is at 0 V, recorded unless it is; the fault, empty without one."""
        try:
            told, fault = self._rig.read_back(), ""
        except SafetyError as error:
            told = fault = str(error)
        self._output = f"{told[:1].upper()}{told[1:].rstrip('.')}."
        self._at_zero = told.startswith("output at 0 V")
        if not self._at_zero:
            with contextlib.suppress(HaselabError):
                self._note(told)
        return fault

    def _ended_by(self, error: BaseException, found: str) -> None:
        """Record why, and end the camera's part.

        What goes wrong from here on, a full disk, must not hide the error that led here.
        """
        if isinstance(error, KeyboardInterrupt):
            error.add_note(self._output)
        if isinstance(error, DeviceError):
            self._safety.trip(str(error))
        elif str(error):
            with contextlib.suppress(HaselabError):
                self._note(f"reason: {error}")
        with contextlib.suppress(HaselabError):
            at = "output not at 0 V" if found else "0 V commanded, not read back"
            at = "output at 0 V" if self._at_zero else at
            self._event(f"ended by {type(error).__name__}; {at}")
        with contextlib.suppress(HaselabError):
            self._camera_recorder.finish()

    def _event(self, what: str) -> None:
        self._session.event(self._rig.acquisition.time_s, what)

    def _note(self, what: str) -> None:
        """An event of any length."""
        for line in textwrap.wrap(what, _EVENT_LETTERS)[:_EVENT_LINES]:
            self._event(line)

    def _begin(self, name: str) -> None:
        self._safety.sign_of_life(_ASIDE_S)
        self._event(f"start {name}")
        self._rig.begin()

    def play(
        self,
        name: str,
        drive_v: NDArray[np.float64],
        frame_rate_hz: float,
        mass_kg: float,
        particles: str = "",
    ) -> None:
        """Open loop: put out one drive value a block and record.

        Args:
            name: of the experiment in the session.
            drive_v: in V, shape `(blocks,)`; all are checked before the first is put out.
            frame_rate_hz: of the camera.
            mass_kg: that hangs, for the record.
            particles: name under which the sheet's particles are recorded; none without one.
        Raises:
            LimitError: a value outside the drive limits.
            SafetyError: the bench protected itself.
            DeviceError: disk or instrument failed.
        """
        self._rig.check_drive(drive_v)
        self._begin(name)
        self._camera_recorder.start(name, frame_rate_hz, mass_kg, particles=particles)
        self._rig.preload(drive_v)
        for k, value in enumerate(drive_v):
            self._block(name, k, float(value), float("nan"))
        self._end(name)

    def close_loop(
        self,
        name: str,
        reference: NDArray[np.float64],
        loop: LoopSettings,
        frame_rate_hz: float,
        mass_kg: float,
    ) -> None:
        """Closed loop by self-sensing: monitors, capacitance, strain, controller, voltage, output.

        With `LoopSettings.video_zero_px` the strain is that of the last frame that has come in.
        A block whose reference is NaN is driven open loop at the voltage of zero strain, before
        the loop closes without a bump.

        Args:
            name: of the experiment in the session.
            reference: desired strain, shape `(blocks,)`.
            loop: controller and maps.
            frame_rate_hz: of the camera.
            mass_kg: that hangs, for the record.
        Raises:
            SafetyError: the sensor was lost, or the bench protected itself.
            DeviceError: disk or instrument failed.
        """
        controller = RunningController(loop, self._rig.description.block_s)
        sensor, watchdog = self._sensor(loop), self._watchdog(loop)
        lost = outside = 0
        self._check_reach(loop)
        self._begin(name)
        self._note(f"controller {name}: {loop.controller.summary()}")
        if loop.carrier_v is not None:
            self._rig.generator.sine(self._carrier[0], loop.carrier_v)
        self._camera_recorder.start(name, frame_rate_hz, mass_kg)
        output_v = self._voltage(loop, 0.0)
        waiting = deque([output_v] * loop.extra_delay_blocks)
        for k, desired in enumerate(reference):
            waiting.append(output_v)
            due_v = waiting.popleft()
            codes = self._block(name, k, due_v, float(desired), look=not sensor.watches)
            strain = sensor.strain(codes)
            lost = 0 if strain == strain else lost + 1
            outside += not sensor.in_range
            if lost >= PATIENCE_BLOCKS:
                raise self._safety.trip(f"No strain in {lost} blocks of {name!r}. {sensor.lost()}")
            if fault := watchdog.fault(codes, self._sample(sensor, strain, float(desired))):
                raise self._safety.trip(fault)
            if desired == desired:
                drive = self._step(controller, float(desired), self._measured(sensor, strain))
                output_v = output_v if drive is None else self._voltage(loop, drive)
        if outside:
            self._note(f"{name}: {_outside(outside, len(reference), loop)}")
        self._end(name)
        if loop.carrier_v is not None:
            self._rig.generator.sine(*self._carrier)

    def follow(
        self, name: str, reference: NDArray[np.float64], frame_rate_hz: float, mass_kg: float
    ) -> None:
        """Closed loop by the rig's own controller, which is told the desired strain alone.

        Args:
            name: of the experiment in the session.
            reference: desired strain, shape `(blocks,)`; all are checked before the first is told.
                NaN ahead of the first: the rig stays at rest, for the camera's first frames.
            frame_rate_hz: of the camera.
            mass_kg: that hangs, for the record.
        Raises:
            InputError: the rig has no controller.
            LimitError: a strain that the controller does not take.
            SafetyError: the controller, or the bench, protected itself.
            DeviceError: disk or instrument failed.
        """
        controller = self._rig.controller
        if controller is None:
            raise InputError(
                "This rig has no controller of its own, needed is one, as kind = 'mega'. Close the "
                "loop by the program instead, or name another rig."
            )
        controller.strain_limits.check(reference[~np.isnan(reference)])
        watchdog = OutputWatchdog(
            self._rig.description, controller.strain_limits, self._safety.settings.loop
        )
        self._begin(name)
        self._camera_recorder.start(name, frame_rate_hz, mass_kg)
        for k, desired in enumerate(reference):
            if desired == desired:
                controller.follow(float(desired))
            codes = self._take(name, k, float(desired))
            drive_v = self._rig.standing_v
            if desired == desired and (fault := watchdog.fault(codes, drive_v, float(desired))):
                raise self._safety.trip(fault)
        self.rest()  # what comes takes longer than a controller waits for a sign of life
        self._end(name)

    def _sensor(self, loop: LoopSettings) -> StrainSensor:
        if loop.video_zero_px is not None:
            return VideoSensor(self._camera_recorder, loop.video_zero_px)
        lockin = lockin_of(self._rig.description, self._carrier[0])
        if loop.printed_chain:
            chain = printed_chain_of(self._rig.description, self._carrier[0])
            return PrintedChainSensor(chain, loop.strain_map)
        return CapacitanceSensor(lockin, loop.strain_map)

    def _watchdog(self, loop: LoopSettings) -> LoopWatchdog:
        settings, by_video = self._safety.settings, loop.video_zero_px is not None
        model = loop_model(
            self._rig.description,
            loop.voltage_map,
            (loop.saturation.low, loop.saturation.high),
            (self._carrier[0], self._carrier[1] if loop.carrier_v is None else loop.carrier_v),
            settings.settle_s,
            None if by_video else loop.strain_map.coefficients,
        )
        return LoopWatchdog(model, settings.loop, settings.rating, self._rig.standing_v)

    def _sample(self, sensor: StrainSensor, strain: float, desired: float) -> LoopSample:
        """What the watchdog compares, of the block just read."""
        age_s = None
        if sensor.frame_time_s is not None:
            age_s = self._rig.acquisition.time_s - sensor.frame_time_s
        return LoopSample(
            strain, sensor.capacitance_f, self._rig.standing_v, desired, sensor.fresh, age_s
        )

    def _measured(self, sensor: StrainSensor, strain: float) -> Measurement:
        """What a controller gets, of the block just read."""
        farad = sensor.capacitance_f
        return Measurement(
            strain=strain,
            capacitance_f=math.nan if farad is None else farad,
            voltage_v=self._rig.standing_v,
            time_s=self._rig.acquisition.time_s,
            valid=not math.isnan(strain),
            in_range=sensor.in_range,
        )

    def _step(
        self, controller: RunningController, desired: float, measured: Measurement
    ) -> float | None:
        """The next drive; a controller that fails trips the bench."""
        try:
            return controller.step(desired, measured)
        except SafetyError as error:
            raise self._safety.trip(str(error)) from error

    def _check_reach(self, loop: LoopSettings) -> None:
        """Refuse a loop that could ask for too much, by the arithmetic that will run in it."""
        strains = np.linspace(loop.saturation.low, loop.saturation.high, _REACH_POINTS)
        voltages = [self._voltage(loop, float(strain)) for strain in (*strains, 0.0)]
        self._rig.description.drive_limits.check(voltages)

    @staticmethod
    def _voltage(loop: LoopSettings, strain: float) -> float:
        v = loop.voltage_map
        return _core.voltage_from_strain(v.a1_v, v.b1, v.a2_v, v.b2, strain)

    def hang(
        self, name: str, masses_kg: list[float], settle_s: float, frame_rate_hz: float
    ) -> None:
        """Static loads: hang each mass at 0 V, wait, take a few frames.

        Args:
            name: of the experiment in the session.
            masses_kg: in the order of hanging.
            settle_s: wait before the frames, in s.
            frame_rate_hz: of the camera.
        """
        self._begin(name)
        self.rest()
        self._rig.generator.off()
        for k, mass_kg in enumerate(masses_kg):
            self._rig.stand.hang(mass_kg)
            self._rig.stand.wait(settle_s)
            self._camera_recorder.start(name, frame_rate_hz, mass_kg, f"-{k}")
            self._rig.stand.wait((_STATIC_FRAMES + 1) / frame_rate_hz)
            self._camera_recorder.finish()
            self._progress.advance(settle_s, name)
        self._rig.generator.sine(*self._carrier)
        self._event(f"end {name}")

    def release(self, name: str, drive_v: float, settle_s: float, record_s: float,
                frame_rate_hz: float, mass_kg: float) -> None:  # fmt: skip
        """Free response: lift the mass, wait, let go, record.

        Args:
            name: of the experiment in the session.
            drive_v: held all the time, in V.
            settle_s: how long the mass is held up, in s.
            record_s: from the moment of letting go, in s.
            frame_rate_hz: of the camera.
            mass_kg: that hangs, for the record.
        """
        self._rig.description.drive_limits.check(drive_v)
        self._begin(name)
        self._rig.source.write(drive_v)
        self._rig.stand.lift()
        self._rig.stand.wait(settle_s)
        self._camera_recorder.start(name, frame_rate_hz, mass_kg)
        rest = round(0.1 / self._rig.description.block_s)
        blocks = rest + round(record_s / self._rig.description.block_s)
        self._rig.preload(np.full(blocks, drive_v))
        for k in range(blocks):
            if k == rest:
                self._rig.stand.drop()
                self._event(f"drop {name}")
            self._block(name, k, drive_v, float("nan"))
        self._end(name)

    def settle(self, drive_v: float, duration_s: float) -> None:
        """Hold one output with nothing recorded, so that creep fades before what comes.

        Args:
            drive_v: held, in V.
            duration_s: for how long, in s.
        Raises:
            LimitError: outside the drive limits.
        """
        self._rig.source.write(drive_v)
        self._rig.stand.wait(duration_s)

    def rest(self) -> None:
        """The drive to 0 V, at once; the sensing signal stays."""
        self._rig.source.zero()

    def load(self, mass_kg: float) -> None:
        """Hang a mass at 0 V without the sensing signal, leave it there, restore the signal."""
        self._rig.stand.hang(mass_kg)  # switches everything off first
        self._rig.generator.sine(*self._carrier)

    def _block(
        self, name: str, index: int, output_v: float, desired: float, *, look: bool = True
    ) -> NDArray[np.int16]:
        self._rig.source.write(output_v)
        return self._take(name, index, desired, look=look)

    def _take(
        self, name: str, index: int, desired: float, *, look: bool = True
    ) -> NDArray[np.int16]:
        """Read a block, keep it, and look at the camera now and then."""
        codes = self._rig.acquisition.read()
        start_s = self._rig.acquisition.time_s - self._rig.description.block_s
        self._session.append_block(name, codes, start_s, self._rig.standing_v, desired)
        missed, self._missed = self._rig.missed_outputs - self._missed, self._rig.missed_outputs
        self._missed_row = self._missed_row + 1 if missed else 0
        if missed:
            self._note(f"{missed} outputs came too late and were left out")
        limit = self._safety.settings.missed_limit
        if self._missed_row >= limit and self._safety.settings.real_time:
            raise self._safety.trip(
                f"Lost deadline: outputs of {self._missed_row} blocks in a row came too late and "
                f"were left out (missed_limit = {limit}). Close other programs."
            )
        if index % _LOOK_EVERY == _LOOK_EVERY - 1:
            if look:
                self._camera_recorder.look()
            self._progress.advance(_LOOK_EVERY * self._rig.description.block_s, name)
        return codes

    def _end(self, name: str) -> None:
        self._safety.sign_of_life(_ASIDE_S)
        self._session.flush(name)
        self._camera_recorder.finish()
        if self._safety.settings.real_time:
            self._note(f"deadlines of {name}: {self._rig.deadlines.ticks}")
        self._event(f"end {name}")
        self._safety.sign_of_life(self._safety.settings.idle_s)
