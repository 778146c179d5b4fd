"""A chip as a rig: it closes the loop, reports every update in full, and watches over itself."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, InputError, LimitError, Limits, SafetyError
from haselab.firmware import CARRIER_HZ, OUTPUT_V_PER_CODE, RATE_HZ, ChipSettings, settings_crc
from haselab.firmware.messages import (
    VERSION,
    Ack,
    ClearFault,
    Fault,
    KeepAlive,
    Run,
    SetReference,
    SetTelemetry,
    State,
    Status,
    Stop,
    Trace,
    Verdict,
)
from haselab.rig import RigDescription
from haselab.rig.chip.link import ChipLink
from haselab.rig.chip.supply_check import check_supply
from haselab.rig.drivers import quietly

__all__ = ["ChipBench", "describe_chip"]

_UPDATES = 10  # of the chip in a block
_READINGS = 4  # of each channel in an update
_ALIVE_BLOCKS = 5  # between two signs of life: 50 ms of the 150 ms after which the chip stops
_SILENT_S = 0.25  # without an update: the chip is gone
_ARMED_S = 0.5  # until a strain is valid
_RUN_S = 0.02  # from the command until its update is reported
_DOWN_S = 1.0  # for the ramp to 0 V
_SETTLED = 4  # updates until the level follows an output: two were measured on the simulated chip
_LIVE = (State.ARMED, State.RUNNING, State.STOPPING)


def describe_chip(
    settings: ChipSettings,
    *,
    name: str = "chip",
    shell_area_m2: float,
    lateral_stretch: float,
    scale_m_per_px: float,
    mass_kg: float,
) -> RigDescription:
    """What a user of the chip's bench knows about it.

    A block is ten updates of four readings a channel. The first of each four of the voltage is the
    level without a filter; the others are the carrier behind the band-pass stage.

    Args:
        settings: that are compiled in.
        name: of the rig.
        shell_area_m2: cross-section of the unstretched shell.
        lateral_stretch: fixed by the clamps.
        scale_m_per_px: of the camera.
        mass_kg: that hangs on the lower clamp.
    """
    front = settings.front_end
    return RigDescription(
        name=name,
        rate_hz=float(RATE_HZ * _READINGS),
        block_samples=_UPDATES * _READINGS,
        switch_sample=_READINGS,
        skew_s=front.skew_s,
        volt_per_code=front.volt_per_code,
        amplifier_gain=front.gain,
        v_monitor_v_per_v=front.v_stage_at_carrier / front.volt_per_monitor_volt,
        i_monitor_v_per_a=front.i_stage_at_carrier / front.ampere_per_monitor_volt,
        drive_limits=Limits("drive voltage", 0.0, settings.drive_high_v, "V"),
        shell_area_m2=shell_area_m2,
        lateral_stretch=lateral_stretch,
        scale_m_per_px=scale_m_per_px,
        mass_kg=mass_kg,
        amplifier="module of the chip",
    )


class ChipBench:
    """One chip: fulfils `Acquisition`, `VoltageSource`, `FunctionGenerator` and `ClosesLoop`.

    Its blocks are what its updates latched, from `Trace`. It is off after opening. Where nobody
    reads for longer than its patience it ramps its output down and trips: the chip is its own
    guardian.

    Args:
        link: to the chip.
        settings: that its firmware has to hold.
        bandgap_v: of this chip's reference, as measured, in V; None: as its data sheet allows.
    Raises:
        InputError: a chip with another firmware.
        DeviceError: no answer, or a supply on which its readings cannot be trusted.
    """

    def __init__(
        self, link: ChipLink, settings: ChipSettings, bandgap_v: float | None = None
    ) -> None:
        self._link, self._settings = link, settings
        self._traces: deque[Trace] = deque()
        self._last: Trace | None = None
        self._count = 0  # of updates since opening, those that were lost on the way too
        self.origin = 0  # updates of the chip before its clock here showed 0
        self._time_s = 0.0
        self._told_v = 0.0
        self._alive = 0  # blocks since the last sign of life
        self._refused: Ack | None = None
        self._reset: Status | None = None
        self._status: Status | None = None
        self._asks = False  # for a status
        self._desired = math.nan
        identity = link.greet()
        wanted = settings_crc(settings)
        if (identity.version, identity.settings) != (VERSION, wanted):
            raise InputError(
                f"The chip holds settings {identity.settings:08x} of protocol {identity.version}, "
                f"needed are {wanted:08x} of {VERSION}. Build with 'haselab firmware build RUN "
                "--rig' and this rig file, and flash again."
            )
        supply = check_supply(identity.supply, settings.front_end.converter_v, bandgap_v)
        self.identity = (
            f"settings {identity.settings:08x}, {identity.rate_hz} updates a second{supply}"
        )
        link.tell(SetTelemetry(0, 1))
        link.messages.clear()
        self.strain_limits = Limits("desired strain", settings.strain_low, settings.strain_high, "")
        self._pass(2.0 / RATE_HZ)

    # ---- updates -----------------------------------------------------------------------------

    def _pass(self, duration_s: float) -> None:
        """Let time pass and take in what comes."""
        self._link.run(duration_s)
        self._take_in()

    def _take_in(self) -> None:
        messages, self._link.messages = self._link.messages, []
        for message in messages:
            if isinstance(message, Trace):
                self._append(message)
            elif isinstance(message, Status) and self._asks:
                self._status = message
            elif isinstance(message, Status):
                self._reset = message  # its traces have ended, and it does not know us any more
            elif isinstance(message, Ack) and message.verdict != Verdict.ACCEPTED:
                self._refused = message

    def _check_refused(self) -> None:
        """A refused command; where the chip has tripped, that is why."""
        refused, self._refused = self._refused, None
        if refused is not None and self._follows:
            self._wait(lambda: self._state in (State.TRIPPED, State.STOPPING), 4.0 / RATE_HZ)
            if self._state in (State.TRIPPED, State.STOPPING):
                raise self._tripped()
            verdict = Verdict(refused.verdict).name.lower()
            raise DeviceError(
                f"The chip answered command {refused.command} by {verdict}, needed is accepted. "
                "Look at its state; arm again."
            )

    def _append(self, trace: Trace) -> None:
        if self._last is None:
            self.origin = trace.update - 1
            steps = 1
        else:
            steps = (trace.update - self._last.update) & 0xFFFF
        if steps != 1:
            self._traces.clear()  # the block that they belong to has a hole
        self._count += steps
        self._last = trace
        self._traces.append(trace)

    @property
    def _state(self) -> State:
        return State.OFF if self._last is None else State(self._last.state)

    @property
    def _follows(self) -> bool:
        """It was asked for a strain and not stopped since: off or tripped comes as a surprise."""
        return not math.isnan(self._desired)

    def _wait(self, done: Callable[[], bool], within_s: float) -> bool:
        """Let time pass, update by update, until something has come in."""
        for _ in range(round(within_s * RATE_HZ)):
            if done():
                return True
            self._pass(1.0 / RATE_HZ)
        return done()

    @property
    def _patience_s(self) -> float:
        """For what the chip sends every millisecond: a port may deliver its bytes in parts."""
        return max(self._link.patience_s, 10.0 / RATE_HZ)

    # ---- Acquisition -------------------------------------------------------------------------

    def read(self) -> NDArray[np.int16]:
        """See `haselab.rig.Acquisition`."""
        if self._state in _LIVE and self._alive >= _ALIVE_BLOCKS:
            self._link.send(KeepAlive())
            self._alive = 0
        self._alive += 1
        waited = 0
        while len(self._traces) < _UPDATES:
            before, missing = self._count, _UPDATES - len(self._traces)
            self._pass(missing / RATE_HZ)
            self._check_refused()
            if self._reset is not None and self._follows:
                raise self._tripped()
            waited = 0 if self._count > before else waited + missing
            if waited > _SILENT_S * RATE_HZ:
                raise DeviceError(
                    f"No update received from the chip for {_SILENT_S:g} s. Check cable "
                    "and power; it ramps its output down by itself."
                )
        block = [self._traces.popleft() for _ in range(_UPDATES)]
        self._time_s = (self._count - len(self._traces)) / RATE_HZ
        self._told_v = block[-1].code * OUTPUT_V_PER_CODE
        if self._follows and any(trace.state == State.TRIPPED for trace in block):
            raise self._tripped()
        codes = np.array([trace.codes for trace in block], dtype=np.int16)
        return codes.reshape(_UPDATES * _READINGS, 2)

    def _tripped(self) -> SafetyError:
        fault = self._fault() if self._reset is None else Fault(self._reset.fault)
        self._desired = math.nan
        why = fault.name.lower() if fault else "it does not say why"
        if self._reset is not None and not fault:
            why = "it was reset, the cause is not known"
        return SafetyError(
            f"The chip tripped: {why}. Its output is off, or on its way down. Look at wires, "
            "actuator and link before arming again."
        )

    def _fault(self) -> Fault | None:
        """Why it tripped, asked for by status instead of traces."""
        self._asks, self._status = True, None
        try:
            self._link.tell(SetTelemetry(1, 0))
            self._wait(lambda: self._status is not None, self._patience_s)
            self._link.tell(SetTelemetry(0, 1))
            self._take_in()
        finally:
            self._asks = False
        self._traces.clear()
        return None if self._status is None else Fault(self._status.fault)

    @property
    def time_s(self) -> float:
        """See `haselab.rig.Acquisition`: by the chip's updates."""
        return self._time_s

    # ---- VoltageSource -----------------------------------------------------------------------

    def write(self, voltage_v: float) -> None:
        """0 V alone: the chip finds its output itself.

        Raises:
            LimitError: any other voltage.
        """
        Limits("drive voltage", 0.0, self._settings.drive_high_v, "V").check(voltage_v)
        if voltage_v != 0.0:
            raise LimitError(
                f"Drive of {voltage_v:g} V; a chip that closes its own loop takes 0 V alone. Ask "
                "it for a strain, or use a rig without a controller."
            )
        self.zero()

    def zero(self) -> None:
        """See `haselab.rig.VoltageSource`: the chip ramps down, in half a second at most."""
        quietly(self._stop)

    def _stop(self) -> None:
        self._desired = math.nan
        self._link.send(Stop())  # first of all; where it is off already nothing happens
        self._pass(2.0 / RATE_HZ)
        down_s = max(_DOWN_S, self._patience_s)
        self._wait(lambda: self._state not in _LIVE or self._reset is not None, down_s)
        self._traces.clear()  # of the way down: they belong to no block
        self._refused = None

    def read_back(self) -> float:
        """See `haselab.rig.ReportsOutput`: the level of the voltage monitor."""
        if self._reset is not None:  # it has forgotten its client
            self._link.greet()
            self._link.tell(SetTelemetry(0, 1))
        settled = self._count + _SETTLED
        if not self._wait(lambda: self._count >= settled, self._patience_s) or self._last is None:
            raise DeviceError("No update received from the chip. Check cable and power.")
        front = self._settings.front_end
        level_v = self._last.codes[0] * front.volt_per_code
        return level_v * front.volt_per_monitor_volt / front.gain

    # ---- FunctionGenerator -------------------------------------------------------------------

    def sine(self, frequency_hz: float, amplitude_v: float) -> None:
        """The chip's carrier comes with arming and goes with it: nothing is changed here.

        Raises:
            LimitError: another frequency than the chip's.
        """
        del amplitude_v
        Limits("carrier of the chip", CARRIER_HZ, CARRIER_HZ, "Hz").check(frequency_hz)

    def off(self) -> None:
        """See `haselab.rig.FunctionGenerator`."""
        self.zero()

    # ---- ClosesLoop --------------------------------------------------------------------------

    def follow(self, strain: float) -> None:
        """See `haselab.rig.ClosesLoop`: arms the chip where it is off."""
        self.strain_limits.check(strain)
        if self._state not in (State.ARMED, State.RUNNING):
            if self._follows:
                raise self._tripped()
            self._arm()
        if self._state == State.ARMED:
            self._run(strain)
        elif self._state != State.RUNNING:
            raise self._tripped()
        elif strain != self._desired:
            self._link.send(SetReference(strain))
            self._alive = 0
        self._desired = strain

    def _run(self, strain: float) -> None:
        """Close the loop, as soon as there is a valid strain."""
        end = self._count + round(_ARMED_S * RATE_HZ)
        while self._count < end:
            answer = self._link.ask(Run(strain))
            verdict = None if answer is None else answer.verdict
            if verdict not in (None, Verdict.ACCEPTED, Verdict.NOT_READY):
                break
            if self._wait(lambda: self._state == State.RUNNING, _RUN_S):
                self._refused = None  # that it was not ready before is no fault
                return
        if self._state == State.TRIPPED:
            raise self._tripped()
        raise DeviceError(
            f"The chip did not close its loop within {_ARMED_S:g} s of arming, needed is a valid "
            "strain. Check the monitors' wires, the carrier and the actuator."
        )

    def _arm(self) -> None:
        """Two frames, and the time until a strain is valid. A trip of before is cleared: whoever
        asks for a strain has armed the bench since. A chip that was reset is not: open it again.
        """
        if self._reset is not None:
            raise self._tripped()
        if self._state == State.STOPPING:
            self._wait(lambda: self._state != State.STOPPING, _DOWN_S)
        if self._state == State.TRIPPED:
            self._link.tell(ClearFault())
            self._pass(2.0 / RATE_HZ)
            self._traces.clear()  # they describe the trip
        self._link.arm_in_two_steps()
        self._alive = 0
        self._pass(self._settings.settle_s + _UPDATES / RATE_HZ)

    @property
    def output_v(self) -> float:
        """See `haselab.rig.ClosesLoop`."""
        return self._told_v

    # ---- the stand's clock -------------------------------------------------------------------

    def pause(self) -> None:
        """WeightHandler are at work for as long as they take: the output goes to 0 V."""
        self.zero()

    def catch_up(self) -> None:
        """What came meanwhile belongs to no block."""
        self._pass(1.0 / RATE_HZ)
        self._traces.clear()

    def pass_time(self, duration_s: float) -> None:
        """Blocks that nobody keeps."""
        for _ in range(round(duration_s * RATE_HZ / _UPDATES)):
            self.read()

    def close(self) -> None:
        """0 V, and the link ends. Never raises."""
        self.zero()
        quietly(self._link.close)
