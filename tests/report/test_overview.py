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
    assert "Final error (% of the step)" in text and re.search(r"PI 2.71\d* \[.*?\] — 0.20", text)
    assert re.search(r"Open loop 7.01\d \[.*?\] \d\S* 10.0", text)  # overshoot: of figure 6


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
        "Dynamics: natural frequency, damping and slow motion",
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


def _row(key, value, std=0.0, unit=""):
    ci95 = [value - 1.96 * std, value + 1.96 * std]
    return {"id": key, "name": key, "unit": unit,
            "measured": {"value": value, "std": std, "ci95": ci95, "unit": unit}}  # fmt: skip


@pytest.mark.parametrize(
    ("slow", "said"),
    [
        (0.36, "Creep: slow further motion 45 % of the fast motion, time constant 5.00 s"),
        (-0.04, "Slow partial return after the fast motion (the opposite of creep) 5 % of the"),
        (0.01, "Slow motion, whose direction is not identifiable 1.2 % of the fast motion"),
    ],
)
def test_a_slow_branch_of_the_other_sign_is_no_creep(written, slow, said):
    rows = [_row("S20.gain", 0.8, 0.01), _row("S20.slow_gain", slow, 0.01),
            _row("S20.slow_tau", 5.0, 0.1, "s")]  # fmt: skip
    page = written(rows).read_text(encoding="utf-8")
    text = _text(page[page.index('<section id="summary"') : page.index('<section id="results"')])
    assert said in text
    assert "time constant: [4.80, 5.20] s" in text
    assert ("Creep" in text) == (slow > 0.1)


def _loop(feedthrough, ends):
    controller = {"magnitude": [1.0], "phase_rad": [0.0]}
    worst = {"worst_phase_margin_deg": 41.26, "worst_gain_margin_db": 5.5}
    return {
        "omega_rad_s": [1.0],
        "plant": controller,
        "controllers": {"PI": {**controller, **worst}},
        "worst": {"frequency_spread": 0.1, "feedthrough": feedthrough, "feedthrough_range": ends},
    }


@pytest.mark.parametrize(
    ("feedthrough", "ends", "said"),
    [
        (0.274, [0.227, 0.321],
         "The margins contain a feedthrough of 0.274. Worst margins: the smallest ones with the "
         "natural frequency 10 % lower or higher, or a feedthrough of 0.227 to 0.321"),
        (0.0, None, "Worst margins: the smallest ones with the natural frequency 10 % lower or "
         "higher; the PID"),
    ],
)  # fmt: skip
def test_the_summary_states_the_worst_margins_and_the_feedthrough(written, feedthrough, ends, said):
    rows = [_row("S21.phase_margin", 55.5, 0.1, "deg"), _row("S21.gain_margin", 8.0, 0.1, "dB"),
            _row("S20.feedthrough", 0.274, 0.02)]  # fmt: skip
    page = written(rows, loop=_loop(feedthrough, ends)).read_text(encoding="utf-8")
    text = _text(page[page.index('<section id="summary"') : page.index('<section id="results"')])
    assert said in text
    assert "Phase margin (°) Worst phase margin (°) Gain margin (dB) Worst gain margin (dB)" in text
    assert "55.50 41.3 8.00 5.50" in text
    assert "Feedthrough: fraction of the sensed strain" in text
    used = "the margins contain it" if feedthrough else "the margins use 0"
    assert f"0.274 [0.235, 0.313]; {used}" in text


def test_predicted_steps_stand_beside_the_played_ones(written, documents):
    steps = copy.deepcopy(documents[1]["steps"])
    played = {
        "rise_time_s": {"value": 2.885, "std": 0.004, "ci95": [2.877, 2.893], "unit": "s"},
        "overshoot": {"value": 0.0983, "std": 0.0025, "ci95": [0.093, 0.103], "unit": ""},
        "error": {"value": 0.064, "std": 0.0025, "ci95": [0.059, 0.069], "unit": ""},
    }
    never = {"value": None, "std": None, "ci95": [None, None], "unit": "s"}
    opened = {
        "settling_time_s": never,
        "overshoot": {"value": 0.5627, "std": 0.0025, "ci95": [0.55, 0.57], "unit": ""},
    }
    steps["metrics"] = {"open loop": opened, "PI": played}
    steps["predicted"] = {
        "open loop": {"rise_time_s": None, "overshoot": 0.567, "error": -1e-18},
        "PI": {"rise_time_s": 3.2344, "overshoot": 0.006, "settling_time_s": 4.85, "error": 0.0415},
    }
    steps["map_error"] = {"PI": 0.0431}
    page = written(steps=steps).read_text(encoding="utf-8")
    text = _text(page[page.index("<h3>Predicted and played steps") :])
    assert "Open loop — — 56.7 56.27 — not settled 0 — —" in text
    assert "PI 3.23 2.8850 0.60 9.83 4.85 — 4.15 6.40 4.31" in text
    assert "Not settled: the strain does not stay within 2 % of the way" in text
    assert "By the strain map: strain sensed by capacitance minus strain by the camera" in text
    # the overshoot of the open loop stands in the table above, too
    short = _text(page[page.index('<section id="summary"') : page.index("<h3>Predicted")])
    assert re.search(r"Open loop 7\.01\d \[.*?, .*?\] 56\.27 10\.0", short)


def test_the_loop_of_the_actuator_file_is_marked_and_rise_times_have_intervals(written):
    rows = [_row("S25.kp", 0.0), _row("S25.ki", 11.394), _row("S25.rise_pid", 0.1, 0.02)]
    folder = written(rows).parent
    for ki, marked in ((11.39, True), (9.0, False)):
        gains = f"[controller.parameters]\nkp = 0.0\nki = {ki}\n"
        (folder / "actuator.toml").write_text(f'[controller]\nkind = "pid"\n{gains}')
        text = _text(write_report(folder).read_text(encoding="utf-8"))
        mark = " (controller of actuator.toml)" if marked else ""
        assert f"PID{mark} 0.100 [0.061, 0.139]" in text


@pytest.mark.parametrize("modelled", [False, True])
def test_what_differs_between_the_natural_frequencies_is_said_where_they_are(written, modelled):
    row = _row("S19.omega_0", 33.22, 3e-4)
    if modelled:
        row["direct"] = {"value": 33.22, "std": 0.02, "ci95": [33.18, 33.26], "unit": ""}
    page = written([row, _row("S20.omega_n", 32.66)]).read_text(encoding="utf-8")
    text = _text(page[page.index('<section id="results-dynamics"') :])
    assert "S20 is of the chirp" in text and "another amplitude and another motion" in text
    assert ("those of the physical model of all experiments together" in text) == modelled
