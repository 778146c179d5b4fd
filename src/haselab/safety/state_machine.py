"""The safety chain of a bench: off, requested, armed, running, tripped.

| from | event | to | who may cause it |
|---|---|---|---|
| off, requested, tripped | request | requested | the person who arms |
| requested | arm | armed | the same person, in a second step; acknowledges the reason of a trip |
| armed | run | running | the program |
| requested, armed, running | end | off | the program, at the end of a run |
| any | trip | tripped | watchdogs, guardians, `haselab rig safe`, a program that crashed |

`TRANSITIONS` is this table; the tests derive their fault matrix from it.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

from haselab.base import HaselabError, SafetyError
from haselab.safety.gate import Gate
from haselab.safety.guardian.client import UNARMED_S, Guardians
from haselab.safety.interlock import lease_clock_s
from haselab.safety.watchdog.settings import (
    FieldRating,
    WatchdogSettings,
    permit_expired,
    require_finite,
)

__all__ = ["LIVE", "TRANSITIONS", "ArmingRequest", "Event", "Safety", "SafetySettings", "Stage"]


class Stage(Enum):
    """A stage of the safety chain."""

    OFF = "off"
    REQUESTED = "requested"
    ARMED = "armed"
    RUNNING = "running"
    TRIPPED = "tripped"


class Event(Enum):
    """An event that takes the safety chain from one stage to another."""

    REQUEST = "request"
    ARM = "arm"
    RUN = "run"
    END = "end"
    TRIP = "trip"


TRANSITIONS: dict[tuple[Stage, Event], Stage] = {
    (Stage.OFF, Event.REQUEST): Stage.REQUESTED,
    (Stage.REQUESTED, Event.REQUEST): Stage.REQUESTED,
    (Stage.TRIPPED, Event.REQUEST): Stage.REQUESTED,
    (Stage.REQUESTED, Event.ARM): Stage.ARMED,
    (Stage.ARMED, Event.RUN): Stage.RUNNING,
    (Stage.OFF, Event.END): Stage.OFF,
    (Stage.REQUESTED, Event.END): Stage.OFF,
    (Stage.ARMED, Event.END): Stage.OFF,
    (Stage.RUNNING, Event.END): Stage.OFF,
    (Stage.TRIPPED, Event.END): Stage.TRIPPED,
    **{(stage, Event.TRIP): Stage.TRIPPED for stage in Stage},
}
_ARM_S = 5.0  # longest wait for another program that makes the bench safe
_CALL_S = 0.5  # longest wait for a call in another thread
LIVE = frozenset({Stage.ARMED, Stage.RUNNING})  # stages that permit an output other than 0 V


@dataclass(frozen=True)
class SafetySettings:
    """Limits that apply while the bench is energised.

    Args:
        rate_limit_v_per_s: fastest rise of the drive from one update to the next, at the
            amplifier's input; towards 0 V there is no limit.
        current_limit_a: largest mean current once the output has settled.
        follow: largest difference between voltage monitor and requested output, as a fraction of
            the drive's range.
        carrier_limit_v: highest peak of the sensing signal at the amplifier's input; None: half of
            the largest drive.
        supply_limit_v: highest voltage of a separate supply; None: the largest drive times the
            amplifier's gain.
        settle_s: settling time of the output: amplifier, charging of the actuator.
        residual_v: voltage at the amplifier's output below which the bench counts as safe.
        read_back: read the monitor at the end, to confirm that the output is at 0 V.
        real_time: the rig runs in real time, so deadlines count.
        missed_limit: number of missed ticks in a row that trips.
        late_limit: number of late ticks in a hundred that trips.
        lease_s: longest time without a heartbeat of the program before the guardians act.
        idle_s: the same between experiments, where fits are made.
        permit_age_s: longest time for which one arming is valid.
        compare_output: compare the voltage monitor with the drive; False for a recorded session,
            which has no output.
        loop: limits of closed loops.
        rating: of the dielectric; None: unknown, so the electric field is not monitored.
    Raises:
        InputError: A limit is not finite and above zero.
    """

    rate_limit_v_per_s: float = 2000.0
    current_limit_a: float = 1e-3
    follow: float = 0.1
    carrier_limit_v: float | None = None
    supply_limit_v: float | None = None
    settle_s: float = 5e-3
    residual_v: float = 50.0
    read_back: bool = True
    real_time: bool = False
    missed_limit: int = 5
    late_limit: int = 20
    lease_s: float = 2.0
    idle_s: float = 600.0
    permit_age_s: float = 12 * 3600.0
    compare_output: bool = True
    loop: WatchdogSettings = field(default_factory=WatchdogSettings)
    rating: FieldRating | None = None

    def __post_init__(self) -> None:
        require_finite("safety", self)


@dataclass(frozen=True)
class ArmingRequest:
    """First step of arming, which states what the second step will energise.

    Args:
        number: of this request; only the last one can be armed, and only once.
        limits: limits that will apply, for the person who arms.
        reason: why the bench was made safe before, which must be acknowledged; or empty.
        revision: of the interlock when this was requested.
    """

    number: int
    limits: str
    reason: str
    revision: int


class Safety:
    """The safety chain of one bench.

    Args:
        settings: limits.
        guardians: the independent processes, already started; None if the bench has none.
        clock: monotonic, in s.
    """

    def __init__(
        self,
        settings: SafetySettings,
        guardians: Guardians | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.settings = settings
        self.guardians = guardians
        self.gate = Gate()
        self._limits = ""
        self._clock = clock
        self._stage = Stage.OFF
        self._changing = threading.RLock()  # held briefly: STOP comes from another thread
        self._reason = ""
        self._trips = 0
        self._number = 0
        self._open: ArmingRequest | None = None
        self._armed_s = 0.0
        self._make_safe: Callable[[], None] = lambda: None
        self._confirm: Callable[[], None] = lambda: None
        self._note: Callable[[str], None] = lambda what: None

    def _to(self, event: Event) -> None:
        self._stage = TRANSITIONS[self._stage, event]

    @property
    def stage(self) -> Stage:
        """Current stage of the safety chain."""
        return self._stage

    @property
    def reason(self) -> str:
        """Reason for the last trip; empty before one and after a new arming."""
        return self._reason

    @property
    def trips(self) -> int:
        """Number of trips so far."""
        return self._trips

    def attach(
        self,
        gate: Gate,
        make_safe: Callable[[], None],
        limits: str = "",
        confirm: Callable[[], None] = lambda: None,
    ) -> None:
        """Attach the drivers that this chain protects.

        Args:
            gate: the one that wraps all of them.
            make_safe: takes them to 0 V; a trip calls it first.
            limits: limits in force, for the person who arms; see `arming_limits`.
            confirm: trips and raises `SafetyError` unless they are at 0 V.
        """
        self.gate, self._make_safe, self._limits = gate, make_safe, limits
        self._confirm = confirm

    def record_with(self, note: Callable[[str], None]) -> None:
        """Record trips by calling `note`."""
        self._note = note

    # ---- arming ------------------------------------------------------------------------------

    def request(self) -> ArmingRequest:
        """First step of arming: state what would be energised.

                Returns:
                    The request that `arm` takes.
                Raises:
        SafetyError: The bench is already armed, a guardian does not respond, or the interlock's
                    files were removed.
        """
        if (self._stage, Event.REQUEST) not in TRANSITIONS:
            raise SafetyError(f"The bench is already {self._stage.value}. Stop it first.")
        if self.guardians is not None and (lost := self.guardians.lost()):
            raise SafetyError(f"{lost} Nothing was armed. Run the command again.")
        watched = "Two guardians watch." if self.guardians is not None else "No guardian watches."
        limits = f"{self._limits} {watched}"
        interlock = self.gate.interlock
        if not interlock.intact:
            raise SafetyError(
                "The software interlock's files were removed, or the rig was closed. Open the rig "
                "again, or run the command again."
            )
        self._number += 1
        revision = interlock.revision  # read first: `arm` refuses after any later revocation
        self._open = ArmingRequest(self._number, limits, interlock.reason or self._reason, revision)
        self._to(Event.REQUEST)
        return self._open

    def arm(self, request: ArmingRequest, acknowledged: str = "") -> None:
        """Second step of arming.

        Args:
            request: the one that the last `request` returned.
            acknowledged: its `reason`, once a person has read it.
        Raises:
            SafetyError: The request is not the last one or was used, its reason was not
                acknowledged, or the bench was made safe meanwhile.
        """
        if request is not self._open and request.number != self._number:
            raise SafetyError(
                f"Arming request {request.number} is no longer valid (the last one is "
                f"{self._number}). Request arming again."
            )
        if request is not self._open or self._stage is not Stage.REQUESTED:
            raise SafetyError(
                f"Arming request {request.number} is no longer valid: it was used or withdrawn, or "
                "the bench was stopped meanwhile. Request arming again."
            )
        if request.reason and acknowledged != request.reason:
            raise SafetyError(
                f"The permission of the bench was revoked: {request.reason.rstrip('.')}. Remove "
                "the cause, then acknowledge this reason when you arm."
            )
        interlock = self.gate.interlock
        self._open = None
        if self.guardians is not None and (lost := self.guardians.lost()):
            raise self.trip(f"{lost} Nothing was armed.")
        # Wait for a program that makes the bench safe.
        interlock.holding_output(lambda acquired: self._grant(request, acquired), _ARM_S)

    def _grant(self, request: ArmingRequest, acquired: bool) -> None:
        if not acquired:
            raise SafetyError("Another program is taking the bench to 0 V. Request arming again.")
        interlock = self.gate.interlock
        with self._changing:
            if interlock.revision != request.revision or self._stage is not Stage.REQUESTED:
                self._stage = Stage.TRIPPED
                self._reason = interlock.reason
                raise SafetyError(
                    "The permission of the bench was revoked after arming was requested: "
                    f"{interlock.reason.rstrip('.')}. Request arming again."
                )
            interlock.acknowledge(request.revision)
            self._reason = ""
            self._to(Event.ARM)
            self._armed_s = self._clock()
            interlock.lease(self.settings.idle_s)
            self.gate.permit(request.revision, self._expired)

    def _expired(self) -> str:
        return permit_expired(self._clock() - self._armed_s, self.settings.permit_age_s)

    def _lease_ended(self) -> str:
        """Why a heartbeat must not renew the lease, because it has ended; empty if it has not.

        After the computer slept, the guardians may notice this later than the program.
        """
        late_s = lease_clock_s() - self.gate.interlock.lease_end_s
        if late_s <= 0.0:
            return ""
        return (
            f"The lease (lease_s; idle_s between experiments) of this program ended {late_s:.4g} s "
            "before its next heartbeat. Check whether the program hung or the computer slept."
        )

    def run(self) -> None:
        """Go from armed to running.

        Raises:
            SafetyError: The bench is not armed.
        """
        with self._changing:
            if self._stage is not Stage.ARMED or not self.gate.permitted:
                raise self.refusal()
            self._to(Event.RUN)

    def end_run(self) -> None:
        """End the run; the next one needs a new arming. A trip remains.

        Raises:
            SafetyError: The output is not confirmed at 0 V; the bench is tripped.
        """
        try:
            if why := self.revoked_by_others:  # revoked at the last moment
                self._trip_once(why)
                self._record(why)
            elif self._stage in LIVE and self.gate.has_requests:  # not yet taken to 0 V
                self._make_safe()
            if self._stage in LIVE or self._stage is Stage.TRIPPED:
                self._confirm()
        finally:
            with self._changing:
                self._to(Event.END)
            self._open = None
            self.gate.end()
            self.gate.interlock.lease(UNARMED_S)

    def refusal(self) -> SafetyError:
        """Return the error that says why nothing may be energised now."""
        reason = (
            self._reason or self.gate.revoked or self.gate.expired or self.gate.interlock.reason
        )
        if reason:
            return SafetyError(
                f"The bench is tripped: {reason.rstrip('.')}. No voltage is applied until you arm "
                "it again. Remove the cause first."
            )
        return SafetyError(
            f"The bench is {self._stage.value}. Arm the bench before you apply a voltage."
        )

    @property
    def live(self) -> bool:
        """Whether anything may be energised."""
        return self._stage in LIVE and self.gate.permitted

    # ---- tripping ----------------------------------------------------------------------------

    def trip(self, reason: str) -> SafetyError:
        """Make the bench safe, keep the first reason, and record it.

        Args:
            reason: what happened, the limit, and what to do.
        Returns:
            The error to raise.
        """
        first = self._trip_once(reason)
        try:
            try:
                self._make_safe()
            finally:
                self.gate.settle(_CALL_S)
        finally:
            if first:
                self._record(reason)
        return SafetyError(f"{reason} All outputs were commanded to 0 V.")

    def _record(self, reason: str) -> None:
        with contextlib.suppress(HaselabError):
            self._note(f"trip: {reason}")

    @property
    def revoked_by_others(self) -> str:
        """What made the bench safe while this program had a permission; empty if nothing did."""
        why = self.gate.revoked if self._stage in LIVE else ""
        return f"The permission of the bench was revoked: {why.rstrip('.')}." if why else ""

    def _trip_once(self, reason: str) -> bool:
        """Revoke the permission before anything else; return whether this is the first reason."""
        self.gate.end_permission()  # without waiting for the lock
        with self._changing:
            first = self._stage is not Stage.TRIPPED
            self.gate.end_permission()
            with contextlib.suppress(OSError):  # a failing interlock must not prevent 0 V
                self.gate.interlock.revoke(reason)
            self._to(Event.TRIP)
            if first:
                self._reason = reason
                self._trips += 1
            return first

    def heartbeat(self, for_s: float) -> None:
        """Send the guardians a heartbeat, and check whether the bench was made safe by others.

        Args:
            for_s: time until the next heartbeat, in s, beyond the lease.
        Raises:
            SafetyError: The bench was made safe by others, the lease has ended, a guardian is
                lost, or the arming has expired.
        """
        if self._stage not in LIVE:
            return
        if why := self.revoked_by_others:
            raise self.trip(why)
        if self.guardians is not None and (why := self._lease_ended()):
            raise self.trip(why)
        self.gate.interlock.lease(for_s + self.settings.lease_s)
        if self.guardians is not None and (lost := self.guardians.lost()):
            raise self.trip(lost)
        if why := self._expired():
            raise self.trip(why)
