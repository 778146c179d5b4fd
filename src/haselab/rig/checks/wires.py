"""Find the wrong wire from how a carrier and a small step appear at both inputs."""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

__all__ = ["CRITERION", "Expected", "Seen", "capacitance_f", "diagnose"]

_NOTHING = 0.1  # fraction of the expected signal below which there is none
_ALIKE = 0.25  # two factors that differ by less have one cause, if both are far from 1
_SAME = 0.08  # the same if only the step is far from 1
_SCALE = 0.2  # an amplifier of 6 kHz raises 2 kHz by 3 %; more than this is a wrong setting
_STEP_SCALE = 0.1  # of a step of 20 codes or more, which the converter resolves to 5 %
_CURRENT_LIKE = (1.0 / 3.0, 3.0)  # ratio to the carrier of a current at the voltage monitor's input
_LARGE_A = 2e-3  # at 100 V and 2 kHz: 1.6 nF
_LEAST_F = 3e-12  # open leads
_HALF, _DOUBLE = (0.45, 0.55), (1.8, 2.2)  # ratios if the generator's 50 ohm load setting is wrong
_RIGHT_ANGLE_DEG = 20.0  # largest deviation of the current's phase from 90 degrees
CRITERION = (
    f"{1.0 - _SCALE:g} to {1.0 + _SCALE:g} times the expected amplitude, a current of at least "
    f"{1e12 * _LEAST_F:g} pF that leads by 90 ± {_RIGHT_ANGLE_DEG:g} degrees"
)


@dataclass(frozen=True)
class Seen:
    """What both inputs of the board showed, in V at the input.

    Args:
        v_carrier: phasor at the input of the voltage monitor while the carrier was on.
        i_carrier: the same at the input of the current monitor.
        v_step: change of the voltage monitor's mean by a step of the drive.
        i_step: the same for the current monitor.
    """

    v_carrier: complex
    i_carrier: complex
    v_step: float
    i_step: float


@dataclass(frozen=True)
class Expected:
    """What the inputs should show according to the rig file.

    Args:
        carrier_v: amplitude at the input of the voltage monitor.
        step_v: the step there.
        frequency_hz: of the carrier.
        carrier_output_v: its amplitude at the actuator.
        i_monitor_v_per_a: of the current monitor.
        skew_s: from the first input's sample to the second's.
    """

    carrier_v: float
    step_v: float
    frequency_hz: float
    carrier_output_v: float
    i_monitor_v_per_a: float
    skew_s: float


def capacitance_f(v_carrier: complex, i_carrier: complex, expected: Expected) -> complex:
    """Complex capacitance: admittance over j omega, in F; its imaginary part is a loss.

    Args:
        v_carrier: phasor at the input of the voltage monitor.
        i_carrier: of the current monitor.
        expected: values of the rig file.
    Returns:
        The capacitance; 0 if the voltage is 0.
    """
    if v_carrier == 0.0:
        return 0.0
    omega = 2.0 * math.pi * expected.frequency_hz
    ampere = i_carrier / expected.i_monitor_v_per_a * cmath.exp(-1j * omega * expected.skew_s)
    volt = v_carrier * expected.carrier_output_v / expected.carrier_v
    return ampere / (1j * omega * volt)


def diagnose(seen: Seen, expected: Expected) -> tuple[str, str] | None:
    """Find the first cause that explains what was measured.

    Args:
        seen: measured at both inputs.
        expected: values of the rig file.
    Returns:
        What is wrong, and what to change; None if all is as expected.
    """
    carrier = abs(seen.v_carrier) / expected.carrier_v
    step, step_at_i = seen.v_step / expected.step_v, seen.i_step / expected.step_v
    farad = capacitance_f(seen.v_carrier, seen.i_carrier, expected)
    ampere = abs(seen.i_carrier) / expected.i_monitor_v_per_a
    # From the current alone, for the expected voltage of the carrier.
    current = ampere / (2.0 * math.pi * expected.frequency_hz * expected.carrier_output_v)
    return (
        _swapped(step, step_at_i, carrier, negative=farad.real < 0.0)
        or _overloaded(carrier, step, ampere)
        or _silent(carrier, step, current)
        or _polarity(farad, step)
        or _scale(carrier, step)
        or _phase(farad)
    )


def _swapped(
    step: float, step_at_i: float, carrier: float, *, negative: bool
) -> tuple[str, str] | None:
    here = abs(step) < 0.5 < abs(step_at_i) and abs(step_at_i) < 2.0
    # A current shows less of a step than the voltage does, also with a wrong scale.
    beyond = (carrier < _CURRENT_LIKE[0] or carrier > _CURRENT_LIKE[1]) and negative
    if here or (beyond and abs(step_at_i) > 3.0 * abs(step) and abs(step_at_i) > _NOTHING):
        return (
            "the step appears at the current monitor's input, not at the voltage monitor's",
            "Swap the cables of the two monitors, or daq.v_monitor and daq.i_monitor",
        )
    return None


def _overloaded(carrier: float, step: float, ampere: float) -> tuple[str, str] | None:
    if carrier < 1.0 - _SCALE and abs(step) > 0.5 and ampere > _LARGE_A:
        return (
            f"the load draws {1e3 * ampere:.3g} mA from the sensing signal, which drops to "
            f"{carrier:.2g} times its expected value",
            "Disconnect the actuator. If the signal is then correct, the actuator is shorted, or "
            "its capacitance is too large for the amplifier's current",
        )
    return None


def _silent(carrier: float, step: float, current: float) -> tuple[str, str] | None:
    no_carrier, no_step = carrier < _NOTHING, abs(step) < _NOTHING
    no_current = current < _LEAST_F
    if no_carrier and no_step and no_current:
        return (
            "neither the sensing signal nor a step of the drive arrives at the monitors",
            "Assume that the output is energised: switch the amplifier off, and check the cables "
            "of both monitors first. If the amplifier was off, switch it and its high voltage "
            "on, close its enable contact, and check the cable to its input",
        )
    if no_carrier and no_step:
        return (
            "the voltage monitor shows neither the sensing signal nor the step; the current "
            "monitor shows a current",
            "Connect the voltage monitor to daq.v_monitor",
        )
    if no_carrier:
        return (
            "the sensing signal does not arrive, but the step does",
            "Connect the generator's output (channel generator.channel) to the summing input; or "
            "disconnect the actuator, since a short circuit removes the signal",
        )
    if no_step:
        return (
            "the step of the drive does not arrive, but the sensing signal does",
            "Connect daq.output to the summing input, and check that it is the right output",
        )
    if no_current:
        return (
            f"the current monitor shows no current ({1e12 * current:.2g} pF)",
            "Connect the current monitor to daq.i_monitor, and the actuator to the amplifier",
        )
    return None


def _polarity(farad: complex, step: float) -> tuple[str, str] | None:
    if step < 0.0 and farad.real < 0.0:
        return (
            "the voltage monitor has the wrong sign",
            "Swap the two wires of the voltage monitor at the board",
        )
    if step < 0.0:
        return (
            "the output has the wrong sign, at both monitors",
            "Use the amplifier's non-inverting input; or swap the wires of both monitors",
        )
    if farad.real < 0.0 and abs(farad.real) > abs(farad.imag):
        return (
            "the current monitor has the wrong sign",
            "Swap the two wires of the current monitor at the board",
        )
    return None


def _scale(carrier: float, step: float) -> tuple[str, str] | None:
    off_carrier, off_step = abs(carrier - 1.0) > _SCALE, abs(step - 1.0) > _STEP_SCALE
    alike = _ALIKE if off_carrier else _SAME  # an amplifier raises the carrier by some per cent
    if off_step and abs(carrier / step - 1.0) < alike:
        return (
            f"the voltage monitor shows {step:.3g} times the expected value of carrier and step",
            "Change amplifier.volt_per_monitor_volt or amplifier.gain (a switch on the amplifier "
            "may set it), or the gain of the summing stage",
        )
    if off_carrier:
        return _generator(carrier)
    if off_step:
        return (
            f"a step of the drive is {step:.3g} times its expected value, but the sensing signal "
            "is correct",
            "Change the gain of the summing stage at daq.output's input",
        )
    return None


def _generator(carrier: float) -> tuple[str, str]:
    found = f"the sensing signal is {carrier:.3g} times its expected value, but the step is correct"
    if _HALF[0] < carrier < _HALF[1] or _DOUBLE[0] < carrier < _DOUBLE[1]:
        return found, (
            "Set generator.load to 'INF' for an amplifier's or summing stage's input, or to '50' "
            "for a 50 ohm input; else change generator.volt_per_volt"
        )
    return found, "Set generator.volt_per_volt to the summing stage's gain for the generator"


def _phase(farad: complex) -> tuple[str, str] | None:
    angle_deg = math.degrees(cmath.phase(farad)) if farad else 0.0
    if abs(angle_deg) > _RIGHT_ANGLE_DEG:
        return (
            f"the current's phase differs by {abs(angle_deg):.3g} degrees from 90 degrees",
            "Change daq.skew_s; if it is correct, measure the actuator's leakage and the filters "
            "of the monitors",
        )
    return None
