"""Checks with high voltage: sensing signal, a small step, the supply, then 0 V again."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.rig import BuiltInController, HighVoltageSupply, Rig, RigDescription
from haselab.rig.check_result import CheckResult
from haselab.rig.checks.board import start_checks
from haselab.rig.checks.dry import QUIET_SHARE, read_backs
from haselab.rig.checks.signals import input_volts, keep, phasor, saturated, span_v, volts
from haselab.rig.checks.wires import CRITERION, Expected, Seen, capacitance_f, diagnose
from haselab.rig.instruments.sections import DaqConfig

__all__ = ["CARRIER_V", "SUPPLY_V", "LivePlan", "live_checks", "live_step_v"]

_BLOCKS = 50
_CARRIER_HZ, CARRIER_V = 2000.0, 0.02  # the amplitude is a peak
_STEP_SHARE = 0.1  # fraction of the drive's range, put out if the sensing signal is correct
_PROBE_SHARE = 0.1  # fraction of that step, put out to find a fault
_MEANS_S = 0.1  # whole periods of 50 and 60 Hz
_LEAST_CODES = 20.0  # smallest step that stands out from the noise
_STEP_TOLERANCE = 0.02  # gain errors of amplifier and monitor
_SETTLE_S = 0.5e-3
_LATE = (
    "Raise daq.ahead_blocks, close other programs, connect the board to a USB port without a hub, "
    "or use a PCIe or PXIe board"
)
_LATE_BLOCKS = 6  # longest wait for an output that is late
SUPPLY_V = 100.0  # at least
_SUPPLY_SHARE, _SUPPLY_OFFSET_V = 0.1, 50.0  # of its meter
_SUPPLY_S = 3.0  # longest time to rise, and to discharge
_MEASURABLE = 0.1  # fraction of the sensing signal needed to measure a capacitance
_KNOWN_SHARE, _STRAY_F = (
    0.05,
    60e-12,
)  # tolerance for a known capacitor: gain errors; cable and fixture


@dataclass(frozen=True)
class LivePlan:
    """Settings of the live checks.

    Args:
        capacitor_f: capacitance of a known capacitor in place of the actuator; None: the actuator
            is connected.
        supply_v: voltage that the supply puts out for a moment, in V.
        loop_back: whether the board's output is wired to the voltage monitor's input, without the
            amplifier; then only the starts of the output are checked.
        daq: section `daq` of the rig file; for `loop_back`.
        alive: called about every second before anything is energised: sends the guardians a
            heartbeat, and raises if they no longer watch.
    """

    capacitor_f: float | None = None
    supply_v: float = SUPPLY_V
    loop_back: bool = False
    daq: DaqConfig | None = None
    alive: Callable[[], object] = lambda: None


def live_step_v(rig: RigDescription) -> float:
    """Drive that the live checks put out, in V at the amplifier's input."""
    limits = rig.drive_limits
    return _STEP_SHARE * (limits.high if limits.high >= -limits.low else limits.low)


def _probe_v(rig: RigDescription) -> float:
    """Drive used to find what is wrong with the sensing signal; about its amplitude."""
    step_v = live_step_v(rig)
    least_v = _LEAST_CODES * rig.volt_per_code / rig.monitor_v_per_drive_v
    probe_v = max(_PROBE_SHARE * abs(step_v), CARRIER_V, least_v)
    return math.copysign(min(abs(step_v), probe_v), step_v)


def live_checks(rig: Rig, plan: LivePlan) -> Iterator[CheckResult]:
    """Check sensing signal, a small step and the supply with the monitors; then go to 0 V.

    Args:
        rig: the bench. HIGH VOLTAGE WILL BE APPLIED.
        plan: what is connected.
    Yields:
        The result of each check.
    Raises:
        DeviceError: An instrument failed during the check.
        SafetyError: The bench tripped.
    """
    try:
        if plan.loop_back and plan.daq is not None:
            plan.alive()
            d = rig.description
            yield from start_checks(rig, plan.daq, live_step_v(d), _probe_v(d))
            return
        if rig.controller is not None and plan.capacitor_f is not None:
            yield _see_capacitor(rig.controller, plan.capacitor_f)
        elif rig.controller is not None:
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
    """Check with the supply's own meter that its voltage rises, and falls once it is off."""
    supply.set_voltage(wanted_v)
    near_v = max(_SUPPLY_SHARE * wanted_v, _SUPPLY_OFFSET_V)
    measured_v = _wait_for(supply, lambda v: abs(v - wanted_v) < near_v)
    supply.off()
    left_v = _wait_for(supply, lambda v: abs(v) < near_v)
    yield CheckResult(
        "live",
        "supply",
        f"{measured_v:g} V read back, {wanted_v:g} V requested",
        abs(measured_v - wanted_v) < near_v,
        "Plug in its power, switch its main switch on, "
        "and calibrate it; check that the load does not draw too much current",
        criterion=f"within {near_v:g} V, after at most {_SUPPLY_S:g} s",
    )
    yield CheckResult(
        "live",
        "supply off",
        f"{left_v:g} V, within {_SUPPLY_S:g} s of switching it off",
        abs(left_v) < near_v,
        "Pull its power jack, because it does not switch off. Have the output switch repaired",
        criterion=f"below {near_v:g} V",
    )


def _wait_for(supply: HighVoltageSupply, reached: Callable[[float], bool]) -> float:
    """Reading of the meter when it reaches the expected value, or after some seconds."""
    end_s = time.monotonic() + _SUPPLY_S
    while True:
        measured_v = supply.read_voltage()
        if reached(measured_v) or time.monotonic() > end_s:
            return measured_v
        time.sleep(0.05)


def _see_loop(rig: Rig, controller: BuiltInController) -> CheckResult:
    """Hold zero strain for half a second: the microcontroller must arm, sense and drive."""
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
        "Calibrate the microcontroller again, and check its wiring",
        criterion=f"above 0 and below {rig.description.drive_limits.high:g} V",
    )


def _see_capacitor(controller: BuiltInController, known_f: float) -> CheckResult:
    """Measure a known capacitor with the sensing signal alone; the loop stays open."""
    farad = controller.measure_capacitance_f()
    factor = f"multiply both numbers of front_end.correction by {known_f / farad:.4g}"
    return CheckResult(
        "live",
        "known capacitor",
        f"measured {1e12 * farad:.4g} pF, nominal {1e12 * known_f:.4g} pF: {factor}",
        abs(farad / known_f - 1.0) <= _KNOWN_SHARE,
        f"If the capacitor is right, {factor}, build the firmware again with 'haselab firmware "
        "build RUN --rig' and this rig file, and flash it",
        criterion=f"within {100.0 * _KNOWN_SHARE:g} %",
    )


def _see_wires(rig: Rig, plan: LivePlan) -> Iterator[CheckResult]:
    """Check the sensing signal; then a step of 10 %, or a smaller one that shows the fault."""
    probe_v = _probe_v(rig.description)
    expected = _expected(rig, probe_v)
    if abs(expected.step_v) < 0.99 * _LEAST_CODES * rig.description.volt_per_code:
        yield CheckResult(
            "live",
            "drive range",
            f"its step is {1e3 * expected.step_v:.2g} mV at the "
            "voltage monitor's input, too small to measure",
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
        what, advice = named or ("correct on the second try", "Run the check again")
        yield CheckResult(
            "live", "sensing signal", f"{found}: {what}", False, advice, criterion=CRITERION
        )
        return
    if plan.capacitor_f is None:
        found += ", current scale not checked (use --capacitor)"
    yield CheckResult("live", "sensing signal", found, True, criterion=CRITERION)
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
    """Name of the monitor that clips, or empty; and the phasors at both inputs, in V."""
    rig.generator.sine(_CARRIER_HZ, CARRIER_V)
    rig.acquisition.read()
    codes = rig.acquisition.read()
    rig.generator.off()
    at_input = input_volts(rig, codes)
    top = rig.description.top_code
    clipped = [name for k, name in enumerate(("voltage", "current")) if saturated(codes[:, k], top)]
    rate_hz = rig.description.rate_hz
    found = [phasor(at_input[:, k], _CARRIER_HZ, rate_hz) for k in (0, 1)]
    return "".join(clipped[:1]), found[0], found[1]


def _means(rig: Rig) -> NDArray[np.float64]:
    """Means of both inputs over whole periods of the mains, in V; shape `(2,)`."""
    count = max(1, round(_MEANS_S / rig.description.block_s))
    blocks = [input_volts(rig, rig.acquisition.read()) for _ in range(count)]
    mean: NDArray[np.float64] = np.concatenate(blocks).mean(axis=0)
    return mean


@dataclass(frozen=True)
class _Step:
    """What both inputs showed of a step of the drive.

    Args:
        rest_v: values before the step, in V at the input, `(2,)`.
        change_v: changes by the step, in V at the input, `(2,)`.
        codes: samples from the block after which the step was written, `(n, 2)`.
        missed: number of outputs that were skipped because they came too late.
    """

    rest_v: NDArray[np.float64]
    change_v: NDArray[np.float64]
    codes: NDArray[np.int16]
    missed: int


def _step(rig: Rig, step_v: float) -> _Step:
    """Put a step out, measure it, and return to 0 V."""
    d = rig.description
    missed = _missed(rig)
    keep(rig, True)
    rest_v = _means(rig)
    rig.source.write(step_v)
    queued = d.queued_blocks + _LATE_BLOCKS
    blocks = [rig.acquisition.read() for _ in range(queued + 2)]
    change_v = _means(rig) - rest_v
    keep(rig, False)
    rig.source.zero()
    return _Step(rest_v, change_v, np.concatenate(blocks), _missed(rig) - missed)


def _see_step(rig: Rig, v_carrier: complex, i_carrier: complex) -> Iterator[CheckResult]:
    d = rig.description
    step_v = live_step_v(d)
    seen = _step(rig, step_v)  # back at 0 V before a line is printed, since printing may block
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
    if saturated(codes[:, 0], rig.description.top_code):
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
    from_ = d.switch_in_block // 2  # ignore noise before the output
    at = from_ + int(np.argmax(np.abs(volt[from_:] - rest_v) > 0.5 * abs(step_v)))
    if named is not None:
        yield CheckResult(
            "live", "size of an output", f"{v_step:.4g} V at the input: {named[0]}", False, named[1]
        )
        return
    late = round((at - d.switch_sample) / d.block_samples)
    advice = (
        f"Change daq.output_delay_s: the output begins {at % d.block_samples} samples into the "
        "block"
    )
    if late:
        advice = f"Outputs come {late} blocks late. {_LATE}"
    yield CheckResult(
        "live",
        "time of an output",
        f"sample {at}, the rig file says {d.switch_sample}",
        0 <= at - d.switch_sample < settle,
        advice,
        criterion=f"0 to {settle - 1} samples later",
    )
    # The monitor's own offset is not part of the step.
    reached_v = v_step / d.monitor_v_per_drive_v
    yield CheckResult(
        "live",
        "size of an output",
        f"{reached_v:.4g} V, {step_v:.4g} V requested",
        abs(reached_v / step_v - 1.0) < _STEP_TOLERANCE,
        "Change amplifier.gain, "
        "amplifier.volt_per_monitor_volt or the gain of the summing stage, or calibrate "
        "the monitor",
        criterion=f"within {100.0 * _STEP_TOLERANCE:g} %",
    )
    yield CheckResult(
        "live",
        "0 V at once",
        f"{left_v:.3g} V in the next block",
        abs(left_v) < QUIET_SHARE * span_v(rig),
        "Switch the amplifier off by hand, then find what else drives its input",
        criterion=f"below {QUIET_SHARE * span_v(rig):.3g} V",
    )


def _missed(rig: Rig) -> int:
    """Number of outputs that the source skipped because they came too late, if it counts them."""
    return int(getattr(rig.source, "missed_outputs", 0))


def _known(farad: float, known_f: float, rig: Rig) -> CheckResult:
    """Check the scale of the current monitor with a known capacitor."""
    ratio = farad / known_f
    low_f, high_f = (1.0 - _KNOWN_SHARE) * known_f, (1.0 + _KNOWN_SHARE) * known_f + _STRAY_F
    good = low_f <= farad <= high_f  # parallel capacitance adds to it
    return CheckResult(
        "live",
        "known capacitor",
        f"measured {1e12 * farad:.4g} pF, nominal {1e12 * known_f:.4g} pF (ratio {ratio:.3g})",
        good,
        f"Multiply amplifier.ampere_per_monitor_volt by {1.0 / ratio:.3g}, which gives "
        f"{1.0 / (rig.description.i_monitor_v_per_a * ratio):.3g} A/V; or change "
        "volt_per_monitor_volt, if a voltmeter at the monitor confirms that",
        criterion=f"{1e12 * low_f:.4g} to {1e12 * high_f:.4g} pF, with cable and fixture",
    )
