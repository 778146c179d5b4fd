"""The bench of the panel: reads blocks, drives manually or in a closed loop, and stops."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from haselab.base import (
    DeviceError,
    HaselabError,
    InputError,
    JsonObject,
    LimitError,
    SafetyError,
    described,
    shown,
)
from haselab.panel.armed_study import CHECK, ArmedStudy
from haselab.panel.bench_state import BenchState
from haselab.panel.columns import LiveWriter
from haselab.panel.live_signals import IdleWatch, LiveSignals
from haselab.panel.page_leases import PageLeases
from haselab.panel.pages.study_job import StudyJob
from haselab.panel.pages.values import number, up_to_millivolts
from haselab.panel.stop_process import REASON
from haselab.panel.study_player import PictureFile, StudyPlayer
from haselab.runtime.closed_loop import ClosedLoop
from haselab.runtime.loop import LoopSettings
from haselab.runtime.observer import Seen
from haselab.safety.guarded import GuardedRig
from haselab.safety.state_machine import LIVE, ArmingRequest, Stage

__all__ = ["LiveBench"]

CARRIER_HZ, CARRIER_V = 2000.0, 0.02  # of the reference study
_RAMP_V_PER_S = 1.0  # at the amplifier's input: 5 kV/s with a gain of 5000
_HEARTBEAT_S = 0.5
_PICTURES_HZ = 5.0
_MOST_EVENTS = 40  # that a page shows
_RECENT = ("arm", "drive", "loop", "open", "confirm")  # an old command could energise the bench
_SHOWN_DIGITS = 5e-6  # a page shows the limits of the strain with six digits
_REOPEN_S = 1.0  # between two attempts to open the board again
_LEAST_V = 0.001  # that can be typed: pages show three decimals
_TYPED = "the limit typed on the page"


class _NoCamera:
    """The loop of the panel senses the strain by the capacitance alone."""

    def start(
        self, name: str, rate_hz: float, mass_kg: float, part: str = "", particles: str = ""
    ) -> None:
        """See `Observer`."""

    def look(self) -> Seen | None:
        """See `Observer`."""
        return None

    def finish(self) -> None:
        """See `Observer`."""


class LiveBench:
    """A guarded rig that is read block by block while pages drive it.

    `step` belongs to one thread; `do` and `stop` may be called from others.

    Args:
        rig: the bench behind its safety chain.
        writer: of the live signals.
        read_loop: reads the controller and the maps of the actuator file, at the start and before
            each arming; it returns None if no loop can be closed.
        picture: JPEG file for the last camera frame while the bench is armed; None: no pictures.
        prepare: prepares the study that a page has chosen; None: no study can be played.
        player: plays it.
        lease_s: longest time without a message from the page that armed the bench, in s.
        rig_safe_runs: whether the `haselab rig safe` that STOP has started still runs. Meanwhile
            arming is refused, because it would trip the bench.
    """

    def __init__(
        self,
        rig: GuardedRig,
        writer: LiveWriter,
        read_loop: Callable[[], LoopSettings | None] = lambda: None,
        picture: Path | None = None,
        prepare: Callable[[JsonObject], StudyJob] | None = None,
        player: StudyPlayer | None = None,
        lease_s: float = 1.5,
        rig_safe_runs: Callable[[], bool] = lambda: False,
    ) -> None:
        self._leases = PageLeases(lease_s)
        self._rig, self._rig_safe_runs = rig, rig_safe_runs
        self._picture = None if picture is None else PictureFile(picture)
        self._read_loop, self._loop = read_loop, read_loop()
        self._signals, self._idle = LiveSignals(rig, writer, CARRIER_HZ), IdleWatch(rig)
        self._mutex = threading.Lock()  # protects all below
        self._turn = threading.Lock()  # held by a command until it ends; the next block waits
        self._request: ArmingRequest | None = None
        self._requester = ""  # page of the last request
        self._mode, self._reason, self._holder = "idle", "", ""
        self._drive_v = self._target_v = 0.0
        self._reference: float | None = None
        self._limit_v = 0.0
        self._closed: ClosedLoop | None = None
        self._beat_s = 0.0
        self._prepare, self._player = prepare, player or StudyPlayer()
        self._player.note = self._note
        self._study = ArmedStudy(rig, self._leases, self._player)
        self._danger = ""  # why 0 V was not confirmed at the end of the last run
        self._reopen_s = 0.0  # time of the next attempt to open the board again
        self._over = False  # the panel has ended: commands are refused
        self._events: deque[tuple[float, str]] = deque(maxlen=_MOST_EVENTS)
        rig.bench.on_block = self._on_block

    # ---- from other threads ------------------------------------------------------------------

    @property
    def state(self) -> BenchState:
        """What the pages show."""
        safety, about = self._rig.safety, self._rig.description
        stage, latched = safety.stage, safety.gate.interlock.reason
        if stage is Stage.OFF and latched:  # a request was withdrawn
            stage = Stage.TRIPPED
        low, high = about.drive_limits.low, about.drive_limits.high
        limits, job = None, self._study.job
        drive_v, target_v = self._drive_v, self._target_v
        if stage is Stage.TRIPPED and self._rig.bench.requested_v == 0.0:
            drive_v = target_v = 0.0  # a study that computes has not ended yet
        if self._loop is not None:
            limits = (self._loop.saturation.low, self._loop.saturation.high)
        return BenchState(
            stage.value, self._mode, drive_v, target_v, self._reference,
            self._limit_v, self._holder, self._danger or latched or self._reason, low, high,
            about.amplifier_gain, limits, about.name, self._rig.simulated, self._player.task,
            self._player.done, self._player.prompt, self._player.step, tuple(self._events),
            self._study.recorded, "" if job is None else job.options.folder.name,
            self._requester if stage is Stage.REQUESTED else "",
            self._rig.simulated and self._study.computes(), self._signals.extrapolated,
        )  # fmt: skip

    def do(
        self, what: str, holder: str, values: JsonObject, at_s: float | None = None
    ) -> JsonObject:
        """Carry out a command of a page.

        Args:
            what: `request`, `cancel`, `arm`, `drive`, `loop`, `open`, `confirm`, `disarm`, `lease`,
                `leave`, or `stop`, which every page may send at any age.
            holder: the page.
            values: arguments of the command.
            at_s: time of the last data that the page received, or of its sign of life; see
                `page_leases`. None: a call in this process.
        Returns:
            The answer.
        Raises:
            InputError: There is no such command, or an argument is missing or of a wrong type.
            LimitError: A value is outside the limits.
            SafetyError: Another page has armed the bench, it is not armed, or the command is too
                old.
        """
        commands = {
            "request": self._request_arming, "cancel": self._cancel_request, "arm": self._arm,
            "drive": self._drive_to,
            "loop": self._close_loop, "open": self._open_loop, "disarm": self._disarm,
            "leave": self._leave, "confirm": self._confirm,
        }  # fmt: skip
        if what == "lease":
            self._leases.renew(holder, at_s)
            return {}
        if what == "stop":  # the second way, for a page whose stop process does not answer
            return {"commanded": not self.stop(REASON)}
        if what not in commands:
            raise InputError(
                f"There is no command {shown(what)}. Use one of: {', '.join(commands)}."
            )
        # Ramping to 0 V and disarming are accepted at any age.
        recent = what in _RECENT and not (what == "drive" and values.get("value_v") == 0)
        if recent:
            self._leases.require_recent(at_s)
        if what == "arm":
            self._leases.begin(holder)
        job = None
        if what == "arm" and values.get("study") is not None:
            with self._turn, self._mutex:
                self._check_turn(what, holder)
                self._find_request(values)
            job = self._chosen(values["study"])  # which takes longer than a block
        # The file is read here, so that no block waits for it.
        found = self._read_loop() if what == "request" else None
        with self._turn, self._mutex:
            if what == "request" and not self._holder:
                self._loop = found
            self._check_turn(what, holder)
            if what == "arm":  # checking a study takes a while
                return self._arm_for(holder, values, job, at_s)
            if recent:  # the command may have waited for its turn
                self._leases.require_recent(at_s)
            return commands[what](holder, values)

    def stop(self, reason: str) -> str:
        """Take the bench to 0 V at once and latch the reason. Never waits for a command.

        Args:
            reason: one sentence.
        Returns:
            Why 0 V is not certain; empty if it was commanded, here or by a guardian.
        """
        self._rig.safety.trip(reason)
        self._note("STOP")
        return self._rig.unconfirmed()

    def end_study(self, reason: str) -> None:
        """End a study that is being played; the bench goes to 0 V and the recording is kept.

        Args:
            reason: one sentence; the first one is kept.
        """
        self._study.end(reason)

    def _note(self, what: str) -> None:
        self._events.append((self._rig.bench.time_s, what))

    def _request_arming(self, holder: str, values: JsonObject) -> JsonObject:
        self._require_idle()
        guardians = self._rig.safety.guardians
        if guardians is not None and guardians.lost():  # for example, they have acted after STOP
            guardians.close()
            guardians.start()
        self._request, self._requester = self._rig.safety.request(), holder
        output_v_per_s = _RAMP_V_PER_S * self._rig.description.amplifier_gain
        manual = (
            f"Manual drive changes by {_RAMP_V_PER_S:g} V/s ({1e-3 * output_v_per_s:g} kV/s at the "
            "output)."
        )
        if self._loop is not None:
            limits = self._rig.description.drive_limits
            with contextlib.suppress(LimitError):  # closing the loop says why it is not possible
                highest_v = up_to_millivolts(self._loop.largest_v(limits.low, limits.high))
                manual += (
                    f" In closed loop: up to {highest_v} V at the amplifier's input. Neither "
                    "exceeds the limit that you type."
                )
        return {"number": self._request.number, "limits": f"{self._request.limits} {manual}",
                "reason": self._request.reason}  # fmt: skip

    def _cancel_request(self, holder: str, values: JsonObject) -> JsonObject:
        if holder == self._requester and self._rig.safety.stage is Stage.REQUESTED:
            self._request = None
            self._rig.safety.end_run()
        return {}

    def _leave(self, holder: str, values: JsonObject) -> JsonObject:
        """Take the bench to 0 V if its page has disconnected: nobody sees what it does."""
        self._leases.end(holder)
        self._cancel_request(holder, values)
        if holder == self._holder and self._mode == "study":
            self.end_study("The page that started the study has disconnected.")
        elif holder == self._holder:
            self._end("The page that armed the bench has disconnected.")
        return {}

    def _arm_for(
        self, holder: str, values: JsonObject, job: StudyJob | None, at_s: float | None
    ) -> JsonObject:
        """Arm the bench for a page that is still connected and waits for the answer."""
        if at_s is not None and self._leases.is_lost(holder):
            raise SafetyError(
                f"No message for {self._leases.lease_s:g} s from the page that wanted to arm the "
                "bench. Nothing was armed. Check that the page shows live data, then try again."
            )
        self._leases.require_in_time(at_s)
        answer = self._arm(holder, values, job)
        if job is None:  # an instrument may have been slow
            try:
                self._leases.require_in_time(at_s)
            except SafetyError:
                reason = (
                    "Arming took too long, so the bench was taken to 0 V. Check the instruments "
                    "and the CPU load, then arm the bench again."
                )
                self._end(reason)
                raise SafetyError(reason) from None
        return answer

    def _arm(self, holder: str, values: JsonObject, job: StudyJob | None = None) -> JsonObject:
        self._require_idle()
        limit_v, request = number(values, "limit_v"), self._find_request(values)
        limits = self._rig.description.drive_limits
        if not _LEAST_V <= limit_v <= limits.high:
            raise LimitError(
                f"The typed limit is {limit_v:g} V, but it must be at least "
                f"{_LEAST_V:g} V and at most {limits.high:g} V. Type another one."
            )
        highest_v = 0.0 if job is None else job.highest_v(self._rig.description)
        if highest_v > limit_v:
            raise LimitError(
                f"The study needs {up_to_millivolts(highest_v)} V, but the typed limit is "
                f"{limit_v:g} V. Type what it needs, or change the study."
            )
        self._request = None
        self._rig.safety.arm(request, str(values.get("acknowledged", "")))
        self._note("armed")
        self._reason = self._danger = ""
        self._leases.begin(holder)
        if job is not None:  # `step` plays it
            self._rig.limit_drive(limit_v, _TYPED)
            self._mode, self._holder, self._limit_v = "study", holder, limit_v
            self._study.begin(holder, job)
            return {"folder": str(job.options.folder)}
        try:
            self._rig.safety.run()
            self._rig.check_idle()
            self._rig.generator.sine(CARRIER_HZ, CARRIER_V)
            if self._picture is not None:
                self._rig.camera.start(_PICTURES_HZ)
            self._rig.begin()  # last: from here on a slow instrument is a missed deadline
            if not self._rig.safety.live:  # STOP, while an instrument was slow
                raise self._rig.safety.refusal()
        except BaseException:  # also a fault of a driver from another package
            self._end()
            raise
        self._rig.limit_drive(limit_v, _TYPED)
        self._mode, self._holder, self._limit_v, self._reason = "drive", holder, limit_v, ""
        self._drive_v = self._target_v = 0.0
        self._leases.begin(holder)  # an instrument may have been slow
        self._beat_s = time.monotonic()
        return {}

    def _check_turn(self, what: str, holder: str) -> None:
        """Refuse commands of other pages while a page has armed the bench, and all at the end."""
        if self._over:
            raise SafetyError("The panel has ended. No command is carried out.")
        if self._holder and holder != self._holder and what not in ("disarm", "leave", "cancel"):
            raise SafetyError("Another page has armed the bench. It must disarm the bench first.")

    def _find_request(self, values: JsonObject) -> ArmingRequest:
        if self._request is None or self._request.number != values.get("number"):
            raise SafetyError("This request is no longer valid. Press 'Arm the bench' again.")
        return self._request

    def _chosen(self, wanted: object) -> StudyJob:
        """The study that the bench is to be armed for."""
        if self._prepare is None or not isinstance(wanted, dict):
            raise InputError("This panel cannot play a study. Use haselab run.")
        return self._prepare(wanted)

    def _confirm(self, holder: str, values: JsonObject) -> JsonObject:
        if self._mode != "study" or holder != self._holder:
            raise SafetyError("Only the page that started the study can confirm this step.")
        if values.get("step") != self._player.step or not self._player.prompt:
            raise SafetyError(
                "This step is no longer current. If the page shows another step, do it, then press "
                "Done."
            )
        self._player.confirm()
        return {}

    def _drive_to(self, holder: str, values: JsonObject) -> JsonObject:
        self._require_armed(holder)
        target_v = number(values, "value_v")
        low_v = self._rig.description.drive_limits.low
        if not low_v <= target_v <= self._limit_v:
            raise LimitError(
                f"The requested drive is {target_v:g} V, but the bench was armed for {low_v:g} to "
                f"{self._limit_v:g} V. Request a drive in this range, or arm with another "
                "limit."
            )
        self._leave_loop()
        self._target_v = target_v
        return {}

    def _close_loop(self, holder: str, values: JsonObject) -> JsonObject:
        self._require_armed(holder)
        if self._loop is None:
            raise InputError(
                "There is no controller. Start the panel with --actuator A.toml, an actuator file "
                "with both maps and a controller (haselab design A.toml)."
            )
        strain, limits = number(values, "strain"), self._loop.saturation
        slack = _SHOWN_DIGITS * max(abs(limits.low), abs(limits.high))
        if not limits.low - slack <= strain <= limits.high + slack:
            raise LimitError(
                f"The desired strain is {100.0 * strain:.6g} %, but the limits of the controller "
                f"are {100.0 * limits.low:.6g} to {100.0 * limits.high:.6g} %. Choose another one."
            )
        drive = self._rig.description.drive_limits
        loop = self._loop.within(drive.low, drive.high)
        if self._closed is None:
            carrier = (CARRIER_HZ, CARRIER_V)
            self._closed = ClosedLoop(self._rig, _NoCamera(), carrier, loop, "panel")
            self._mode = "loop"
        self._reference = min(max(strain, loop.saturation.low), loop.saturation.high)
        if abs(self._reference - strain) <= slack:
            return {}
        note = (
            f"A drive of {drive.low:g} to {drive.high:g} V does not reach a strain of "
            f"{100.0 * strain:.6g} %. The desired strain was limited to "
            f"{100.0 * self._reference:.6g} %."
        )
        return {"note": note}

    def _open_loop(self, holder: str, values: JsonObject) -> JsonObject:
        self._require_armed(holder)
        self._leave_loop()
        return {}

    def _disarm(self, holder: str, values: JsonObject) -> JsonObject:
        if self._mode == "study":
            self.end_study("The study was ended from a page.")
        elif self._holder:
            self._end("The bench was disarmed.")
        return {}

    def _require_idle(self) -> None:
        if self._holder:
            raise SafetyError("The bench is armed already. Disarm it first.")
        if self._rig_safe_runs():
            raise SafetyError(
                "'haselab rig safe', which STOP has started, is still switching the instruments "
                "off. Try again in a few seconds."
            )

    def _require_armed(self, holder: str) -> None:
        if not self._holder or holder != self._holder or not self._rig.safety.live:
            raise self._rig.safety.refusal()
        if self._mode == "study":
            raise SafetyError("A study is being played. End it first.")

    def _leave_loop(self) -> None:
        if self._closed is not None:
            self._closed, self._reference, self._mode = None, None, "drive"
            self._target_v = self._drive_v

    def _end(self, reason: str = "") -> None:
        """End the run at 0 V, read back."""
        self._mode, self._holder, self._closed, self._reference = "idle", "", None, None
        self._drive_v = self._target_v = self._limit_v = 0.0
        self._reason = reason
        self._note(reason or "0 V")
        try:
            self._rig.safe()
        except SafetyError as error:
            self._danger = str(error)  # the latch keeps the first reason, which may be another one
        finally:
            self._rig.limit_drive()
            self._rig.safety.end_run()

    # ---- of the thread that reads --------------------------------------------------------------

    def step(self) -> None:
        """Put out the next drive and read one block; or play the study that is due."""
        if (job := self._study.job) is not None:
            self._play(job)
            return
        with self._turn:  # a thread that releases a lock and takes it again keeps others waiting
            pass
        with self._mutex:
            if self._study.job is not None:  # a page has armed the bench for it meanwhile
                return
            try:
                self._block()
                if self._closed is not None:
                    self._target_v = self._drive_v
                if self._holder and self._picture is not None:
                    self._look(self._picture)
            except HaselabError as error:
                self._failed(error)
                return
            except Exception as error:  # of a driver, for example if STOP interrupts its call
                self._failed(DeviceError(f"A driver failed: {described(error)}. {CHECK}"))
                return
            if self._holder and self._rig.safety.stage is Stage.TRIPPED:
                self._end(self._rig.safety.reason)

    def close(self) -> None:
        """End at 0 V, and refuse all later commands."""
        with self._mutex:
            self._over = True
            self._end("The panel has ended.")

    def _failed(self, error: HaselabError) -> None:
        if not self._holder:
            self._reason = str(error)
            self._reopen()
            time.sleep(self._rig.description.block_s)
            return
        if not isinstance(error, SafetyError):
            self._rig.safety.trip(str(error))
        self._end(self._rig.safety.reason or str(error))

    def _reopen(self) -> None:
        """Open the board again at 0 V: `haselab rig safe`, which STOP starts, has reset it."""
        if time.monotonic() < self._reopen_s or self._rig.safety.stage in LIVE:
            return
        with contextlib.suppress(Exception):  # the next block says why it still fails
            self._rig.reopen()
        self._reopen_s = time.monotonic() + _REOPEN_S

    def _play(self, job: StudyJob) -> None:
        """Play a study, and end at 0 V."""
        self._signals.sense_at(job.study.sensing.carrier_hz)
        reason = ""
        try:
            reason = self._study.play(job, self._picture)
        finally:
            self._signals.sense_at(CARRIER_HZ)
            with self._mutex:
                self._study.job = None
                self._end(reason)

    def _block(self) -> None:
        rig = self._rig
        if self._holder:
            now_s = time.monotonic()
            if self._leases.is_lost(self._holder):
                silent_s = self._leases.lease_s
                self._end(f"No message for {silent_s:g} s from the page that armed the bench.")
            elif now_s > self._beat_s + _HEARTBEAT_S:
                self._beat_s = now_s
                rig.safety.heartbeat(0.0)
        if self._holder:
            self._drive_v = self._next_v()
            rig.source.write(self._drive_v)
        else:
            rig.bench.passed()  # blocks may be skipped: nothing is recorded or controlled
        codes = rig.acquisition.read()
        if self._closed is not None and self._reference is not None:
            self._closed.step(codes, self._reference)
        watched = not self._holder and self._rig.safety.stage not in LIVE
        if watched and (fault := self._idle.fault(codes)):
            self._end(fault)

    def _look(self, picture: PictureFile) -> None:
        """Keep the last frame that has arrived, if there is a new one."""
        frames = self._rig.camera.take()
        if frames is not None and len(frames.time_s):
            picture.save(frames)

    def _next_v(self) -> float:
        if self._closed is not None:
            limits = self._rig.description.drive_limits
            return min(max(self._closed.due_v(), limits.low), limits.high)
        most_v = _RAMP_V_PER_S * self._rig.description.block_s
        return self._drive_v + min(max(self._target_v - self._drive_v, -most_v), most_v)

    def _on_block(self, codes: NDArray[np.int16]) -> None:
        """Write the live signals of each block that is read, and end a study that must end."""
        if self._study.job is not None:
            self._drive_v = self._rig.present_drive_v
        self._study.passed()
        self._signals.append(codes, self._loop, self._reference, armed=bool(self._holder))
