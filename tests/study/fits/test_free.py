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
