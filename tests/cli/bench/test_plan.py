"""`haselab plan carrier`: the choice, the table, and the warning for the study's own carrier."""

import json

import pytest

from haselab.cli import main as entry


def run(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as stop:
        entry.main(["plan", "carrier", *arguments])
    return int(stop.value.code)


def test_the_studys_own_carrier_is_warned_of(capsys):
    assert run(["--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["asked"]["carrier_hz"] == 2000.0
    assert "2000 Hz is harmonic 20 of the 100 Hz staircase" in answer["warnings"][0]
    assert "times the error of" in answer["warnings"][-1]
    assert answer["carrier_hz"] == answer["chosen"]["carrier_hz"]
    assert answer["chosen"]["total"] < answer["asked"]["total"]
    assert answer["chosen"]["step_average"] < 1e-6
    assert len(answer["candidates"]) > 100


def test_the_table_shows_choice_and_question(tmp_path, capsys):
    out = tmp_path / "new" / "plan.json"
    arguments = ["--rate-hz", "200000", "--update-hz", "100", "--block-s", "0.01",
                 "--mains-hz", "60", "--bandwidth-hz", "3000", "--capacitance-f", "2e-9",
                 "--noise-v", "5e-4", "--carrier-hz", "1500", "--out", str(out)]  # fmt: skip
    assert run(arguments) == 0
    page = capsys.readouterr().out
    chosen = json.loads(out.read_text())["carrier_hz"]
    rows = [line for line in page.splitlines() if "<-" in line]
    assert [row.split()[0] for row in rows if "chosen" in row] == [f"{chosen:g}"]
    assert [row.split()[0] for row in rows if "given" in row] == ["1500"]
    assert "Disadvantages of 1500 Hz" in page
    assert json.loads(out.read_text())["request"]["mains_hz"] == 60.0


def test_a_blank_frees_the_choice_of_the_staircase(capsys):
    assert run(["--json", "--blank-s", "0.0015"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["chosen"]["step"] < 1e-9
    assert "its steps are negligible compared with the noise" in answer["warnings"][0]
    assert run(["--json", "--update-unknown"]) == 0
    unknown = json.loads(capsys.readouterr().out)
    assert unknown["request"]["update_s"] is None
    assert "let the lock-in search" in " ".join(unknown["reasons"])


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--carrier-hz", "90000"], "at least 2 periods and 3 samples per period are needed"),
        (["--carrier-hz", "nan"], "is not a finite number"),
        (["--rate-hz", "-1"], "rate_hz = -1; it must be above 0"),
        (["--blank-s", "0.009"], "three quarters of a block"),
        (["--update-s", "1"], "outside the block, [0, 0.01)"),
        (["--carrier-v", "5"], "Lower carrier_v"),
        (["--capacitance-f", "x"], "not a valid number"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(arguments, words, capsys):
    assert run(arguments) == 2
    captured = capsys.readouterr()
    assert words in captured.err
    assert captured.err.count("\n") == 1
    assert captured.out == ""
