"""`rig check` names the wire: each fault as a formula, with any healthy bench around it."""

from __future__ import annotations

import cmath
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.rig.checks.wires import Expected, Seen, capacitance_f, diagnose

EXPECTED = Expected(
    carrier_v=0.02, step_v=0.02, frequency_hz=2e3, carrier_output_v=100.0, i_monitor_v_per_a=500.0,
    skew_s=2.5e-6,
)  # fmt: skip
OMEGA = 2.0 * math.pi * EXPECTED.frequency_hz


def seen(
    farad: float, loss: float, carrier: float, step: float, phase: float, noise_v: float
) -> Seen:
    """What a right wiring shows of a capacitor with a loss; the generator has any phase."""
    volt = EXPECTED.carrier_v * carrier * cmath.exp(1j * phase)
    ampere = 1j * OMEGA * farad * (1.0 - 1j * loss) * EXPECTED.carrier_output_v * carrier
    ampere *= cmath.exp(1j * phase) * cmath.exp(1j * OMEGA * EXPECTED.skew_s)
    i_carrier = EXPECTED.i_monitor_v_per_a * ampere - noise_v
    return Seen(volt + noise_v, i_carrier, EXPECTED.step_v * step + noise_v, noise_v)


# A deviation of the means of a block of a 16-bit converter of 10 V is some microvolts.
healthy = st.builds(
    seen,
    farad=st.floats(2e-11, 1.5e-9),
    loss=st.floats(0.0, 0.2),
    carrier=st.floats(0.85, 1.15),
    step=st.floats(0.95, 1.05),
    phase=st.floats(-math.pi, math.pi),
    noise_v=st.floats(-1e-5, 1e-5),
)


@given(healthy)
def test_a_bench_that_is_wired_right_is_not_accused(found: Seen) -> None:
    assert diagnose(found, EXPECTED) is None


FAULTS = {
    "no voltage monitor": (
        lambda s: replace(s, v_carrier=2e-6, v_step=3e-6),
        "Connect the voltage monitor",
    ),
    "no current monitor": (
        lambda s: replace(s, i_carrier=2e-6, i_step=0.0),
        "Connect the current monitor",
    ),
    "monitors swapped": (
        lambda s: Seen(s.i_carrier, s.v_carrier, s.i_step, s.v_step),
        "Swap the cables of the two monitors",
    ),
    "voltage monitor reversed": (
        lambda s: replace(s, v_carrier=-s.v_carrier, v_step=-s.v_step),
        "Swap the two wires of the voltage monitor",
    ),
    "current monitor reversed": (
        lambda s: replace(s, i_carrier=-s.i_carrier, i_step=-s.i_step),
        "Swap the two wires of the current monitor",
    ),
    "output reversed": (lambda s: replace(s, v_step=-s.v_step), "non-inverting input"),
    "no output": (lambda s: replace(s, v_step=1e-6), "Connect daq.output"),
    "no generator": (
        lambda s: replace(s, v_carrier=1e-6, i_carrier=1e-6),
        "Connect the generator",
    ),
    "amplifier off": (lambda s: Seen(1e-6, 1e-6, 1e-6, 1e-6), "switch it and its high voltage on"),
    "voltage monitor at 10 V/kV": (
        lambda s: replace(s, v_carrier=2.5 * s.v_carrier, v_step=2.5 * s.v_step),
        "amplifier.volt_per_monitor_volt",
    ),
    "generator reported 50 ohm": (
        lambda s: replace(s, v_carrier=2 * s.v_carrier / _carrier(s), i_carrier=2 * s.i_carrier),
        "generator.load",
    ),
    "summing stage": (
        lambda s: replace(s, v_carrier=4 * s.v_carrier, i_carrier=4 * s.i_carrier),
        "generator.volt_per_volt",
    ),
    "summing stage at the output": (
        lambda s: replace(s, v_step=0.5 * s.v_step),
        "gain of the summing stage at daq.output",
    ),
    "skew": (
        lambda s: replace(s, i_carrier=s.i_carrier * cmath.exp(1j * OMEGA * 60e-6)),
        "daq.skew_s",
    ),
    "short": (
        lambda s: replace(s, v_carrier=0.01 * s.v_carrier, i_carrier=12e-3 * 500.0),
        "Disconnect the actuator",
    ),
}


def _carrier(found: Seen) -> float:
    return abs(found.v_carrier) / EXPECTED.carrier_v


@pytest.mark.parametrize("fault", FAULTS)
@given(found=healthy)
def test_each_fault_is_named_on_any_bench(fault: str, found: Seen) -> None:
    plant, advice = FAULTS[fault]
    named = diagnose(plant(found), EXPECTED)
    assert named is not None
    assert advice in named[1]


@given(healthy, st.floats(2e-11, 1.5e-9))
def test_the_capacitance_is_that_of_the_formula(found: Seen, farad: float) -> None:
    exact = seen(farad, 0.05, 1.0, 1.0, 0.3, 0.0)
    assert capacitance_f(exact.v_carrier, exact.i_carrier, EXPECTED).real == pytest.approx(farad)
    assert capacitance_f(0.0, found.i_carrier, EXPECTED) == 0.0
