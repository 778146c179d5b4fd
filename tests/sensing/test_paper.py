"""The study's own chain: exact where it is exact, and as weak as it is where it is weak."""

import numpy as np
import pytest
from scipy import signal

from haselab.base import InputError
from haselab.sensing import Lockin, PaperChain


def test_each_step_of_the_chain_is_that_of_the_study(scene, rng):
    """Rows S6 to S9 written out again, by transfer function instead of sections."""
    readings = scene.readings(4, rng)
    b, a = signal.butter(4, 2001.0, fs=200e3)
    record = readings.reshape(-1, 2)
    start = signal.lfilter_zi(b, a)[:, np.newaxis] * record[0]
    filtered, _ = signal.lfilter(b, a, record, axis=0, zi=start)
    mean_period = filtered.reshape(4, 20, 100, 2).mean(axis=1)
    v_pp, i_pp = (mean_period.max(axis=1) - mean_period.min(axis=1)).T
    spectrum = np.fft.fft(mean_period, axis=1)[:, 1]
    phase_rad = np.angle(spectrum[:, 1] / spectrum[:, 0])
    reactance_ohm = 2.5e6 * np.abs(v_pp / i_pp) * np.sin(np.abs(phase_rad))

    sensed = PaperChain(scene.config()).sense(readings)
    # Poles at |z| = 0.94 to 0.98 in fourfold cluster: the transfer function loses 6 to 7 digits.
    np.testing.assert_allclose(sensed.v_pp, v_pp, rtol=1e-8)
    np.testing.assert_allclose(sensed.i_pp, i_pp, rtol=1e-8)
    np.testing.assert_allclose(sensed.phase_rad, phase_rad, rtol=1e-8)
    np.testing.assert_allclose(
        sensed.capacitance_f, 1 / (2 * np.pi * 2000 * reactance_ohm), rtol=1e-8
    )


def test_the_filter_goes_on_from_call_to_call(scene, rng):
    readings = scene.readings(6, rng)
    whole = PaperChain(scene.config()).sense(readings)
    chain = PaperChain(scene.config())
    parts = [chain.sense(part) for part in (readings[:1], readings[1:4], readings[4:])]
    np.testing.assert_array_equal(
        whole.capacitance_f, np.concatenate([part.capacitance_f for part in parts])
    )


def test_the_low_pass_takes_three_decibels_and_leaves_capacitance_alone(scene):
    """Row D13: a cut-off of 2,001 Hz sits on the carrier."""
    readings = scene.readings(5, None)
    paper = PaperChain(scene.config()).sense(readings)
    lockin = Lockin(scene.config()).sense(readings)
    warped = np.tan(np.pi * 2000 / 200e3) / np.tan(np.pi * 2001 / 200e3)
    gain = 1 / np.sqrt(1 + warped**8)
    # A maximum between two of 100 samples: cos(pi / 100) at the worst.
    np.testing.assert_allclose(paper.v_pp[1:], gain * lockin.v_pp[1:], rtol=1 - np.cos(np.pi / 100))
    np.testing.assert_allclose(paper.phase_rad[1:], lockin.phase_rad[1:], rtol=1e-6)
    np.testing.assert_allclose(
        paper.capacitance_f[1:], lockin.capacitance_f[1:], rtol=2 * (1 - np.cos(np.pi / 100))
    )


def test_a_ramp_biases_it_beyond_its_deviations_and_the_lock_in_by_none(scene, rng):
    case = scene.but(ramp_v_s=5.0)
    readings = case.readings(100, rng)
    errors = {}
    for method in (PaperChain, Lockin):
        sensed = method(case.config()).sense(readings)
        mean_std_f = sensed.capacitance_std_f.mean() / np.sqrt(100)
        errors[method] = (sensed.capacitance_f[1:].mean() - case.capacitance_f) / mean_std_f
    assert abs(errors[Lockin]) < 5
    assert abs(errors[PaperChain]) > 5


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"carrier_hz": 2001.0}, "whole periods"),
        ({"block_samples": 2050}, "whole periods"),
        ({"block_samples": 100}, "whole periods"),
        ({"blank": (0, 400)}, "blank"),
    ],
)
def test_what_the_chain_cannot_do_is_refused(scene, changes, words):
    with pytest.raises(InputError, match=words):
        PaperChain(scene.config(**changes))


def test_a_cut_off_beyond_half_the_rate_is_refused(scene):
    with pytest.raises(InputError, match="Cut-off"):
        PaperChain(scene.config(), cutoff_hz=100e3)
