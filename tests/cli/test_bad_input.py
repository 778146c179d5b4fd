"""Bad input to any command: exit code 2, one line on stderr with what to do, nothing moved."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest

from haselab.cli.main import main
from haselab.study import definition

BUILTIN = (Path(definition.__file__).parent / "studies" / "hasel-iros2018.toml").read_text()
HASELAB = [sys.executable, "-m", "haselab.cli"]
Refused = Callable[..., str]


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Refused:
    """Runs a command that must be refused; gives its line."""

    def run(*arguments: object, code: int = 2) -> str:
        with pytest.raises(SystemExit) as stop:
            main([str(argument) for argument in arguments])
        printed = capsys.readouterr()
        assert stop.value.code == code, printed.err
        assert printed.out == ""
        assert printed.err.startswith("haselab: ")
        assert printed.err.count("\n") == 1, printed.err
        assert not (tmp_path / "out").exists()
        return printed.err.rstrip("\n")

    return run


# ---- files ----------------------------------------------------------------------------------

FILE_COMMANDS = {
    "run": ("run", "{}", "--rig", "{rig}", "--out", "{out}"),
    "run --rig": ("run", "{study}", "--rig", "{}", "--out", "{out}"),
    "reproduce --twin": ("reproduce", "--twin", "{}", "--out", "{out}"),
    "analyse": ("analyse", "{}"),
    "report": ("report", "{}"),
    "sense": ("sense", "{}", "--carrier-hz", "2000", "--rate-hz", "2e5", "--out", "{out}"),
    "track": ("track", "{}", "--auto", "--out", "{out}"),
    "design": ("design", "{}", "--out", "{out}"),
    "identify transfer": (
        "identify", "transfer", "{}", "--input", "u", "--output", "y", "--rate-hz", "100",
    ),
    "identify frequency-response": (
        "identify", "frequency-response", "{}", "--input", "u", "--output", "y", "--rate-hz", "9",
    ),
    "identify free-response": (
        "identify", "free-response", "{}", "--output", "y", "--rate-hz", "100",
    ),
    "identify hyperelastic": ("identify", "hyperelastic", "{}", "--model", "auto"),
    "identify regions": ("identify", "regions", "{}"),
    "identify voltage-map": ("identify", "voltage-map", "{}"),
    "identify capacitance-map": ("identify", "capacitance-map", "{}"),
}  # fmt: skip
SUFFIX = {"run": "toml", "run --rig": "toml", "reproduce --twin": "toml", "design": "json",
          "track": "mkv", "analyse": "h5"}  # fmt: skip


def missing(path: Path) -> None:
    del path


def empty(path: Path) -> None:
    path.write_bytes(b"")


def garbage(path: Path) -> None:
    path.write_bytes(bytes(range(256)) * 20)


def folder(path: Path) -> None:
    path.mkdir()


def filled(command: str, path: Path) -> list[str]:
    (path.parent / "rig.toml").write_text('kind = "twin"\n')
    (path.parent / "study.toml").write_text(BUILTIN)
    places = {"rig": path.parent / "rig.toml", "study": path.parent / "study.toml",
              "out": path.parent / "out"}  # fmt: skip
    return [part.format(path, **places) for part in FILE_COMMANDS[command]]


@pytest.mark.parametrize(
    ("command", "fault"),
    [
        (command, fault)
        for command in FILE_COMMANDS
        for fault in (missing, empty, garbage, folder)
        if (command, fault) != ("reproduce --twin", empty)  # an empty file is the default twin
    ],
)
def test_a_file_that_is_not_there_or_not_what_it_should_be_is_one_line(
    tmp_path: Path, refused: Refused, command: str, fault: Callable[[Path], None]
) -> None:
    path = tmp_path / f"given.{SUFFIX.get(command, 'csv')}"
    fault(path)
    line = refused(*filled(command, path))
    assert "given" in line, "the path is missing"


# ---- studies, rigs, twins -------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            "cycles = 5",
            "cycles = 5\ncicles = 5",
            "triangle.cicles: no such key",
        ),
        ("high_v = 2.0", "high_v = 3.0", "highest drive voltage is 3 V in triangle (limit 2 V)"),
        ("low_v = 0.0", "low_v = -0.5", "lowest drive voltage is -0.5 V in triangle (limit 0 V)"),
        (
            "amplitude_v = 0.6",
            "amplitude_v = 1.2",
            "highest drive voltage is 2.4 V in chirp (limit 2 V)",
        ),
        (
            "[operating_point]",
            "[operating_point]\nbaseline_v = nan",
            "operating_point.baseline_v: must be a finite number",
        ),
        ("masses_kg = [0.0,", "masses_kg = [-0.1,", "masses_kg"),
        (
            "masses_kg = [",
            "masses_kg = [0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.5]\nold = [",
            "has 6 different masses, but needs at least 7",
        ),
        ("cycles = 5", "cycles = 1", "triangle.cycles: must be greater than or equal to 2"),
        ("cycles = 5", 'cycles = "many"', "triangle.cycles: must be a number, not a text"),
        ("carrier_hz = 2000.0", "carrier_hz = -1.0", "sensing.carrier_hz: must be"),
        ("carrier_hz = 2000.0", "carrier_hz = 90e3", "carrier frequency is 9e+04 Hz"),
        ("[chirp]", "[chrip]", "has a table [chrip], but no installed experiment"),
        ("[chirp]", "[chirp", "Not a TOML file"),
    ],
)
def test_a_fault_in_a_study_is_refused_before_anything_moves(
    tmp_path: Path, refused: Refused, old: str, new: str, words: str
) -> None:
    assert old in BUILTIN
    (tmp_path / "study.toml").write_text(BUILTIN.replace(old, new, 1))
    (tmp_path / "rig.toml").write_text('kind = "twin"\n')
    line = refused("run", tmp_path / "study.toml", "--rig", tmp_path / "rig.toml",
                   "--out", tmp_path / "out")  # fmt: skip
    assert words in line


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "the file has no key kind ("),
        ('kind = "robot"', "kind: must be 'twin'"),
        ('kind = "twin"\nsed = 1', "sed: no such key"),
        ('kind = "twin"\nseed = -1', "seed: must be greater than or equal to 0"),
        ('kind = "twin"\nseed = "one"', "seed: must be a number, not a text"),
        ('kind = "twin"\nseed = 99999999999999999999', "seed: "),
        ('kind = "twin"\nreading = "khz"', "reading: must be 'rad' or 'hz'"),
        ('kind = "twin"\ntwin = 5', "twin: must be a valid string"),
        ('kind = "twin"\ntwin = "no.toml"', "No such twin file. Give the name of one that exists"),
        ('kind = "twin"\ntwin = "t.toml"\nreading = "hz"', "either twin or reading"),
    ],
)
def test_a_fault_in_a_rig_file_is_one_line(
    tmp_path: Path, refused: Refused, text: str, words: str
) -> None:
    (tmp_path / "study.toml").write_text(BUILTIN)
    (tmp_path / "rig.toml").write_text(text)
    (tmp_path / "t.toml").write_text("")
    line = refused("run", tmp_path / "study.toml", "--rig", tmp_path / "rig.toml",
                   "--out", tmp_path / "out")  # fmt: skip
    assert words in line


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[load]\nmass_kg = -0.2", "load.mass_kg: must be greater than 0 (got -0.2)"),
        ("[load]\nmass_kg = nan", "load.mass_kg: must be a finite number (got nan)"),
        (
            "[load]\nmas_kg = 1",
            "mas_kg: no such key; the keys are added_inertia_kg, mass_kg (got 1)",
        ),
        ("[acquisition]\ndrive_high_v = 50", "acquisition.drive_high_v: must be less"),
        (
            "[acquisition]\ndrive_high_v = 1.5",
            "highest drive voltage is 2 V in triangle (limit 1.5 V)",
        ),
        ("[acquisition]\nblock_samples = 1001", "acquisition.block_samples"),
        ("[viscosity]\nshare = [0.1]", "share and relaxation_s each need one number per branch"),
        ('reading = "khz"', "reading: must be 'rad' or 'hz'"),
        ("load = 3", "load: must be a table, headed [load]"),
        ('[load]\nmass_kg = -1\n[shell]\nwidth_m = "wide"', "2 errors: shell.width_m"),
    ],
)
def test_a_twin_that_cannot_be_is_one_line_that_names_every_fault(
    tmp_path: Path, refused: Refused, text: str, words: str
) -> None:
    (tmp_path / "twin.toml").write_text(text)
    line = refused("reproduce", "--twin", tmp_path / "twin.toml", "--out", tmp_path / "out")
    assert words in line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["reproduce"], "Missing option '--out'"),
        (["reproduce", "--out", "{out}", "--seed", "-1"], "-1 is not in the range"),
        (
            ["reproduce", "--out", "{out}", "--seed", "99999999999999999999"],
            "is too large. Use at most",
        ),
        (["reproduce", "--out", "{out}", "--reading", "khz"], "'khz' is not one of"),
        (["reproduce", "--out", "{file}"], "--out names a file, not a folder. Name a new folder."),
        (["run", "{file}"], "Missing option '--out'"),
        (["run", "{file}", "--out", "{out}"], "--rig"),
        (["analyse"], "Missing argument"),
        (["design", "{file}", "--out", "{file}/controller.toml"], ""),
        (["no-such-command"], "No such command 'no-such-command'"),
        (["report", "--no-such-option"], "No such option"),
    ],
)
def test_a_fault_on_the_command_line_is_one_line(
    tmp_path: Path, refused: Refused, arguments: list[str], words: str
) -> None:
    (tmp_path / "file").write_text("")
    places = {"out": tmp_path / "out", "file": tmp_path / "file"}
    assert words in refused(*(argument.format(**places) for argument in arguments))


def test_a_session_that_is_another_hdf5_file_is_one_line(tmp_path: Path, refused: Refused) -> None:
    with h5py.File(tmp_path / "session.h5", "w") as file:
        file["u"] = [1.0, 2.0]
    assert "not a complete haselab session" in refused("analyse", tmp_path / "session.h5")
    assert "The file is not a complete haselab session" in refused("analyse", tmp_path)


# ---- faults of the program, and of what it is connected to ----------------------------------


def test_a_fault_of_the_program_itself_is_one_line_too(
    tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    def slip(*_: object, **__: object) -> None:
        raise IndexError("index 8 is out of bounds")

    monkeypatch.setattr("haselab.cli.study.study_run.run_study", slip)
    line = refused("reproduce", "--quick", "--out", tmp_path / "out", code=1)
    assert "A bug in haselab (IndexError: index 8 is out of bounds)" in line
    assert line.endswith("Run again with --debug and report the traceback.")


def test_debug_shows_the_traceback(tmp_path: Path) -> None:
    command = [*HASELAB, "analyse", str(tmp_path / "no.h5"), "--debug"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert "Traceback (most recent call last)" in done.stderr
    assert "No session here" in done.stderr


@pytest.mark.skipif(os.name == "nt", reason="pipes of a POSIX shell")
def test_a_reader_that_goes_away_gets_no_complaint(tmp_path: Path) -> None:
    with subprocess.Popen([*HASELAB, "doctor", "--json"], stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE) as process:  # fmt: skip
        process.stdout.close()
        printed = process.stderr.read()
    assert printed == b""


def test_an_answer_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    table = tmp_path / "map.csv"
    table.write_text("strain,voltage_v\n" + "".join(f"{k / 100},{1 + k / 10}\n" for k in range(30)))
    (tmp_path / "file").write_text("")
    command = [*HASELAB, "identify", "voltage-map", str(table), "--json", "--out"]
    for out in (tmp_path, tmp_path / "file" / "answer.json"):
        done = subprocess.run([*command, str(out)], capture_output=True, text=True, check=False)
        assert done.returncode == 2, done.stderr
        assert done.stderr.count("\n") == 1
        assert done.stderr.rstrip().endswith(("file", str(out)))


def test_json_alone_goes_to_standard_output_and_faults_alone_to_the_other(tmp_path: Path) -> None:
    table = tmp_path / "map.csv"
    table.write_text("strain,voltage_v\n" + "".join(f"{k / 100},{1 + k / 10}\n" for k in range(30)))
    command = [*HASELAB, "identify", "voltage-map", str(table), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert {"a1_v", "b1", "a2_v", "b2", "monotone"} <= set(json.loads(done.stdout))
    assert done.stderr == ""
    command[3] = "capacitance-map"
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)


HELP = """
import sys
from haselab.cli.main import main
try:
    main(["--help"])
finally:
    print(*sorted({name.partition(".")[0] for name in sys.modules}), file=sys.stderr)
"""


def test_help_loads_none_of_the_slow_libraries() -> None:
    """What makes it answer at once; `make bench` says how long it takes."""
    done = subprocess.run([sys.executable, "-c", HELP], capture_output=True, text=True, check=True)
    assert "Usage:" in done.stdout
    loaded = set(done.stderr.split())
    assert "click" in loaded
    assert not loaded & {"scipy", "matplotlib", "h5py", "pydantic", "av", "cv2", "jinja2", "rich"}


# ---- numbers on the command line --------------------------------------------------------------


@pytest.mark.parametrize("value", ["nan", "inf", "-inf", "1e308", "1" + "0" * 400])
def test_a_number_that_no_computation_can_bear_is_bad_usage(refused: Refused, value: str) -> None:
    for arguments in (["design", "m.json", "--rate-hz"], ["plan", "carrier", "--step-v"],
                      ["identify", "arx", "a.csv", "--rate-hz"]):  # fmt: skip
        assert "is not a finite number of at most 1e+30" in refused(*arguments, value)


def test_no_limit_is_a_limit(refused: Refused) -> None:
    line = refused("identify", "model-comparison", "no.csv", "--question", "creep", "--slew", "inf")
    assert "There is no such file" in line
