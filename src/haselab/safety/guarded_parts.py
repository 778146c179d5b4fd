"""The instruments behind the safety chain: every value and every block is checked here."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import HaselabError, InputError, Limits, text_of
from haselab.rig import (
    Acquisition,
    BuiltInController,
    FunctionGenerator,
    HighVoltageSupply,
    LoadStand,
    PreloadsOutputs,
    Rig,
    VoltageSource,
)
from haselab.safety.instrument_state import OutputState, discharged, instrument_states, output_state
from haselab.safety.request_limits import as_number, check_carrier, supply_limits
from haselab.safety.state_machine import LIVE, Safety
from haselab.safety.watchdog.block_checks import BlockWatch
from haselab.safety.watchdog.deadlines import Deadlines

__all__ = [
    "GuardedAcquisition",
    "GuardedBench",
    "GuardedController",
    "GuardedGenerator",
    "GuardedSource",
    "GuardedStand",
    "GuardedSupply",
]

_ROUNDING = 1.0 + 1e-9  # of a difference of two outputs
_RINGING_S = 5.0  # after which 10 % are left at the reference study's 5.1 rad/s, damping 0.09
_SETUP_S = 30.0  # longest time to set an instrument that has its own connection
_MANUAL_S = 3600.0  # longest time for a person to hang a mass


class GuardedBench:
    """State that the guarded parts of one rig share."""

    def __init__(self, rig: Rig, safety: Safety, clock: Callable[[], float]) -> None:
        s = safety.settings
        self.rig, self.safety = rig, safety
        self.whole: Limits | None = None  # drive limits of the rig while narrower ones apply
        self.preloads = rig.source if isinstance(rig.source, PreloadsOutputs) else None
        self.watch = BlockWatch(rig.description, s)
        queued = rig.description.queued_blocks
        deadline_s = (1 + queued) * rig.description.block_s
        self.deadlines = Deadlines(deadline_s, s.missed_limit, s.late_limit, clock)
        self.requested_v = 0.0  # last accepted
        self.present_drive_v = 0.0  # in force during the last block
        self.time_s = 0.0
        self.moved_s = -math.inf  # when drive or load last changed
        self.unbroken = False  # whether the next block has to follow without a gap
        self.found: dict[str, OutputState] = {}  # by instrument, since anything was energised
        self.asked_guardian = False  # since anything was energised
        self.unconfirmed = ""  # why 0 V is not certain, since anything was energised
        self._requests = -1  # number that the gate had let through then
        self.turn = threading.Lock()  # several threads report instruments
        self.on_block: Callable[[NDArray[np.int16]], None] = lambda codes: None  # of each block

    def outdate(self) -> None:
        """Discard what was found off if any driver was given a request since."""
        requests = self.safety.gate.requests
        if requests != self._requests:
            self._requests = requests
            self.found, self.asked_guardian, self.unconfirmed = {}, False, ""

    @property
    def left_out(self) -> int:
        """Number of outputs since opening that were skipped because they came too late."""
        return 0 if self.preloads is None else self.preloads.missed_outputs

    def check(self, voltage_v: float, before_v: float) -> None:
        """Check one value against the drive limits, then its rise against the rate limit."""
        self.rig.description.drive_limits.check(voltage_v)
        towards_zero = min(before_v, 0.0) <= voltage_v <= max(before_v, 0.0)
        if not towards_zero:
            rate = self.safety.settings.rate_limit_v_per_s
            rise = (voltage_v - before_v) / self.rig.description.block_s
            if abs(rise) > rate * _ROUNDING:
                Limits("rise of the drive", -rate, rate, "V/s").check(rise)

    @contextlib.contextmanager
    def calling(self) -> Iterator[None]:
        """Make a driver call; if it fails because the bench was made safe, say so."""
        try:
            yield
        except InputError:  # refused: nothing was changed
            raise
        except Exception as error:
            if why := self.safety.revoked_by_others:
                raise self.safety.trip(why) from error
            if self.safety.live:
                self.safety.trip(text_of(error) or type(error).__name__)
            raise

    def answered(self) -> None:
        """Trip if the output that was just given missed its deadline."""
        if self.has_deadlines and (fault := self.deadlines.answered()):
            raise self.safety.trip(fault)

    @property
    def has_deadlines(self) -> bool:
        """Whether this program has deadlines; not if the rig has its own controller."""
        return self.safety.settings.real_time and self.rig.controller is None

    @property
    def is_settled(self) -> bool:
        """Whether drive and load have been constant for so long that the actuator hardly rings."""
        return self.time_s - self.moved_s >= _RINGING_S

    def passed(self) -> None:
        """Note that time passed with the present output, and that blocks may be missing."""
        self.unbroken = False
        self.present_drive_v = self.requested_v
        self.watch.rest(self.requested_v)

    def reopened(self) -> None:
        """Note that the board was opened again: it is at 0 V, and its clock begins at 0 s."""
        self.requested_v = 0.0
        self.time_s = self.moved_s = 0.0
        self.passed()


class _Part:
    """Base of the guarded instruments, which offer the calls of their protocol and no others."""

    _name = "instrument"

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(self._unknown(name))

    def __setattr__(self, name: str, value: object) -> None:
        if not name.startswith("_"):
            raise AttributeError(self._unknown(name))
        object.__setattr__(self, name, value)

    def _unknown(self, name: str) -> str:
        return (
            f"The guarded {self._name} has no {name!r}: it offers only the calls of its protocol "
            "in haselab.rig. Nothing was changed. Set up your driver before you guard the rig."
        )


class GuardedSource(_Part):
    """See `haselab.rig.VoltageSource`."""

    _name = "source"

    def __init__(self, bench: GuardedBench, plain: VoltageSource) -> None:
        self._bench, self._plain = bench, plain

    def write(self, voltage_v: float) -> None:
        """Request a drive voltage; other than 0 V only while the bench is armed."""
        b = self._bench
        voltage_v = as_number("drive voltage", voltage_v)
        b.check(voltage_v, b.present_drive_v)
        if voltage_v != 0.0:
            if not b.safety.live:
                raise b.safety.refusal()
            b.safety.heartbeat(0.0)
        with b.calling():
            self._plain.write(voltage_v)
        if voltage_v != b.requested_v:
            b.moved_s = b.time_s
        b.requested_v = voltage_v
        b.answered()

    def zero(self) -> None:
        """See `haselab.rig.VoltageSource`."""
        try:
            self._plain.zero()
        finally:
            if self._bench.requested_v != 0.0:
                self._bench.moved_s = self._bench.time_s
            self._bench.requested_v = 0.0
            self._bench.passed()


class GuardedAcquisition(_Part):
    """See `haselab.rig.Acquisition`."""

    _name = "acquisition"

    def __init__(self, bench: GuardedBench, plain: Acquisition) -> None:
        self._bench, self._plain = bench, plain
        self._left_out = bench.left_out

    def read(self) -> NDArray[np.int16]:
        """Read the next block and check it."""
        b = self._bench
        b.safety.heartbeat(b.rig.description.block_s)
        with b.calling():
            before_s = self._plain.time_s
            codes = self._plain.read()
            b.time_s = self._plain.time_s
            follows, b.unbroken = b.unbroken, True
            b.watch.check_form(codes, b.time_s - before_s if follows else None)
        before, self._left_out = self._left_out, b.left_out
        if self._left_out == before:
            b.present_drive_v = b.requested_v
        b.on_block(codes)
        own = b.rig.controller is not None  # which has its own checks
        fault = "" if own else b.watch.fault(codes, b.present_drive_v, follows=follows)
        if fault and b.safety.stage in LIVE:
            raise b.safety.trip(b.safety.revoked_by_others or fault)
        if b.has_deadlines:
            b.deadlines.arrived(b.time_s)
        return codes

    @property
    def time_s(self) -> float:
        """Time at the end of the last block; the last known time if the device is gone."""
        with contextlib.suppress(HaselabError):
            self._bench.time_s = self._plain.time_s
        return self._bench.time_s


class GuardedGenerator(_Part):
    """See `haselab.rig.FunctionGenerator`."""

    _name = "generator"

    def __init__(self, bench: GuardedBench, plain: FunctionGenerator) -> None:
        self._bench, self._plain = bench, plain

    def sine(self, frequency_hz: float, amplitude_v: float) -> None:
        """Set the sensing signal, which energises the actuator; only while the bench is armed.

        Raises:
            LimitError: Frequency or amplitude is outside the limits; the carrier is unchanged.
        """
        b = self._bench
        frequency_hz = as_number("carrier frequency", frequency_hz)
        amplitude_v = as_number("carrier amplitude", amplitude_v)
        check_carrier(b.rig.description, b.safety.settings, frequency_hz, amplitude_v)
        if not b.safety.live:
            raise b.safety.refusal()
        b.safety.heartbeat(_SETUP_S)
        b.watch.add_carrier(frequency_hz, amplitude_v)
        with self._bench.calling():
            self._plain.sine(frequency_hz, amplitude_v)

    def off(self) -> None:
        """See `haselab.rig.FunctionGenerator`."""
        self._plain.off()


class GuardedSupply(_Part):
    """See `haselab.rig.HighVoltageSupply`."""

    _name = "supply"

    def __init__(self, bench: GuardedBench, plain: HighVoltageSupply) -> None:
        self._bench, self._plain = bench, plain

    def set_voltage(self, voltage_v: float) -> None:
        """Set the supply; other than 0 V only while the bench is armed.

        Raises:
            LimitError: The voltage is outside the limits of the supply, which is unchanged.
        """
        voltage_v = as_number("supply voltage", voltage_v)
        supply_limits(self._bench.rig.description, self._bench.safety.settings).check(voltage_v)
        if voltage_v != 0.0:
            if not self._bench.safety.live:
                raise self._bench.safety.refusal()
            self._bench.safety.heartbeat(_SETUP_S)
        with self._bench.calling():
            self._plain.set_voltage(voltage_v)

    def read_voltage(self) -> float:
        """See `haselab.rig.HighVoltageSupply`."""
        return self._plain.read_voltage()

    def off(self) -> None:
        """See `haselab.rig.HighVoltageSupply`."""
        self._plain.off()


class GuardedController(_Part):
    """See `haselab.rig.BuiltInController`."""

    _name = "controller"
    strain_limits: Limits

    def __init__(self, bench: GuardedBench, plain: BuiltInController) -> None:
        self._bench, self._plain = bench, plain
        vars(self)["strain_limits"] = plain.strain_limits

    def follow(self, strain: float) -> None:
        """Send a desired strain, which energises the actuator; only while the bench is armed."""
        b = self._bench
        if not b.safety.live:
            raise b.safety.refusal()
        b.safety.heartbeat(0.0)
        with b.calling():
            self._plain.follow(strain)

    def measure_capacitance_f(self) -> float:
        """Switch the sensing signal on, which energises the actuator; only while armed."""
        b = self._bench
        if not b.safety.live:
            raise b.safety.refusal()
        b.safety.heartbeat(0.0)
        with b.calling():
            return self._plain.measure_capacitance_f()

    @property
    def output_v(self) -> float:
        """See `haselab.rig.BuiltInController`."""
        return self._plain.output_v


class GuardedStand(_Part):
    """See `haselab.rig.LoadStand`."""

    _name = "stand"

    def __init__(
        self, bench: GuardedBench, plain: LoadStand, acquisition: GuardedAcquisition
    ) -> None:
        self._bench, self._plain, self._acquisition = bench, plain, acquisition

    def hang(self, mass_kg: float) -> None:
        """Switch everything off, then let a person change the mass at the clamp. The drive and
        the generator stay off until they are set again.

        Raises:
            SafetyError: The bench is not confirmed at 0 V, so the person was not asked to touch it.
        """
        self._bench.safety.heartbeat(_SETUP_S)
        self._switch_off()
        self._bench.safety.heartbeat(_MANUAL_S)
        with self._bench.calling():
            self._plain.hang(mass_kg)
        self._bench.passed()

    def _switch_off(self) -> None:
        """Switch drive, generator and supply off, and read back if the rig allows it."""
        b, rig = self._bench, self._bench.rig
        if b.requested_v != 0.0 or b.preloads is not None:  # a queue may hold other values
            rig.source.zero()
            b.requested_v = 0.0
            b.passed()
        rig.generator.off()
        if rig.supply is not None:
            rig.supply.off()
        if not b.safety.settings.read_back:
            return
        limit_v = b.safety.settings.residual_v
        found = [output_state(rig, limit_v), *instrument_states(rig, limit_v)]
        faults = [each.fault for each in found if each is not None and not each.confirmed]
        if fault := next(iter(faults), "") or discharged(rig, limit_v):
            raise b.safety.trip(
                "Do not touch anything. Switch the high voltage off by hand, and short it. 0 V is "
                f"not confirmed before the mass is changed: {fault.rstrip('.')}."
            )

    def lift(self) -> None:
        """See `haselab.rig.LoadStand`: the output keeps its voltage."""
        self._bench.safety.heartbeat(_MANUAL_S)
        with self._bench.calling():
            self._plain.lift()
        self._bench.passed()

    def drop(self) -> None:
        """See `haselab.rig.LoadStand`."""
        self._bench.safety.heartbeat(_MANUAL_S)
        with self._bench.calling():
            self._plain.drop()
        self._bench.moved_s = self._bench.time_s

    def wait(self, duration_s: float) -> None:
        """Wait; on a real-time rig, read and check the blocks meanwhile."""
        b = self._bench
        if b.safety.settings.real_time:
            for _ in range(round(duration_s / b.rig.description.block_s)):
                b.unbroken = False  # nothing is recorded: a late computer may skip blocks
                self._acquisition.read()
            b.deadlines.start()
            return
        b.safety.heartbeat(duration_s)
        with b.calling():
            self._plain.wait(duration_s)
        b.time_s = b.rig.acquisition.time_s
        b.passed()
