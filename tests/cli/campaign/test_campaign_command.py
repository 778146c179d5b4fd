"""`haselab campaign` from its options to its answer."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import time
from pathlib import Path

import pyarrow
import pyarrow.parquet
import pytest

from haselab.base import InputError
from haselab.campaign.folder import read_results
from haselab.cli.main import main
from haselab.store.campaign.shards import CaseRow, Shards

QUICK = """
name = "quick"
kind = "transfer"
[case]
duration_s = 1.0
[parameters]
case.gain = [0.4, 0.6]
"""
BREAKS = """
name = "too high"
kind = "geometry"
[base]
twin = "hz"
[parameters]
case.voltage_v = [20000.0, 30000.0]
"""


def code_of(*words: object) -> int:
    with pytest.raises(SystemExit) as stop:
        main([str(word) for word in words])
    return int(str(stop.value.code))


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "campaign.toml"
    path.write_text(QUICK)
    return path


def test_the_answer_has_the_keys_of_the_contract_and_the_folder_the_results(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of("campaign", file, "--out", "out", "--workers", 1, "--json") == 0
    answer = json.loads(capsys.readouterr().out)
    assert (answer["cases"], answer["done"], answer["failed"]) == (2, 2, 0)
    assert answer["wall_s"] > 0.0 and 0.0 < answer["efficiency"] <= 1.0
    assert answer["summary"] == json.loads(Path("out/summary.json").read_text())
    # a second start computes nothing; 2 cases are too few for medians, but they are the same ones
    assert code_of("campaign", file, "--out", "out", "--compare", "out") == 0
    printed = capsys.readouterr()
    summary = json.loads(Path("out/summary.json").read_text())
    assert printed.err == "" and summary["comparison"] == []
    assert {(each["count"], each["largest"]) for each in summary["paired"]} == {(2, 0.0)}
    described = Path("out/campaign.json").read_text()
    Path("other").mkdir()
    shutil.copy("out/results.parquet", "other")
    Path("other/campaign.json").write_text(described.replace('"seed": 0', '"seed": 1'))
    assert code_of("campaign", file, "--out", "out", "--compare", "other") == 0
    printed = capsys.readouterr()
    assert printed.err.startswith("haselab: No comparison: no result has at least 8 values")
    assert "2 of 2 cases have a result, 0 failed" in printed.out
    assert "computed" not in printed.out
    # --force begins anew
    file.write_text(QUICK.replace("0.6]", "0.6, 0.8]"))
    assert code_of("campaign", file, "--out", "out", "--workers", 1) == 2
    assert "parameters.case.gain is [0.4, 0.6] there and [0.4, 0.6, 0.8] here" in (
        capsys.readouterr().err
    )
    assert code_of("campaign", file, "--out", "out", "--workers", 1, "--force") == 0
    printed = capsys.readouterr()
    assert "moved out to" in printed.err and "3 of 3 cases" in printed.out
    assert Path("out.previous-1/results.parquet").exists()


def test_a_comparison_with_itself_finds_no_difference(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file.write_text(f"{QUICK}[design]\nrepeats = 8\n")
    assert code_of("campaign", file, "--out", "out", "--workers", 1) == 0
    assert "16 computed in" in (first := capsys.readouterr().out)
    assert re.search(r"by 1 worker; the cases took \d+ % of the workers' time\n", first)
    assert code_of("campaign", file, "--out", "out", "--compare", "out") == 0
    assert capsys.readouterr().err == ""
    summary = json.loads(Path("out/summary.json").read_text())
    differences = [one["difference"] for one in summary["comparison"]]
    assert differences and all(one["value"] == 0.0 for one in differences)
    assert all(one["ci95"][0] <= 0.0 <= one["ci95"][1] for one in differences)


def test_a_comparison_says_why_the_other_folder_may_be_outdated(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file.write_text(f"{QUICK}[design]\nrepeats = 8\n")
    assert code_of("campaign", file, "--out", "a", "--workers", 1) == 0
    shutil.copytree("a", "b")
    compare = ("campaign", file, "--out", "a", "--compare", "b")
    capsys.readouterr()
    assert code_of(*compare) == 0
    assert capsys.readouterr().err == ""
    # copied without its times: the shards are newer, but the table has their cases
    later_s = time.time() + 100.0
    for shard in Path("b/shards").glob("*.parquet"):
        os.utime(shard, (later_s, later_s))
    assert code_of(*compare) == 0
    assert capsys.readouterr().err == ""
    # cases that were finished after the table
    writer = Shards(Path("b"), "later")
    writer.write([CaseRow("new", 3, {"case.gain": 0.4})])
    assert code_of(*compare) == 0
    told = "the campaign in b: its table lacks 1 cases that were finished later"
    assert told in capsys.readouterr().err
    summary = json.loads(Path("a/summary.json").read_text())
    assert len(summary["doubts"]) == 1
    page = Path("a/report.html").read_text()
    assert "The two campaign files are equal. About the other campaign: its table lacks 1" in page
    # another version of the code, or an unknown one
    about = json.loads(Path("b/summary.json").read_text())
    Path("b/summary.json").write_text(json.dumps({**about, "code": "0.1.0+abc"}))
    assert code_of(*compare) == 0
    assert "it was computed by haselab 0.1.0+abc, and this one by" in capsys.readouterr().err
    Path("b/summary.json").unlink()
    assert code_of(*compare) == 0
    assert "its summary.json is missing or unreadable" in capsys.readouterr().err


def test_no_flipped_bit_of_the_other_table_gives_other_values(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of("campaign", file, "--out", "a", "--workers", 1) == 0
    expected, path = read_results(Path("a")), Path("a/results.parquet")
    whole = path.read_bytes()
    for place in range(0, 8 * len(whole), 397):
        damaged = bytearray(whole)
        damaged[place // 8] ^= 1 << place % 8
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"Not a table of a campaign|not the table of summary"):
            read_results(Path("a"))
    path.write_bytes(whole)
    Path("a/summary.json").unlink()  # of a folder of an older version: nothing to compare with
    assert read_results(Path("a")).keys() == expected.keys()


def test_a_foreign_file_among_the_shards_is_refused(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert code_of("campaign", file, "--out", "a", "--workers", 1) == 0
    pyarrow.parquet.write_table(pyarrow.table({"x": [1.0]}), "a/shards/x.parquet")
    capsys.readouterr()
    assert code_of("campaign", file, "--out", "a", "--workers", 1) == 2
    assert capsys.readouterr().err.count("\n") == 1


def test_two_grids_are_compared_without_intervals_and_an_axis_without_effect_is_named(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A grid that is computed once draws nothing."""
    grid = """
name = "a"
kind = "geometry"
[base]
twin = "hz"
[parameters]
twin.load.mass_kg = [0.2, {}]
twin.hysteresis.width = [1e-3, 1.2e-3, 1.4e-3, 1.6e-3]
"""
    for name, mass_kg, more in (("one", 0.25, ()), ("two", 0.3, ("--compare", "one"))):
        file.write_text(grid.format(mass_kg))
        assert code_of("campaign", file, "--out", name, "--workers", 1, *more) == 0
        said = capsys.readouterr().err
        assert said.count("no result depends on") == 1 and "twin.hysteresis.width" in said
    summary = json.loads(Path("two/summary.json").read_text())
    assert summary["without_effect"] == ["twin.hysteresis.width"]
    assert summary["comparison"]
    for one in summary["comparison"]:
        assert all(one[key]["ci95"] is None for key in ("here", "there", "difference"))
    page = Path("two/report.html").read_text()
    assert "[0.2, 0.25] there and [0.2, 0.3] here" in page


def test_if_all_cases_fail_there_is_no_result(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file.write_text(BREAKS)
    assert code_of("campaign", file, "--out", "out", "--workers", 1) == 3
    printed = capsys.readouterr()
    assert printed.err == "haselab: All 2 cases failed. See out/failed.txt.\n"
    assert Path("out/failed.txt").read_text().count("has no equilibrium") == 2
    assert "no equilibrium" in Path("out/report.html").read_text()


def test_a_case_alone_has_the_results_of_the_table_and_writes_nothing(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import pyarrow.parquet

    assert code_of("campaign", file, "--case", 1, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert [path.name for path in Path().iterdir()] == [file.name]
    assert code_of("campaign", file, "--out", "out", "--workers", 1) == 0
    row = pyarrow.parquet.read_table("out/results.parquet").to_pylist()[1]
    assert found["parameters"] == {"case.gain": row["case.gain"]} == {"case.gain": 0.6}
    assert found["results"] and all(row[name] == one for name, one in found["results"].items())
    capsys.readouterr()
    assert code_of("campaign", file, "--case", 1) == 0
    printed = dict(line.split(" = ") for line in capsys.readouterr().out.splitlines())
    assert float(printed["gain"]) == pytest.approx(row["gain"], rel=1e-5)
    file.write_text(BREAKS)
    assert code_of("campaign", file, "--case", 0) == 3
    said = capsys.readouterr()
    assert said.out == "" and "Traceback" in said.err
    assert said.err.splitlines()[-1].startswith("haselab: Case 0 failed: ")
    assert "has no equilibrium" in said.err


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        ((), 2, "Missing option '--out'"),
        (("--out", "full/notes.txt"), 2, "--out names a file, not a folder"),
        (("--case", "1", "--out", "full", "--force"), 2, "--case computes one case here"),
        (("--case", "1", "--retry-failed"), 2, "--case computes one case here"),
        (("--case", "2"), 2, "--case is 2, but the campaign has the cases 0 to 1"),
        (("--out", "full"), 2, "not empty and has no campaign"),
        (("--out", "new", "--compare", "full"), 2, "This folder has no results.parquet"),
        (("--out", "new", "--workers", "0"), 2, "0 is not in the range 1<=x<=256"),
        (("--out", "new", "--scheduler", "tcp://127.0.0.1:9"), 2, "No Dask scheduler answers at"),
    ],
)
def test_bad_use_is_one_line(
    file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...], code: int, said: str,
) -> None:  # fmt: skip
    from haselab.campaign.executors import dask

    monkeypatch.setattr(dask, "_CONNECT_S", 0.5)
    Path("full").mkdir()
    Path("full/notes.txt").write_text("mine")
    assert code_of("campaign", file, *words) == code
    printed = capsys.readouterr()
    assert said in printed.err and printed.err.count("\n") == 1 and printed.out == ""
    assert [path.name for path in Path("full").iterdir()] == ["notes.txt"]


def test_a_campaign_without_pyarrow_writes_nothing(
    file: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    assert code_of("campaign", file, "--out", "out") == 2
    assert "pip install 'haselab[campaign]'" in capsys.readouterr().err
    assert not Path("out").exists()
