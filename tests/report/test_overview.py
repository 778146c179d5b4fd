"""The summary and the groups of results, on the page and in a browser."""

import copy
import re

import pytest

from haselab.report import write_report

STEP = {"value": 0.2, "std": 0.01, "ci95": [0.18, 0.22], "unit": ""}


def _text(found):
    return re.sub(r"\s+", " ", re.sub(r"<[^>]*>", " ", found))


@pytest.fixture
def written(make_run, documents):
    """Write the page of a changed folder."""

    def write(more=(), simulated=False, **sections):
        results, analysis = copy.deepcopy(documents)
        results["quantities"] += more
        results["simulated"] = simulated
        return write_report(make_run(results, {**analysis, **sections}))

    return write


@pytest.mark.parametrize("simulated", (False, True))
def test_the_page_begins_with_what_the_actuator_is_like(written, simulated):
    page = written(simulated=simulated).read_text(encoding="utf-8")
    short = page[page.index('<section id="summary"') : page.index('<section id="results"')]
    text = _text(short)
    assert ("SIMULATED: The actuator in short" in text) == simulated
    # omega of the fixture: 5.11 (1 + 0.002 at % 3) rad/s, over 2 pi in Hz
    assert "Natural frequency 5.130 rad/s = 0.8165 Hz [5.090, 5.171] rad/s" in text
    assert "Damping ratio 0.09000 [0.08929, 0.09071]" in text
    # -4.79 to -4.79 + 4.54 * 2^2 = 13.37, with a noise of 0.05 and a lag at the peak
    assert re.search(r"Strain reach −4\.[89] to 13\.[345] % triangle, 0 to 2 V", text)
    assert "Final error (% of the step)" in text and re.search(r"PI 2.71\d* 0.20", text)
    assert re.search(r"Open loop 7.01\d 10.0", text)


def test_results_stand_in_groups_with_the_main_ones_first(written):
    page = written(
        [
            {"id": "S6.carrier_gain", "name": "low-pass gain", "measured": STEP},
            {"id": "mine.end", "name": "end of the creep", "measured": STEP},
            {"id": "S28.settling", "name": "settling", "measured": None, "note": "too noisy"},
        ],
        experiments=[{"title": "Creep at <1.5 V>", "ids": ["mine.end"]}],
    ).read_text(encoding="utf-8")
    assert re.findall(r"<h3>(.*?)</h3>", page)[:7] == [
        "Reach, operating point and elasticity",
        "Maps between voltage, strain and capacitance",
        "Dynamics: natural frequency, damping and creep",
        "Steps in open and closed loop",
        "Creep at &lt;1.5 V&gt;",
        "Sensing by phase, as in the paper",
        "Without a result",
    ]
    assert page.index("S20.omega_n") < page.index("S20.zeta") < page.index("S19.omega_0")
    assert "settling (S28.settling): too noisy" in page
    folded = re.findall(r"<details>.*?</details>", page, re.DOTALL)
    assert "2 more results" in folded[0] and "S14.a1" in folded[0]
    ids = re.findall(r'id="([^"]*)"', page)
    assert len(ids) == len(set(ids))


def test_a_figure_never_has_the_name_of_a_row(written):
    chart = {"name": "mine", "title": "my chart", "curves": [{"x": [0, 1], "y": [0, 1]}]}
    page = written(charts=[chart]).read_text(encoding="utf-8")
    labels = re.findall(r"<figcaption><b>(.*?)\.</b>", page)
    assert labels == [f"Figure {number}" for number in range(2, 2 + len(labels))]
    assert f'<a href="#mine">{labels[-1]}: my chart</a>' in page


@pytest.mark.parametrize("width", (390, 1280))
def test_the_page_fits_its_window(written, browser, width):
    long = "Capacitance, relative difference of the paper's chain from the lock-in, rising"
    path = written([{"id": "S8.difference_rising", "name": long, "measured": STEP, "paper": 1.0,
                     "verdict": "disagrees", "set_in_twin": "all"}])  # fmt: skip
    page = browser.new_page(viewport={"width": width, "height": 844})
    page.goto(path.as_uri())
    assert page.evaluate("document.documentElement.scrollWidth") == width
    summary = page.locator("summary").first
    summary.click()
    assert page.locator("details").first.get_by_text("S14.a1").is_visible()
    page.close()
