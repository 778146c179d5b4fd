"""`haselab run --rig chip.toml`: the chip behind the same runtime, session file and report."""

from __future__ import annotations

import contextlib
import json
import os
import select
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab import _core
from haselab.base import DeviceError, InputError, LimitError, SafetyError
from haselab.cli.main import main
from haselab.firmware import ChipSettings
from haselab.firmware.messages import Ack, Result, Run, SetReference, Trace
from haselab.models.maps import VoltageMap
from haselab.rig import Rig
from haselab.rig.checks import LivePlan, live_checks
from haselab.rig.chip import ChipBench, CoSim, Firmware, SerialChip
from haselab.rig.chip.chip_bench import describe_chip
from haselab.rig.chip.link import ChipLink
from haselab.rig.operator import BenchStand, OperatorWeights
from haselab.rig.twin.twin_bench import TwinBench
from haselab.safety.guarded import GuardedRig, guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.sensing import sense_quadrature
from haselab.store.session.writer import SessionReader

DATA = Path(__file__).resolve().parent / "data"
CHIP_RIG = f"""
kind = "chip"
run = "{DATA}"
structure = "pid"
[simulator]
reading = "hz"
seed = 3
"""
STEPS = """
name = "steps on the chip"
[step_trials]
step = 0.03
zero_s = 6.0
step_s = 4.0
rest_s = 0.3
frame_rate_hz = 40.0
trials = 2
"""


class NoCamera:
    def start(self, rate_hz: float) -> None: ...
    def stop(self) -> None: ...
    def take(self) -> None: ...


def rig_of(bench: ChipBench, settings: ChipSettings) -> Rig:
    described = describe_chip(
        settings, shell_area_m2=1e-4, lateral_stretch=3.0, scale_m_per_px=1e-4, mass_kg=0.25
    )
    stand = BenchStand(OperatorWeights(), bench)
    return Rig(described, bench, bench, bench, NoCamera(), stand, controller=bench)


def armed(
    bench: ChipBench, settings: ChipSettings, safety: SafetySettings | None = None
) -> GuardedRig:
    rig = guard(rig_of(bench, settings), Safety(safety or SafetySettings()))
    request = rig.safety.request()
    rig.safety.arm(request, acknowledged=request.reason)
    rig.safety.run()
    return rig


@pytest.fixture
def bench(chip: CoSim, settings: ChipSettings) -> ChipBench:
    return ChipBench(chip, settings)


class Told(ChipBench):
    """Keeps what the chip reported, to compare with what was recorded."""

    def _append(self, trace: Trace) -> None:
        self.reported: list[Trace]
        if not hasattr(self, "reported"):
            self.reported = []
        self.reported.append(trace)
        super()._append(trace)


def follow(rig: GuardedRig, strain: float, blocks: int) -> np.ndarray:
    assert rig.controller is not None
    codes = []
    for _ in range(blocks):
        rig.controller.follow(strain)
        codes.append(rig.acquisition.read())
    return np.concatenate(codes)


def test_the_loop_reaches_its_strain_and_every_way_out_is_0_v(
    chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    rig = armed(bench, settings)
    follow(rig, 0.03, 400)
    wanted_v = VoltageMap(*settings.voltage_map).voltage_v(np.array([0.03]))[0]
    assert rig.present_drive_v == pytest.approx(wanted_v, abs=0.3)  # the plant is not its map
    assert chip.outputs[-1].on
    rig.safe()
    assert not chip.outputs[-1].on
    assert not chip.outputs[-1].enable
    assert rig.read_back().at_zero


def test_what_is_recorded_gives_the_chips_strain_bit_for_bit(
    chip: CoSim, settings: ChipSettings
) -> None:
    bench = Told(chip, settings)
    rig = armed(bench, settings)
    codes = follow(rig, 0.02, 100)
    capacitance_f = sense_quadrature(codes, settings)
    rows = [tuple(map(int, row)) for row in codes.reshape(-1, 8)]
    reported = bench.reported
    first = next(
        k for k in range(len(reported)) if [t.codes for t in reported[k : k + len(rows)]] == rows
    )
    compared = 0
    for trace, farad in zip(reported[first:], capacitance_f, strict=False):
        if np.isfinite(farad):
            strain = _core.strain_from_capacitance(*settings.strain_map, farad)
            assert struct.pack("<f", strain) == struct.pack("<f", trace.strain)
            compared += 1
    assert compared > 950


def test_a_chip_with_another_firmware_is_refused(chip: CoSim, settings: ChipSettings) -> None:
    other = ChipSettings(**{**vars(settings), "kp": settings.kp * 1.01})
    with pytest.raises(
        InputError, match=r"The microcontroller has settings .* needs .* Build with 'haselab fir"
    ):
        ChipBench(chip, other)


def test_a_drive_or_a_strain_that_the_chip_does_not_take_is_refused_before_it_is_armed(
    chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    rig = armed(bench, settings)
    with pytest.raises(LimitError, match=r"accepts only 0 V\. Request a strain"):
        rig.source.write(0.5)
    with pytest.raises(LimitError, match=r"desired strain = 0\.5 is outside"):
        follow(rig, 0.5, 1)
    with pytest.raises(LimitError, match=r"carrier of the microcontroller = 2000 Hz is outside"):
        rig.generator.sine(2000.0, 0.02)
    assert not any(out.enable for out in chip.outputs)


def test_a_known_capacitor_is_measured_with_the_loop_open(
    chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    """10 bits and four readings of each channel: 0.1 % of rounding; the stage's tolerances, 5 %."""
    known_f = 500e-12
    chip.command(f"connect {known_f} 5e3")
    rig = armed(bench, settings)
    first = len(chip.outputs)
    (found,) = [each for each in live_checks(rig, LivePlan(known_f)) if "capacitor" in each.what]
    assert found.passed and "multiply both numbers of front_end.correction by" in found.found
    factor = float(found.found.rpartition(" ")[2])
    assert factor == pytest.approx(known_f / chip_measured_f(found.found), rel=1e-3)
    assert any(out.enable for out in chip.outputs[first:])  # it was armed
    assert not any(out.on and out.code for out in chip.outputs[first:])  # and put out 0 V
    assert not chip.outputs[-1].enable and rig.read_back().at_zero


def chip_measured_f(text: str) -> float:
    return 1e-12 * float(text.split()[1])


def test_a_capacitor_outside_the_strain_map_trips_and_names_the_range(
    chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    chip.command(f"connect {3.0 * settings.capacitance_range_f[1]} 5e3")
    rig = armed(bench, settings)
    assert rig.controller is not None
    with pytest.raises(SafetyError, match=r"tripped: .* Only capacitances of .* pF, those of its"):
        rig.controller.measure_capacitance_f()
    rig.safe()
    assert not chip.outputs[-1].enable


def test_a_capacitance_is_only_measured_while_the_bench_is_armed(
    chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    rig = guard(rig_of(bench, settings))
    assert rig.controller is not None
    with pytest.raises(SafetyError, match="The bench is off"):
        rig.controller.measure_capacitance_f()
    assert not any(out.enable for out in chip.outputs)
    rig = armed(bench, settings)
    assert rig.controller is not None
    follow(rig, 0.02, 20)
    with pytest.raises(DeviceError, match="has closed its loop"):
        rig.controller.measure_capacitance_f()


def test_nothing_moves_before_the_bench_is_armed(
    chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    rig = guard(rig_of(bench, settings))
    with pytest.raises(SafetyError, match="The bench is off"):
        follow(rig, 0.02, 1)
    assert not any(out.enable for out in chip.outputs)


@pytest.mark.parametrize(
    ("fault", "reason"), [("breakdown", "breakdown"), ("wire_i", "sensing"), ("carrier", "sensing")]
)
def test_a_trip_of_the_chip_ends_the_loop_with_its_reason(
    fault: str, reason: str, chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    rig = armed(bench, settings)
    follow(rig, 0.03, 100)
    at_s = chip.fault(fault)
    with pytest.raises(SafetyError, match=rf"The microcontroller tripped: {reason}"):
        follow(rig, 0.03, 10)
    off = next(out for out in chip.outputs if out.time_s > at_s and not out.enable)
    assert off.time_s - at_s < 5e-3
    rig.safe()
    assert not chip.outputs[-1].on


def test_a_trip_is_reported_when_a_new_reference_is_sent(
    chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    rig = armed(bench, settings)
    follow(rig, 0.02, 50)
    chip.fault("breakdown")
    chip.run(3e-3)
    with pytest.raises(SafetyError, match="The microcontroller tripped: breakdown"):
        follow(rig, 0.03, 10)


def test_a_chip_that_sees_no_carrier_says_so_when_it_is_armed(
    chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    rig = armed(bench, settings)
    chip.fault("carrier")
    with pytest.raises(SafetyError, match="The microcontroller tripped: sensing"):
        follow(rig, 0.02, 1)
    assert not chip.outputs[-1].on


def test_one_bad_update_at_the_moment_of_running_is_no_fault(
    chip: CoSim, bench: ChipBench, settings: ChipSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig, asked, plain = armed(bench, settings), [], chip.query

    def once_blind(message: object, wait_s: float | None = None) -> object:
        asked.append(message)
        if isinstance(message, Run) and sum(isinstance(m, Run) for m in asked) == 1:
            chip.run(1e-3)
            return Ack(Run.CODE, 0, Result.NOT_READY, 0)
        return plain(message, wait_s)

    monkeypatch.setattr(chip, "query", once_blind)
    follow(rig, 0.02, 50)
    assert chip.outputs[-1].on


def test_what_passes_while_the_output_goes_down_belongs_to_no_block(
    chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    rig = armed(bench, settings)
    follow(rig, 0.03, 100)
    rig.source.zero()
    before_s = chip.time_s
    rig.plain.stand.wait(0.3)
    assert chip.time_s - before_s == pytest.approx(0.3, abs=0.02)
    rig.acquisition.read()
    assert rig.present_drive_v == 0.0


def test_a_chip_that_is_reset_says_why(
    chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    rig = armed(bench, settings)
    follow(rig, 0.03, 50)
    chip.fault("brown_out")
    with pytest.raises(SafetyError, match="The microcontroller tripped: brown_out"):
        follow(rig, 0.03, 20)
    rig.safe()
    assert not chip.outputs[-1].on
    assert rig.read_back().at_zero


def test_zero_comes_first_though_a_command_was_refused(
    chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    rig = armed(bench, settings)
    follow(rig, 0.03, 50)
    chip.send(SetReference(5.0))  # beyond what is compiled in
    rig.source.zero()
    assert not chip.outputs[-1].on
    follow(rig, 0.03, 50)
    chip.send(SetReference(5.0))
    with pytest.raises(DeviceError, match="refused command 5: bad_value"):
        follow(rig, 0.03, 3)


def test_a_program_that_stops_reading_lets_the_chip_ramp_down_by_itself(
    chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    rig = armed(bench, settings)
    follow(rig, 0.03, 100)
    CoSim.run(chip, 1.0)  # the program hangs; the chip goes on
    assert not chip.outputs[-1].on
    with pytest.raises(SafetyError, match="The microcontroller tripped: link"):
        follow(rig, 0.03, 200)


def test_lost_updates_are_a_gap_in_the_recording(
    chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    rig = armed(bench, settings)
    follow(rig, 0.0, 10)
    chip.run(0.004)
    chip.messages.clear()  # lost on the way
    with pytest.raises(DeviceError, match=r"Gap in the recording"):
        follow(rig, 0.0, 3)
    rig.safe()
    assert not chip.outputs[-1].on


def test_a_chip_that_tripped_is_cleared_by_whoever_arms_again(
    chip: CoSim, bench: ChipBench, settings: ChipSettings
) -> None:
    rig = armed(bench, settings)
    follow(rig, 0.03, 50)
    chip.fault("carrier")
    with pytest.raises(SafetyError, match="sensing"):
        follow(rig, 0.03, 10)
    rig.safe()
    chip.fault("none")
    again = armed(bench, settings)
    follow(again, 0.03, 200)
    assert chip.outputs[-1].on
    again.safe()


# ---- on a serial port ------------------------------------------------------------------------


class _Raw(CoSim):
    """The chip's bytes as they are."""

    def decoded(self, data: bytes) -> list[Any]:
        self.raw = getattr(self, "raw", b"") + data
        return []


@contextlib.contextmanager
def behind_port(chip: _Raw) -> Iterator[str]:
    """A pseudo-terminal whose other end is the chip, at a fifth of the clock's speed."""
    pty = pytest.importorskip("pty", reason="pseudo-terminals are POSIX's")
    tty = pytest.importorskip("tty", reason="pseudo-terminals are POSIX's")
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    done = threading.Event()

    def pump() -> None:
        while not done.is_set():
            if select.select([ours], [], [], 0.0)[0]:
                chip.put(os.read(ours, 4096))
            chip.command("run 16000")
            data, chip.raw = chip.raw, b""
            if data and select.select([], [ours], [], 0.5)[1]:
                os.write(ours, data)
            time.sleep(4e-3)  # slower than the clock, and nothing is made up for after a stall

    thread = threading.Thread(target=pump, daemon=True)
    thread.start()
    try:
        yield os.ttyname(theirs)
    finally:
        done.set()
        thread.join()
        os.close(ours)
        os.close(theirs)


def test_on_a_serial_port_it_is_the_same_bench(
    firmware: Firmware, cosim_program: Path, twin: TwinBench, settings: ChipSettings
) -> None:
    with _Raw(cosim_program, firmware.elf, twin) as chip:
        chip.raw = b""
        chip.run(0.02)
        with behind_port(chip) as port:
            link: ChipLink = SerialChip(port, patience_s=60.0, reset_s=0.05)
            bench = ChipBench(link, settings)
            # As on a port: the clock is the wall's. The chip meets its own deadlines.
            rig = armed(bench, settings, SafetySettings(real_time=True))
            codes = follow(rig, 0.02, 60)
            assert np.isfinite(sense_quadrature(codes, settings)[1:]).mean() > 0.9
            assert chip.outputs[-1].on
            rig.safe()
            assert not chip.outputs[-1].on
            bench.close()


def test_a_missing_port_is_reported_in_one_line() -> None:
    with pytest.raises(DeviceError, match=r"serial port does not work .*change port\. /dev/none"):
        SerialChip("/dev/none")


# ---- by the command --------------------------------------------------------------------------


def command(*arguments: object) -> object:
    with pytest.raises(SystemExit) as stop:
        main([str(item) for item in arguments])
    return stop.value.code


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory, cosim_program: Path) -> Path:
    """The folder of a run on the chip."""
    del cosim_program  # skips where the tools are missing
    folder = tmp_path_factory.mktemp("chip")
    (folder / "chip.toml").write_text(CHIP_RIG, encoding="utf-8")
    (folder / "steps.toml").write_text(STEPS, encoding="utf-8")
    code = command(
        "run", folder / "steps.toml", "--rig", folder / "chip.toml", "--out", folder / "out"
    )
    assert code == 0
    return folder / "out"


def test_a_study_of_steps_runs_on_the_chip_and_reports(played: Path) -> None:
    rows = json.loads((played / "results.json").read_text())["quantities"]
    found = {row["id"]: row["measured"]["value"] for row in rows}
    assert 0.02 < found["S26.rise"] < 0.3  # the PID of this study: 0.08 s, and 0.025 s a frame
    assert abs(found["S26.error"]) < 0.03
    assert 0.0 <= found["S26.overshoot"] < 0.5
    page = (played / "report.html").read_text()
    assert "loop on the chip" in page
    assert "is left out" not in page
    with SessionReader(played / "session.h5") as session:
        record = session.experiment("chip-2")
        reported = [what for _, what in session.events()]
    assert record.codes.shape == (1050, 40, 2)
    assert record.drive_v.max() > 0.5
    lead = np.isnan(record.reference)
    assert lead.sum() == 50
    assert record.drive_v[lead].max() == 0.0  # the camera's reference is taken at rest
    assert abs(record.frame_time_s[0] - record.block_start_s[0]) < 2.0 / 40.0
    assert reported.count("end chip-2") == 1


def test_the_recording_alone_gives_the_same_numbers(played: Path, tmp_path: Path) -> None:
    assert command("analyse", played, "--out", tmp_path) == 0
    again = json.loads((tmp_path / "results.json").read_text())
    assert again == json.loads((played / "results.json").read_text())


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        ("[simulator]", "either port or a table simulator"),
        (f'run = "{DATA}"', "the file has no key run (folder"),
    ],
)
def test_a_rig_file_without_what_it_needs_is_one_line(
    change: str, reported: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = CHIP_RIG.replace(change, "").replace('reading = "hz"\nseed = 3\n', "")
    (tmp_path / "chip.toml").write_text(text, encoding="utf-8")
    (tmp_path / "steps.toml").write_text(STEPS, encoding="utf-8")
    out = tmp_path / "out"
    code = command("run", tmp_path / "steps.toml", "--rig", tmp_path / "chip.toml", "--out", out)
    assert code == 2
    said = capsys.readouterr().err
    assert reported in said
    assert "Traceback" not in said
    assert not (tmp_path / "out").exists()


def test_a_whole_study_is_refused_on_a_chip_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "chip.toml").write_text(CHIP_RIG, encoding="utf-8")
    study = DATA.parents[2] / "src/haselab/study/studies/hasel-iros2018.toml"
    code = command("run", study, "--rig", tmp_path / "chip.toml", "--out", tmp_path / "out")
    assert code == 2
    assert "no table [step_trials]" in capsys.readouterr().err
    (tmp_path / "twin.toml").write_text('kind = "twin"', encoding="utf-8")
    (tmp_path / "steps.toml").write_text(STEPS, encoding="utf-8")
    code = command("run", tmp_path / "steps.toml", "--rig", tmp_path / "twin.toml", "--out",
                   tmp_path / "out")  # fmt: skip
    assert code == 2
    assert 'which needs a rig with kind = "chip"' in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "wrong", "reported"),
    [
        (CHIP_RIG + "[front_end]\ncorrection = [0.0, 0.0]\n", STEPS, "a magnitude of 0.1 to 10"),
        (CHIP_RIG + "[front_end]\ncorrection = [0.0, 1.0]\n", STEPS, "a phase of -45 to 45 deg"),
        (CHIP_RIG + "[front_end]\ncorrection = [-1.0, 0.0]\n", STEPS, "a phase of -45 to 45 deg"),
        (CHIP_RIG + "[front_end]\ncarrier_high_v = inf\n", STEPS, "front_end.carrier_high_v"),
        (CHIP_RIG + 'twin = "x.toml"\n', STEPS, "either twin or reading"),
        (CHIP_RIG, STEPS.replace("step = 0.03", "step = 0.0"), "step must not be 0"),
        (CHIP_RIG, STEPS.replace("step = 0.03", "step = nan"), "step_trials.step"),
        (CHIP_RIG, STEPS.replace("step = 0.03", "step = 0.3"), "desired strain = 0.3 is outside"),
    ],
)
def test_what_cannot_be_played_is_one_line_before_anything_is_armed(
    text: str, wrong: str, reported: str, tmp_path: Path, capsys: pytest.CaptureFixture[str],
    cosim_program: Path,
) -> None:  # fmt: skip
    del cosim_program
    (tmp_path / "chip.toml").write_text(text, encoding="utf-8")
    (tmp_path / "steps.toml").write_text(wrong, encoding="utf-8")
    out = tmp_path / "out"
    code = command("run", tmp_path / "steps.toml", "--rig", tmp_path / "chip.toml", "--out", out)
    assert code == 2
    assert reported in capsys.readouterr().err
    assert not (out / "session.h5").exists()


def test_ctrl_c_in_a_terminal_stops_the_chip_before_it_ends(
    tmp_path: Path, cosim_program: Path
) -> None:
    """A terminal sends it to the whole group; the simulation must keep running to be stopped."""
    del cosim_program
    (tmp_path / "chip.toml").write_text(CHIP_RIG, encoding="utf-8")
    steps = STEPS.replace("zero_s = 6.0", "zero_s = 600.0")
    (tmp_path / "steps.toml").write_text(steps, encoding="utf-8")
    line = [sys.executable, "-m", "haselab.cli", "run", "steps.toml", "--rig", "chip.toml", "--out",
            "out"]  # fmt: skip
    with subprocess.Popen(
        line, cwd=tmp_path, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as program:
        end_s = time.monotonic() + 300.0
        while time.monotonic() < end_s and not _closed(tmp_path / "out" / "session.h5"):
            time.sleep(0.2)
        os.killpg(program.pid, signal.SIGINT)
        _, said = program.communicate(timeout=300.0)
    assert program.returncode == 130, said
    with SessionReader(tmp_path / "out" / "session.h5") as session:
        reported = [what for _, what in session.events()]
    assert reported[-1] == "ended by KeyboardInterrupt; output at 0 V"


def _closed(path: Path) -> bool:
    """The loop runs: blocks with an output have been recorded."""
    try:
        with SessionReader(path) as session:
            return bool(session.experiment("chip-1").drive_v[-20:].max() > 0.1)
    except (InputError, ValueError, OSError, KeyError):
        return False
