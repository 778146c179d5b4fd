import json

import pytest

from haselab.cli.main import main

RESULTS = {
    "quantities": [
        {
            "id": "S20.omega_n",
            "name": "Natural frequency",
            "unit": "rad/s",
            "paper": 5.11,
            "recomputed": 5.113,
            "measured": {"value": 5.12, "std": 0.02, "ci95": [5.08, 5.16], "unit": "rad/s"},
            "verdict": "agrees",
            "note": "",
        }
    ],
    "provenance": {"seed": 1},
}
STATIC = {
    "stretch": [1.0, 1.5, 2.0],
    "load_n": [0.0, 1.2, 2.0],
    "fit_stretch": [1.0, 1.5, 2.0],
    "fit_load_n": [0.0, 1.25, 1.95],
}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "results.json").write_text(json.dumps(RESULTS), encoding="utf-8")
    (tmp_path / "analysis.json").write_text(json.dumps({"static": STATIC}), encoding="utf-8")
    return tmp_path


def run(*arguments):
    with pytest.raises(SystemExit) as stop:
        main(["report", *map(str, arguments)])
    return stop.value.code


def test_the_page_is_written_and_the_answer_is_one_json_document(folder, capsys):
    assert run(folder, "--json") == 0
    out, err = capsys.readouterr()
    answer = json.loads(out)
    assert answer["report"] == str(folder / "report.html")
    assert answer["figures"] == ["fig4", "residuals"]
    assert "fig7" in answer["left_out"]
    assert "analysis.json has no section 'loop'" in err
    assert "S20.omega_n" in (folder / "report.html").read_text(encoding="utf-8")


def test_out_names_the_page(folder, tmp_path):
    page = tmp_path / "pages" / "supplement.html"
    assert run(folder, "--out", page) == 0
    assert page.is_file()
    assert not (folder / "report.html").exists()


def test_a_missing_folder_is_bad_input_in_one_line(tmp_path, capsys):
    assert run(tmp_path / "none") == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert err.startswith("haselab: The folder does not exist.")


def test_corrupt_results_are_bad_input_in_one_line(folder, capsys):
    (folder / "results.json").write_text('{"quantities"', encoding="utf-8")
    assert run(folder) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "results.json is not a JSON document" in err
    assert "Traceback" not in err


def test_out_that_is_a_folder_is_refused(folder, capsys):
    assert run(folder, "--out", folder) == 2
    assert "--out names a folder" in capsys.readouterr().err


def test_a_report_does_not_write_into_a_folder_of_others_through_a_link(folder, tmp_path, capsys):
    others = tmp_path / "others"
    others.mkdir()
    (others / "fig4.svg").write_text("theirs")
    (folder / "figures").symlink_to(others)
    assert run(folder) == 2
    assert "This path is a link to" in capsys.readouterr().err
    assert [path.read_text() for path in others.iterdir()] == ["theirs"]
    assert not (folder / "report.html").exists()


def test_a_page_that_is_a_link_is_replaced_and_what_it_led_to_stays(folder, tmp_path):
    theirs = tmp_path / "theirs.html"
    theirs.write_text("theirs")
    (folder / "report.html").symlink_to(theirs)
    assert run(folder) == 0
    assert theirs.read_text() == "theirs"
    assert not (folder / "report.html").is_symlink()
