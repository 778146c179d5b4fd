"""Effects of the twin that no law has: warming, ageing, a second resonance."""

import numpy as np
import pytest

from haselab.actuators import equilibrium_m
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import native_bench


def moved(unmodelled, voltage_v, load_n=2.45, mass_kg=0.25, **tables):
    """Lengths after each 0.1 ms, of a twin with what no law has, from its free length on."""
    config = TwinConfig.model_validate({"unmodelled": unmodelled, **tables})
    bench, lengths = native_bench(config, 0), np.empty(voltage_v.size)
    bench.inertia_kg = mass_kg
    bench.move(voltage_v / config.amplifier.gain, 1, load_n, lengths)
    return lengths


def test_a_permittivity_that_rose_acts_as_that_of_the_law():
    """From the first 0.1 ms on, in which 0.03 N less act: 1.2e-5 m/s, or 0.4 um at 30 rad/s."""
    voltage_v = np.full(10000, 6e3)
    risen = moved({"capacitance_rise": 0.1, "warming_s": 1e-12}, voltage_v)
    expected = moved({}, voltage_v, dielectric={"permittivity": 3.3})
    assert np.abs(risen - expected).max() < 4e-7
    assert risen[-1] > moved({}, voltage_v)[-1] * 1.001


def test_ageing_takes_its_share_of_the_elastic_force():
    """Shell and electrodes softer by 10 % from the start; branches act on the elastic force."""
    voltage_v = np.zeros(20000)
    aged = moved({"stiffness_loss": 0.1, "ageing_s": 1e-12}, voltage_v)
    softer = {"shell": {"shear_modulus_pa": 0.9 * 15.6e3},
              "electrodes": {"stiffness_n_per_m": 135.0}}  # fmt: skip
    expected = moved({}, voltage_v, **softer)
    # its branches began relaxed at the force before it aged, which decays
    assert aged[-1] == pytest.approx(expected[-1], rel=5e-3)
    assert aged[-1] > 1.01 * moved({}, voltage_v)[-1]


def test_the_second_mass_has_the_two_resonances_of_two_masses():
    """Free ringing against the eigenvalues of two masses on two springs."""
    mass_kg, second_kg, second_hz = 0.25, 0.05, 12.0
    plain = {"viscosity": {"share": [], "relaxation_s": [], "damping_n_s_per_m": 1e-6},
             "mullins": {"share": 0.0}}  # fmt: skip
    unmodelled = {"resonance_mass_kg": second_kg, "resonance_hz": second_hz,
                  "resonance_damping_ratio": 1e-6}  # fmt: skip
    config = TwinConfig.model_validate(plain)
    law = config.law
    rest_m = equilibrium_m(law, 0.0, 2.45)
    stiffness = float(np.diff(law.elastic_force_n(rest_m + np.array([-1e-5, 1e-5])))[0] / 2e-5)
    spring = second_kg * (2.0 * np.pi * second_hz) ** 2
    inverse = np.diag([1.0 / mass_kg, 1.0 / second_kg])
    both = np.array([[stiffness + spring, -spring], [-spring, spring]])
    expected_hz = np.sort(np.sqrt(np.linalg.eigvals(inverse @ both).real)) / (2.0 * np.pi)
    voltage_v = np.zeros(200000)
    lengths = moved(unmodelled, voltage_v, **plain)[20000:]
    spectrum = np.abs(np.fft.rfft((lengths - lengths.mean()) * np.hanning(lengths.size)))
    frequency_hz = np.fft.rfftfreq(lengths.size, 1e-4)
    # the large swing from the free length is not quite linear
    for low, high, hz in ((1.0, 7.5, expected_hz[0]), (10.0, 20.0, expected_hz[1])):
        inside = (frequency_hz > low) & (frequency_hz < high)
        peak_hz = frequency_hz[inside][np.argmax(spectrum[inside])]
        assert peak_hz == pytest.approx(hz, rel=0.05)
