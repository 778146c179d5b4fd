"""`haselab rig`, `twin serve`, `doctor --rig`: a bench from the outside, as processes and calls."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from haselab.cli.bench import rig as rig_commands
from haselab.cli.main import main
from haselab.rig.bench_config import BenchConfig
from haselab.rig.checks import CheckResult, LivePlan
from haselab.rig.real_bench import RealBench
from haselab.rig.rig_file import load_rig
from haselab.safety.gate import Gate
from haselab.safety.interlock import Interlock

pytest.importorskip("pty", reason="serial ports of the served twin are POSIX's")


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as stop:
        main([str(argument) for argument in arguments])
    out, err = capsys.readouterr()
    return int(stop.value.code or 0), out, err


@contextlib.contextmanager
def served(folder: Path, *options: str) -> Iterator[Path]:
    """The rig file of a twin that another process serves in lock-step."""
    (folder / "twin.toml").write_text('kind = "twin"\n')
    path = folder / "rig.toml"
    command = [sys.executable, "-m", "haselab.cli", "twin", "serve", str(folder / "twin.toml")]
    command += ["--pace", "0", "--out", str(path), *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as server:
        try:
            until = time.monotonic() + 300.0
            while not (path.exists() and path.stat().st_size):  # reserved empty, then replaced
                assert server.poll() is None and time.monotonic() < until
                time.sleep(0.05)
            yield path
        finally:
            server.send_signal(signal.SIGTERM)
            assert server.wait(20.0) == 0


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    with served(tmp_path_factory.mktemp("served")) as path:
        yield path


def test_a_fault_is_named_with_what_to_do_and_the_protocol_holds_it(tmp_path, capsys) -> None:
    with served(tmp_path, "--fault", "voltage-monitor-reversed") as path:
        save = tmp_path / "check.json"
        code, out, err = call(capsys, "rig", "check", path, "--live", "--yes", "--save", save)
    assert code == 4
    assert err.splitlines()[-1].endswith(
        "the voltage monitor has the wrong sign. First switch the amplifier and the "
        "supply off and discharge the electrodes. Swap the two wires of the voltage monitor at "
        "the board. Then run "
        f"'haselab rig check' again. File: {path}"
    )
    assert "recommended for the rig file" not in out  # the file has what was measured
    printed = json.loads(save.read_text())
    assert printed["rig"]["text"] == path.read_text()
    assert printed["rig"]["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert printed["passed"] is False and printed["recommended"] == {"daq.skew_s": 2.5e-6}
    assert [each["passed"] for each in printed["checks"]].index(False) == len(printed["checks"]) - 1
    assert printed["checks"][-1]["advice"].startswith("Swap the two wires")


def test_a_bench_that_cannot_be_opened_has_not_passed(tmp_path, capsys) -> None:
    with served(tmp_path, "--fault", "supply-stays-on") as path:
        save = tmp_path / "check.json"
        code, _, err = call(capsys, "doctor", "--rig", path)
        assert code == 0
        code, _, err = call(capsys, "rig", "check", path, "--save", save)
    printed = json.loads(save.read_text())
    assert code == 4 and "its meter shows 80" in err
    assert printed["passed"] is False
    assert "Pull the power jack of" in printed["checks"][-1]["found"]


def test_the_doctor_says_that_a_supply_is_on_and_leaves_it(tmp_path, capsys) -> None:
    with served(tmp_path, "--fault", "supply-on-at-boot") as path:
        for _ in range(2):
            code, out, _ = call(capsys, "doctor", "--rig", path)
            assert code == 0
            assert "the high-voltage supply is ON, its meter shows 19" in out
            assert "haselab rig safe RIG.toml" in out


def test_the_check_verifies_mock_dry_and_live(rig: Path, capsys) -> None:
    code, out, err = call(capsys, "rig", "check", rig, "--live", "--yes", "--json")
    assert "a step of 1 kV, a sensing signal of 100 V peak, 500 V from the supply. Keep" in err
    checks = json.loads(out)["checks"]
    assert code == 0
    assert [r["passed"] for r in checks] == [True] * len(checks)
    steps = [r["step"] for r in checks]
    assert steps == sorted(steps, key=["mock", "dry", "live"].index)
    printed = {(r["step"], r["what"]): r["found"] for r in checks}
    assert printed["dry", "source"].startswith("USB-6212, serial number ")
    assert printed["live", "time of an output"] == "sample 4408, the rig file says 4400"
    assert printed["live", "generator off"] == "off"


def test_how_late_readings_come_gives_the_outputs_that_have_to_wait(rig, tmp_path, capsys) -> None:
    """In lock-step only the bus takes its time; the rig file calls it real time."""
    path = tmp_path / "timed.toml"
    path.write_text(rig.read_text().replace("lock_step = true", "lock_step = false"))
    code, out, err = call(capsys, "rig", "check", path, "--json")
    assert code == 0, err
    row = next(r for r in json.loads(out)["checks"] if r["what"] == "read latency")
    found = re.fullmatch(r"median ([0-9.]+) ms, worst ([0-9.]+) ms", row["found"])
    assert found and 0.0 < float(found[1]) <= float(found[2]) < 2.0  # packets of a millisecond
    assert row["recommended"] == {"daq.ahead_blocks": 1.0}  # a quarter of a block to spare


def guardians() -> list[int]:
    """Process numbers of this program's guardians."""
    found = []
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):
            parent = int(stat.read_text().rpartition(")")[2].split()[1])
            line = stat.with_name("cmdline").read_bytes()
            if parent == os.getpid() and b"guardian.process" in line:
                found.append(int(stat.parent.name))
    return found


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="processes are found in /proc")
def test_a_check_whose_guardians_are_lost_ends(rig: Path, capsys, monkeypatch) -> None:
    def killed(_: object, plan: LivePlan) -> Iterator[CheckResult]:
        assert len(guardians()) == 2
        for pid in guardians():
            os.kill(pid, signal.SIGKILL)
        until = time.monotonic() + 300.0
        while time.monotonic() < until:
            plan.alive()
            time.sleep(0.01)
        yield CheckResult("live", "never", "", False)

    monkeypatch.setattr(rig_commands, "live_checks", killed)
    monkeypatch.setattr(rig_commands, "_mock", lambda file, path: iter(()))
    code, _, err = call(capsys, "rig", "check", rig, "--live", "--yes", "--acknowledge")
    assert code == 4
    assert re.search(r"Guardian [12] (\(process|has ended)", err)


def test_all_missing_drivers_are_named_at_once(rig: Path, capsys, monkeypatch) -> None:
    for package in ("nidaqmx", "pyvisa", "serial"):
        monkeypatch.setitem(sys.modules, package, None)  # import raises ModuleNotFoundError
    code, out, err = call(capsys, "rig", "check", rig)
    assert code == 4 and "FAILED  mock  drivers" in out
    assert err.count("needs the Python package") == 3, err
    for section, package in (("daq", "nidaqmx"), ("generator", "pyvisa"), ("supply", "serial")):
        assert f"{section}: " in err and f"'{package}'" in err.partition(f"{section}: ")[2]


def test_a_bench_that_a_program_uses_is_left_alone(rig: Path, capsys) -> None:
    file = load_rig(rig)
    assert isinstance(file, BenchConfig)
    with RealBench(file, Gate()):
        code, out, err = call(capsys, "rig", "check", rig)
    assert code == 4 and "is in use by" in err
    assert "board:" not in out


@pytest.mark.parametrize("number", [1, 2])
def test_the_result_goes_into_a_file_each_time(rig: Path, capsys, tmp_path, number) -> None:
    answer = tmp_path / "answer.json"
    more = ["--force"] * (number - 1)
    for _ in range(number):
        code, _, err = call(capsys, "rig", "check", rig, "--out", answer, *more)
        assert code == 0, err
    assert json.loads(answer.read_text())["checks"][-1]["passed"]


def test_the_dry_checks_put_nothing_out(rig: Path, capsys) -> None:
    code, out, _ = call(capsys, "rig", "check", rig)
    assert code == 0
    assert "live" not in out and "ok      dry   supply off" in out


@pytest.mark.parametrize(
    ("flag", "printed"),
    [
        ("--live", "add --yes"),
        ("--yes", "--yes has no effect without --live"),
        ("--acknowledge", "--acknowledge has no effect without --live"),
    ],
)
def test_high_voltage_needs_two_words(rig: Path, capsys, flag: str, printed: str) -> None:
    code, _, err = call(capsys, "rig", "check", rig, flag)
    assert code == 2 and printed in err


def test_a_wrong_serial_number_stops_the_check_and_is_found_by_the_doctor(
    rig: Path, capsys, tmp_path: Path
) -> None:
    other = tmp_path / "other.toml"
    other.write_text(rig.read_text().replace("MY00000001", "MY00000002"))
    code, out, err = call(capsys, "rig", "check", other)
    assert code == 2 and err.count("\n") == 1
    assert out.splitlines()[-1].startswith("FAILED") and out.count("FAILED") == 1
    assert "generator has the serial number MY00000001" in err
    assert "generator has the serial number MY00000001" in out.splitlines()[-1]
    code, out, _ = call(capsys, "doctor", "--rig", other, "--json")
    found = {f["name"]: f for f in json.loads(out)["findings"] if f["kind"] == "instrument"}
    assert code == 0
    assert [found[name]["found"] for name in ("daq", "generator", "supply")] == [True, False, True]
    assert "Connect that one, or change generator.serial_number" in found["generator"]["advice"]


def test_an_existing_out_does_not_keep_rig_safe_from_commanding_0_v(rig: Path, capsys) -> None:
    before = rig.read_bytes()
    for force in ([], ["--force"]):
        code, out, err = call(capsys, "rig", "safe", rig, "--out", rig, *force)
        assert code == 2 and "0 V set" in out and str(rig) in err
        assert out.count("off, as reported by the instrument") == 2
        assert rig.read_bytes() == before and not list(rig.parent.glob("*previous*"))


def test_a_bench_is_made_safe_by_a_command(rig: Path, capsys) -> None:
    code, out, err = call(capsys, "rig", "safe", rig)
    assert code == 0 and "0 V set" in out and out.count("off, as reported by the instrument") == 2
    assert err.startswith("Permission revoked.")
    assert "Revoking the permission and commanding 0 V. If this does not finish," in err


@pytest.mark.parametrize(
    "fault",
    ["kind = 3", "kind = 'bench'\n[daq]\nrate_hz = 'x'\n", "[daq", "a." * 20000 + "a = 1"],
    ids=["kind", "bench", "bracket", "dots"],
)
def test_rig_safe_on_a_file_that_cannot_be_read_says_to_switch_off_by_hand(
    fault: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rig.toml").write_text(fault)
    code, _, err = call(capsys, "rig", "safe", tmp_path / "rig.toml")
    assert code == 2
    assert "NOTHING WAS COMMANDED TO 0 V: switch the high voltage off by hand." in err


def test_a_missing_bench_is_reported_and_not_called_safe(rig: Path, capsys, tmp_path) -> None:
    gone = tmp_path / "gone.toml"
    gone.write_text(
        "\n".join(
            'server = "127.0.0.1:1"' if line.startswith("server") else line
            for line in rig.read_text().splitlines()
        )
    )
    code, out, err = call(capsys, "rig", "safe", gone)
    assert code == 4 and "FAILED  safe  daq" in out
    assert "Not confirmed at 0 V: daq. Switch the high voltage off by hand." in err
    if "serial_number" not in gone.read_text().split("[generator]")[0]:
        assert "FAILED  safe  interlock" in out and "permission NOT revoked: the board" in out
        assert "Permission not revoked: stop the program" in err


def test_what_only_a_twin_can_do_refuses_a_bench(rig: Path, capsys) -> None:
    code, _, err = call(capsys, "twin", "serve", rig)
    assert code == 2 and "kind = 'bench', but this command needs kind = 'twin'" in err


def test_a_bench_whose_program_was_killed_is_not_called_armed_by_it(
    capsys, tmp_path, monkeypatch
) -> None:
    monkeypatch.setenv("HASELAB_INTERLOCKS", str(tmp_path / "locks"))
    code = "from haselab.safety.interlock import Interlock; import os\n"
    code += "lock = Interlock('NI 01A2'); lock.own('a test'); lock.set_live(True); os._exit(0)"
    subprocess.run([sys.executable, "-c", code], check=True)
    printed = call(capsys, "rig", "status")[1]
    assert "NOT CONFIRMED AT 0 V. Its last program ended while the bench was armed" in printed


def test_the_status_names_armed_benches_and_why_others_were_made_safe(
    capsys, tmp_path, monkeypatch
) -> None:
    monkeypatch.setenv("HASELAB_INTERLOCKS", str(tmp_path / "locks"))
    assert "No bench has been used" in call(capsys, "rig", "status")[1]
    gate = Gate(Interlock("NI 01A2"))
    gate.interlock.own("a test")
    try:
        assert "not armed" in call(capsys, "rig", "status")[1]
        gate.interlock.set_live(True)
        code, printed, _ = call(capsys, "rig", "status")
        assert code == 0
        assert f"NI_01A2  ARMED by process {os.getpid()}" in printed
        Interlock("a later bench").close()
        rows = call(capsys, "rig", "status")[1].splitlines()
        assert [row.split("  ")[0] for row in rows] == ["NI_01A2", "a_later_bench"]
        (tmp_path / "locks" / "a_later_bench.state").unlink()
        gate.interlock.set_live(False)
        gate.interlock.revoke("The strain is stuck.")
        (bench,) = json.loads(call(capsys, "rig", "status", "--json")[1])["benches"]
        assert not bench["armed"]
        assert bench["reason"].startswith("The strain is stuck")
        out = tmp_path / "status.json"
        assert call(capsys, "rig", "status", "--out", out)[0] == 0
        assert json.loads(out.read_text())["benches"] == [bench]
    finally:
        gate.interlock.close()


def test_each_check_says_what_it_accepts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The limits are those of the twin: half a sample of 200 kHz, 1 % of a drive of 2 V."""
    (tmp_path / "twin.toml").write_text('kind = "twin"\n')
    code, out, _ = call(capsys, "rig", "check", tmp_path / "twin.toml", "--json")
    checks = {each["what"]: each["criterion"] for each in json.loads(out)["checks"]}
    assert code == 0
    assert [what for what, criterion in checks.items() if not criterion] == ["rig file"]
    assert checks["gaps"] == "below 0.0025 ms, half a sample"
    assert checks["0 V at once on a twin"] == "below 0.02 V"
    assert checks["size of an output on a twin"] == "within 2 %"
    code, out, _ = call(capsys, "rig", "check", tmp_path / "twin.toml")
    assert "0.000 ms between blocks (accepted: below 0.0025 ms, half a sample)" in out
