"""`haselab compare RUN RUN` shows the results of two runs row by row."""

import json
import math

import numpy as np
import pytest

from haselab.base import Estimate
from haselab.cli.main import main
from haselab.pipelines.compare_results import compare_results

MODEL = '[actuator]\nkind = "planar-hasel"\n[model.physical]\nkind = "planar-hasel"\n'


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main([str(item) for item in arguments])
    printed = capsys.readouterr()
    return stop.value.code, printed.out, printed.err


def folder_of(path, rows, *, study="first study", kind="planar-hasel", **more):
    """The folder of a run with these results."""
    path.mkdir()
    (path / "session.h5").write_bytes(b"\x89HDF\r\n\x1a\n haselab session")
    quantities = [
        {"id": key, "name": f"name of {key}", "unit": measured.unit if measured else "",
         "measured": None if measured is None else finite(measured.to_dict())}
        for key, measured in rows.items()
    ]  # fmt: skip
    provenance = {
        "study": {"name": study},
        "study_sha256": study,
        "rig_config": {"kind": kind, "load": {"mass_kg": 0.25}},
        "recorded": {"date": path.name},
    }
    content = {"quantities": quantities, "provenance": provenance, "simulated": True, **more}
    (path / "results.json").write_text(json.dumps(content))
    return path


def finite(measured):
    """Numbers that are not finite are null in a file of results."""
    ends = [end if math.isfinite(end) else None for end in measured["ci95"]]
    std = measured["std"] if math.isfinite(measured["std"]) else None
    return {**measured, "ci95": ends, "std": std}


@pytest.fixture
def runs(tmp_path):
    normal, exact = Estimate.normal, Estimate(20.0, 0.0, (20.0, 20.0), "V")
    first = {"same": normal(1.0, 0.3, "s"), "far": normal(1.0, 0.3, "V"), "kp": exact,
             "gone": normal(2.0, 0.1, "m"), "none": None,
             "open": Estimate(3.0, math.inf, (0.0, math.inf), "s")}  # fmt: skip
    second = {"same": normal(1.5, 0.4, "s"), "far": normal(3.5, 0.4, "V"), "kp": exact,
              "new": normal(2.0, 0.1, "m"), "none": None,
              "open": normal(3.0, 0.1, "s")}  # fmt: skip
    return folder_of(tmp_path / "a", first), folder_of(tmp_path / "b", second)


def test_two_runs_are_compared_row_by_row(runs, capsys):
    code, text, error = run(capsys, "compare", *runs)
    assert code == 3 and error.startswith("haselab: 1 of 2 rows differs by more than noise")
    assert error.count("\n") == 1
    lines = {line.split()[0]: line for line in text.splitlines() if line}
    assert "1.00 [0.41, 1.59]" in lines["same"] and "1.50 [0.72, 2.28]" in lines["same"]
    assert "0.50 [−0.48, 1.48]" in lines["same"] and "  no " in lines["same"]
    assert lines["same"].endswith("name of same") and " s " in lines["same"]
    assert "2.50 [1.52, 3.48]" in lines["far"] and "  yes " in lines["far"]
    assert "no interval" in lines["kp"] and "no interval" in lines["open"]
    assert "none" not in lines
    assert "Only in the first run:\n  gone  name of gone" in text
    assert "Only in the second run:\n  new  name of new" in text
    assert "2 differences have an interval. 0 is outside the 95 % interval of 1 of them" in text


def test_the_same_as_json(runs, capsys, tmp_path):
    out = tmp_path / "compared.json"
    code, text, _ = run(capsys, "compare", *runs, "--json", "--out", out)
    answer = json.loads(text)
    assert code == 3 and json.loads(out.read_text()) == answer
    rows = {row["id"]: row for row in answer["rows"]}
    assert rows["far"]["difference"] == 2.5 and rows["far"]["exceeds"] is True
    assert rows["far"]["deviations"] == pytest.approx(5.0)
    assert rows["same"]["difference_ci95"] == pytest.approx([0.5 - 0.98, 0.5 + 0.98], abs=1e-3)
    assert answer["exceeding"] == ["far"] and answer["compared"] == 2
    assert (answer["only_in_first"], answer["only_in_second"]) == (["gone"], ["new"])
    assert rows["kp"]["exceeds"] is None and rows["open"]["exceeds"] is None


def test_equal_runs_end_with_code_0_and_copies_are_named(runs, capsys):
    code, text, error = run(capsys, "compare", runs[0], runs[0])
    assert (code, error) == (0, "") and "copies of one run" in text and "status: ok" in text


def test_other_studies_kinds_and_masses_are_named(runs, tmp_path, capsys):
    other = folder_of(
        tmp_path / "c", {"same": Estimate.normal(1.0, 0.3, "s")}, study="x", kind="dea-stack"
    )
    notes = json.loads(run(capsys, "compare", runs[0], other, "--json")[1])["notes"]
    assert notes == [
        "different kinds of actuator: planar-hasel and dea-stack",
        "different studies: first study and x",
    ]


@pytest.mark.parametrize("rows", [1, 60])
def test_noise_alone_marks_a_row_in_at_most_5_percent_of_comparisons(tmp_path, rows):
    """Known numbers: 400 comparisons of equal values with normal noise."""
    rng, trials = np.random.default_rng(1), 400
    paths = [folder_of(tmp_path / name, {}) for name in ("a", "b")]
    marked = outside = 0
    for _ in range(trials):
        for path in paths:
            quantities = [
                {"id": str(k), "name": "", "unit": "",
                 "measured": Estimate.normal(error, 0.3, "").to_dict()}
                for k, error in enumerate(rng.normal(0.0, 0.3, rows))
            ]  # fmt: skip
            (path / "results.json").write_text(json.dumps({"quantities": quantities}))
        found = compare_results(*paths)
        marked += bool(found.exceeding)
        outside += found.outside
    assert 0.02 < marked / trials < 0.09  # 0.05, 4 standard deviations of 0.011
    assert outside / trials / rows == pytest.approx(0.05, abs=4 * (0.0475 / trials / rows) ** 0.5)


def test_rows_of_a_controller_that_was_designed_anew_are_not_judged(tmp_path, capsys):
    """Noise of the model changes the gains too, which have no interval."""
    for name, gain, margin in (("a", 0.5, 58.0), ("b", 0.6, 61.0)):
        kp = Estimate(gain, 0.0, (gain, gain), "")
        rows = {"S25.kp": kp, "S25.phase_margin": Estimate.normal(margin, 0.2, "deg"),
                "S20.gain": Estimate.normal(1.0, 0.1, "")}  # fmt: skip
        folder_of(tmp_path / name, rows)
    code, text, _ = run(capsys, "compare", tmp_path / "a", tmp_path / "b")
    assert code == 0 and "note: S25.kp are settings" in text
    line = next(one for one in text.splitlines() if one.startswith("S25.phase_margin"))
    assert "3.00 [2.45, 3.55]" in line and "other settings" in line


def test_the_interval_of_a_difference_of_skewed_values_is_skewed(tmp_path):
    first = folder_of(tmp_path / "a", {"tau": Estimate.lognormal(1.0, 0.5, "s")})
    second = folder_of(tmp_path / "b", {"tau": Estimate.normal(1.0, 0.0, "s")})
    low, high = compare_results(first, second).rows[0].difference_ci95
    assert (low, high) == pytest.approx((1.0 - math.exp(1.96 * 0.5), 1.0 - math.exp(-0.98)), 1e-3)


def test_what_cannot_be_compared_is_refused_with_what_to_do(runs, tmp_path, capsys):
    first, second = runs
    file = first / "actuator.toml"
    file.write_text('[actuator]\nkind = "planar-hasel"\n')
    code, _, error = run(capsys, "compare", file, second)
    assert code == 2 and "which only a physical model predicts, but" in error
    assert "haselab identify actuator RUN" in error and "compare RUN RUN --results" in error
    code, _, error = run(capsys, "compare", file, second / "session.h5")
    assert code == 2 and "only a physical model predicts" in error
    code, _, error = run(capsys, "compare", first, second, "--model", "physical")
    assert code == 2 and "The actuator file has no [model.physical]" in error
    code, _, error = run(capsys, "compare", first, second, "--results", "--hold", "zero")
    assert code == 2 and "--hold is for the prediction by a model" in error
    code, _, error = run(capsys, "compare", first, file, "--results")
    assert code == 2 and "--results compares the folders of two runs. Name two." in error
    (second / "results.json").unlink()
    code, _, error = run(capsys, "compare", first, second)
    assert code == 2 and f"Create them with 'haselab analyse {second}'" in error


def test_a_run_with_a_physical_model_predicts_unless_results_are_requested(runs, capsys):
    (runs[0] / "actuator.toml").write_text(MODEL)
    code, _, error = run(capsys, "compare", *runs)
    assert code == 2 and "[model.physical]" in error
    assert "1 of 2 rows differs" in run(capsys, "compare", *runs, "--results")[2]
