"""The notebooks of docs/notebooks run from top to bottom, and what they find is right."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient
from scipy.stats import binom, chi2

import haselab as hl
from haselab.models import VoltageMap
from haselab.pipelines.examples import recordings
from haselab.rig.chip.build import simavr_header

FOLDER = Path(__file__).resolve().parents[3] / "docs" / "notebooks"
NAMES = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
_GUARD_S = 900


def read(name: str) -> nbformat.NotebookNode:
    return nbformat.read(FOLDER / f"{name}.ipynb", as_version=nbformat.NO_CONVERT)


def executed(name: str, folder: Path, wanted: str) -> Any:
    """Run a notebook in an empty folder, which it must leave empty; the value of an expression.

    Args:
        name: of the notebook.
        folder: working directory of its kernel.
        wanted: expression in its names afterwards, of plain numbers, texts, lists and dictionaries.
    """
    notebook = read(name)
    code = f"import json\nprint(json.dumps({wanted}, default=float))"
    notebook.cells.append(nbformat.v4.new_code_cell(code))
    where = {"metadata": {"path": str(folder)}}
    NotebookClient(notebook, timeout=_GUARD_S, kernel_name="python3", resources=where).execute()
    assert list(folder.iterdir()) == [], "a notebook writes into a temporary folder of its own"
    return json.loads(notebook.cells[-1].outputs[0].text)


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_is_committed_without_outputs_and_says_that_it_is_simulated(name: str) -> None:
    notebook = read(name)
    nbformat.validate(notebook)
    assert (notebook.nbformat, notebook.nbformat_minor) == (4, 5)
    assert notebook.metadata.kernelspec.name == "python3"
    for cell in notebook.cells:
        if cell.cell_type == "code":
            assert cell.outputs == [] and cell.execution_count is None, cell.id
    first = notebook.cells[0].source
    assert "SIMULATED" in first and "**Time:**" in first and "glossary.md" in first


def test_the_page_lists_each_notebook() -> None:
    page = (FOLDER / "README.md").read_text(encoding="utf-8")
    assert [name for name in NAMES if f"]({name}.ipynb)" not in page] == []


@pytest.mark.parametrize("name", NAMES)
def test_links_of_a_notebook_lead_to_a_file(name: str) -> None:
    for cell in read(name).cells:
        if cell.cell_type == "markdown":
            for part in cell.source.split("](")[1:]:
                target = part.partition(")")[0].partition("#")[0]
                assert (FOLDER / target).exists(), f"{cell.id} points to {target}"


def test_the_loop_of_the_reference_study_leaves_no_error_but_that_of_its_map(
    tmp_path: Path,
) -> None:
    found = executed("reference-study", tmp_path, """{
        "closed": 0.04 * closed_loop.steady_state_error.value,
        "open": 0.04 * open_loop.steady_state_error.value,
        "rise_s": closed_loop.rise_time_s.ci95,
        "map": to_strain.hysteresis_strain + max(map(abs, to_strain.band)),
        "slope": line.parameters["slope"].ci95,
        "used": [to_strain.slope_at(c) / 100 for c in np.quantile(capacitance_f, [0.1, 0.5, 0.9])],
    }""")  # fmt: skip
    # An integrator leaves no sensed error; what is left is the error of sensing.
    assert abs(found["closed"]) < found["map"]
    assert abs(found["open"]) > found["map"]
    assert found["rise_s"][0] < found["rise_s"][1]
    # The straight line lies between the slopes of the curved map, which was fitted another way.
    assert min(found["used"]) < found["slope"][1] and found["slope"][0] < max(found["used"])


def test_the_frequency_from_the_data_is_that_of_the_record_without_noise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, installed: Callable[[str, str], str]
) -> None:
    found = executed("your-data-to-firmware", tmp_path, """{
        "map": [float(getattr(actuator.voltage_map, key)) for key in ("a1_v", "b1", "a2_v", "b2")],
        "frequency": actuator.plant.natural_frequency_rad_s,
        "file": Path("actuator.toml").read_text(),
        "step": simulated,
    }""")  # fmt: skip
    monkeypatch.setattr(recordings, "_CAMERA_M", 0.0)
    time_s, drive_v, strain = recordings.actuator_records(8).played["chirp"]
    to_volt = VoltageMap(*found["map"])
    corrected = to_volt.strain(drive_v)
    record = hl.Record(corrected, 100.0, strain, time_s)
    fit = hl.fit_transfer(record, hl.identify.TransferStructure(slow_modes=1))
    assert fit.succeeded
    low, high = fit.parameters["natural_frequency_rad_s"].ci95
    assert low < found["frequency"] < high
    assert found["file"].count('status = "ok"') == 4
    installed("avr-gcc", "gcc-avr")
    if simavr_header() is None:
        pytest.skip("libsimavr is not installed. Run:  sudo apt-get install -y libsimavr-dev")
    step = found["step"]
    assert step["status"] == "ok" and step["deviation"] <= step["deviation_tolerated"]
    assert step["loops"][-1]["loop"].startswith("chip")


def test_the_stated_deviations_of_the_video_are_those_of_its_true_motion(tmp_path: Path) -> None:
    found = executed("tracking-a-video", tmp_path, """{
        "outside": int((np.abs(error) >= 1.96 * std).sum()), "frames": int(error.size),
        **{name: [
            float((((rows := moved(f"{name}.csv")[lambda each: each.index.str.startswith("p")])
                    .down_px - true[299] * (rows.y_px - upper_px)) ** 2 / rows.std_px ** 2).sum()),
            len(rows)] for name in ("all", "by-hand")},
    }""")  # fmt: skip
    # 0.1 % of all videos would have more errors outside of the interval of 95 %.
    assert found["outside"] <= binom.ppf(0.999, found["frames"], 0.05)
    for name, is_right in (("all", True), ("by-hand", False)):
        squares, count = found[name]
        assert bool(squares < chi2.ppf(0.999, count)) == is_right, name


def test_no_controller_is_faster_than_the_physical_limit(tmp_path: Path) -> None:
    found = executed("controllers-compared", tmp_path, """{
        "limit_s": limit.rise_s, "motion": limit.motion.tolist(),
        "rows": [[row.controller, row.metric, row.median, row.bound] for row in rows],
        "status": dict(game.identification),
    }""")  # fmt: skip
    assert found["status"] == {"hz": "ok"}
    time_s, moved = np.array(found["motion"])
    ten_s, ninety_s = np.interp([0.1, 0.9], moved / 0.04, time_s)
    assert ninety_s - ten_s == pytest.approx(found["limit_s"], abs=2e-4)  # of two steps of 0.1 ms
    bounded = [row for row in found["rows"] if row[3] is not None]
    assert {metric for _, metric, _, _ in bounded} == {"rise_s", "settling_s", "peak"}
    for controller, metric, median, bound in bounded:
        assert (math.inf if median is None else median) > bound, (controller, metric)
    peaks = {controller: median for controller, metric, median, _ in bounded if metric == "peak"}
    assert peaks["observer"] == min(peaks.values())


def test_the_chosen_peano_moves_as_its_law_says(tmp_path: Path) -> None:
    found = executed("design-a-peano", tmp_path, """{
        "law_m": float(-best.stroke_m), "twin_m": float(stroke_m), "std_m": float(std_m),
        "force_n": float(best.force_n), "failed": cases[cases.status == "failed"].error.tolist(),
        "share": [law.branch_share[0], law.branch_relaxation_s[0]],
    }""")  # fmt: skip
    share, relaxation_s = found["share"]
    # Creep that is left 8 s after the step, and the scatter of both means.
    allowed_m = share * math.exp(-8.0 / relaxation_s) * found["law_m"] + 4.0 * found["std_m"]
    assert abs(found["twin_m"] - found["law_m"]) < allowed_m
    assert found["force_n"] >= 4.0
    assert found["failed"] and all("of the pouch" in error for error in found["failed"])


def test_the_campaign_finds_which_parameter_matters(tmp_path: Path) -> None:
    found = executed("campaign", tmp_path, """{
        "cases": len(cases), "failed": len(failed), "again": int((again.status == "failed").sum()),
        "largest": float(good.relative_field.max()),
        "first": [each["first"] for each in found], "total": [each["total"] for each in found],
        "survivors": len(stroke_mm),
    }""")  # fmt: skip
    assert found["cases"] >= 100 and found["survivors"] == found["cases"]
    assert found["failed"] == found["again"] > 0
    assert found["largest"] < 1.0
    # The law is smooth and the ranges are small, so the parameters act almost additively.
    for name in ("first", "total"):
        half = [0.5 * (each["ci95"][1] - each["ci95"][0]) for each in found[name]]
        total = sum(each["value"] for each in found[name])
        assert abs(total - 1.0) < math.hypot(*half), name
