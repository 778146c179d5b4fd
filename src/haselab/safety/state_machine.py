"""The chain of safety: off, armed in two steps, running, tripped; the first reason stays."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum

from haselab.base import HaselabError, SafetyError
from haselab.safety.guardian import UNARMED_S, Guardian
from haselab.safety.watchdog_settings import FieldRating, WatchdogSettings, require_finite

__all__ = ["Permit", "Safety", "SafetySettings", "Stage"]


class Stage(Enum):
    """Where the chain stands."""

    OFF = "off"
    ARMED = "armed"
    RUNNING = "running"
    TRIPPED = "tripped"


@dataclass(frozen=True)
class SafetySettings:
    """Limits that hold while the bench is energised.

    Args:
        rate_limit_v_per_s: fastest rise of the drive from one update to the next, ahead of the
            amplifier; towards 0 V there is no limit.
        current_limit_a: of the mean current once the output has settled.
        follow: how far the voltage monitor may be from what was asked, part of the drive's range.
        settle_s: what the output may take to get there: amplifier, charging of the actuator.
        residual_v: output at which the bench counts as safe, after the amplifier.
        read_back: read the monitor at the end, to see that the output is at 0 V.
        real_time: the rig runs by the wall clock; deadlines count.
        missed_limit: as many missed ticks in a row trip.
        late_limit: as many late ticks in a hundred trip.
        lease_s: longest silence of the program before the guardian acts.
        idle_s: the same between experiments, where fits are made.
        permit_age_s: longest time armed without a new permission, see `permit_expired`.
        compare_output: compare the voltage monitor with the drive; False for a recorded session,
            which has no output.
        loop: limits of closed loops.
        rating: of the dielectric; None where it is not known, then the field is not watched.
    Raises:
        InputError: a limit that is not finite and above zero.
    """

    rate_limit_v_per_s: float = 2000.0
    current_limit_a: float = 1e-3
    follow: float = 0.1
    settle_s: float = 5e-3
    residual_v: float = 50.0
    read_back: bool = True
    real_time: bool = False
    missed_limit: int = 5
    late_limit: int = 20
    lease_s: float = 2.0
    idle_s: float = 600.0
    permit_age_s: float = 4 * 3600.0
    compare_output: bool = True
    loop: WatchdogSettings = field(default_factory=WatchdogSettings)
    rating: FieldRating | None = None

    def __post_init__(self) -> None:
        require_finite("safety", self)


@dataclass(frozen=True)
class Permit:
    """The first step of arming: what the second one will energise.

    Args:
        number: of this permit; only the last one given is good, and once.
        words: limits that will hold, for the person who arms.
        after: reason of the trip before it; empty if there was none.
    """

    number: int
    words: str
    after: str = ""


class Safety:
    """One bench's chain of safety.

    Args:
        settings: limits.
        guardian: the independent process, started; None where the bench has none.
    """

    def __init__(self, settings: SafetySettings, guardian: Guardian | None = None) -> None:
        self.settings = settings
        self.guardian = guardian
        self._stage = Stage.OFF
        self._reason = ""
        self._number = 0
        self._open: Permit | None = None
        self._make_safe: Callable[[], None] = lambda: None
        self._note: Callable[[str], None] = lambda what: None

    @property
    def stage(self) -> Stage:
        """Where the chain stands."""
        return self._stage

    @property
    def reason(self) -> str:
        """Of the last trip; empty before one and after a new arming."""
        return self._reason

    def acts_by(self, make_safe: Callable[[], None]) -> None:
        """What a trip does before anything else."""
        self._make_safe = make_safe

    def tells(self, note: Callable[[str], None]) -> None:
        """Who records trips."""
        self._note = note

    def request(self) -> Permit:
        """First step of arming: say what would be energised.

        Returns:
            The permit that `arm` takes.
        Raises:
            SafetyError: armed already, or the guardian does not answer.
        """
        if self._stage in (Stage.ARMED, Stage.RUNNING):
            raise SafetyError(f"The bench is {self._stage.value} already; stop it first.")
        if self.guardian is not None and (lost := self.guardian.lost()):
            raise SafetyError(f"{lost} Nothing was armed. Start the guardian again.")
        s = self.settings
        guarded = "a guardian watches" if self.guardian is not None else "no guardian"
        words = (
            f"current {1e3 * s.current_limit_a:g} mA, rate {s.rate_limit_v_per_s:g} V/s, {guarded}"
        )
        self._number += 1
        self._open = Permit(self._number, words, self._reason)
        return self._open

    def arm(self, permit: Permit) -> None:
        """Second step of arming.

        Args:
            permit: the one that the last `request` gave.
        Raises:
            SafetyError: another permit, or one that was used.
        """
        if permit is not self._open:
            raise SafetyError(
                f"Permit {permit.number} is not open (the last one is {self._number}). Request "
                "arming again, then arm."
            )
        self._open = None
        self._reason = ""
        self._stage = Stage.ARMED
        if self.guardian is not None:
            self.guardian.renew(self.settings.idle_s)

    def run(self) -> None:
        """From armed to running.

        Raises:
            SafetyError: not armed.
        """
        if self._stage is not Stage.ARMED:
            raise self.refusal()
        self._stage = Stage.RUNNING

    def rest(self) -> None:
        """The run is over; the next one needs a new arming. A trip stays."""
        if self._stage is not Stage.TRIPPED:
            self._stage = Stage.OFF
        self._open = None
        if self.guardian is not None:
            self.guardian.renew(UNARMED_S)

    def refusal(self) -> SafetyError:
        """Why nothing may be energised now."""
        if self._stage is Stage.TRIPPED:
            return SafetyError(
                f"The bench is tripped ({self._reason}) The output stays at 0 V. Remove the "
                "cause, then arm again."
            )
        return SafetyError(
            f"The bench is {self._stage.value}; allowed is an output other than 0 V only when it "
            "is armed. Arm it first."
        )

    @property
    def live(self) -> bool:
        """Whether anything may be energised."""
        return self._stage in (Stage.ARMED, Stage.RUNNING)

    def trip(self, reason: str) -> SafetyError:
        """Make the bench safe, keep the first reason, and record it.

        Args:
            reason: what happened, what was allowed, what to do.
        Returns:
            The error to raise.
        """
        first = self._stage is not Stage.TRIPPED
        if first:
            self._stage, self._reason = Stage.TRIPPED, reason
        try:
            self._make_safe()
        finally:
            if first:
                with contextlib.suppress(HaselabError):
                    self._note(f"trip: {reason}")
        return SafetyError(f"{reason} The output is at 0 V.")

    def sign_of_life(self, for_s: float) -> None:
        """Tell the guardian that all is well, and hear that it is there.

        Args:
            for_s: how long the program may now be silent, in s, beyond the lease.
        Raises:
            SafetyError: the guardian is lost, or has acted.
        """
        if self.guardian is None or not self.live:
            return
        self.guardian.renew(for_s + self.settings.lease_s)
        if lost := self.guardian.lost():
            raise self.trip(lost)
