"""Lines in the spectrum of an output that is updated once per block, at a known time."""

import numpy as np
import pytest

from haselab.sensing import LockinConfig
from haselab.sensing.block.tones import find_lines

RATE_HZ, BLOCK = 200e3, 2000


def blocks(tone_hz: float) -> np.ndarray:
    """16 blocks with a step at sample 400 of each, noise of one code and a tone of 20 codes."""
    rng = np.random.default_rng(1)
    levels = np.cumsum(rng.uniform(50.0, 150.0, 17))
    at = np.arange(16 * BLOCK)
    drive = levels[(at + BLOCK - 400) // BLOCK]
    carrier = 60.0 * np.cos(2 * np.pi * 2000.0 * at / RATE_HZ)
    tone = 20.0 * np.cos(2 * np.pi * tone_hz * at / RATE_HZ)
    pair = np.stack([drive + carrier + tone, carrier], axis=1)
    return (pair + rng.standard_normal(pair.shape)).reshape(16, BLOCK, 2)


def test_the_staircase_of_known_updates_is_no_tone_and_a_tone_beside_it_is_found():
    known = LockinConfig(RATE_HZ, BLOCK, 2000.0, 0.0, 2.5e6, blank=(400, 500))
    (found,) = (hz for hz in find_lines(blocks(5650.0), known).hz if hz > 1000.0)  # above the ramp
    assert found == pytest.approx(5650.0, abs=2.0)  # a third of a line of the spectrum
    unknown = LockinConfig(RATE_HZ, BLOCK, 2000.0, 0.0, 2.5e6, search_updates=True)
    lines = find_lines(blocks(5650.0), unknown).hz
    assert sum(abs(hz / 100.0 - round(hz / 100.0)) < 0.02 for hz in lines) >= 4
