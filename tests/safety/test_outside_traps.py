"""A bench made safe from outside while its instruments, and other programs, get in the way."""

from __future__ import annotations

import contextlib
import socket
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from haselab.rig.bench_config import BenchConfig
from haselab.rig.instruments.keysight33500.generator import KeysightGenerator
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.faults import BenchFaults
from haselab.rig.twin.serve.generator.scpi import GeneratorFaults
from haselab.rig.twin.serve.server import ServedTwin
from haselab.rig.twin.serve.supply.server import SupplyFaults
from haselab.safety.guardian import make_safe as outside
from haselab.safety.guardian.make_safe import make_safe

for needed in ("pty", "serial", "pymeasure", "pyvisa_py", "nidaqmx", "grpc"):
    pytest.importorskip(needed, reason="the served twin's drivers")

GUARD_S = 300.0
EXTERNAL = SupplyFaults(
    left_by=("SVset 3000", "SSwSrc 1", "SSwMode 1"), external_high=True, external_v=3000.0
)
ALL_OFF = [("daq", ""), ("supply", ""), ("generator", "")]


@contextlib.contextmanager
def served(**faults: Any) -> Iterator[ServedTwin]:
    with ServedTwin(twin_of_reading("hz"), 1, pace=0.0, faults=BenchFaults(**faults)) as twin:
        yield twin


def config_of(twin: ServedTwin, *, supply: bool = True) -> BenchConfig:
    data = tomllib.loads(twin.rig_file())
    data["daq"]["server_patience_s"] = 30.0
    if not supply:
        del data["supply"]
    return BenchConfig.model_validate(data)


def carrier_v(twin: ServedTwin) -> float:
    return float(twin.hub.bench._native.carrier_v)


def held(twin: ServedTwin) -> socket.socket:
    """A connection of somebody else, which the generator has taken."""
    port = int(twin.generator.address.split("::")[2])
    link = socket.create_connection(("127.0.0.1", port), timeout=GUARD_S)
    link.sendall(b"*OPC?\n")
    assert link.recv(16) == b"1\n"
    return link


# ---- the supply ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "faults",
    [
        EXTERNAL,
        SupplyFaults(left_by=("SVset 3000", "SP 255", "SSwMode 3")),
        SupplyFaults(stored_set_v=2500),
        SupplyFaults(left_by=("SVset 900", "SSwSrc 2"), button_down=True),
        SupplyFaults(fragment=b"AT", stale=b"Err\r\n", left_by=("SVset 900", "SSwMode 1")),
    ],
)
def test_a_supply_that_was_left_on_somehow_is_off_by_its_meter_too(faults: SupplyFaults) -> None:
    with served(supply=faults) as twin:
        assert make_safe(config_of(twin)) == ALL_OFF
        assert twin.hub.rail_v == 0.0
        # The meter has ten bits: it shows whole steps, rounded.
        step_v = faults.reach_v / 1023
        assert twin.supply.converter_v <= 50.0 + step_v


def test_a_converter_that_stays_charged_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("haselab.rig.instruments.petapicovoltron.supply.DISCHARGE_S", 0.2)
    with served(supply=SupplyFaults(stuck_v=900.0)) as twin:
        found = dict(make_safe(config_of(twin)))
        assert "not confirmed off: its meter shows" in found.pop("supply")
        assert set(found.values()) == {""}


@pytest.mark.parametrize("way", ["guardian", "rig safe"])
@pytest.mark.long
def test_the_processes_that_make_a_bench_safe_open_an_external_switch(
    way: str, tmp_path: Path
) -> None:
    """Each as the program that it is, with the generator's other connection in use."""
    with served(supply=EXTERNAL) as twin:
        rig = tmp_path / "rig.toml"
        rig.write_text(twin.rig_file())
        generator = KeysightGenerator(config_of(twin).generator)
        generator.sine(2000.0, 0.02)
        assert (twin.hub.rail_v, carrier_v(twin)) == (3000.0, 0.02)
        if way == "guardian":
            code = ["-m", "haselab.safety.guardian.process", str(rig), "0", str(tmp_path / "log")]
            reported = subprocess.run(
                [sys.executable, *code], input="safe test\n", text=True, capture_output=True,
                timeout=GUARD_S, check=False,
            )  # fmt: skip
            assert reported.stdout.splitlines()[-1] == "acted test", reported
        else:
            reported = subprocess.run(
                [sys.executable, "-m", "haselab.cli", "rig", "safe", str(rig)], text=True,
                capture_output=True, timeout=GUARD_S, check=False,
            )  # fmt: skip
            assert reported.returncode == 0, reported
            assert "FAILED" not in reported.stdout
        assert (twin.hub.rail_v, carrier_v(twin)) == (0.0, 0.0)
        generator.close()


# ---- the generator's connections ----------------------------------------------------------------


def old_act(config: BenchConfig) -> bool:
    """How the carrier was switched off before: a driver of its own, next to the program's."""
    with contextlib.suppress(Exception):
        KeysightGenerator(config.generator).close()
        return True
    return False


def all_at_once(config: BenchConfig, programs: int) -> list[list[tuple[str, str]]]:
    """What each of these programs reports when they make a bench safe at the same time."""
    found: list[list[tuple[str, str]]] = []
    threads = [
        threading.Thread(target=lambda: found.append(make_safe(config))) for _ in range(programs)
    ]
    for each in threads:
        each.start()
    for each in threads:
        each.join(GUARD_S)
    return found


def test_program_guardians_and_rig_safe_get_along_with_two_connections() -> None:
    with served() as twin:
        config = config_of(twin, supply=False)
        generator = KeysightGenerator(config.generator)
        generator.sine(2000.0, 0.02)
        assert all_at_once(config, 3) == [[("daq", ""), ("generator", "")]] * 3
        assert carrier_v(twin) == 0.0
        assert generator.is_off()
        generator.close()


def test_a_board_that_six_programs_make_safe_at_once_is_safe_for_each() -> None:
    """Each resets the tasks of the others, again and again."""
    with served() as twin:
        config = config_of(twin, supply=False)
        for _ in range(10):
            assert [dict(rows)["daq"] for rows in all_at_once(config, 6)] == [""] * 6


def test_with_both_connections_in_use_the_old_way_is_refused_and_the_new_one_waits() -> None:
    with served() as twin, contextlib.ExitStack() as closing:
        config = config_of(twin, supply=False)
        generator = KeysightGenerator(config.generator)
        generator.sine(2000.0, 0.02)
        other = closing.enter_context(held(twin))
        assert not old_act(config)
        assert carrier_v(twin) == 0.02
        refused_before = twin.generator.refused
        found: list[list[tuple[str, str]]] = []
        thread = threading.Thread(target=lambda: found.append(make_safe(config)))
        thread.start()
        end_s = time.monotonic() + GUARD_S
        while twin.generator.refused == refused_before and time.monotonic() < end_s:
            time.sleep(0.005)
        other.close()
        thread.join(GUARD_S)
        assert found == [[("daq", ""), ("generator", "")]]
        assert carrier_v(twin) == 0.0
        generator.close()


def test_an_unreachable_generator_is_reported_and_does_not_delay_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(outside, "_REFUSED_S", 0.2)
    with served(supply=EXTERNAL) as twin, held(twin):
        config = config_of(twin)
        generator = KeysightGenerator(config.generator)
        generator.sine(2000.0, 0.02)
        found = dict(make_safe(config))
        assert "the connection failed" in found.pop("generator")
        assert set(found.values()) == {""}
        assert twin.hub.rail_v == 0.0
        generator.off()  # by the program that holds the connection, once its permission is gone
        assert carrier_v(twin) == 0.0
        generator.close()


def test_a_burst_left_by_an_earlier_user_is_switched_off_as_well() -> None:
    panel = ("OUTP1 ON", "BURS:STAT ON", "TRAC ON")
    with served(generator=GeneratorFaults(panel=panel)) as twin:
        assert make_safe(config_of(twin)) == ALL_OFF
        assert twin.generator.answer("OUTP1?;:OUTP2?") == b"0;0\n"
