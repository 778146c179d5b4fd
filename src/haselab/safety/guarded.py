"""A rig behind its safety chain: every value and every block is checked here."""

from __future__ import annotations

import contextlib
import dataclasses
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, HaselabError, InputError, Limits
from haselab.rig import (
    Acquisition,
    ClosesLoop,
    Foresees,
    FunctionGenerator,
    HighVoltageSupply,
    LoadStand,
    Rig,
    VoltageSource,
)
from haselab.safety.arming_text import arming_limits
from haselab.safety.block_checks import BlockWatch
from haselab.safety.deadlines import Deadlines
from haselab.safety.gate import Gate
from haselab.safety.instrument_state import (
    Rest,
    discharged,
    lines_at_rest,
    output_at_rest,
)
from haselab.safety.request_limits import as_number, check_carrier, supply_limits
from haselab.safety.shutdown import Shutdown
from haselab.safety.state_machine import LIVE, Safety, SafetySettings

__all__ = ["GuardedRig", "guard"]

_ROUNDING = 1.0 + 1e-9  # of a difference of two outputs
_ASIDE_S = 30.0  # that an instrument on a line of its own may take to be set
_HANDS_S = 3600.0  # a person may take so long to hang a weight


class _Bench:
    """What the guarded parts of one rig share."""

    def __init__(self, rig: Rig, safety: Safety, clock: Callable[[], float]) -> None:
        s = safety.settings
        self.rig, self.safety = rig, safety
        self.foresees = rig.source if isinstance(rig.source, Foresees) else None
        self.watch = BlockWatch(rig.description, s)
        queued = rig.description.switch_sample // rig.description.block_samples
        deadline_s = (1 + queued) * rig.description.block_s
        self.deadlines = Deadlines(deadline_s, s.missed_limit, s.late_limit, clock)
        self.asked_v = 0.0  # last accepted
        self.standing_v = 0.0  # asked for before the last block
        self.time_s = 0.0
        self.unbroken = False  # the next block has to follow the last one without a gap
        self.found: dict[str, Rest] = {}  # by instrument, since anything was energised
        self.asked_guardian = False  # since then
        self._requests = -1  # that the gate had let through then
        self.turn = threading.Lock()  # instruments tell of their rest from threads of their own

    def outdate(self) -> None:
        """What was found at rest is out of date once a request was let through to any driver."""
        requests = self.safety.gate.requests
        if requests != self._requests:
            self._requests = requests
            self.found, self.asked_guardian = {}, False

    @property
    def left_out(self) -> int:
        """Outputs since the bench was opened that came too late and were left out."""
        return 0 if self.foresees is None else self.foresees.missed_outputs

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


class _Source(_Part):
    """See `haselab.rig.VoltageSource`."""

    _name = "source"

    def __init__(self, bench: _Bench, plain: VoltageSource) -> None:
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


class _Acquisition(_Part):
    """See `haselab.rig.Acquisition`."""

    _name = "acquisition"

    def __init__(self, bench: _Bench, plain: Acquisition) -> None:
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


class _Generator(_Part):
    """See `haselab.rig.FunctionGenerator`."""

    _name = "generator"

    def __init__(self, bench: _Bench, plain: FunctionGenerator) -> None:
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


class _Supply(_Part):
    """See `haselab.rig.HighVoltageSupply`."""

    _name = "supply"

    def __init__(self, bench: _Bench, plain: HighVoltageSupply) -> None:
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


class _Controller(_Part):
    """See `haselab.rig.ClosesLoop`."""

    _name = "controller"
    strain_limits: Limits

    def __init__(self, bench: _Bench, plain: ClosesLoop) -> None:
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


class _Stand(_Part):
    """See `haselab.rig.LoadStand`."""

    _name = "stand"

    def __init__(self, bench: _Bench, plain: LoadStand, acquisition: _Acquisition) -> None:
        self._bench, self._plain, self._acquisition = bench, plain, acquisition

    def hang(self, mass_kg: float) -> None:
        """Everything off first: a person's hands come to the clamp. The drive and the generator
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
        if b.asked_v != 0.0 or b.foresees is not None:  # a queue may hold other values
            rig.source.zero()
            b.asked_v = 0.0
            b.passed()
        rig.generator.off()
        if rig.supply is not None:
            rig.supply.off()
        if not b.safety.settings.read_back:
            return
        limit_v = b.safety.settings.residual_v
        found = [output_at_rest(rig, limit_v), *lines_at_rest(rig, limit_v)]
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


@dataclasses.dataclass
class GuardedRig(Rig):
    """A rig whose parts answer to a safety chain.

    Args:
        plain: the rig behind it.
        bench: what its guarded parts share.
    """

    plain: Rig = dataclasses.field(kw_only=True)
    bench: _Bench = dataclasses.field(kw_only=True)

    @property
    def safety(self) -> Safety:
        """The chain."""
        return self.bench.safety

    @property
    def deadlines(self) -> Deadlines:
        """Of the present experiment."""
        return self.bench.deadlines

    def begin(self) -> None:
        """An experiment begins: its blocks follow one another, its ticks are counted.

        Raises:
            DeviceError: an instrument that no block tells of, generator or supply, is gone.
        """
        for found in lines_at_rest(self.plain, self.safety.settings.residual_v):
            if found.silent:
                with self.bench.calling():
                    raise DeviceError(f"A link is lost: {found.silent}")
        self.bench.passed()
        self.deadlines.start()

    def check_drive(self, drive_v: NDArray[np.float64]) -> None:
        """Refuse a whole drive before its first value goes out.

        Args:
            drive_v: one value a block, in V.
        Raises:
            LimitError: a value outside the limits, or a rise above the rate.
        """
        self.description.drive_limits.check(drive_v)
        before_v = self.bench.standing_v
        if np.isfinite(self.safety.settings.rate_limit_v_per_s):
            for value in drive_v:
                self.bench.check(float(value), before_v)
                before_v = float(value)

    def foresee(self, drive_v: NDArray[np.float64]) -> None:
        """Tell a source that can wait of the coming outputs: a late computer is then no fault.

        Args:
            drive_v: one value a block, in V.
        Raises:
            LimitError: see `check_drive`.
            SafetyError: not armed, and not all of it is 0 V.
        """
        source = self.bench.foresees
        if source is None:
            return
        self.check_drive(drive_v)
        if np.any(drive_v) and not self.safety.live:
            raise self.safety.refusal()
        self.deadlines.start(source.foresee(drive_v) * self.description.block_s)

    @property
    def missed_outputs(self) -> int:
        """Outputs since the bench was opened that came too late and were left out."""
        return self.bench.left_out

    @property
    def standing_v(self) -> float:
        """The output of the last block: what was asked for, or what stood where that was late."""
        return self.bench.standing_v if self.controller is None else self.controller.output_v

    def check_at_rest(self) -> None:
        """Before anything is energised: the link works, and the monitor shows 0 V.

        Raises:
            DeviceError: no block, or none of this rig.
            SafetyError: there is an output already.
        """
        if not self.safety.settings.read_back:
            return
        codes = self.acquisition.read()
        left_v = self.bench.watch.residual_v(codes) if self.controller is None else self._told_v()
        if not left_v < self.safety.settings.residual_v:
            raise self.safety.trip(
                f"Output of {left_v:.4g} V before anything was requested (limit "
                f"{self.safety.settings.residual_v:g} V). Check amplifier and monitor cables."
            )

    def _told_v(self) -> float:
        """The output by the source's own meter, in V: the monitors of a chip show no level."""
        found = output_at_rest(self.plain, self.safety.settings.residual_v)
        if found is None or found.silent:
            raise DeviceError(f"The output cannot be read: {found.silent if found else 'no meter'}")
        return abs(found.voltage_v)

    def safe(self) -> None:
        """0 V, no sensing signal, camera off, and 0 V read back.

        Raises:
            SafetyError: the output is not at 0 V, or not known to be. The bench is tripped: switch
                the high voltage off by hand.
        """
        try:
            self.command_zero()
        finally:
            self.read_back()

    def command_zero(self) -> None:
        """The first half of `safe`: everything is taken to rest, the rest is not judged."""
        Shutdown(self).run()

    def confirm_zero(self) -> None:
        """`read_back`, unless it was done since anything was energised.

        Raises:
            SafetyError: see `read_back`.
        """
        self.bench.outdate()
        if "output" not in self.bench.found:
            self.read_back()

    def read_back(self) -> str:
        """Whether the bench is at 0 V; see `Shutdown.read_back`.

        Returns:
            What was read back, for the record.
        Raises:
            SafetyError: the output is not at 0 V, or not known to be.
        """
        return Shutdown(self).read_back()


def guard(
    rig: Rig,
    safety: Safety | None = None,
    *,
    clock: Callable[[], float] = time.monotonic,
) -> GuardedRig:
    """Put a safety chain in front of a rig.

    Args:
        rig: the bench. Its drivers are put behind a gate where they are not yet, in `rig` itself:
            from here on nothing energises it without a permission.
        safety: its chain; None makes one with the default limits.
        clock: monotonic, in s.
    Returns:
        The same bench, guarded: nothing is put out until the chain is armed.
    Raises:
        InputError: a driver without the methods that take it to 0 V.
    Example:
        >>> from haselab.rig.twin.bench import make_twin
        >>> from haselab.rig.twin.config import twin_of_reading
        >>> rig = guard(make_twin(twin_of_reading("hz"), 1))
        >>> rig.safety.arm(rig.safety.request())
        >>> rig.source.write(0.5)
        >>> rig.safe()
        >>> rig.safety.end_run()
    """
    chain = safety if safety is not None else Safety(SafetySettings())
    gate = _put_gate(rig)
    bench = _Bench(rig, chain, clock)
    given = {field.name: getattr(rig, field.name) for field in dataclasses.fields(Rig)}
    acquisition = _Acquisition(bench, rig.acquisition)
    given |= {
        "source": _Source(bench, rig.source),
        "acquisition": acquisition,
        "generator": _Generator(bench, rig.generator),
        "stand": _Stand(bench, rig.stand, acquisition),
        "supply": None if rig.supply is None else _Supply(bench, rig.supply),
        "controller": None if rig.controller is None else _Controller(bench, rig.controller),
    }
    guarded = GuardedRig(**given, plain=rig, bench=bench)
    s = chain.settings
    own = rig.controller is not None
    limits = arming_limits(
        rig.description, s.current_limit_a, s.rate_limit_v_per_s, own_controller=own
    )
    if s.rating is None and s.real_time and not own:
        limits += " The field is not checked against ratings: add [rating] to the rig file."
    chain.attach(gate, guarded.command_zero, limits, guarded.confirm_zero)
    return guarded


def _put_gate(rig: Rig) -> Gate:
    """The gate of a rig, with all drivers behind it.

    Raises:
        InputError: a driver that cannot be taken to 0 V.
    """
    for name, driver, needed in (
        ("source", rig.source, ("write", "zero")),
        ("generator", rig.generator, ("sine", "off")),
        ("supply", rig.supply, ("set_voltage", "read_voltage", "off")),
    ):
        missing = [method for method in needed if not callable(getattr(driver, method, None))]
        if driver is not None and missing:
            raise InputError(
                f"The {name} has no method {missing[0]!r}, so it cannot be made safe. Give your "
                f"driver every method of its protocol in haselab.rig."
            )
    gate = rig.gate
    opened_behind = Gate.has_wrapped(rig.source)  # then camera and stand hold its gated drivers
    if not isinstance(gate, Gate):
        gate = rig.gate = Gate()
    rig.source = gate.instrument(rig.source)
    rig.acquisition = gate.instrument(rig.acquisition)
    rig.generator = gate.instrument(rig.generator)
    if rig.supply is not None:
        rig.supply = gate.instrument(rig.supply)
    if rig.controller is not None:
        rig.controller = gate.instrument(rig.controller)
    if not opened_behind:
        rig.camera = gate.companion(rig.camera)
        rig.stand = gate.companion(rig.stand)
    return gate
