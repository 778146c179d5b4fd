"""Equations 2 and 3 of the study, with the numbers that its other equations ask of them."""

import numpy as np
import pytest

from haselab.base import LimitError
from haselab.sensing import relative_capacitance

EQ5_SLOPE, EQ5_OFFSET = 4.923e6, -0.276
QUARTER_TURN_RAD = np.array([np.pi / 2])


@pytest.mark.parametrize(("strain", "ratio"), [(-0.05, 6.9e-5), (0.1, 4.2e-5)])
@pytest.mark.parametrize("factor", [1.0, 1e3])
def test_the_printed_scale_requires_microvolts_and_a_thousandth_for_millivolts(
    strain, ratio, factor
):
    """Row D11b: eq. 5 over the saturation range, and the amplitude ratio it takes."""
    relative = (strain - EQ5_OFFSET) / EQ5_SLOPE
    got = relative_capacitance(
        np.array([ratio * factor]),
        np.array([1.0]),
        QUARTER_TURN_RAD,
        frequency_hz=2000.0,
        reactance_scale=2.5e6 / factor,
    )
    # The ratio is printed with two digits.
    np.testing.assert_allclose(got, relative, rtol=0.05 / 4.2)


def test_it_follows_the_sine_of_the_phase_of_either_sign():
    phase_rad = np.array([0.3, -0.3, np.pi - 0.3])
    got = relative_capacitance(np.array(0.1), np.array(0.2), phase_rad, frequency_hz=1000.0)
    expected = 1 / (2 * np.pi * 1000 * 10 * 2.5e6 * 0.5 * np.sin(0.3))
    np.testing.assert_allclose(got, expected, rtol=1e-12)


@pytest.mark.parametrize(("v_pp", "i_pp", "phase_rad"), [(0, 1, 1), (1, 0, 1), (1, 1, 0)])
def test_without_a_reactance_there_is_no_answer(v_pp, i_pp, phase_rad):
    with pytest.raises(LimitError, match="no reactance"):
        relative_capacitance(
            np.array([float(v_pp)]),
            np.array([float(i_pp)]),
            np.array([float(phase_rad)]),
            frequency_hz=2000.0,
        )
