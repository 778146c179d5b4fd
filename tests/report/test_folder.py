import copy
import json
import re

import pytest

from haselab.base import InputError
from haselab.report import read_folder, write_report
from haselab.report.analysis import LeftOutError


def test_a_complete_folder_is_read(run_folder):
    run = read_folder(run_folder)
    zeta = run.results.get("S20.zeta")
    assert zeta.paper == 0.09
    assert zeta.measured.ci95 == (
        zeta.measured.value * (1 - 1.96 * 0.004),
        pytest.approx(0.0907056),
    )
    assert run.section("loop").array("omega_rad_s").size == 200


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match=r"The folder does not exist.*--out.*nowhere$"):
        write_report(tmp_path / "nowhere")


def test_a_folder_without_results_says_what_to_do(tmp_path):
    with pytest.raises(InputError, match=r"neither results\.json nor session\.h5.* --out folder"):
        write_report(tmp_path)
    (tmp_path / "session.h5").touch()
    with pytest.raises(InputError, match=r"no results\.json\. Create it with 'haselab analyse"):
        write_report(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"quantities": [', "results.json is not a JSON document"),
        ("\xff\xfe", "results.json"),
        ("[]", "no list 'quantities'"),
        ('{"quantities": [{"name": "x"}]}', "quantity 0 has no text 'id'"),
        ('{"quantities": [{"id": "S20.zeta", "measured": 0.09}]}', "S20.zeta: 'measured' = 0.09"),
        (
            '{"quantities": [{"id": "S20.zeta", "measured": {"value": 1, "ci95": [1]}}]}',
            "S20.zeta: 'measured'",
        ),
        ('{"quantities": [{"id": "S20.zeta", "truth": "low"}]}', "'truth' = 'low'"),
    ],
)
def test_results_that_cannot_be_read_give_one_clear_line(tmp_path, text, message):
    (tmp_path / "results.json").write_text(text, encoding="latin-1")
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        write_report(tmp_path)
    printed = str(caught.value)
    assert "\n" not in printed
    assert printed.endswith(str(tmp_path / "results.json"))
    assert not (tmp_path / "report.html").exists()


def test_an_analysis_that_is_broken_is_refused_not_skipped(tmp_path):
    (tmp_path / "results.json").write_text('{"quantities": []}', encoding="utf-8")
    (tmp_path / "analysis.json").write_text('{"chirp": {', encoding="utf-8")
    with pytest.raises(InputError, match=r"analysis\.json is not a JSON document"):
        write_report(tmp_path)


def test_null_means_a_number_that_is_not_finite(make_run, documents):
    results, analysis = copy.deepcopy(documents)
    results["quantities"][0]["measured"]["ci95"][1] = None
    row = read_folder(make_run(results, analysis)).results.quantities[0]
    assert row.interval_text == "[1.3136, open]"
    assert row.noise_free_inside is True


def test_a_picture_outside_the_folder_is_refused(run_folder):
    run = read_folder(run_folder)
    with pytest.raises(LeftOutError, match="outside the folder"):
        run.picture("../first.png")
    assert run.picture("video/none.png") is None
    assert run.picture("video/first.png").shape == (480, 480)


def test_a_file_that_is_not_a_picture_is_reported(make_run, documents):
    folder = make_run(*documents)
    (folder / "video" / "first.png").write_bytes(json.dumps({}).encode())
    with pytest.raises(LeftOutError, match=r"first\.png cannot be read"):
        read_folder(folder).picture("video/first.png")
