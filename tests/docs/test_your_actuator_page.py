"""The commands of docs/your-actuator.md as they stand there, from records to firmware."""

import json
import re
import shlex
import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from haselab.base import InputError
from haselab.cli.main import main
from haselab.rig.chip import find_tool
from haselab.rig.chip.build import simavr_header
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.history import precondition
from haselab.rig.twin.twin_bench import TwinBench, describe
from haselab.study.definition import load_study

PAGE = Path(__file__).resolve().parents[2] / "docs" / "your-actuator.md"
TEXT = PAGE.read_text(encoding="utf-8")
COMMANDS = re.findall(r"^```\n(.*?)^```$", TEXT, flags=re.DOTALL | re.MULTILINE)[0].splitlines()
FOREIGN, _, RECORDED = (
    block.splitlines()
    for block in re.findall(r"^```sh\n(.*?)^```$", TEXT, flags=re.DOTALL | re.MULTILINE)
)
TABLES = re.findall(r"^```toml\n(.*?)^```$", TEXT, flags=re.DOTALL | re.MULTILINE)
PERIOD_S, RATE_HZ = 0.01, 100e3


def lab() -> TwinConfig:
    """The bench on which the firmware is tried later, recorded by a slower converter."""
    config = twin_of_reading("hz")
    changed = {"rate_hz": RATE_HZ, "block_samples": round(RATE_HZ * PERIOD_S), "skew_s": 0.0}
    daq = config.acquisition.model_copy(update=changed)
    return config.model_copy(update={"acquisition": daq})


def played(bench: TwinBench, drive_v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    codes, length_m = [], []
    for volt in drive_v:
        length_m.append(bench.length_m)
        bench.write(float(volt))
        codes.append(bench.read())
    return np.concatenate(codes), np.array(length_m)


def saved(path: Path, drive_v: np.ndarray, strain: np.ndarray) -> None:
    time_s = PERIOD_S * np.arange(drive_v.size)
    rows = np.column_stack([time_s, drive_v, strain])
    np.savetxt(path, rows, "%.6g", ",", header="time_s,voltage_v,strain", comments="")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The four records that the page asks for."""
    made = tmp_path_factory.mktemp("lab")
    bench, rng = TwinBench(lab(), 3), np.random.default_rng(1)
    precondition(bench, 2.0)
    bench.sine(2000.0, 0.05)
    phase = np.arange(1000) % 200 / 200.0
    triangle_v = 2.0 * (1.0 - np.abs(2.0 * phase - 1.0))
    time_s = PERIOD_S * np.arange(2000)
    turns = np.cumsum(0.1 * 100.0 ** (time_s / 20.0)) * PERIOD_S
    swept = 1.0 + 0.5 * np.sin(2.0 * np.pi * turns)
    drives = {
        "triangle": triangle_v,
        "chirp": np.r_[np.full(500, 1.0), np.full(1500, 1.3), swept],
        "steps": np.r_[np.full(300, 1.0), np.repeat([1.3, 0.8, 1.2, 0.9], 500)],
    }
    zero_m = float(COMMANDS[0].split("--zero-length-m ")[1].split()[0])
    for name, drive_v in drives.items():
        codes, length_m = played(bench, drive_v)
        strain = length_m / zero_m - 1.0 + 5e-5 * rng.standard_normal(length_m.size)
        saved(made / f"{name}.csv", drive_v, strain)
        if name == "triangle":
            volts = codes * describe(lab()).volt_per_code
            head = "v_monitor_v,i_monitor_v"
            np.savetxt(made / "monitors.csv", volts, "%.5f", ",", header=head, comments="")
        bench.write(1.0)
        bench.wait(20.0)
    return made


def run(capsys: pytest.CaptureFixture[str], line: str) -> str:
    program, *arguments = shlex.split(line)
    assert program == "haselab", line
    with pytest.raises(SystemExit) as stop:
        main(arguments)
    printed = capsys.readouterr()
    assert stop.value.code == 0, (line, printed.err)
    return printed.out


@pytest.mark.long
def test_the_journey_from_records_to_firmware(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    assert len(COMMANDS) <= 10
    desk = [line for line in COMMANDS if " firmware " not in line]
    for line in desk:
        answer = run(capsys, line + " --json")
        if " compare " in line:
            predicted = json.loads(answer)
    assert predicted["status"] == "ok" and predicted["fit_percent"] > 85.0
    data = tomllib.loads((folder / "actuator.toml").read_text(encoding="utf-8"))
    assert data["actuator"]["name"] == "my HASEL"
    to_strain = data["sensing"]["strain_map"]
    assert to_strain["band"][1] - to_strain["band"][0] < 0.005
    # The twin's resonance at its operating point, as the reference study finds it: 32.6 rad/s.
    assert data["model"]["natural_frequency_rad_s"] == pytest.approx(32.6, rel=0.05)
    assert data["controller"]["margins"]["worst_phase_margin_deg"] >= 50.0
    assert data["controller"]["limits"]["high"] <= 0.1
    written = {"sensing", "drive", "model", "controller"}
    assert set(data["provenance"]) == written
    hashes = data["provenance"]["sensing"]["strain_map"]
    assert hashes["input"] == ["capacitance.csv", "triangle.csv"]
    try:
        find_tool("avr-gcc", "gcc-avr")
        assert simavr_header() is not None
    except (InputError, AssertionError):
        pytest.skip("avr-gcc or libsimavr is not installed")
    for line in COMMANDS[len(desk) :]:
        answer = run(capsys, line + " --json")
    simulated = json.loads(answer)
    assert simulated["status"] == "ok"
    chip = simulated["loops"][-1]
    # The map's band, some 0.0005 of strain, is 1.3 % of the step of 0.04; and the sheet creeps.
    assert abs(chip["steady_state_error"]) < 0.05
    assert chip["overshoot"] < 0.1
    assert abs(chip["overshoot"] - chip["predicted"]["overshoot"]) < 0.05
    assert (folder / "firmware" / "firmware.hex").is_file()


def as_another_program_writes(plain: Path, path: Path) -> None:
    """The same record in ms, mV and %, with a preamble, `;` and decimal commas."""
    time_s, volt, strain = np.loadtxt(plain, delimiter=",", skiprows=1, unpack=True)
    rows = zip(1e3 * time_s, 1e3 * volt, 100.0 * strain, strict=True)
    lines = [";".join(f"{value:.7g}".replace(".", ",") for value in row) for row in rows]
    head = ["Messung: Aktor 3", "Datum: 12.03.2026", "Zeit (ms);U (mV);Dehnung (%)"]
    path.write_text("\n".join([*head, *lines, ""]), encoding="utf-8")


@pytest.mark.long
def test_files_of_another_program_give_the_same_actuator(
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    plain = [line for line in COMMANDS if re.search(" init | sense | identify | compare ", line)]
    shutil.copy(folder / "monitors.csv", tmp_path)
    names = {"triangle": "dreieck", "chirp": "sweep", "steps": "stufen"}
    for name, foreign in names.items():
        shutil.copy(folder / f"{name}.csv", tmp_path)
        as_another_program_writes(folder / f"{name}.csv", tmp_path / f"{foreign}.csv")
    fits, files = [], []
    for lines in (plain, [*plain[:2], *FOREIGN]):
        (tmp_path / "actuator.toml").unlink(missing_ok=True)
        (tmp_path / "capacitance.csv").unlink(missing_ok=True)
        answers = [run(capsys, line + " --json") for line in lines]
        fits.append(json.loads(answers[-1])["fit_percent"])
        files.append(tomllib.loads((tmp_path / "actuator.toml").read_text(encoding="utf-8")))
    assert fits[1] == pytest.approx(fits[0], abs=0.01)
    ours, theirs = files
    for section, name in (("sensing", "strain_map"), ("drive", "voltage_map")):
        for key in ("slope_per_f", "offset", "a1_v", "b1"):
            if key in ours[section][name]:
                assert theirs[section][name][key] == pytest.approx(
                    ours[section][name][key], rel=1e-3
                )
    for key in ("gain", "natural_frequency_rad_s", "damping_ratio"):
        assert theirs["model"][key] == pytest.approx(ours["model"][key], rel=1e-3)
    assert theirs["model"]["input"] == ours["model"]["input"] == "strain"


def test_what_the_page_types_is_enough_for_a_design(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, study, typed = TABLES
    (tmp_path / "steps.toml").write_text(study, encoding="utf-8")
    assert load_study(tmp_path / "steps.toml").steps.custom_trials == 3
    path = tmp_path / "typed.toml"
    path.write_text(typed, encoding="utf-8")
    run(capsys, f"haselab design {path}")
    controller = tomllib.loads(path.read_text(encoding="utf-8"))["controller"]
    assert controller["demands"]["phase_margin_deg"] == 60.0
    assert controller["uncertainty"].startswith("no uncertainty")
    assert controller["loop"] == {"rate_hz": 100.0, "measurement_delay_s": 0.0075}


@pytest.mark.long
def test_the_tables_of_a_run_give_the_model_of_the_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "records.toml").write_text(TABLES[0], encoding="utf-8")
    (tmp_path / "rig.toml").write_text('kind = "twin"\n', encoding="utf-8")
    answers = {line.split()[1]: json.loads(run(capsys, line + " --json")) for line in RECORDED}
    assert answers["compare"]["status"] == "ok" and answers["compare"]["fit_percent"] > 85.0
    assert answers["session"]["empty"] == ["particles", "particles-blocks"]
    read = [
        tomllib.loads(Path(name).read_text(encoding="utf-8"))
        for name in ("recorded.toml", "out/records/actuator.toml")
    ]
    ours, of_run = (data["model"]["natural_frequency_rad_s"] for data in read)
    assert ours == pytest.approx(of_run, rel=0.01)
    assert set(read[0]["provenance"]) == {"sensing", "drive", "model", "controller"}
