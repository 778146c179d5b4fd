"""The bench of the panel: reads blocks, drives by hand or in a closed loop, and stops."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from haselab.base import (
    HaselabError,
    InputError,
    JsonObject,
    LimitError,
    SafetyError,
    shown,
)
from haselab.panel.columns import LiveWriter
from haselab.panel.values import number
from haselab.runtime.closed_loop import ClosedLoop
from haselab.runtime.lockin import lockin_of
from haselab.runtime.loop import LoopSettings
from haselab.runtime.observer import Seen
from haselab.safety.guarded import GuardedRig
from haselab.safety.state_machine import ArmingRequest, Stage

__all__ = ["BenchState", "LiveBench"]

CARRIER_HZ, CARRIER_V = 2000.0, 0.02  # of the reference study
LEASE_S = 1.5  # longest time without a message from the page that armed the bench
_RAMP_V_PER_S = 1.0  # at the amplifier's input: 5 kV/s with a gain of 5000
_HEARTBEAT_S = 0.5
_PICTURES_HZ = 5.0


@dataclass(frozen=True)
class BenchState:
    """What the pages show of the bench.

    Args:
        stage: of the safety chain: off, requested, armed, running or tripped.
        mode: `idle`, `drive` (by hand) or `loop`.
        drive_v: drive of the last block, in V.
        target_v: drive to which the ramp leads, in V.
        reference: desired strain; None: the loop is open.
        limit_v: highest drive that was typed when the bench was armed, in V.
        holder: page that armed the bench; empty: none.
        reason: of the last trip, or why the last run ended.
        low_v: lowest drive of the rig, in V.
        high_v: highest drive of the rig, in V.
        gain: of the amplifier.
        loop: limits of the desired strain; None: the actuator file has no complete controller.
        name: of the rig.
        simulated: whether it is a twin.
    """

    stage: str
    mode: str
    drive_v: float
    target_v: float
    reference: float | None
    limit_v: float
    holder: str
    reason: str
    low_v: float
    high_v: float
    gain: float
    loop: tuple[float, float] | None
    name: str
    simulated: bool


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
    """

    def __init__(
        self,
        rig: GuardedRig,
        writer: LiveWriter,
        read_loop: Callable[[], LoopSettings | None] = lambda: None,
        picture: Path | None = None,
    ) -> None:
        self._rig, self._writer, self._picture = rig, writer, picture
        self._read_loop, self._loop = read_loop, read_loop()
        about = rig.description
        self._lockin = lockin_of(about, CARRIER_HZ)
        self._mutex = threading.Lock()  # protects all below
        self._request: ArmingRequest | None = None
        self._mode, self._reason, self._holder = "idle", "", ""
        self._drive_v = self._target_v = 0.0
        self._reference: float | None = None
        self._limit_v = 0.0
        self._closed: ClosedLoop | None = None
        self._seen_s = self._beat_s = 0.0
        self._settled = about.switch_in_block + round(1e-3 * about.rate_hz)

    # ---- from other threads ------------------------------------------------------------------

    @property
    def state(self) -> BenchState:
        """What the pages show."""
        safety, about = self._rig.safety, self._rig.description
        low, high = about.drive_limits.low, about.drive_limits.high
        limits = None
        if self._loop is not None:
            limits = (self._loop.saturation.low, self._loop.saturation.high)
        return BenchState(
            safety.stage.value, self._mode, self._drive_v, self._target_v, self._reference,
            self._limit_v, self._holder, safety.gate.interlock.reason or self._reason, low, high,
            about.amplifier_gain, limits, about.name, self._rig.simulated,
        )  # fmt: skip

    def do(self, what: str, holder: str, values: JsonObject) -> JsonObject:
        """Carry out a command of a page.

        Args:
            what: `request`, `arm`, `drive`, `loop`, `open`, `disarm` or `lease`.
            holder: the page.
            values: arguments of the command.
        Returns:
            The answer.
        Raises:
            InputError: There is no such command, or an argument is missing or of a wrong type.
            LimitError: A value is outside the limits.
            SafetyError: Another page has armed the bench, or it is not armed.
        """
        commands = {
            "request": self._request_arming, "arm": self._arm, "drive": self._drive_to,
            "loop": self._close_loop, "open": self._open_loop, "disarm": self._disarm,
            "lease": self._lease,
        }  # fmt: skip
        if what not in commands:
            raise InputError(
                f"There is no command {shown(what)}. Use one of: {', '.join(commands)}."
            )
        # The file is read here, so that no block waits for it.
        found = self._read_loop() if what == "request" else None
        with self._mutex:
            if what == "request" and not self._holder:
                self._loop = found
            if self._holder and holder != self._holder and what not in ("disarm", "lease"):
                raise SafetyError(
                    "Another page has armed the bench. It must disarm the bench first."
                )
            return commands[what](holder, values)

    def stop(self, reason: str) -> None:
        """Take the bench to 0 V at once and latch the reason. Never waits for a command.

        Args:
            reason: one sentence.
        """
        self._rig.safety.trip(reason)

    def _request_arming(self, holder: str, values: JsonObject) -> JsonObject:
        self._require_idle()
        self._request = self._rig.safety.request()
        return {"number": self._request.number, "limits": self._request.limits,
                "reason": self._request.reason}  # fmt: skip

    def _arm(self, holder: str, values: JsonObject) -> JsonObject:
        self._require_idle()
        limit_v, request = number(values, "limit_v"), self._request
        limits = self._rig.description.drive_limits
        if not 0.0 < limit_v <= limits.high:
            raise LimitError(
                f"The typed limit is {limit_v:g} V, but it must be above 0 and at most "
                f"{limits.high:g} V. Type another one."
            )
        if request is None or request.number != values.get("number"):
            raise SafetyError("This request is no longer valid. Press 'Arm the bench' again.")
        self._request = None
        self._rig.safety.arm(request, str(values.get("acknowledged", "")))
        try:
            self._rig.safety.run()
            self._rig.begin()
            self._rig.generator.sine(CARRIER_HZ, CARRIER_V)
            if self._picture is not None:
                self._rig.camera.start(_PICTURES_HZ)
        except HaselabError:
            self._end()
            raise
        self._mode, self._holder, self._limit_v, self._reason = "drive", holder, limit_v, ""
        self._drive_v = self._target_v = 0.0
        self._seen_s = self._beat_s = time.monotonic()
        return {}

    def _drive_to(self, holder: str, values: JsonObject) -> JsonObject:
        self._require_armed(holder)
        target_v = number(values, "value_v")
        low_v = max(self._rig.description.drive_limits.low, -self._limit_v)
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
        if not limits.low <= strain <= limits.high:
            raise LimitError(
                f"The desired strain is {strain:g}, but the limits of the controller are "
                f"{limits.low:g} to {limits.high:g}. Choose another one."
            )
        if self._closed is None:
            highest_v = float(self._loop.voltage_map.voltage_v(limits.high))
            if highest_v > self._limit_v:
                raise LimitError(
                    f"The controller may use up to {highest_v:.3g} V, but the bench was armed for "
                    f"{self._limit_v:g} V. Arm with a limit of at least {highest_v:.3g} V."
                )
            carrier = (CARRIER_HZ, CARRIER_V)
            self._closed = ClosedLoop(self._rig, _NoCamera(), carrier, self._loop, "panel")
            self._mode = "loop"
        self._reference = strain
        return {}

    def _open_loop(self, holder: str, values: JsonObject) -> JsonObject:
        self._require_armed(holder)
        self._leave_loop()
        return {}

    def _disarm(self, holder: str, values: JsonObject) -> JsonObject:
        if self._holder:
            self._end("The bench was disarmed.")
        return {}

    def _lease(self, holder: str, values: JsonObject) -> JsonObject:
        if holder == self._holder:
            self._seen_s = time.monotonic()
        return {}

    def _require_idle(self) -> None:
        if self._holder:
            raise SafetyError("The bench is armed already. Disarm it first.")

    def _require_armed(self, holder: str) -> None:
        if not self._holder or holder != self._holder or not self._rig.safety.live:
            raise self._rig.safety.refusal()

    def _leave_loop(self) -> None:
        if self._closed is not None:
            self._closed, self._reference, self._mode = None, None, "drive"
            self._target_v = self._drive_v

    def _end(self, reason: str = "") -> None:
        """End the run at 0 V, read back."""
        self._mode, self._holder, self._closed, self._reference = "idle", "", None, None
        self._drive_v = self._target_v = self._limit_v = 0.0
        self._reason = reason
        try:
            self._rig.safe()
        except SafetyError as error:  # the latch keeps it
            self._reason = str(error)
        finally:
            self._rig.safety.end_run()

    # ---- of the thread that reads --------------------------------------------------------------

    def step(self) -> None:
        """Put out the next drive, read one block, and write the live signals."""
        with self._mutex:
            try:
                codes, time_s = self._block()
            except HaselabError as error:
                self._failed(error)
                return
            if self._closed is not None:
                self._target_v = self._drive_v
            if self._holder and self._picture is not None:
                self._look(self._picture)
            self._write(codes, time_s)
            if self._holder and self._rig.safety.stage is Stage.TRIPPED:
                self._end(self._rig.safety.reason)

    def close(self) -> None:
        """End at 0 V."""
        with self._mutex:
            self._end("The panel has ended.")

    def _failed(self, error: HaselabError) -> None:
        if not self._holder:
            self._reason = str(error)
            time.sleep(self._rig.description.block_s)
            return
        if not isinstance(error, SafetyError):
            self._rig.safety.trip(str(error))
        self._end(self._rig.safety.reason or str(error))

    def _block(self) -> tuple[NDArray[np.int16], float]:
        rig = self._rig
        if self._holder:
            now_s = time.monotonic()
            if now_s > self._seen_s + LEASE_S:
                self._end(f"No message from the page that armed the bench for {LEASE_S:g} s.")
            elif now_s > self._beat_s + _HEARTBEAT_S:
                self._beat_s = now_s
                rig.safety.heartbeat(0.0)
        if self._holder:
            self._drive_v = self._next_v()
            rig.source.write(self._drive_v)
        codes = rig.acquisition.read()
        if self._closed is not None and self._reference is not None:
            self._closed.step(codes, self._reference)
        return codes, rig.acquisition.time_s

    def _look(self, path: Path) -> None:
        """Keep the last frame that has arrived, if there is a new one."""
        try:
            frames = self._rig.camera.take()
        except HaselabError as error:
            self._failed(error)
            return
        if frames is not None and len(frames.time_s):
            new = path.with_suffix(".new")
            Image.fromarray(frames.image(len(frames.time_s) - 1)).save(new, "JPEG", quality=80)
            new.replace(path)

    def _next_v(self) -> float:
        if self._closed is not None:
            return min(self._closed.due_v(), self._limit_v)
        most_v = _RAMP_V_PER_S * self._rig.description.block_s
        return self._drive_v + min(max(self._target_v - self._drive_v, -most_v), most_v)

    def _write(self, codes: NDArray[np.int16], time_s: float) -> None:
        about = self._rig.description
        capacitance_f, _, valid = self._lockin.step(codes)
        sensed_f = capacitance_f if valid and self._holder else math.nan
        strain = math.nan
        if self._loop is not None and not math.isnan(sensed_f):
            strain = float(self._loop.strain_map.strain(sensed_f))
        seen_v = float(codes[self._settled :, 0].mean()) * about.volt_per_code
        residual_v = seen_v / about.monitor_v_per_drive_v - self._rig.present_drive_v
        reference = math.nan if self._reference is None else self._reference
        values = (self._rig.present_drive_v, reference, sensed_f, strain, residual_v)
        self._writer.append(codes, time_s, values)
