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
