"""The instruments behind the safety chain: every value and every block is checked here."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import HaselabError, InputError, Limits
from haselab.rig import (
    Acquisition,
    ClosesLoop,
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
_ASIDE_S = 30.0  # that an instrument on a line of its own may take to be set
_HANDS_S = 3600.0  # a person may take so long to hang a weight


class GuardedBench:
    """What the guarded parts of one rig share."""

    def __init__(self, rig: Rig, safety: Safety, clock: Callable[[], float]) -> None:
        s = safety.settings
        self.rig, self.safety = rig, safety
        self.preloads = rig.source if isinstance(rig.source, PreloadsOutputs) else None
        self.watch = BlockWatch(rig.description, s)
        queued = rig.description.switch_sample // rig.description.block_samples
        deadline_s = (1 + queued) * rig.description.block_s
        self.deadlines = Deadlines(deadline_s, s.missed_limit, s.late_limit, clock)
        self.asked_v = 0.0  # last accepted
        self.standing_v = 0.0  # asked for before the last block
        self.time_s = 0.0
        self.unbroken = False  # the next block has to follow the last one without a gap
        self.found: dict[str, OutputState] = {}  # by instrument, since anything was energised
        self.asked_guardian = False  # since then
        self._requests = -1  # that the gate had let through then
        self.turn = threading.Lock()  # instruments report from threads of their own

    def outdate(self) -> None:
        """What was found at rest is out of date once a request was let through to any driver."""
        requests = self.safety.gate.requests
        if requests != self._requests:
            self._requests = requests
            self.found, self.asked_guardian = {}, False

    @property
    def left_out(self) -> int:
        """Outputs since the bench was opened that came too late and were left out."""
        return 0 if self.preloads is None else self.preloads.missed_outputs

    def check(self, voltage_v: float, before_v: float) -> None:
        """Check one value against the drive limits, then against the limit of its rise."""
        self.rig.description.drive_limits.check(voltage_v)
        towards_zero = min(before_v, 0.0) <= voltage_v <= max(before_v, 0.0)
        if not towards_zero:
            rate = self.safety.settings.rate_limit_v_per_s
            rise = (voltage_v - before_v) / self.rig.description.block_s
            if abs(rise) > rate * _ROUNDING:
                Limits("rise of the drive", -rate, rate, "V/s").check(rise)

    @contextlib.contextmanager
    def calling(self) -> Iterator[None]:
        """A call of a driver: where others have made the bench safe, that is why it fails."""
        try:
            yield
        except InputError:  # refused: nothing was changed
            raise
        except Exception as error:
            if why := self.safety.revoked_by_others:
                raise self.safety.trip(why) from error
            if self.safety.live:
                self.safety.trip(str(error) or type(error).__name__)
            raise

    def answered(self) -> None:
        """The output for the last block is on its way: was it in time?"""
        if self.has_deadlines and (fault := self.deadlines.answered()):
            raise self.safety.trip(fault)

    @property
    def has_deadlines(self) -> bool:
        """The program has to be in time: not where a controller of the rig's own is."""
        return self.safety.settings.real_time and self.rig.controller is None

    def passed(self) -> None:
        """Time has gone by with the present output; blocks may have been passed over."""
        self.unbroken = False
        self.standing_v = self.asked_v
        self.watch.rest(self.asked_v)


class _Part:
    """Base of the guarded instruments: they take the calls of their protocol and nothing else."""

    _name = "instrument"

    def __getattr__(self, name: str) -> Any:
        raise AttributeError(self._unknown(name))

    def __setattr__(self, name: str, value: object) -> None:
        if not name.startswith("_"):
            raise AttributeError(self._unknown(name))
        object.__setattr__(self, name, value)

    def _unknown(self, name: str) -> str:
        return (
            f"The guarded {self._name} takes only the calls of its protocol in haselab.rig, and "
            f"{name!r} is none that can be called or set here. Nothing was changed. Set up your "
            "driver before you guard the rig."
        )


class GuardedSource(_Part):
    """See `haselab.rig.VoltageSource`."""

    _name = "source"

    def __init__(self, bench: GuardedBench, plain: VoltageSource) -> None:
        self._bench, self._plain = bench, plain

    def write(self, voltage_v: float) -> None:
        """Checked here, whoever asks; other than 0 V only while the chain is armed."""
        b = self._bench
        voltage_v = as_number("drive voltage", voltage_v)
        b.check(voltage_v, b.standing_v)
        if voltage_v != 0.0:
            if not b.safety.live:
                raise b.safety.refusal()
            b.safety.sign_of_life(0.0)
        with b.calling():
            self._plain.write(voltage_v)
        b.asked_v = voltage_v
        b.answered()

    def zero(self) -> None:
        """See `haselab.rig.VoltageSource`."""
        try:
            self._plain.zero()
        finally:
            self._bench.asked_v = 0.0
            self._bench.passed()


class GuardedAcquisition(_Part):
    """See `haselab.rig.Acquisition`."""

    _name = "acquisition"

    def __init__(self, bench: GuardedBench, plain: Acquisition) -> None:
        self._bench, self._plain = bench, plain
        self._left_out = bench.left_out

    def read(self) -> NDArray[np.int16]:
        """The next block, looked through."""
        b = self._bench
        b.safety.sign_of_life(b.rig.description.block_s)
        with b.calling():
            before_s = self._plain.time_s
            codes = self._plain.read()
            b.time_s = self._plain.time_s
            follows, b.unbroken = b.unbroken, True
            b.watch.check_form(codes, b.time_s - before_s if follows else None)
        before, self._left_out = self._left_out, b.left_out
        if self._left_out == before:
            b.standing_v = b.asked_v
        own = b.rig.controller is not None  # which watches over itself
        fault = "" if own else b.watch.fault(codes, b.standing_v, follows=follows)
        if fault and b.safety.stage in LIVE:
            raise b.safety.trip(b.safety.revoked_by_others or fault)
        if b.has_deadlines:
            b.deadlines.arrived(b.time_s)
        return codes

    @property
    def time_s(self) -> float:
        """Clock at the end of the last block; the last known one where the device is gone."""
        with contextlib.suppress(HaselabError):
            self._bench.time_s = self._plain.time_s
        return self._bench.time_s


class GuardedGenerator(_Part):
    """See `haselab.rig.FunctionGenerator`."""

    _name = "generator"

    def __init__(self, bench: GuardedBench, plain: FunctionGenerator) -> None:
        self._bench, self._plain = bench, plain

    def sine(self, frequency_hz: float, amplitude_v: float) -> None:
        """Energises the actuator too: only while the chain is armed.

        Raises:
            LimitError: a frequency that the monitors cannot show, or an amplitude above the limit;
                the carrier stays as it was.
        """
        b = self._bench
        frequency_hz = as_number("carrier frequency", frequency_hz)
        amplitude_v = as_number("carrier amplitude", amplitude_v)
        check_carrier(b.rig.description, b.safety.settings, frequency_hz, amplitude_v)
        if not b.safety.live:
            raise b.safety.refusal()
        b.safety.sign_of_life(_ASIDE_S)
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
        """Other than 0 V only while the chain is armed.

        Raises:
            LimitError: outside the limits of the supply; it stays as it was.
        """
        voltage_v = as_number("supply voltage", voltage_v)
        supply_limits(self._bench.rig.description, self._bench.safety.settings).check(voltage_v)
        if voltage_v != 0.0:
            if not self._bench.safety.live:
                raise self._bench.safety.refusal()
            self._bench.safety.sign_of_life(_ASIDE_S)
        with self._bench.calling():
            self._plain.set_voltage(voltage_v)

    def read_voltage(self) -> float:
        """See `haselab.rig.HighVoltageSupply`."""
        return self._plain.read_voltage()

    def off(self) -> None:
        """See `haselab.rig.HighVoltageSupply`."""
        self._plain.off()


class GuardedController(_Part):
    """See `haselab.rig.ClosesLoop`."""

    _name = "controller"
    strain_limits: Limits

    def __init__(self, bench: GuardedBench, plain: ClosesLoop) -> None:
        self._bench, self._plain = bench, plain
        vars(self)["strain_limits"] = plain.strain_limits

    def follow(self, strain: float) -> None:
        """Energises the actuator: only while the chain is armed."""
        b = self._bench
        if not b.safety.live:
            raise b.safety.refusal()
        b.safety.sign_of_life(0.0)
        with b.calling():
            self._plain.follow(strain)

    @property
    def output_v(self) -> float:
        """See `haselab.rig.ClosesLoop`."""
        return self._plain.output_v


class GuardedStand(_Part):
    """See `haselab.rig.LoadStand`."""

    _name = "stand"

    def __init__(
        self, bench: GuardedBench, plain: LoadStand, acquisition: GuardedAcquisition
    ) -> None:
        self._bench, self._plain, self._acquisition = bench, plain, acquisition

    def hang(self, mass_kg: float) -> None:
        """Everything off first: a person comes to the clamp. The drive and the generator
        stay off until they are set again.

        Raises:
            SafetyError: the bench is not confirmed at 0 V; nobody was asked to touch anything.
        """
        self._bench.safety.sign_of_life(_ASIDE_S)
        self._switch_off()
        self._bench.safety.sign_of_life(_HANDS_S)
        with self._bench.calling():
            self._plain.hang(mass_kg)
        self._bench.passed()

    def _switch_off(self) -> None:
        """Drive, generator and supply off, and read back where the rig can be."""
        b, rig = self._bench, self._bench.rig
        if b.asked_v != 0.0 or b.preloads is not None:  # a queue may hold other values
            rig.source.zero()
            b.asked_v = 0.0
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
                f"Not confirmed at 0 V before the weight is moved: {fault.rstrip('.')}. Do not "
                "touch anything. Switch the high voltage off by hand, and short it."
            )

    def lift(self) -> None:
        """See `haselab.rig.LoadStand`: the output keeps its voltage."""
        self._bench.safety.sign_of_life(_HANDS_S)
        with self._bench.calling():
            self._plain.lift()
        self._bench.passed()

    def drop(self) -> None:
        """See `haselab.rig.LoadStand`."""
        self._bench.safety.sign_of_life(_HANDS_S)
        with self._bench.calling():
            self._plain.drop()

    def wait(self, duration_s: float) -> None:
        """On a rig of the wall clock the blocks are read and looked through meanwhile."""
        b = self._bench
        if b.safety.settings.real_time:
            for _ in range(round(duration_s / b.rig.description.block_s)):
                b.unbroken = False  # nothing is recorded: a late computer may pass over blocks
                self._acquisition.read()
            b.deadlines.start()
            return
        b.safety.sign_of_life(duration_s)
        with b.calling():
            self._plain.wait(duration_s)
        b.passed()
