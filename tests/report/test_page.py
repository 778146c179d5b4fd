import copy
import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser

import pytest

from haselab.report import compose_page, read_folder, results_table, save_page, write_report
from haselab.report.numbers import value_text

VOID = {"meta", "br", "link", "img", "input", "hr"}
REFERENCES = {"src", "href", "xlink:href", "srcset", "poster", "action", "data"}


class Reader(HTMLParser):
    """Collects text, ids and references; notes tags that are not closed."""

    def __init__(self, page):
        super().__init__()
        self.open, self.ids, self.references, self.rows = [], [], [], []
        self.cell = None
        self.feed(page)
        self.close()

    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        if tag not in VOID:
            self.open.append(tag)
        if "id" in named:
            self.ids.append(named["id"])
        self.references += [named[key] for key in REFERENCES & set(named)]
        for value in named.values():
            self.references += re.findall(r"url\(([^)]*)\)", value or "")
        if tag == "tr":
            self.rows.append([])
        if tag in ("td", "th") and self.rows:
            self.rows[-1].append("")

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        if tag not in VOID:
            self.open.pop()

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data


@pytest.fixture(scope="module")
def page(run_folder):
    return write_report(run_folder).read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def read(page):
    return Reader(page)


def test_the_page_is_well_formed_and_its_ids_are_unique(read):
    assert read.open == []
    assert len(read.ids) == len(set(read.ids))


def test_the_page_refers_to_nothing_outside_itself(page, read):
    assert read.references
    for reference in read.references:
        assert reference.startswith(("#", "data:image/png;base64,")), reference
    assert "http" not in page
    assert "@import" not in page
    assert "<script" not in page


def test_every_reference_inside_the_page_has_its_target(read):
    targets = {f"#{name}" for name in read.ids}
    assert {name for name in read.references if name.startswith("#")} <= targets


def test_the_table_has_every_quantity_with_its_interval(read, documents):
    results, _ = documents
    for quantity in results["quantities"]:
        (cells,) = (cells for cells in read.rows if cells and f" {quantity['id']}" in cells[0])
        if len(cells) == 5:  # a subject of which the paper has no value
            cells = [*cells[:2], "—", "—", *cells[2:], "not in paper"]
        assert quantity["name"] in cells[0]
        ends = re.fullmatch(r"\[([^,]+), ([^\]]+)\](?:×10(.+))?", cells[5])
        power = int((ends[3] or "⁰").translate(str.maketrans("⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "-0123456789")))
        for text, exact in zip(ends.group(1, 2), quantity["measured"]["ci95"], strict=True):
            decimals = len(text.partition(".")[2])
            shown = float(text.replace("−", "-"))
            half_unit = 0.5 * 10.0**-decimals
            assert abs(shown - exact / 10.0**power) <= half_unit * (1 + 1e-9)
        assert cells[7] == quantity["verdict"]


def test_a_verdict_is_worded_and_coloured(page):
    assert page.count('<span class="verdict disagrees">disagrees</span>') == 2
    assert '<span class="verdict neutral">not in paper</span>' in page


def test_the_summary_counts_verdicts_and_values_without_noise(page):
    lead = re.search(r'<p class="lead">(.*?)</p>', page, re.DOTALL)[1]
    assert "11 results, by subject below." in lead
    assert "9 results can be compared with the paper: 8 agree, 1 disagrees." in lead
    assert "10 of 10 intervals contain the noise-free value." in lead


def test_a_simulated_bench_is_marked_in_the_title_and_in_its_rows(make_run, documents):
    results, analysis = copy.deepcopy(documents)
    results["simulated"] = True
    results["verdict_rule"] = "Agrees: by a rule."
    results["quantities"][0]["set_in_twin"] = "span of eq. 4"
    results["quantities"][1]["follows_from_twin"] = "mass"
    analysis["rows"] = [{"id": "S1", "paper": "", "here": "", "where": "", "differs": ""}]
    analysis["rows_changed"] = "This run used another study."
    folder = make_run(results, analysis)
    write_report(folder)
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert "<h1>SIMULATED: " in page
    assert "Agrees: by a rule." in page
    assert page.count(">set in the twin</span>") == 1
    lead = re.search(r'<p class="lead">(.*?)</p>', page, re.DOTALL)[1]
    assert "agreement or disagreement with the paper is no evidence" in lead
    assert "1 were set in the twin, 1 follow from its parameters" in lead
    assert " agree, " not in lead
    assert "This run used another study." in page


def test_a_printed_quantity_with_two_rows_counts_once(make_run, documents):
    results, analysis = copy.deepcopy(documents)
    compared = [row for row in results["quantities"] if row["verdict"] == "agrees"]
    compared[1]["same_as"] = compared[0]["id"]
    write_report(folder := make_run(results, analysis))
    assert "8 results can be compared with the paper: 7 agree, 1 disagrees." in (
        folder / "report.html"
    ).read_text(encoding="utf-8")


def test_results_that_a_run_lacks_are_listed_with_the_reason(make_run, documents):
    results, analysis = copy.deepcopy(documents)
    results["not_played"] = [{"ids": ["S26.rise"], "reason": "no recording."}]
    write_report(folder := make_run(results, analysis))
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert '<li class="missing">S26.rise: no recording.</li>' in page
    assert "1 result is missing" in page


def test_an_empty_estimate_in_a_table_is_one_dash():
    nothing = {"value": None, "std": None, "ci95": [None, None], "unit": "s"}
    assert value_text(nothing) == "—"


def test_figures_stand_in_the_papers_order(page):
    places = [page.index(f'<figure id="fig{at}">') for at in range(2, 8)]
    assert places == sorted(places)


def test_the_files_of_the_figures_are_written(run_folder, page):
    names = {path.name for path in (run_folder / "figures").iterdir()}
    assert {f"fig{at}.svg" for at in range(2, 8)} <= names
    assert "bode-plant.svg" in names


def test_provenance_is_printed_in_full(page):
    for name, text in (("seed", "20181004"), ("versions.numpy", "2.4.6")):
        assert f"<dt>{name}</dt><dd>{text}</dd>" in page
    assert "<dt>configuration.trials</dt><dd>6, 4</dd>" in page


def test_text_of_the_files_cannot_become_markup(make_run, documents):
    results, _ = copy.deepcopy(documents)
    results["quantities"][0]["note"] = "<script>alert(1)</script>"
    folder = make_run(results, {})
    text = write_report(folder).read_text(encoding="utf-8")
    assert "<script" not in text
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in text


def test_a_folder_without_analysis_gives_a_page_of_notes_and_no_old_figures(make_run, documents):
    folder = make_run(documents[0], {})
    (folder / "analysis.json").unlink()
    (folder / "figures").mkdir()
    (folder / "figures" / "fig5.svg").write_text("<svg/>", encoding="utf-8")
    (folder / "figures" / "mine.svg").write_text("<svg/>", encoding="utf-8")
    page = compose_page(read_folder(folder))
    text = save_page(page, folder, folder / "report.html").read_text(encoding="utf-8")
    assert set(page.left_out) == {drawing.plan.name for drawing in page.drawings}
    assert "The figure was left out: analysis.json has no section &#39;loop&#39;." in text
    assert "analysis.json has no section 'd_rows'" in text
    assert [path.name for path in (folder / "figures").iterdir()] == ["mine.svg"]
    assert Reader(text).open == []


def test_the_same_folder_gives_the_same_bytes_elsewhere(run_folder, page, make_run, documents):
    """Another process, hash seed, folder and set of matplotlib settings of the user."""
    folder = make_run(*documents)
    settings = folder.parent / "matplotlibrc"
    settings.write_text("font.size: 20\naxes.grid: False\nsvg.fonttype: path\n", encoding="utf-8")
    code = "import sys, pathlib as p, haselab.report as r; r.write_report(p.Path(sys.argv[1]))"
    environment = {**os.environ, "MATPLOTLIBRC": str(settings), "PYTHONHASHSEED": "7"}
    command = [sys.executable, "-W", "error", "-c", code, str(folder)]
    subprocess.run(command, check=True, env=environment)
    assert (folder / "report.html").read_text(encoding="utf-8") == page
    for path in (run_folder / "figures").iterdir():
        assert (folder / "figures" / path.name).read_bytes() == path.read_bytes()


def test_step_metrics_stand_below_figure_6(read, documents):
    metrics = documents[1]["steps"]["metrics"]
    rows = {cells[0]: cells[1:] for cells in read.rows if cells and cells[0] in metrics}
    assert set(rows) == set(metrics)
    assert rows["PI"][0] == "2.700 [2.541, 2.859] s"


def test_the_caption_of_figure_6_defines_the_columns_of_its_table(page):
    caption = page[page.index("<b>Figure 6.") :].partition("</figcaption>")[0]
    assert "Rise time: from 10 to 90 %" in caption
    assert "Overshoot: largest strain beyond the final strain" in caption
    assert "Settling time" not in caption  # a column that this table does not have


def test_the_summary_names_the_own_controller_of_a_study(make_run, documents):
    results, analysis = copy.deepcopy(documents)
    results["provenance"]["study"] = {"name": "mine", "control": {"kind": "leaky"}}
    results["quantities"] += [
        {"id": "S25.rise_own", "unit": "s", "measured": {"value": None, "std": None,
         "ci95": [None, None], "unit": "s"}, "note": "no value: no rise; more"},
        {"id": "S25.error_own", "measured": {"value": 0.01, "std": 0.001,
         "ci95": [0.008, 0.012], "unit": ""}},
    ]  # fmt: skip
    found = write_report(make_run(results, analysis)).read_text(encoding="utf-8")
    assert ["Controller 'leaky'", "—", "—", "1.00 [0.80, 1.20]"] in Reader(found).rows
    assert '<li class="missing">S25.rise_own (S25.rise_own): no value: no rise; more</li>' in found
    text = results_table(results)
    assert "\nS25.rise_own has no value: no rise\n" in text


def test_rows_of_the_recomputed_paper_may_lack_cells(make_run, documents):
    folder = make_run(documents[0], {"d_rows": [{"id": "D9", "claim": "zero strain at 5 kV"}]})
    rows = Reader(write_report(folder).read_text(encoding="utf-8")).rows
    assert ["zero strain at 5 kV D9", "—", "—", "—"] in rows


def test_analysis_with_json_nan_is_drawn(make_run, documents):
    analysis = {"static": copy.deepcopy(documents[1]["static"])}
    analysis["static"]["load_n"][3] = float("nan")
    folder = make_run(documents[0], analysis)
    assert "NaN" in (folder / "analysis.json").read_text(encoding="utf-8")
    page = compose_page(read_folder(folder))
    assert "fig4" not in page.left_out
    assert json.loads((folder / "results.json").read_text())["quantities"]
