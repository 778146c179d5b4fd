"""Free responses that the tracker hardly saw."""

import numpy as np
import pytest

from haselab.base import ResultError
from haselab.study.fits.free import fit_free
from haselab.study.fits.observe import Observation


def test_a_lost_mark_leaves_the_free_response_undetermined():
    none, frames = np.zeros(0), 6
    seen = Observation(
        "free-1", {}, none, none, none, none, none, none, np.arange(float(frames)),
        np.full(frames, 0.04), np.full(frames, 1e-5), np.full(frames, 0.25), 0.0, none,
    )  # fmt: skip
    with pytest.raises(ResultError, match=r"free-1: 6 frames after the drop .* and 16 are needed"):
        fit_free([seen])


def test_one_drop_has_no_scatter_and_a_note_says_so() -> None:
    time_s = np.arange(400) / 100.0
    none = np.zeros(0)
    rng = np.random.default_rng(1)

    def seen(name: str) -> Observation:
        swing = 4e-3 * np.exp(-1.2 * time_s) * np.cos(20.0 * time_s)
        length_m = 0.04 + swing + 1e-6 * rng.normal(size=time_s.size)
        return Observation(
            name, {}, none, none, none, none, none, none, time_s,
            length_m, np.full(400, 1e-5), np.full(400, 0.25), 0.0, none,
        )  # fmt: skip

    decays = {"S19.eq6_decay_1", "S19.eq6_decay_2"}
    alone = fit_free([seen("free-1")])
    assert decays <= set(alone.quantities)
    assert all("not the scatter" in alone.notes[name] for name in decays)
    assert not decays & set(fit_free([seen("free-1"), seen("free-2")]).notes)


def test_two_peaks_of_one_drop_give_no_interval_instead_of_one_of_zero_width() -> None:
    """Before, the decay through two peaks had both ends at its value, as if it were exact."""
    time_s = np.arange(400) / 200.0
    none = np.zeros(0)

    def seen(name: str, decay: float) -> Observation:
        swing = 4e-3 * np.exp(-decay * time_s) * np.cos(50.0 * time_s)
        rng = np.random.default_rng(len(name) + int(100.0 * decay))
        length_m = 0.04 + swing + 1e-6 * rng.normal(size=time_s.size)
        return Observation(
            name, {}, none, none, none, none, none, none, time_s,
            length_m, np.full(400, 1e-5), np.full(400, 0.25), 0.0, none,
        )  # fmt: skip

    alone = fit_free([seen("free-1", 14.0)])
    envelopes = {"S19.eq6_decay_1", "S19.eq6_decay_2"} & set(alone.quantities)
    assert envelopes
    for name in envelopes:
        assert np.isnan(alone.quantities[name].ci95).all()
        assert "two peaks" in alone.notes[name]
    for name in ("S19.eq6_omega_d", "S19.eq6_decay", "S19.eq6_omega_0", "S19.eq6_rms"):
        assert np.isnan(alone.quantities[name].ci95).all()
        assert "one trial: no interval" in alone.notes[name]
    twice = fit_free([seen("free-1", 14.0), seen("free-22", 14.0)])
    for name in envelopes:  # of two trials, the scatter gives one
        low, high = twice.quantities[name].ci95
        assert low < high and name not in twice.notes
