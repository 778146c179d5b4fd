"""A monitor that drops out or sticks for a part of a block is named; a swing of C is no break."""

import numpy as np
import pytest

from haselab.sensing import LockinConfig
from haselab.sensing.block.dropouts import find_breaks
from haselab.sensing.block.segments import Segments

CONFIG = LockinConfig(200e3, 2000, 2000.0, 0.0, 2.5e6, search_updates=True)
STD = 1e-3


def searched(rng, current, stuck=None, used=None):
    """Segments of a constant voltage and of a current with a factor each, with noise."""
    segments = Segments(CONFIG)
    count = segments.count
    phasors = np.stack([np.full(count, 0.025 + 0j), 0.08j * np.asarray(current)])[np.newaxis]
    scale = STD * np.sqrt(segments.quadrature)
    noise = rng.standard_normal(phasors.shape) + 1j * rng.standard_normal(phasors.shape)
    nothing = np.zeros((1, 2, count), dtype=bool)
    return find_breaks(
        phasors + scale * noise,
        np.ones((1, count), dtype=bool) if used is None else used,
        nothing if stuck is None else stuck,
        np.full((1, 2), STD**2),
        segments,
    )


@pytest.mark.parametrize(
    ("lost", "factor", "text"),
    [
        (slice(6, 12), 0.0, "current monitor lost from 3 to 6 ms"),
        (slice(0, 14), 0.0, "current monitor lost from 0 to 7 ms"),
        (slice(5, 13), 0.5, "current monitor at 50 % from 2.5 to 6.5 ms"),
    ],
)
def test_a_stretch_with_another_quotient_is_refused_and_named(rng, lost, factor, text):
    current = np.ones(20)
    current[lost] = factor
    found = searched(rng, current)
    assert found.refused[0]
    # The segments at the edges belong to either part.
    assert found.texts[0].split(" from ")[0] == text.split(" from ")[0]
    edges = [float(word) for word in found.texts[0].split() if word.replace(".", "").isdigit()]
    known = [float(word) for word in text.split() if word.replace(".", "").isdigit()]
    assert edges[-2:] == pytest.approx(known[-2:], abs=0.5 + 1e-9)


@pytest.mark.parametrize("depth", [0.0, 0.05, 0.2])
def test_noise_and_a_smooth_swing_are_no_break(rng, depth):
    for _ in range(50):
        swing = 1.0 + depth * np.sin(np.linspace(0.0, 1.3, 20) + rng.uniform(0.0, 6.0))
        found = searched(rng, swing)
        assert not found.refused[0]
        assert found.texts == [""]


@pytest.mark.parametrize(("still", "refused"), [(3, False), (12, True)])
def test_stuck_segments_are_left_out_with_their_neighbours(rng, still, refused):
    stuck = np.zeros((1, 2, 20), dtype=bool)
    stuck[0, 1, 4 : 4 + still] = True
    found = searched(rng, np.ones(20), stuck=stuck)
    assert found.refused[0] == refused
    assert found.texts[0] == f"current monitor stuck for {0.5 * still:.2g} ms"
    if not refused:
        assert np.flatnonzero(~found.used[0]).tolist() == list(range(3, 5 + still))
