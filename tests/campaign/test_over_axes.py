"""Results over the axes, Sobol indices of published functions, and campaigns in pairs."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from haselab.campaign.definition import Axis
from haselab.campaign.summary import paired, share_cases, summarised
from haselab.report.campaign_page import campaign_page
from haselab.store.campaign.shards import CaseRow

GRID = """
name = "a"
kind = "transfer"
[parameters]
case.gain = [2.0, 1.0, 3.0]
case.delay_s = [0.0, 0.01]
"""
UNIFORM = """
name = "a"
kind = "transfer"
[parameters]
case.gain = {{ uniform = [0.0, 1.0] }}
case.natural_frequency_rad_s = {{ uniform = [0.0, 1.0] }}
case.slow_gain = {{ uniform = [0.0, 1.0] }}
[design]
kind = "saltelli"
samples = {}
"""


def ishigami(first: float, second: float, third: float) -> float:
    a, b, c = (2.0 * math.pi * (x - 0.5) for x in (first, second, third))
    return math.sin(a) + 7.0 * math.sin(b) ** 2 + 0.1 * c**4 * math.sin(a)


def g_function(*point: float) -> float:
    return math.prod((abs(4 * x - 2) + a) / (1 + a) for x, a in zip(point, G, strict=True))


G = (0.0, 1.0, 4.5)
PARTIAL = [1.0 / (3.0 * (1.0 + a) ** 2) for a in G]
WHOLE = math.prod(1.0 + v for v in PARTIAL) - 1.0


@pytest.mark.long
@pytest.mark.parametrize(
    ("function", "first", "total"),
    [
        # Saltelli et al., Global Sensitivity Analysis: The Primer, 2008, with a = 7 and b = 0.1
        (ishigami, [0.3139, 0.4424, 0.0], [0.5576, 0.4424, 0.2437]),
        # Sobol, 2001: the partial variances of the g-function are 1 / (3 (1 + a)^2)
        (
            g_function,
            [v / WHOLE for v in PARTIAL],
            [
                v * math.prod(1.0 + w for w in PARTIAL[:k] + PARTIAL[k + 1 :]) / WHOLE
                for k, v in enumerate(PARTIAL)
            ],
        ),
    ],
)
def test_sobol_indices_are_the_published_ones(
    campaigns: Any, function: Any, first: list[float], total: list[float]
) -> None:
    """Twice the half width of 95 % is 3.9 standard deviations; six numbers are compared."""
    plan = campaigns.plan(UNIFORM.format(1024))
    found = summarised(plan, campaigns.rows_of(plan, function))["sensitivities"]
    assert len(found) == 3
    for one, *true in zip(found, first, total, strict=True):
        for index, share in zip(("first", "total"), true, strict=True):
            low, high = one[index]["ci95"]
            assert one[index]["value"] == pytest.approx(share, abs=high - low)
            assert high - low < 0.2


@pytest.mark.parametrize(("samples", "given"), [(32, False), (64, True)])
def test_sobol_indices_of_few_blocks_have_no_interval(
    campaigns: Any, samples: int, *, given: bool
) -> None:
    plan = campaigns.plan(UNIFORM.format(samples))
    summary = summarised(plan, campaigns.rows_of(plan, lambda a, b, c: a + b * c))
    found = [one[index]["ci95"] for one in summary["sensitivities"] for index in ("first", "total")]
    assert len(found) == 6 and all((each is not None) == given for each in found)
    page = campaign_page(summary, {})
    assert "Sensitivity: Sobol indices" in page
    assert "spread more evenly" not in page  # no interval of this page is of such a design


@pytest.mark.parametrize(("kind", "even"), [("random", False), ("latin-hypercube", True)])
def test_the_page_warns_of_wide_intervals_where_points_are_spread_evenly(
    campaigns: Any, kind: str, even: bool
) -> None:
    plan = campaigns.plan(UNIFORM.format(64).replace("saltelli", kind))
    page = campaign_page(summarised(plan, campaigns.rows_of(plan, lambda a, b, c: a)), {})
    assert ("spread more evenly" in page) == even
    assert "those of rank correlations by Fisher" in page


def test_a_grid_has_its_results_over_each_axis_and_both(campaigns: Any) -> None:
    plan = campaigns.plan(GRID)
    rows = campaigns.rows_of(plan, lambda gain, delay: gain + 100.0 * delay)
    rows[1].results["y"] = math.nan  # of gain 2 and delay 0.01
    rows[4].results["y"] = math.inf  # of gain 3 and delay 0
    summary = summarised(plan, rows)
    found = {tuple(one["axes"]): one["points"] for one in summary["over_axes"]}
    assert found["case.gain",] == [
        {"at": [2.0], "count": 1, "without_value": 1, "least": 2.0, "median": 2.0, "largest": 2.0},
        {"at": [1.0], "count": 2, "without_value": 0, "least": 1.0, "median": 1.5, "largest": 2.0},
        {"at": [3.0], "count": 2, "without_value": 0, "least": 4.0, "median": math.inf,
         "largest": math.inf},
    ]  # fmt: skip
    assert [point["median"] for point in found["case.delay_s",]] == [2.0, 3.0]
    both = found["case.gain", "case.delay_s"]
    assert [point["at"] for point in both[:3]] == [[2.0, 0.0], [2.0, 0.01], [1.0, 0.0]]
    assert [point.get("median") for point in both] == [2.0, None, 1.0, 2.0, math.inf, 4.0]
    page = campaign_page(summary, {})
    assert "<th>case.gain</th><th>Cases</th><th>y</th>" in page
    assert '<th scope="row">1</th><td>2</td><td>1.5 (1 to 2)</td>' in page
    assert '<th scope="row">3</th><td>not reached</td><td>4</td>' in page
    assert page.count("<svg") == 1 and "case.delay_s = 0.01" in page


@pytest.mark.parametrize("levels", [("zero", "one"), (True, False)])
def test_an_axis_of_texts_has_a_table_and_no_figure(campaigns: Any, levels: Any) -> None:
    plan = campaigns.plan(GRID)
    plan.campaign = replace(plan.campaign, axes=(Axis("case.mode", levels),))
    rows = [CaseRow(f"{k}", k, {"case.mode": level}, {"y": float(k)})
            for k, level in enumerate(levels)]  # fmt: skip
    summary = summarised(plan, rows)
    assert [one["axes"] for one in summary["over_axes"]] == [["case.mode"]]
    page = campaign_page(summary, {})
    assert f'<th scope="row">{levels[1]}</th><td>1</td><td>1</td>' in page and "<svg" not in page


def test_distributions_at_each_point_need_no_further_tables(campaigns: Any) -> None:
    plan = campaigns.plan(GRID + "[design]\nrepeats = 8")
    assert summarised(plan, campaigns.rows_of(plan, lambda gain, delay: gain))["over_axes"] == []


def test_differences_along_an_axis_are_those_of_the_same_devices(campaigns: Any) -> None:
    """The devices differ by 10 and the second value of the axis adds 0.1; the third is worse."""
    text = campaigns.quick.replace("samples = 8", "samples = 64").replace("sobol", "random")
    plan = campaigns.plan(text.replace("[0.01, 0.02]", "[0.01, 0.02, 0.04]"))
    rng = np.random.default_rng(4)
    added = {0.01: 0.0, 0.02: 0.1, 0.04: 50.0}

    def result(noise_std: float, frequency: float, gain: float) -> float:
        return 1e3 * gain + frequency + added[noise_std] + 0.01 * rng.standard_normal()

    rows = campaigns.rows_of(plan, result)
    rows[64 + 3].results["y"] = math.inf
    summary = summarised(plan, rows)
    second, third = summary["axis_differences"]
    assert (second["axis"], second["value"], third["value"]) == ("case.noise_std", 0.02, 0.04)
    assert (second["count"], second["without_value"]) == (63, 1)
    low, high = second["median"]["ci95"]
    assert low < 0.1 < high and high - low < 0.02
    assert third["least"] > 49.0
    page = campaign_page(summary, {})
    assert "Differences along case.noise_std" in page
    assert "case.noise_std</th><td>0.01, 0.02, 0.04</td><td>axis</td>" in page
    assert "case.gain</th><td>0.4, 0.6</td><td>uniform</td>" in page and "duration_s = 1" in page
    ranks = page[page.index("Sensitivity: rank correlation") :]
    gain, frequency = (ranks.index(f"<td>case.{name}</td>")
                       for name in ("gain", "natural_frequency_rad_s"))  # fmt: skip
    assert gain < frequency, "the gain matters most"
    shared = campaigns.plan(text.replace("samples = 64", "samples = 64\nrepeats = 2"))
    shared_rows = campaigns.rows_of(shared, lambda noise_std, *_: noise_std)
    (found,) = summarised(shared, shared_rows)["axis_differences"]
    assert found["median"] == {"value": pytest.approx(0.01), "ci95": None}


def test_differences_along_one_of_two_axes_keep_the_other(campaigns: Any) -> None:
    plan = campaigns.plan(GRID)
    rows = campaigns.rows_of(plan, lambda gain, delay: gain + 1e4 * delay * gain)
    found = {
        (one["axis"], one["value"]): (one["least"], one["median"], one["largest"])
        for one in summarised(plan, rows)["axis_differences"]
    }
    assert found == {
        ("case.gain", 1.0): (-101.0, {"value": -51.0, "ci95": None}, -1.0),
        ("case.gain", 3.0): (1.0, {"value": 51.0, "ci95": None}, 101.0),
        ("case.delay_s", 0.01): (100.0, {"value": 200.0, "ci95": None}, 300.0),
    }


def test_the_page_says_what_its_figures_leave_out(campaigns: Any) -> None:
    delays = [0.01 * k for k in range(9)]
    plan = campaigns.plan(GRID.replace("[0.0, 0.01]", str(delays)))
    rows = campaigns.rows_of(plan, lambda gain, delay: gain + delay)
    page = campaign_page(summarised(plan, rows), {f"y{k}": {} for k in range(13)})
    assert "the first 6 of 9 values of case.delay_s." in page
    assert "the first 12 of 13 results." in page
    assert page.index("<table>") < page.index("<svg")


def test_a_figure_over_each_of_three_axes_is_counted(campaigns: Any) -> None:
    plan = campaigns.plan(GRID + "case.noise_std = [0.1, 0.2]\n")
    rows = campaigns.rows_of(plan, lambda *values: sum(values))
    for row in rows:
        row.results.update({f"z{k}": float(k) for k in range(4)})
    page = campaign_page(summarised(plan, rows), {})
    assert page.count("<svg") == 12 and "Of 15 figures over axes, 12 are shown." in page


def test_errors_that_differ_in_their_numbers_are_counted_together(campaigns: Any) -> None:
    plan = campaigns.plan(GRID)
    rows = campaigns.rows_of(plan, lambda gain, delay: gain)
    for k, error in enumerate(["5.3e-2 is too far.", "-1,200 is too far.", "No S14."]):
        rows[k + 1] = replace(rows[k + 1], error=error, results={})
    found = summarised(plan, rows)["failures"]
    assert [(one["error"], one["count"], one["index"]) for one in found] == [
        ("5.3e-2 is too far.", 2, 1), ("No S14.", 1, 3),
    ]  # fmt: skip


def test_infinities_of_both_signs_have_no_mean_and_no_warning(campaigns: Any) -> None:
    plan = campaigns.plan(GRID)
    rows = campaigns.rows_of(plan, lambda gain, delay: math.inf if gain > 1.5 else -math.inf)
    (found,) = summarised(plan, rows)["distributions"]
    assert math.isnan(found["mean"]) and found["least"] == -math.inf


def test_a_median_between_a_number_and_an_infinity_is_the_infinity(campaigns: Any) -> None:
    plan = campaigns.plan(GRID)
    for infinity in (-math.inf, math.inf):
        rows = campaigns.rows_of(
            plan, lambda gain, delay, end=infinity: gain if delay == 0.0 else end
        )
        found = {tuple(one["axes"]): one["points"] for one in summarised(plan, rows)["over_axes"]}
        assert [point["median"] for point in found["case.gain",]] == [infinity] * 3


def test_cases_with_the_same_draws_are_compared_in_pairs(campaigns: Any) -> None:
    """The devices differ by 10 and the change is 0.1: only the pairs show it."""
    text = campaigns.quick.replace("samples = 8", "samples = 16").replace("[0.01, 0.02]", "[0.01]")
    here, there, other = (
        campaigns.plan(text.replace("1.0\nrate", f"{duration}\nrate").replace("= 7", f"= {seed}"))
        for duration, seed in ((1.0, 7), (2.0, 7), (1.0, 8))
    )
    described = [plan.campaign.described() for plan in (here, there, other)]
    assert described[0] != described[1] and share_cases(*described[:2])
    assert not share_cases(described[0], described[2])
    rng = np.random.default_rng(4)
    devices = rng.normal(0.0, 10.0, 16)
    rows = [CaseRow(f"{k}", k, here.values(k), {"y": y}) for k, y in enumerate(devices + 0.1)]
    rows[3].results["y"] = math.inf
    rows[4].results.clear()
    table = {"y": devices + rng.normal(0.0, 0.01, 16), "z": np.zeros(16)}
    table["y"][3] = math.inf
    (found,) = paired(rows, table, independent=True)
    assert (found["count"], found["without_value"]) == (14, 2)
    low, high = found["median"]["ci95"]
    assert found["least"] <= low < 0.1 < high <= found["largest"] and high - low < 0.05
    (grid,) = paired(rows, table, independent=False)
    assert grid["median"] == {"value": found["median"]["value"], "ci95": None}
    assert paired(rows, {"y": np.zeros(15)}, independent=True) == []
    page = campaign_page(summarised(here, rows) | {"paired": [found], "comparison": []}, {})
    assert "Comparison case by case" in page
