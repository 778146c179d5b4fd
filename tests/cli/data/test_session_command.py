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
    time_s = np.arange(100) / 1000.0
    drive_v = np.repeat([0.0, 0.5, 1.0, 1.5, 2.0], 20)
    wave = np.sin(2.0 * np.pi * 200.0 * time_s)
    rows = np.column_stack([time_s, wave, 0.5 * wave, drive_v])
    np.savetxt(tmp_path / "m.csv", rows, "%.6g", ",", header="t,u,i,out", comments="")
    with pytest.raises(SystemExit) as stop:
        main(["session", "import", str(tmp_path / "m.csv"), "--v", "u", "--i", "i", "--drive",
              "out", "--block-samples", "20", "--out", str(tmp_path / "o")])  # fmt: skip
    err = capsys.readouterr().err
    assert stop.value.code == 0, err
    assert err == (
        "haselab: column t states no unit: its values are taken as times in seconds. State "
        f"another one with --unit t=ms. {tmp_path / 'm.csv'}\n"
    )
    with SessionReader(tmp_path / "o" / "session.h5") as session:
        record = session.experiment("imported")
    assert record.drive_v.tolist() == [0.0, 0.5, 1.0, 1.5, 2.0]
