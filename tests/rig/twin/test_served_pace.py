"""The clock of the served twin: samples come between its events, too."""

import sys
from types import SimpleNamespace

import pytest

from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve import hub as hub_module
from haselab.rig.twin.serve.hub import UNDERFLOW, TwinHub

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="needs pseudo-terminals")


def test_samples_within_a_block_come_without_an_event(monkeypatch):
    """Who waited for the next event got the samples of mid-block at its end, 6 ms late."""
    monkeypatch.setattr(TwinHub, "_keep_pace", lambda self: None)  # no event wakes anybody
    with TwinHub(twin_of_reading("hz"), 1) as hub:
        hub.start_inputs()
        half = hub.description.block_samples // 2
        codes = hub.readings(0, half, timeout_s=30.0)
        assert codes is not None and len(codes) == half


@pytest.mark.parametrize(
    ("delivered_late_s", "edge_late_s", "value_late_s", "status"),
    [
        (0.0, 0.0, -1e-4, 0),
        (0.0, 0.0, 1e-3, UNDERFLOW),
        (0.0, 6e-3, 5e-3, 0),
        (0.0, 6e-3, 6.5e-3, 0),
        (0.0, 6e-3, 9e-3, UNDERFLOW),
        (1.5e-3, 0.0, 1e-3, 0),
        (1.5e-3, 0.0, 2.5e-3, UNDERFLOW),
    ],
)
def test_an_output_is_not_late_because_the_server_ran_late(
    delivered_late_s: float,
    edge_late_s: float,
    value_late_s: float,
    status: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The server's thread is late at the end of a block, or at the edge that needs the value."""
    now = [0.0]
    monkeypatch.setattr(TwinHub, "_keep_pace", lambda self: None)
    monkeypatch.setattr(hub_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with TwinHub(twin_of_reading("hz"), 1) as hub:
        about, written = hub.description, False
        block_s, step_s = about.block_s, hub_module.TICKS / about.rate_hz
        hub.start_inputs((about.switch_in_block, about.block_samples))
        hub.queue_output([0.0])
        hub.stream(True)
        edge_s = block_s + about.switch_in_block / about.rate_hz
        for event_s, late_s in ((block_s, delivered_late_s), (edge_s, edge_late_s)):
            while now[0] < event_s:
                now[0] = min(now[0] + hub._follow_clock(), event_s)
            now[0] += late_s
            hub._note_delay(late_s)
            if value_late_s < 0.0 and event_s == edge_s:
                hub.queue_output([1.0])
                written = True
        while hub.put_out < 2 and not hub.output_status:
            if not written and now[0] >= edge_s + value_late_s:
                hub.queue_output([1.0])
                written = True
            now[0] += step_s
            hub._follow_clock()
        assert hub.output_status == status
