"""Play experiments on a rig, record them, and always end at 0 V."""

from __future__ import annotations

import contextlib
import textwrap
from types import TracebackType
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, HaselabError, InputError, Progress, SafetyError, text_of
from haselab.rig import Rig
from haselab.runtime.closed_loop import ClosedLoop
from haselab.runtime.conditions import Conditions
from haselab.runtime.loop import LoopSettings
from haselab.runtime.observer import Observer
from haselab.safety.armed import arm_simulated
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.signals import OrderlyEnd
from haselab.safety.watchdog.loop_watchdog import OutputWatchdog

__all__ = ["Recorder", "Runner"]

_SETTLING = "settling"  # for the progress bar
_LOOK_EVERY = 20  # blocks between two calls of the camera recorder
_STATIC_FRAMES = 40  # for each static load
_SETUP_S = 30.0  # longest time for disk and camera between experiments
_EVENT_LETTERS = 90  # longest event of a session
_EVENT_LINES = 5  # most events for one reason


class Recorder(Protocol):
    """Receives the blocks and events of a session."""

    def append_block(
        self, name: str, codes: NDArray[np.int16], start_s: float, drive_v: float, reference: float
    ) -> None:
        """Add one block."""

    def flush(self, name: str) -> None:
        """Write what is still buffered for an experiment."""

    def event(self, time_s: float, what: str) -> None:
        """Record that something happened."""

    def condition(
        self, time_s: float, drive_v: float, carrier_v: float, pull_n: float, mass_kg: float
    ) -> None:
        """Record what acts on the actuator from a time on, outside the blocks."""


def _left(found: str, error: BaseException | None) -> str:
    """Describe an output that is not at 0 V, and what had ended the run."""
    why = "" if error is None else text_of(error)
    if error is None or (why and why in found):
        return found
    return f"{found} The run had ended by {type(error).__name__}{': ' * bool(why)}{why}"


class Runner:
    """One session on one rig. Use as a context, which always ends at 0 V, read back.

    Args:
        rig: the bench, guarded and armed by its user (`haselab.safety.armed`). A rig that is
            simulated in this process may be passed unguarded: it is guarded and armed here, with
            the default limits.
        session: to which blocks are written.
        camera_recorder: records the camera.
        carrier_hz: frequency of the sensing signal.
        carrier_v: peak amplitude of the sensing signal at the amplifier's input.
        progress: updated with the time on the rig's clock, in s.
    Raises:
        SafetyError: The bench is neither armed nor simulated in this process; or at the end, the
            output is not confirmed at 0 V.
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
        self._entered = False  # whether the start was completed
        self._left = ""  # what remains at the output, if the start was interrupted
        self._safety = self._rig.safety
        self._session = session
        self._camera_recorder = camera_recorder
        self._progress = progress
        self._carrier = (carrier_hz, carrier_v)
        self._conditions = Conditions(session, self._rig)
        self._missed = self._rig.missed_outputs
        self._missed_row = 0  # blocks in a row with skipped outputs
        self._at_zero = False  # whether 0 V was read back at the end
        self._output = ""  # what was read back at the end

    @property
    def mass_kg(self) -> float:
        """The rig's own hung mass, in kg."""
        return self._rig.description.mass_kg

    @property
    def present_drive_v(self) -> float:
        """The present drive, in V."""
        return self._rig.present_drive_v

    def __enter__(self) -> Self:
        self._safety.record_with(self._note)
        if self._arms:
            arm_simulated(self._rig)
        self._safety.run()
        self._entered = False
        self._signals.__enter__()
        try:
            if not self._arms:
                self._rig.check_idle()
                self._safety.heartbeat(_SETUP_S)  # instruments are set up, still at 0 V
            self._conditions.carrier(0.0)  # it hung for long without one
            self._rig.generator.sine(*self._carrier)
            self._conditions.carrier(self._carrier[1])
            self._entered = True
            return self
        except BaseException as error:
            self._signals.__exit__(None, error, None)
            if isinstance(error, DeviceError):
                self._safety.trip(text_of(error))
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
            except KeyboardInterrupt as stop:  # keep the reason and the output in the message
                notes = str(error or ""), self._output or "0 V commanded, not read back."
                for note in notes:
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
        """Go to 0 V, read it back, and record the reason."""
        stopped, found, before = error, "", self._safety.trips
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
        if found:  # more important than what ended the run
            raise SafetyError(_left(found, error)) from error
        if others and isinstance(error, DeviceError):  # the driver's error is only a consequence
            raise SafetyError(others) from error
        if error is None and self._safety.trips != before:
            raise SafetyError(self._safety.reason)

    def _read_back(self) -> str:
        """Read the output back, record it unless it is at 0 V, and return the fault or ''."""
        try:
            found, self._at_zero = self._rig.read_back()
            fault = ""
        except SafetyError as error:
            found = fault = str(error)
            self._at_zero = False
        self._output = f"{found[:1].upper()}{found[1:].rstrip('.')}."
        if not self._at_zero:
            with contextlib.suppress(HaselabError):
                self._note(found)
        return fault

    def _ended_by(self, error: BaseException, found: str) -> None:
        """Record why the run ended, and stop the camera recorder.

        A further error, such as a full disk, must not hide the one that ended the run.
        """
        if isinstance(error, KeyboardInterrupt):
            error.add_note(self._output)
        if isinstance(error, DeviceError):
            self._safety.trip(text_of(error))
        elif why := text_of(error):
            with contextlib.suppress(HaselabError):
                self._note(f"reason: {why}")
        with contextlib.suppress(HaselabError):
            at = "output not at 0 V" if found else "0 V commanded, not read back"
            at = "output at 0 V" if self._at_zero else at
            self._event(f"ended by {type(error).__name__}; {at}")
        with contextlib.suppress(HaselabError):
            self._camera_recorder.finish()

    def _event(self, what: str) -> None:
        self._session.event(self._rig.acquisition.time_s, what)

    def _note(self, what: str) -> None:
        """Record an event of any length."""
        for line in textwrap.wrap(what, _EVENT_LETTERS)[:_EVENT_LINES]:
            self._event(line)

    def _begin(self, name: str) -> None:
        self._safety.heartbeat(_SETUP_S)
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
        """Play a drive in open loop, one value per block, and record.

        Args:
            name: of the experiment in the session.
            drive_v: in V, shape `(blocks,)`; all are checked before the first is put out.
            frame_rate_hz: of the camera.
            mass_kg: hung mass, for the record.
            particles: name of the record of the sheet's particles; empty: they are not recorded.
        Raises:
            LimitError: A value is outside the drive limits.
            SafetyError: The bench tripped.
            DeviceError: The disk or an instrument failed.
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
        """Run a closed loop by self-sensing: monitors, capacitance, strain, controller, drive.

        With `LoopSettings.video_zero_px` the strain is that of the last frame that has arrived.
        Blocks whose reference is NaN are driven in open loop at the voltage of zero strain; then
        the loop closes without a step.

        Args:
            name: of the experiment in the session.
            reference: desired strain, shape `(blocks,)`.
            loop: controller and maps.
            frame_rate_hz: of the camera.
            mass_kg: hung mass, for the record.
        Raises:
            SafetyError: The sensor was lost, or the bench tripped.
            DeviceError: The disk or an instrument failed.
        """
        closed = ClosedLoop(self._rig, self._camera_recorder, self._carrier, loop, name)
        self._begin(name)
        self._note(f"controller {name}: {loop.controller.summary()}")
        if loop.carrier_v is not None:
            self._rig.generator.sine(self._carrier[0], loop.carrier_v)
            self._conditions.carrier(loop.carrier_v)
        self._camera_recorder.start(name, frame_rate_hz, mass_kg)
        ahead = (*reference.tolist(), *reference[-1:].tolist() * closed.preview_blocks)
        for k, desired in enumerate(reference):
            codes = self._block(
                name, k, closed.due_v(), float(desired), look=not closed.watches_camera
            )
            closed.step(codes, float(desired), ahead[k + 1 : k + 1 + closed.preview_blocks])
        if note := closed.note(len(reference)):
            self._note(note)
        self._end(name)
        if loop.carrier_v is not None:
            self._rig.generator.sine(*self._carrier)
            self._conditions.carrier(self._carrier[1])

    def follow(
        self, name: str, reference: NDArray[np.float64], frame_rate_hz: float, mass_kg: float
    ) -> None:
        """Run a closed loop by the rig's built-in controller, which gets only the desired strain.

        Args:
            name: of the experiment in the session.
            reference: desired strain, shape `(blocks,)`; all are checked before the first is sent.
                During leading NaN values the output stays at 0 V, for the camera's first frames.
            frame_rate_hz: of the camera.
            mass_kg: hung mass, for the record.
        Raises:
            InputError: The rig has no built-in controller.
            LimitError: A strain is outside the controller's limits.
            SafetyError: The controller or the bench tripped.
            DeviceError: The disk or an instrument failed.
        """
        controller = self._rig.controller
        if controller is None:
            raise InputError(
                "This rig has no built-in controller. Use a rig with kind = 'chip', or close the "
                "loop in the program."
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
            drive_v = self._rig.present_drive_v
            if desired == desired and (fault := watchdog.fault(codes, drive_v, float(desired))):
                raise self._safety.trip(fault)
        self.rest()  # the next steps take longer than a controller waits for a keep-alive
        self._end(name)

    def hang(
        self, name: str, masses_kg: list[float], settle_s: float, frame_rate_hz: float
    ) -> None:
        """Record static loads: hang each mass at 0 V, wait, take a few frames.

        Args:
            name: of the experiment in the session.
            masses_kg: in the order of hanging.
            settle_s: time to wait before the frames, in s.
            frame_rate_hz: of the camera.
        """
        self._begin(name)
        self.rest()
        self._rig.generator.off()
        self._conditions.carrier(0.0)
        for k, mass_kg in enumerate(masses_kg):
            with self._conditions.hanging(mass_kg):
                self._rig.stand.hang(mass_kg)
            self._rig.stand.wait(settle_s)
            self._camera_recorder.start(name, frame_rate_hz, mass_kg, f"-{k}")
            self._rig.stand.wait((_STATIC_FRAMES + 1) / frame_rate_hz)
            self._camera_recorder.finish()
            self._progress.advance(settle_s, name)
        self._rig.generator.sine(*self._carrier)
        self._conditions.carrier(self._carrier[1])
        self._event(f"end {name}")

    def release(self, name: str, drive_v: float, settle_s: float, record_s: float,
                frame_rate_hz: float, mass_kg: float) -> None:  # fmt: skip
        """Record a free response: lift the mass, wait, release it.

        Args:
            name: of the experiment in the session.
            drive_v: held all the time, in V.
            settle_s: how long the mass is held up, in s.
            record_s: duration of the record after the release, in s.
            frame_rate_hz: of the camera.
            mass_kg: hung mass, for the record.
        """
        self._rig.description.drive_limits.check(drive_v)
        self._begin(name)
        self._rig.source.write(drive_v)
        self._conditions.drive(drive_v)
        with self._conditions.lifting():
            self._rig.stand.lift()
        self._rig.stand.wait(settle_s)
        self._progress.advance(settle_s, name)
        self._camera_recorder.start(name, frame_rate_hz, mass_kg)
        rest = round(0.1 / self._rig.description.block_s)
        blocks = rest + round(record_s / self._rig.description.block_s)
        self._rig.preload(np.full(blocks, drive_v))
        for k in range(blocks):
            if k == rest:
                self._rig.stand.drop()
                self._conditions.dropped()
                self._event(f"drop {name}")
            self._block(name, k, drive_v, float("nan"))
        self._end(name)

    def settle(self, drive_v: float, duration_s: float) -> None:
        """Hold one output without recording, so that creep fades before the next experiment.

        Args:
            drive_v: held, in V.
            duration_s: for how long, in s.
        Raises:
            LimitError: The drive is outside its limits.
        """
        self._rig.source.write(drive_v)
        self._conditions.drive(drive_v)
        self._progress.advance(0.0, _SETTLING)
        self._rig.stand.wait(duration_s)
        self._progress.advance(duration_s, _SETTLING)

    def rest(self) -> None:
        """Set the drive to 0 V at once; the sensing signal stays on."""
        self._rig.source.zero()
        self._conditions.drive(0.0)

    def load(self, mass_kg: float) -> None:
        """Hang a mass at 0 V with the sensing signal off, then restore the signal."""
        with self._conditions.hanging(mass_kg):
            self._rig.stand.hang(mass_kg)  # switches everything off first
        self._rig.generator.sine(*self._carrier)
        self._conditions.carrier(self._carrier[1])

    def _block(
        self, name: str, index: int, output_v: float, desired: float, *, look: bool = True
    ) -> NDArray[np.int16]:
        self._rig.source.write(output_v)
        return self._take(name, index, desired, look=look)

    def _take(
        self, name: str, index: int, desired: float, *, look: bool = True
    ) -> NDArray[np.int16]:
        """Read and record a block, and call the camera recorder at intervals."""
        codes = self._rig.acquisition.read()
        start_s = self._rig.acquisition.time_s - self._rig.description.block_s
        self._session.append_block(name, codes, start_s, self._rig.present_drive_v, desired)
        missed, self._missed = self._rig.missed_outputs - self._missed, self._rig.missed_outputs
        self._missed_row = self._missed_row + 1 if missed else 0
        if missed:
            self._note(f"{missed} outputs came too late and were skipped")
        limit = self._safety.settings.missed_limit
        if self._missed_row >= limit and self._safety.settings.real_time:
            raise self._safety.trip(
                f"Lost deadline: outputs of {self._missed_row} blocks in a row came too late and "
                f"were skipped (missed_limit = {limit}). {self._rig.deadlines.advice}"
            )
        if index % _LOOK_EVERY == _LOOK_EVERY - 1:
            if look:
                self._camera_recorder.look()
            self._progress.advance(_LOOK_EVERY * self._rig.description.block_s, name)
        return codes

    def _end(self, name: str) -> None:
        self._safety.heartbeat(_SETUP_S)
        self._session.flush(name)
        self._camera_recorder.finish()
        if self._safety.settings.real_time:
            self._note(f"deadlines of {name}: {self._rig.deadlines.ticks}")
        self._event(f"end {name}")
        self._safety.heartbeat(self._safety.settings.idle_s)
