"""A microcontroller as a rig: it closes the loop, reports every update, and protects itself."""

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
    Result,
    Run,
    SetReference,
    SetTelemetry,
    State,
    Status,
    Stop,
    Trace,
)
from haselab.rig import RigDescription
from haselab.rig.chip.link import ChipLink
from haselab.rig.chip.supply_check import check_supply
from haselab.rig.drivers import quietly

__all__ = ["ChipBench", "describe_chip"]

_UPDATES = 10  # of the microcontroller in a block
_READINGS = 4  # of each channel in an update
_ALIVE_BLOCKS = 5  # between two keep-alives: 50 ms of the 150 ms after which it stops
_SILENT_S = 0.25  # longest time without an update
_ARMED_S = 0.5  # longest time until a strain is valid
_RUN_S = 0.02  # from the command until its update is reported
_DOWN_S = 1.0  # for the ramp to 0 V
_STATUSES, _STATUS_UPDATES = 10, 5  # for a capacitance: how many, and updates between two
_SETTLED = 4  # updates until the level follows an output: two were measured in simulation
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
    """Nominal values of a microcontroller's bench.

    A block is ten updates of four readings per channel. The first of each four voltage readings is
    the unfiltered level; the others are the carrier after the band-pass stage.

    Args:
        settings: settings compiled into the firmware.
        name: of the rig.
        shell_area_m2: cross-section of the unstretched shell.
        lateral_stretch: fixed by the clamps.
        scale_m_per_px: of the camera.
        mass_kg: mass hung on the lower clamp.
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
        amplifier="module of the microcontroller",
    )


class ChipBench:
    """A microcontroller as acquisition, voltage source, function generator and built-in controller.

    Its blocks are the readings of its updates, from `Trace`. It is off after opening. If its link
    is silent for too long, it ramps its output down and trips: it is its own guardian.

    Args:
        link: to the microcontroller.
        settings: settings that its firmware must have.
        bandgap_v: measured voltage of its reference, in V; None: range of its data sheet.
    Raises:
        InputError: The microcontroller has other firmware.
        DeviceError: It does not reply, or its supply voltage makes its readings wrong.
    """

    def __init__(
        self, link: ChipLink, settings: ChipSettings, bandgap_v: float | None = None
    ) -> None:
        self._link, self._settings = link, settings
        self._traces: deque[Trace] = deque()
        self._last: Trace | None = None
        self._count = 0  # of updates since opening, including lost ones
        self.origin = 0  # updates of the microcontroller before its clock here was 0
        self._time_s = 0.0
        self._drive_v = 0.0
        self._alive = 0  # blocks since the last keep-alive
        self._refused: Ack | None = None
        self._reset: Status | None = None
        self._status: Status | None = None
        self._wants_status = False
        self._desired = math.nan
        identity = link.hello()
        wanted = settings_crc(settings)
        if (identity.version, identity.settings) != (VERSION, wanted):
            raise InputError(
                f"The microcontroller has settings {identity.settings:08x} of protocol "
                f"{identity.version}, but this rig file needs {wanted:08x} of protocol {VERSION}. "
                "Build with 'haselab firmware build RUN --rig' and this rig file, and flash again."
            )
        supply = check_supply(identity.supply, settings.front_end.converter_v, bandgap_v)
        self.identity = (
            f"settings {identity.settings:08x}, {identity.rate_hz} updates per second{supply}"
        )
        link.execute(SetTelemetry(0, 1))
        link.messages.clear()
        self.strain_limits = Limits("desired strain", *settings.reference_limits, "")
        self._pass(2.0 / RATE_HZ)

    # ---- updates -----------------------------------------------------------------------------

    def _pass(self, duration_s: float) -> None:
        """Let time pass and process what arrives."""
        self._link.run(duration_s)
        self._receive()

    def _receive(self) -> None:
        messages, self._link.messages = self._link.messages, []
        for message in messages:
            if isinstance(message, Trace):
                self._append(message)
            elif isinstance(message, Status) and self._wants_status:
                self._status = message
            elif isinstance(message, Status):
                self._reset = message  # it sends no more traces, and has forgotten this program
            elif isinstance(message, Ack) and message.result != Result.ACCEPTED:
                self._refused = message

    def _check_refused(self) -> None:
        """Raise if a command was refused; if the microcontroller has tripped, that is why."""
        refused, self._refused = self._refused, None
        if refused is not None and self._follows:
            self._wait(lambda: self._state in (State.TRIPPED, State.STOPPING), 4.0 / RATE_HZ)
            if self._state in (State.TRIPPED, State.STOPPING):
                raise self._tripped()
            result = Result(refused.result).name.lower()
            raise DeviceError(
                f"The microcontroller refused command {refused.command}: {result}. Check its "
                "state, then arm again."
            )

    def _append(self, trace: Trace) -> None:
        if self._last is None:
            self.origin = trace.update - 1
            steps = 1
        else:
            steps = (trace.update - self._last.update) & 0xFFFF
        if steps != 1:
            self._traces.clear()  # their block has a gap
        self._count += steps
        self._last = trace
        self._traces.append(trace)

    @property
    def _state(self) -> State:
        return State.OFF if self._last is None else State(self._last.state)

    @property
    def _follows(self) -> bool:
        """Whether it was sent a strain and not stopped since, so that it must not be off."""
        return not math.isnan(self._desired)

    def _wait(self, done: Callable[[], bool], within_s: float) -> bool:
        """Let time pass, update by update, until a condition is met."""
        for _ in range(round(within_s * RATE_HZ)):
            if done():
                return True
            self._pass(1.0 / RATE_HZ)
        return done()

    @property
    def _patience_s(self) -> float:
        """Longest wait for what is sent every millisecond; a port may deliver bytes in parts."""
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
                    f"No update received from the microcontroller for {_SILENT_S:g} s. It ramps "
                    "its output down by itself. Check its cable and its power."
                )
        block = [self._traces.popleft() for _ in range(_UPDATES)]
        self._time_s = (self._count - len(self._traces)) / RATE_HZ
        self._drive_v = block[-1].code * OUTPUT_V_PER_CODE
        if self._follows and any(trace.state == State.TRIPPED for trace in block):
            raise self._tripped()
        codes = np.array([trace.codes for trace in block], dtype=np.int16)
        return codes.reshape(_UPDATES * _READINGS, 2)

    def _tripped(self) -> SafetyError:
        fault = self._fault() if self._reset is None else Fault(self._reset.fault)
        self._desired = math.nan
        why = fault.name.lower() if fault else "no reason reported"
        if self._reset is not None and not fault:
            why = "it was reset for an unknown reason"
        return SafetyError(
            f"The microcontroller tripped: {why}. Its output is off or ramping down. Check the "
            "wires, the actuator and the link before you arm again."
        )

    def _fault(self) -> Fault | None:
        """Why it tripped, from a status message."""
        self._wants_status, self._status = True, None
        try:
            self._link.execute(SetTelemetry(1, 0))
            self._wait(lambda: self._status is not None, self._patience_s)
            self._link.execute(SetTelemetry(0, 1))
            self._receive()
        finally:
            self._wants_status = False
        self._traces.clear()
        return None if self._status is None else Fault(self._status.fault)

    @property
    def time_s(self) -> float:
        """See `haselab.rig.Acquisition`; counts updates."""
        return self._time_s

    # ---- VoltageSource -----------------------------------------------------------------------

    def write(self, voltage_v: float) -> None:
        """Accept only 0 V, because the microcontroller computes its output itself.

        Raises:
            LimitError: The voltage is not 0 V.
        """
        Limits("drive voltage", 0.0, self._settings.drive_high_v, "V").check(voltage_v)
        if voltage_v != 0.0:
            raise LimitError(
                f"The drive is {voltage_v:g} V, but a microcontroller that closes its own loop "
                "accepts only 0 V. Request a strain, or use a rig without a built-in controller."
            )
        self.zero()

    def zero(self) -> None:
        """See `haselab.rig.VoltageSource`; ramps down in at most half a second."""
        quietly(self._stop)

    def _stop(self) -> None:
        self._desired = math.nan
        self._link.send(Stop())  # first; it has no effect if the output is off already
        self._pass(2.0 / RATE_HZ)
        down_s = max(_DOWN_S, self._patience_s)
        self._wait(lambda: self._state not in _LIVE or self._reset is not None, down_s)
        self._traces.clear()  # those of the ramp belong to no block
        self._refused = None

    def read_back(self) -> float:
        """See `haselab.rig.ReportsOutput`; reads the level of the voltage monitor."""
        if self._reset is not None:  # it has forgotten this program
            self._link.hello()
            self._link.execute(SetTelemetry(0, 1))
        settled = self._count + _SETTLED
        if not self._wait(lambda: self._count >= settled, self._patience_s) or self._last is None:
            raise DeviceError(
                "No update received from the microcontroller. Check its cable and its power."
            )
        front = self._settings.front_end
        level_v = self._last.codes[0] * front.volt_per_code
        return level_v * front.volt_per_monitor_volt / front.gain

    # ---- FunctionGenerator -------------------------------------------------------------------

    def sine(self, frequency_hz: float, amplitude_v: float) -> None:
        """Check the frequency only: the firmware switches its carrier with arming.

        Raises:
            LimitError: The frequency is not that of the firmware.
        """
        del amplitude_v
        Limits("carrier of the microcontroller", CARRIER_HZ, CARRIER_HZ, "Hz").check(frequency_hz)

    def off(self) -> None:
        """See `haselab.rig.FunctionGenerator`."""
        self.zero()

    # ---- BuiltInController -----------------------------------------------------------------------

    def follow(self, strain: float) -> None:
        """See `haselab.rig.BuiltInController`; arms the microcontroller if it is off."""
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

    def measure_capacitance_f(self) -> float:
        """See `haselab.rig.BuiltInController`; the mean of some status messages."""
        if self._follows:
            raise DeviceError(
                "The microcontroller has closed its loop, but a capacitance is measured at a drive "
                "of 0 V. Go to 0 V first."
            )
        if self._state != State.ARMED:
            self._arm()
        found = [status.capacitance_f for status in self._armed_status()]
        if min(found) <= 0.0:
            raise DeviceError(
                f"The microcontroller measured no capacitance in {found.count(0.0)} of "
                f"{len(found)} readings. Check the monitors' wires and [front_end]."
            )
        return float(np.mean(found))

    def _armed_status(self) -> list[Status]:
        """Collect status messages while the microcontroller is armed; keep it alive meanwhile."""
        found: list[Status] = []
        self._wants_status = True
        try:
            self._link.execute(SetTelemetry(_STATUS_UPDATES, 0))
            while len(found) < _STATUSES:
                self._status = None
                self._link.send(KeepAlive())
                if not self._wait(lambda: self._status is not None, self._patience_s):
                    raise DeviceError(
                        "No status received from the microcontroller. Check its cable and its "
                        "power."
                    )
                assert self._status is not None
                if self._status.state != State.ARMED:
                    low_f, high_f = self._settings.capacitance_range_f
                    raise SafetyError(
                        f"{self._tripped()} Only capacitances of {1e12 * low_f:.3g} to "
                        f"{1e12 * high_f:.3g} pF, those of its strain map, are valid."
                    )
                found.append(self._status)
            self._link.execute(SetTelemetry(0, 1))
        finally:
            self._wants_status = False
        return found

    def _run(self, strain: float) -> None:
        """Close the loop as soon as there is a valid strain."""
        end = self._count + round(_ARMED_S * RATE_HZ)
        while self._count < end:
            answer = self._link.query(Run(strain))
            result = None if answer is None else answer.result
            if result not in (None, Result.ACCEPTED, Result.NOT_READY):
                break
            if self._wait(lambda: self._state == State.RUNNING, _RUN_S):
                self._refused = None  # not being ready before is no fault
                return
        if self._state == State.TRIPPED:
            raise self._tripped()
        raise DeviceError(
            f"The microcontroller did not close its loop within {_ARMED_S:g} s after arming, "
            "because it had no valid strain. Check the monitors' wires, the carrier and the "
            "actuator."
        )

    def _arm(self) -> None:
        """Arm in two steps. An earlier trip is cleared, since the bench was armed again after it.
        A microcontroller that was reset is not armed; it must be opened again.
        """
        if self._reset is not None:
            raise self._tripped()
        if self._state == State.STOPPING:
            self._wait(lambda: self._state != State.STOPPING, _DOWN_S)
        if self._state == State.TRIPPED:
            self._link.execute(ClearFault())
            self._pass(2.0 / RATE_HZ)
            self._traces.clear()  # they describe the trip
        self._link.arm_in_two_steps()
        self._alive = 0
        self._pass(self._settings.settle_s + _UPDATES / RATE_HZ)

    @property
    def output_v(self) -> float:
        """See `haselab.rig.BuiltInController`."""
        return self._drive_v

    # ---- the stand's clock -------------------------------------------------------------------

    def pause(self) -> None:
        """Go to 0 V while a mass is changed, for any length of time."""
        self.zero()

    def catch_up(self) -> None:
        """Discard what arrived meanwhile."""
        self._pass(1.0 / RATE_HZ)
        self._traces.clear()

    def pass_time(self, duration_s: float) -> None:
        """Let time pass without keeping blocks."""
        for _ in range(round(duration_s * RATE_HZ / _UPDATES)):
            self.read()

    def close(self) -> None:
        """Go to 0 V and close the link. Never raises."""
        self.zero()
        quietly(self._link.close)
