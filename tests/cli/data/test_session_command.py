"""`haselab session` and `haselab recover` as they are typed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from haselab.cli.main import main
from haselab.store.manifest import Manifest
from haselab.store.session.writer import ExperimentPlan, SessionReader, SessionWriter

HEADER = {"rig": {"rate_hz": 200e3, "volt_per_code": 3.0517578125e-4}}


def typed(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as ended:
        main([str(each) for each in arguments])
    printed = capsys.readouterr()
    return int(ended.value.code or 0), printed.out, printed.err


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    folder = tmp_path / "run"
    plans = [ExperimentPlan("a", "test", 1, {})]
    with (
        Manifest(folder, {"seed": 1}),
        SessionWriter(folder / "session.h5", plans, 100, HEADER) as writer,
    ):
        for k in range(12):
            block = np.full((100, 2), k, np.int16)
            writer.append_block("a", block, 5e-4 * k, 0.5, float("nan"))
    return folder


def test_a_session_goes_out_and_comes_back(folder, tmp_path, capsys):
    out = tmp_path / "s.mat"
    code, printed, _ = typed(capsys, "session", "export", folder, "--to", "mat", "--out", out,
                          "--json")  # fmt: skip
    assert (code, json.loads(printed)) == (0, {"files": [str(out)], "experiments": {"a": "a"}})
    code, printed, _ = typed(
        capsys, "session", "import", out, "--v", "a/v_monitor_v", "--i", "a/i_monitor_v",
        "--rate-hz", 200e3, "--volt-per-code", 3.0517578125e-4, "--block-samples", 100,
        "--out", tmp_path / "back", "--json",
    )  # fmt: skip
    assert (code, json.loads(printed)["blocks"]) == (0, 12)
    with SessionReader(tmp_path / "back" / "session.h5") as back:
        codes = back.experiment("imported").codes
    np.testing.assert_array_equal(codes[:, 0, 0], np.arange(12))


def test_recover_keeps_complete_recordings_and_reports_changes(folder, capsys):
    code, printed, _ = typed(capsys, "recover", folder, "--json")
    answer = json.loads(printed)
    assert (code, answer["state"], answer["blocks"]) == (0, "SEALED", {"a": 12})
    (folder / "video").mkdir()
    (folder / "video" / "late.mkv").write_bytes(b"x")
    code, _, line = typed(capsys, "recover", folder)
    assert code == 2
    assert line.startswith(
        "haselab: 1 files were changed after the recording was sealed: video/late.mkv."
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("session", "export", "{run}", "--to", "csv"), "the file or folder to write"),
        (("session", "import", "{run}/session.h5"), "the new folder of the session"),
        (
            ("session", "import", "x.csv", "--out", "{run}"),
            "--out names a folder that is not empty",
        ),
        (("session", "export", "{run}/none", "--to", "csv", "--out", "{run}/x"), "No session here"),
        (("recover", "{run}/none"), "No session here"),
        (("analyse", "{run}"), "does not contain a study"),
    ],
)
def test_bad_input_is_one_line(folder, capsys, arguments, words):
    code, _, line = typed(capsys, *(each.format(run=folder) for each in arguments))
    assert code == 2 and words in line and len(line.splitlines()) == 1


def test_an_import_that_fails_leaves_an_empty_folder_and_makes_no_other(tmp_path, capsys):
    (tmp_path / "mine").mkdir()
    for out in ("mine", "new/deep"):
        code, _, _ = typed(capsys, "session", "import", tmp_path / "none.csv", "--out",
                           tmp_path / out)  # fmt: skip
        assert code == 2
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_a_copy_of_a_session_is_not_analysed_over_the_results_beside_it(folder, tmp_path, capsys):
    results = tmp_path / "results.json"
    results.write_text("those of another session")
    copy = tmp_path / "copy.h5"
    copy.write_bytes((folder / "session.h5").read_bytes())
    for force in ((), ("--force",)):
        code, _, line = typed(capsys, "analyse", copy, *force)
        assert code == 2 and "Add --out DIR" in line
    assert "is not empty" in typed(capsys, "analyse", copy, "--out", tmp_path)[2]
    assert results.read_text() == "those of another session"


def test_an_analysis_does_not_write_through_linked_folders(folder, tmp_path, capsys):
    (tmp_path / "others").mkdir()
    (folder / "firmware").symlink_to(tmp_path / "others")
    code, _, line = typed(capsys, "analyse", folder)
    assert code == 2 and "This path is a link to" in line


def test_the_drive_is_imported_block_by_block_and_times_without_a_unit_are_named(
    tmp_path, capsys
) -> None:
    """Blocks of 20 samples, whose drive changes with each of them."""
    time_s = np.arange(100) / 2000.0
    drive_v = np.repeat([0.0, 0.5, 1.0, 1.5, 2.0], 20)
    wave = np.sin(2.0 * np.pi * 400.0 * time_s)
    rows = np.column_stack([time_s, wave, 0.5 * wave, drive_v])
    np.savetxt(tmp_path / "m.csv", rows, "%.6g", ",", header="t,u,i,out", comments="")
    with pytest.raises(SystemExit) as stop:
        main(["session", "import", str(tmp_path / "m.csv"), "--v", "u", "--i", "i", "--drive",
              "out", "--block-samples", "20", "--out", str(tmp_path / "o")])  # fmt: skip
    err = capsys.readouterr().err
    assert stop.value.code == 0, err
    assert err == (
        "haselab: column t states no unit: its values are taken as times in seconds. State "
        f"another one with --unit t=ms. File: {tmp_path / 'm.csv'}\n"
    )
    with SessionReader(tmp_path / "o" / "session.h5") as session:
        record = session.experiment("imported")
    assert record.drive_v.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]


def foreign_record(path: Path, columns: dict[str, str] | None = None) -> tuple[np.ndarray, ...]:
    """A record as a foreign logger writes it, with its true capacitance and strain.

    The strain falls with the capacitance: an actuator that contracts. Two cycles of 2 s.
    """
    rate_hz, carrier_hz, samples = 20e3, 1e3, 80_000
    rng = np.random.default_rng(1)
    time_s = np.arange(samples) / rate_hz
    share = 0.5 - 0.5 * np.cos(2 * np.pi * 0.5 * time_s)
    farad = 180e-12 * (1.0 + 0.6 * share)
    strain = -0.012 * (farad / 180e-12 - 1.0)
    v = 0.1 * np.sin(2 * np.pi * carrier_hz * time_s)  # at the monitor; 1000 V/V: 100 V
    i = 2 * np.pi * carrier_hz * farad * 100.0 * np.cos(2 * np.pi * carrier_hz * time_s) / 1e-3
    v, i = (each + 1e-3 * rng.standard_normal(samples) for each in (v, i))
    every = strain.copy()
    every[np.arange(samples) % 5 != 0] = np.nan  # a camera of a fifth of the rate
    table = {"t [ms]": 1e3 * time_s, "U [mV]": 1e3 * v, "I [mV]": 1e3 * i,
             "Dehnung [%]": 100.0 * strain, "Weg [mm]": 50.0 * strain, "eps": strain,
             "lang [mm]": 50.0 * (1.0 + strain), "selten": every,
             "Prozent": 100.0 * strain}  # fmt: skip
    table = {name: table[name] for name in ("t [ms]", "U [mV]", "I [mV]", *(columns or table))}
    rows = "\n".join(";".join(f"{x:.9g}".replace(".", ",") for x in row)
                     for row in zip(*table.values(), strict=True))  # fmt: skip
    path.write_text(f"Logger 7\nPrüfling;A\n\n{';'.join(table)}\n{rows}\n", encoding="utf-8")
    return time_s, farad, strain


@pytest.mark.parametrize(
    ("column", "options"),
    [
        ("Dehnung [%]", ("--strain", "Dehnung")),
        ("selten", ("--strain", "selten")),
        ("Weg [mm]", ("--displacement", "Weg", "--zero-length-m", 0.05)),
        ("lang [mm]", ("--length", "lang", "--zero-length-m", 0.05)),
        ("eps", ("--strain", "eps", "--zero-length-m", 0.05)),
    ],
)
def test_an_imported_record_of_monitors_and_length_is_sensed_and_gives_a_map(
    column, options, tmp_path, capsys
) -> None:
    record, out, sensed = tmp_path / "log.csv", tmp_path / "session", tmp_path / "c.csv"
    time_s, _, strain = foreign_record(record, {column: ""})
    code, printed, _ = typed(
        capsys, "session", "import", record, "--v", "U", "--i", "I", *options, "--carrier-hz", 1e3,
        "--block-samples", 200, "--volt-per-monitor-volt", 1000, "--ampere-per-monitor-volt", 1e-3,
        "--out", out, "--json",
    )  # fmt: skip
    assert (code, json.loads(printed)["blocks"]) == (0, 400)
    assert typed(capsys, "sense", out / "session.h5", "--out", sensed)[0] == 0
    actuator = tmp_path / "a.toml"
    assert typed(capsys, "init", "mine", "--out", actuator)[0] == 0
    code, printed, _ = typed(
        capsys, "identify", "capacitance-map", sensed, "--strain-file", out, "--actuator", actuator,
        "--json",
    )  # fmt: skip
    found = json.loads(printed)
    assert (code, found["status"]) == (0, "ok")
    # strain = -0.012 (C / 180 pF - 1)
    for name, value in (("slope", -0.012 / 180e-12), ("offset", 0.012)):
        assert abs(found[name]["value"] - value) < 4.0 * found[name]["std"]
    assert typed(capsys, "session", "export", out, "--to", "csv", "--out", tmp_path / "x")[0] == 0
    with (tmp_path / "x" / "imported-strain.csv").open() as file:
        names = file.readline().strip().split(",")
        rows = np.loadtxt(file, delimiter=",")
    middle = np.interp(rows[:, names.index("time_s")], time_s, strain)
    np.testing.assert_allclose(rows[:, names.index("strain")], middle, atol=2e-5)
    if "--zero-length-m" in options:
        length_m = rows[:, names.index("length_m")]
        np.testing.assert_allclose(length_m, 0.05 * (1.0 + middle), atol=1e-6)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--displacement", "Weg"), "needs the length at zero strain. State it with --zero-le"),
        (("--zero-length-m", 0.05), "--zero-length-m has no effect without --strain"),
        (("--strain", "eps", "--length", "lang"), "--strain and --length name the same"),
        (("--strain", "lang"), "The column of the strain is in mm, but must be a ratio or in %"),
        (("--length", "Dehnung"), "The column of the length is in %, but must be in m"),
        (("--strain", "Prozent"), "Column Prozent reaches 0.72 and states no unit"),
        (("--strain", "none"), "Name the columns with --strain"),
    ],
)
def test_a_wrong_column_of_the_length_is_refused(options, words, tmp_path, capsys) -> None:
    record = tmp_path / "log.csv"
    foreign_record(record)
    code, _, line = typed(
        capsys, "session", "import", record, "--v", "U", "--i", "I", *options, "--out",
        tmp_path / "out",
    )  # fmt: skip
    expected = 0 if "Prozent" in options else 2  # 0.72 may be a strain
    assert code == expected
    if expected:
        assert words in line and len(line.splitlines()) == 1
        assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ((), "in seconds it has 100 rows per second, in milliseconds 1e+05"),
        (("--rate-hz", 1e5), "They agree if it is in ms: add --unit t=ms"),
        (("--rate-hz", 5e4), "--rate-hz is 50000, but column t has 100 rows per second"),
        (("--rate-hz", 100), ""),
        (("--unit", "t=ms"), ""),
    ],
)
def test_an_import_does_not_believe_a_rate_that_contradicts_the_times(
    options, words, tmp_path, capsys
) -> None:
    time_ms = np.arange(4000) / 100.0
    rows = np.column_stack([time_ms, np.sin(time_ms), np.cos(time_ms)])
    np.savetxt(tmp_path / "m.csv", rows, "%.6g", ",", header="t,u,i", comments="")
    code, _, err = typed(capsys, "session", "import", tmp_path / "m.csv", "--v", "u", "--i", "i",
                         *options, "--out", tmp_path / "o")  # fmt: skip
    assert code == (2 if words else 0) and words in err


def test_a_session_of_two_experiments_is_sensed_by_name(tmp_path, capsys) -> None:
    plans = [ExperimentPlan(name, "test", 1, {}) for name in "ab"]
    with SessionWriter(tmp_path / "session.h5", plans, 100, HEADER) as writer:
        for name in "ab":
            writer.append_block(name, np.zeros((100, 2), np.int16), 0.0, 0.5, float("nan"))
    code, _, err = typed(capsys, "sense", tmp_path / "session.h5")
    assert code == 2 and "experiments a, b. Name one with --experiment" in err
