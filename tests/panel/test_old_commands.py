"""Commands and signs of life that were delayed do not energise the bench later."""

from __future__ import annotations

import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab.base import SafetyError
from haselab.panel.bench_process import _Link
from haselab.panel.columns import LiveWriter
from haselab.panel.live_bench import LiveBench
from haselab.panel.page_leases import PageLeases
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import make_twin
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.state_machine import Stage
from tests.panel.running import WAIT_S

LEASE_S = 1.5


class Clock:
    """Stands still unless a test moves it."""

    def __init__(self) -> None:
        self.now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def bench(tmp_path: Path, clock: Clock) -> Iterator[tuple[LiveBench, GuardedRig]]:
    """The twin behind the panel, with a clock of its own for pages and commands."""
    rig = guard(make_twin(twin_of_reading("hz"), 1))
    about = rig.description
    with LiveWriter(tmp_path / "live", about.rate_hz, about.block_samples, (1.0, 1.0)) as writer:
        found = LiveBench(rig, writer, lease_s=LEASE_S)
        found._leases = found._study._leases = PageLeases(LEASE_S, clock)
        yield found, rig
        found.close()


def armed(live: LiveBench, at_s: float | None = None) -> None:
    number = live.do("request", "page", {}, at_s)["number"]
    live.do("arm", "page", {"number": number, "limit_v": 1.5}, at_s)


def test_an_old_command_to_arm_is_refused(
    bench: tuple[LiveBench, GuardedRig], clock: Clock
) -> None:
    """It waited in a page, in a stopped process or in a socket; meanwhile its page reported a
    failure, or disconnected."""
    live, rig = bench
    with pytest.raises(SafetyError, match=r"command is 1\.6 s old \(limit 1\.5 s\)"):
        armed(live, clock.now_s - 1.6)
    with pytest.raises(SafetyError, match="has no valid time"):
        armed(live, -float("inf"))
    assert not rig.safety.live and live.state.holder == ""
    armed(live, clock.now_s - 1.4)
    assert rig.safety.live


def test_a_study_is_not_played_for_a_page_that_went_while_it_was_checked(
    bench: tuple[LiveBench, GuardedRig], clock: Clock
) -> None:
    live, rig = bench

    def checking(chosen: Any) -> Any:
        clock.now_s += LEASE_S + 0.1  # without a sign of life
        return object()

    live._prepare = checking
    number = live.do("request", "page", {}, clock.now_s)["number"]
    with pytest.raises(SafetyError, match=r"No message for .* from the page that wanted to arm"):
        live.do("arm", "page", {"number": number, "limit_v": 1.5, "study": {}}, clock.now_s)
    assert not rig.safety.live and live.state.mode == "idle"


def test_a_bench_that_was_armed_too_late_is_at_zero_again(
    bench: tuple[LiveBench, GuardedRig], clock: Clock
) -> None:
    live, rig = bench
    sine = rig.generator.sine

    def slow(*given: float) -> None:
        sine(*given)
        clock.now_s += 27.1  # after 30 s, the page reports that the command failed

    vars(rig.generator)["sine"] = slow
    with pytest.raises(SafetyError, match=r"Arming took too long, so the bench was taken to 0 V\."):
        armed(live, clock.now_s)
    assert not rig.safety.live and live.state.holder == ""
    assert live.state.reason.startswith("Arming took too long")


@pytest.mark.parametrize(("what", "values"), [("drive", {"value_v": 1.0}), ("open", {})])
def test_an_old_command_does_not_move_the_output_but_old_ones_lower_it(
    bench: tuple[LiveBench, GuardedRig], clock: Clock, what: str, values: dict[str, float]
) -> None:
    live, rig = bench
    armed(live, clock.now_s)
    with pytest.raises(SafetyError, match="was not carried out"):
        live.do(what, "page", values, clock.now_s - 2.0)
    assert live.state.target_v == 0.0
    live.do("drive", "page", {"value_v": 1.0}, clock.now_s)
    live.do("drive", "page", {"value_v": 0.0}, clock.now_s - 2.0)
    assert live.state.target_v == 0.0
    live.do("disarm", "page", {}, clock.now_s - 100.0)
    assert not rig.safety.live


def test_signs_of_life_that_waited_do_not_renew_a_lease_that_has_ended(
    bench: tuple[LiveBench, GuardedRig], clock: Clock
) -> None:
    """After the computer slept, they arrive before the bench checks its clock."""
    live, rig = bench
    armed(live, clock.now_s)
    live.do("lease", "page", {}, clock.now_s + 0.4)  # from the future: it has no effect
    clock.now_s += 0.4
    live.do("lease", "page", {}, clock.now_s)
    clock.now_s += 3600.0
    live.do("lease", "page", {}, clock.now_s - 3599.9)  # sent before the pause
    live.do("lease", "page", {}, clock.now_s)  # after it
    live.step()
    assert not rig.safety.live and live.state.holder == ""
    assert live.state.reason.startswith("No message for ")


def test_a_page_that_leaves_takes_the_bench_to_zero_at_once(
    bench: tuple[LiveBench, GuardedRig], clock: Clock
) -> None:
    live, rig = bench
    armed(live, clock.now_s)
    live.do("leave", "another", {}, clock.now_s)
    assert rig.safety.live
    live.do("leave", "page", {}, clock.now_s)
    assert not rig.safety.live and "armed the bench has disconnected" in live.state.reason


def test_a_confirmation_counts_for_its_own_step_alone(
    bench: tuple[LiveBench, GuardedRig], clock: Clock
) -> None:
    """A second click on Done must not confirm that the next mass is hung."""
    live, _ = bench
    live._mode, live._holder = "study", "page"
    player = live._player
    player._show("Hang 0.1 kg.")
    first = live.state.step
    player._show("Hang 0.2 kg.")
    with pytest.raises(SafetyError, match="no longer current"):
        live.do("confirm", "page", {"step": first}, clock.now_s)
    assert not player._confirmed.is_set()
    live.do("confirm", "page", {"step": live.state.step}, clock.now_s)
    assert player._confirmed.is_set()
    live._mode, live._holder = "idle", ""


def test_a_command_without_a_time_is_refused_on_the_socket(
    bench: tuple[LiveBench, GuardedRig], tmp_path: Path
) -> None:
    live, rig = bench
    threading.Thread(target=_Link(tmp_path, live).serve, daemon=True).start()
    with socket.socket(socket.AF_UNIX) as web:
        web.settimeout(WAIT_S)
        web.connect(str(tmp_path / "bench.sock"))
        received = web.makefile()
        number = live.do("request", "page", {})["number"]
        for at_s in (None, "now", True, float("nan")):
            values = {"number": number, "limit_v": 1.5}
            command = {"id": 7, "do": "arm", "holder": "page", "values": values, "at_s": at_s}
            web.sendall(json.dumps(command).encode() + b"\n")
            answers = (json.loads(line) for line in received)
            answer = next(one for one in answers if one.get("id") == 7)
            assert "was not carried out" in answer["error"]
        assert not rig.safety.live
        web.shutdown(socket.SHUT_RDWR)


def test_an_output_that_rises_by_itself_trips_an_idle_bench(
    bench: tuple[LiveBench, GuardedRig],
) -> None:
    live, rig = bench
    for _ in range(30):
        live.step()
    assert live.state.stage == "off"
    read, by_itself_v = rig.plain.acquisition.read, 0.02  # 100 V at the output
    code = by_itself_v * rig.description.monitor_v_per_drive_v / rig.description.volt_per_code

    def ramping() -> Any:
        codes = read().copy()
        codes[:, 0] += np.int16(round(code))
        return codes

    vars(rig.acquisition)["_plain"] = type("Ramping", (), {
        "read": staticmethod(ramping), "time_s": property(lambda self: rig.plain.acquisition.time_s)
    })()  # fmt: skip
    for _ in range(25):
        live.step()
    assert rig.safety.stage is Stage.TRIPPED
    assert live.state.reason.startswith("The voltage monitor shows 1")
    assert "although the bench is not armed" in live.state.reason
    with pytest.raises(SafetyError, match="Remove the cause"):
        armed(live)


def test_no_command_is_carried_out_once_the_panel_has_ended(
    bench: tuple[LiveBench, GuardedRig], clock: Clock
) -> None:
    """A study may still be checked at that moment."""
    live, rig = bench
    number = live.do("request", "page", {})["number"]
    live.close()
    with pytest.raises(SafetyError, match="The panel has ended"):
        live.do("arm", "page", {"number": number, "limit_v": 1.5}, clock.now_s)
    assert not rig.safety.live


def test_a_study_whose_page_goes_says_so(bench: tuple[LiveBench, GuardedRig], clock: Clock) -> None:
    live, _ = bench
    live._mode, live._holder = "study", "page"
    live._study._page = "page"
    live._leases.begin("page")
    assert live._study.why_not() == ""
    live.do("leave", "page", {}, clock.now_s)
    assert live._study.why_not() == "The page that started the study has disconnected."
    live.end_study("The panel has ended.")
    gone = "The page that started the study has disconnected."
    assert live._study.why_not() == gone, "the first reason"
    live._mode, live._holder = "idle", ""


@pytest.mark.parametrize(
    "at_s", [10**400, "1000", None, True, [1000.0]], ids=["large", "text", "none", "true", "list"]
)
def test_a_command_without_a_valid_time_counts_as_old(
    bench: tuple[LiveBench, GuardedRig], capsys: pytest.CaptureFixture[str], at_s: object
) -> None:
    """The command is refused like one that was delayed, without a traceback in the terminal."""
    live, rig = bench
    link = _Link.__new__(_Link)
    link._bench = live
    number = live.do("request", "page", {})["number"]
    values = {"number": number, "limit_v": 1.0}
    answer = link._answer({"id": 1, "do": "arm", "holder": "page", "values": values, "at_s": at_s})
    assert answer["id"] == 1 and "error" in answer
    assert capsys.readouterr().err == ""
    assert not rig.safety.live
    link._answer({"id": 2, "do": "arm", "holder": "page", "values": values, "at_s": 1000.0})
    assert rig.safety.live, "the same with a number"
