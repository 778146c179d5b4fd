"""The checks with high voltage: sensing signal, a small step, the supply, then rest again."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.rig import ClosesLoop, HighVoltageSupply, Rig, RigDescription
from haselab.rig.check_result import CheckResult
from haselab.rig.checks.board import start_checks
from haselab.rig.checks.dry import QUIET_SHARE, read_backs
from haselab.rig.checks.signals import input_volts, keep, phasor, saturated, span_v, volts
from haselab.rig.checks.wires import Expected, Seen, capacitance_f, diagnose
from haselab.rig.instruments.sections import DaqConfig

__all__ = ["CARRIER_V", "SUPPLY_V", "LivePlan", "live_checks", "live_step_v"]

_BLOCKS = 50
_CARRIER_HZ, CARRIER_V = 2000.0, 0.02  # the amplitude is a peak
_STEP_SHARE = 0.1  # of the drive's range, put out when the sensing signal is right
_PROBE_SHARE = 0.1  # of that step, or the sensing signal's amplitude: put out to find a fault
_MEANS_S = 0.1  # whole periods of 50 and 60 Hz
_LEAST_CODES = 20.0  # of a step that stands out of the noise
_STEP_TOLERANCE = 0.02  # gain errors of amplifier and monitor
_SETTLE_S = 0.5e-3
_LATE = (
    "Raise daq.ahead_blocks, close other programs, or use a USB port of its own (no hub), or a "
    "PCIe or PXIe board"
)
_LATE_BLOCKS = 6  # for which an output that does not come in time is waited for
SUPPLY_V = 100.0  # at least
_SUPPLY_SHARE, _SUPPLY_OFFSET_V = 0.1, 50.0  # of its meter
_SUPPLY_S = 3.0  # that it may take to rise, and to run down
_MEASURABLE = 0.1  # of the sensing signal: with less there is no capacitance to measure
_KNOWN_SHARE, _STRAY_F = 0.05, 60e-12  # of a known capacitor: gain errors; cable and fixture


@dataclass(frozen=True)
class LivePlan:
    """Settings of the live checks.

    Args:
        capacitor_f: of a known capacitor that is in the actuator's place; None: the actuator is.
        supply_v: that the supply puts out for a moment, in V.
        loop_back: the board's output is wired to the voltage monitor's input, and the amplifier is
            not: only the starts of the output are looked at.
        daq: section `daq` of the rig file; for `loop_back`.
        alive: called before anything is energised, about every second: gives a sign of life to who
            watches, and raises where nobody does any more.
    """

    capacitor_f: float | None = None
    supply_v: float = SUPPLY_V
    loop_back: bool = False
    daq: DaqConfig | None = None
    alive: Callable[[], object] = lambda: None


def live_step_v(rig: RigDescription) -> float:
    """The drive that the live checks put out, in V ahead of the amplifier."""
    limits = rig.drive_limits
    return _STEP_SHARE * (limits.high if limits.high >= -limits.low else limits.low)


def _probe_v(rig: RigDescription) -> float:
    """The drive that names what is wrong with the sensing signal: about its amplitude."""
    step_v = live_step_v(rig)
    least_v = _LEAST_CODES * rig.volt_per_code / rig.monitor_v_per_drive_v
    probe_v = max(_PROBE_SHARE * abs(step_v), CARRIER_V, least_v)
    return math.copysign(min(abs(step_v), probe_v), step_v)


def live_checks(rig: Rig, plan: LivePlan) -> Iterator[CheckResult]:
    """Sensing signal, a small step and the supply, each seen by the monitors; then rest again.

    Args:
        rig: the bench; high voltage is put out.
        plan: what is connected.
    Yields:
        What was verified.
    Raises:
        DeviceError: an instrument failed on the way.
        SafetyError: the bench protected itself.
    """
    try:
        if plan.loop_back and plan.daq is not None:
            plan.alive()
            d = rig.description
            yield from start_checks(rig, plan.daq, live_step_v(d), _probe_v(d))
            return
        if rig.controller is not None:
            yield _see_loop(rig, rig.controller)
        else:
            yield from _see_wires(rig, plan)
        if rig.supply is not None:
            plan.alive()
            yield from _see_supply(rig.supply, plan.supply_v)
    finally:
        rig.safe()
    rig.acquisition.read()
    yield from read_backs(rig, "live")


def _see_supply(supply: HighVoltageSupply, wanted_v: float) -> Iterator[CheckResult]:
    """The voltage comes, and goes once it is off, by the supply's own meter."""
    supply.set_voltage(wanted_v)
    near_v = max(_SUPPLY_SHARE * wanted_v, _SUPPLY_OFFSET_V)
    measured_v = _wait_for(supply, lambda v: abs(v - wanted_v) < near_v)
    supply.off()
    left_v = _wait_for(supply, lambda v: abs(v) < near_v)
    yield CheckResult(
        "live",
        "supply",
        f"{measured_v:g} V read back, set were {wanted_v:g} V",
        abs(measured_v - wanted_v) < near_v,
        "Plug in its power, switch its main switch on, "
        "calibrate it; a load that takes its current keeps it down",
    )
    yield CheckResult(
        "live",
        "supply off",
        f"{left_v:g} V, within {_SUPPLY_S:g} s of switching it off",
        abs(left_v) < near_v,
        "Pull its power jack: it does not switch off. Have the output switch repaired",
    )


def _wait_for(supply: HighVoltageSupply, reached: Callable[[float], bool]) -> float:
    """The meter, as soon as it shows what is waited for, or after some seconds."""
    end_s = time.monotonic() + _SUPPLY_S
    while True:
        measured_v = supply.read_voltage()
        if reached(measured_v) or time.monotonic() > end_s:
            return measured_v
        time.sleep(0.05)


def _see_loop(rig: Rig, controller: ClosesLoop) -> CheckResult:
    """Zero strain held for half a second: the chip arms, senses and drives."""
    wanted = max(0.0, controller.strain_limits.low)
    for _ in range(_BLOCKS):
        controller.follow(wanted)
        rig.acquisition.read()
    drive_v = controller.output_v
    rig.source.zero()
    return CheckResult(
        "live",
        "loop",
        f"{drive_v:.3g} V of drive at a strain of {wanted:g}",
        0.0 < drive_v < rig.description.drive_limits.high,
        "Calibrate the chip again; check its wiring",
    )


def _see_wires(rig: Rig, plan: LivePlan) -> Iterator[CheckResult]:
    """The sensing signal; then a step of 10 %, or a smaller one that shows what is wrong."""
    probe_v = _probe_v(rig.description)
    expected = _expected(rig, probe_v)
    if abs(expected.step_v) < 0.99 * _LEAST_CODES * rig.description.volt_per_code:
        yield CheckResult(
            "live",
            "drive range",
            f"a step of it is {1e3 * expected.step_v:.2g} mV at the "
            "voltage monitor's input, too small to be measured",
            False,
            "Lower daq.range_v, or raise daq.drive_high_v",
        )
        return
    plan.alive()
    clipped, v_carrier, i_carrier = _carrier(rig)
    if clipped:
        yield CheckResult(
            "live",
            "sensing signal",
            f"the {clipped} monitor is at the end of its range",
            False,
            "Raise daq.range_v, or check the scale of that monitor",
        )
        return
    farad = capacitance_f(v_carrier, i_carrier, expected)
    amplitude_v = CARRIER_V * abs(v_carrier) / expected.carrier_v
    found = f"{1e3 * amplitude_v:.3g} mV of {1e3 * CARRIER_V:g} mV"
    if amplitude_v > _MEASURABLE * CARRIER_V:
        found += f", {1e12 * farad.real:.4g} pF"
    as_if = Seen(v_carrier, i_carrier, expected.step_v, 0.0)
    if diagnose(as_if, expected) is not None:
        plan.alive()
        change = _step(rig, probe_v).change_v
        named = diagnose(Seen(v_carrier, i_carrier, *change.tolist()), expected)
        what, advice = named or ("it is right now", "Run the check again")
        yield CheckResult("live", "sensing signal", f"{found}: {what}", False, advice)
        return
    if plan.capacitor_f is None:
        found += ", scale of the current not checked (--capacitor)"
    yield CheckResult("live", "sensing signal", found, True)
    plan.alive()
    yield from _see_step(rig, v_carrier, i_carrier)
    if plan.capacitor_f is not None:
        yield _known(farad.real, plan.capacitor_f, rig)


def _expected(rig: Rig, step_v: float) -> Expected:
    d = rig.description
    per_drive = d.monitor_v_per_drive_v
    return Expected(
        CARRIER_V * per_drive,
        step_v * per_drive,
        _CARRIER_HZ,
        CARRIER_V * d.amplifier_gain,
        d.i_monitor_v_per_a,
        d.skew_s,
    )


def _carrier(rig: Rig) -> tuple[str, complex, complex]:
    """Which monitor clips, empty if none does; phasors at both inputs, in V there."""
    rig.generator.sine(_CARRIER_HZ, CARRIER_V)
    rig.acquisition.read()
    codes = rig.acquisition.read()
    rig.generator.off()
    at_input = input_volts(rig, codes)
    clipped = [name for k, name in enumerate(("voltage", "current")) if saturated(codes[:, k])]
    rate_hz = rig.description.rate_hz
    found = [phasor(at_input[:, k], _CARRIER_HZ, rate_hz) for k in (0, 1)]
    return "".join(clipped[:1]), found[0], found[1]


def _means(rig: Rig) -> NDArray[np.float64]:
    """Both inputs over whole periods of the mains, in V there; shape `(2,)`."""
    count = max(1, round(_MEANS_S / rig.description.block_s))
    blocks = [input_volts(rig, rig.acquisition.read()) for _ in range(count)]
    mean: NDArray[np.float64] = np.concatenate(blocks).mean(axis=0)
    return mean


@dataclass(frozen=True)
class _Step:
    """What both inputs showed of a step of the drive.

    Args:
        rest_v: before, in V at the input, `(2,)`.
        change_v: by the step, in V at the input, `(2,)`.
        codes: from the block on after which the step was written, `(n, 2)`.
        missed: outputs that were left out because they came too late.
    """

    rest_v: NDArray[np.float64]
    change_v: NDArray[np.float64]
    codes: NDArray[np.int16]
    missed: int


def _step(rig: Rig, step_v: float) -> _Step:
    """Put a step out, look at it, and go back to 0 V."""
    d = rig.description
    missed = _missed(rig)
    keep(rig, True)
    rest_v = _means(rig)
    rig.source.write(step_v)
    queued = d.switch_sample // d.block_samples + _LATE_BLOCKS
    blocks = [rig.acquisition.read() for _ in range(queued + 2)]
    change_v = _means(rig) - rest_v
    keep(rig, False)
    rig.source.zero()
    return _Step(rest_v, change_v, np.concatenate(blocks), _missed(rig) - missed)


def _see_step(rig: Rig, v_carrier: complex, i_carrier: complex) -> Iterator[CheckResult]:
    d = rig.description
    step_v = live_step_v(d)
    seen = _step(rig, step_v)  # at 0 V before a line is printed: printing may block
    rig.acquisition.read()
    left_v = float(volts(rig, rig.acquisition.read()).mean())
    if seen.missed:
        yield CheckResult(
            "live",
            "time of an output",
            f"{seen.missed} outputs came after their block",
            False,
            _LATE,
        )
        return
    codes = seen.codes
    if saturated(codes[:, 0]):
        yield CheckResult(
            "live",
            "size of an output",
            "the voltage monitor is at the end of its range",
            False,
            "Raise daq.range_v",
        )
        return
    volt = volts(rig, codes)
    settle = round(_SETTLE_S * d.rate_hz)
    expected = _expected(rig, step_v)
    v_step, i_step = seen.change_v.tolist()
    named = diagnose(Seen(v_carrier, i_carrier, v_step, i_step), expected)
    rest_v = float(seen.rest_v[0]) / d.monitor_v_per_drive_v
    from_ = d.switch_in_block // 2  # noise is no output
    at = from_ + int(np.argmax(np.abs(volt[from_:] - rest_v) > 0.5 * abs(step_v)))
    if named is not None:
        yield CheckResult(
            "live", "size of an output", f"{v_step:.4g} V at the input: {named[0]}", False, named[1]
        )
        return
    late = round((at - d.switch_sample) / d.block_samples)
    advice = f"Correct daq.output_delay_s: the output begins {at % d.block_samples} samples into it"
    if late:
        advice = f"Outputs come {late} blocks late. {_LATE}"
    yield CheckResult(
        "live",
        "time of an output",
        f"sample {at}, the rig file says {d.switch_sample}",
        0 <= at - d.switch_sample < settle,
        advice,
    )
    # The monitor's own offset is no fault of the step.
    reached_v = v_step / d.monitor_v_per_drive_v
    yield CheckResult(
        "live",
        "size of an output",
        f"{reached_v:.4g} V, set were {step_v:.4g} V",
        abs(reached_v / step_v - 1.0) < _STEP_TOLERANCE,
        "Correct amplifier.gain, "
        "amplifier.volt_per_monitor_volt or the gain of the summing stage, or calibrate "
        "the monitor",
    )
    yield CheckResult(
        "live",
        "0 V at once",
        f"{left_v:.3g} V in the next block",
        abs(left_v) < QUIET_SHARE * span_v(rig),
        "Switch the amplifier off by hand, then find what else drives its input",
    )


def _missed(rig: Rig) -> int:
    """Outputs that the source has left out because they came too late, if it counts them."""
    return int(getattr(rig.source, "missed_outputs", 0))


def _known(farad: float, known_f: float, rig: Rig) -> CheckResult:
    """A known capacitor gives the scale of the current monitor."""
    ratio = farad / known_f
    low_f, high_f = (1.0 - _KNOWN_SHARE) * known_f, (1.0 + _KNOWN_SHARE) * known_f + _STRAY_F
    good = low_f <= farad <= high_f  # what is in parallel adds to it
    return CheckResult(
        "live",
        "known capacitor",
        f"measured {1e12 * farad:.4g} pF, nominal {1e12 * known_f:.4g} pF (ratio {ratio:.3g})",
        good,
        f"Correct amplifier.ampere_per_monitor_volt: {1.0 / ratio:.3g} times what it is, "
        f"{1.0 / (rig.description.i_monitor_v_per_a * ratio):.3g} A/V; or "
        "volt_per_monitor_volt, if a voltmeter at the monitor says so",
    )
