"""The clock of the served twin: samples come between its events, too."""

import sys

import pytest

from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.hub import TwinHub

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")


def test_samples_within_a_block_come_without_an_event(monkeypatch):
    """Who waited for the next event got the samples of mid-block at its end, 6 ms late."""
    monkeypatch.setattr(TwinHub, "_keep_pace", lambda self: None)  # no event wakes anybody
    with TwinHub(twin_of_reading("hz"), 1) as hub:
        hub.start_inputs()
        half = hub.description.block_samples // 2
        codes = hub.readings(0, half, timeout_s=30.0)
        assert codes is not None and len(codes) == half
