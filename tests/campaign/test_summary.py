"""Distributions, coverage and sensitivities against numbers that are known."""

from __future__ import annotations

import json
import math
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab.base import InputError
from haselab.campaign.definition import Distribution
from haselab.campaign.folder import TABLE, finished_rows, read_results
from haselab.campaign.groups import groups_of
from haselab.campaign.summary import (
    compared,
    draws_are_independent,
    median_interval,
    most_important,
    summarised,
    with_infinities,
)
from haselab.report.campaign_page import campaign_page
from haselab.store.campaign.shards import CaseRow
from haselab.store.folder import json_text

DESIGN = """
name = "a"
kind = "transfer"
[parameters]
case.gain = {{ uniform = [0.0, 1.0] }}
case.natural_frequency_rad_s = {{ uniform = [1.0, 2.0] }}
[design]
kind = "{}"
samples = {}
"""


@pytest.mark.long
def test_the_interval_of_a_median_contains_it_in_at_least_95_percent() -> None:
    """Order statistics are discrete, so that for 20 values the exact share is 95.86 %."""
    rng = np.random.default_rng(1)
    drawn = rng.exponential(size=(4000, 20))
    inside = [low <= math.log(2.0) <= high for low, high in map(median_interval, drawn)]
    exact = 1.0 - 2.0 * sum(math.comb(20, k) for k in range(6)) / 2**20
    assert np.mean(inside) == pytest.approx(exact, abs=4.0 * math.sqrt(exact * (1 - exact) / 4000))


def test_too_few_values_have_no_interval() -> None:
    assert median_interval(np.arange(5.0)) is None
    assert median_interval(np.arange(6.0)) == [0.0, 5.0]


def test_sobol_indices_are_those_of_a_known_function(campaigns: Any) -> None:
    r"""Of $y = 3 a + b$ with uniform $a$, $b$ the variances are 9 and 1 parts of ten."""
    plan = campaigns.plan(DESIGN.format("saltelli", 256))
    rows = campaigns.rows_of(plan, lambda gain, omega: 3.0 * gain + omega)
    found = {one["parameter"]: one for one in summarised(plan, rows)["sensitivities"]}
    for path, share in (("case.gain", 0.9), ("case.natural_frequency_rad_s", 0.1)):
        for index in ("first", "total"):
            low, high = found[path][index]["ci95"]
            assert low < share < high
            assert found[path][index]["value"] == pytest.approx(share, abs=0.03)


def test_sobol_indices_come_with_the_sign_of_the_dependence(campaigns: Any) -> None:
    """From the independent points: 128 in 64 blocks."""
    plan = campaigns.plan(DESIGN.format("saltelli", 64))
    rows = campaigns.rows_of(plan, lambda gain, omega: 3.0 * gain - omega)
    summary = summarised(plan, rows)
    found = {one["parameter"]: one for one in summary["sensitivities"]}
    gain, omega = (found[f"case.{key}"] for key in ("gain", "natural_frequency_rad_s"))
    assert gain["correlation"]["value"] > 0.9 and gain["count"] == 128
    assert -0.6 < omega["correlation"]["value"] < -0.1 and omega["correlation"]["ci95"] is None
    assert "(total Sobol index 0.9" in (line := most_important(summary, rows))
    assert ", rises)" in line and line.endswith(", falls)")
    page = campaign_page(summary, {})
    assert "Sensitivity: Sobol indices" in page and "Sensitivity: rank correlation" in page


def test_a_failed_case_takes_its_block_out_of_the_indices(campaigns: Any) -> None:
    plan = campaigns.plan(DESIGN.format("saltelli", 16))
    rows = campaigns.rows_of(plan, lambda gain, omega: 3.0 * gain + omega)
    rows[5] = replace(rows[5], results={}, error="it failed")
    summary = summarised(plan, rows)
    assert {one["blocks"] for one in summary["sensitivities"]} == {15}
    assert {one["blocks_left_out"] for one in summary["sensitivities"]} == {1}
    assert summary["distributions"][0]["without_value"] == 1
    assert summary["distributions"][0]["median"]["ci95"] is None  # the points share coordinates
    assert summary["failures"][0]["count"] == 1 and summary["failures"][0]["index"] == 5


def test_rank_correlations_are_those_of_monotone_and_unrelated_parameters(campaigns: Any) -> None:
    plan = campaigns.plan(DESIGN.format("random", 200))
    rows = campaigns.rows_of(plan, lambda gain, omega: math.exp(-gain))
    found = {
        one["parameter"]: one["correlation"] for one in summarised(plan, rows)["sensitivities"]
    }
    assert found["case.gain"]["value"] == pytest.approx(-1.0)
    low, high = found["case.natural_frequency_rad_s"]["ci95"]
    assert low < 0.0 < high and high - low == pytest.approx(2 * 1.96 / math.sqrt(197), rel=0.05)


def test_a_choice_of_numbers_has_a_rank_and_one_of_texts_is_named(campaigns: Any) -> None:
    drawn = "case.gain = {{ uniform = [0.0, 1.0] }}"
    text = DESIGN.replace(drawn, "case.gain = {{ choice = [0.2, 0.5, 0.3] }}")
    plan = campaigns.plan(text.format("random", 60))
    rows = campaigns.rows_of(plan, lambda gain, omega: gain)
    summary = summarised(plan, rows)
    found = {one["parameter"]: one["correlation"] for one in summary["sensitivities"]}
    assert found["case.gain"]["value"] == pytest.approx(1.0) and summary["unranked"] == []
    texts = Distribution("case.gain", "choice", ("low", "high"))
    plan.campaign = replace(plan.campaign, distributions=(texts, *plan.campaign.distributions[1:]))
    rows = [replace(row, values={**row.values, "case.gain": "low"}) for row in rows]
    summary = summarised(plan, rows)
    assert [one["parameter"] for one in summary["sensitivities"]] == [
        "case.natural_frequency_rad_s"
    ]
    assert "leave out case.gain, whose values are not numbers" in campaign_page(summary, {})


@pytest.mark.parametrize("factor", [1e200, 1e-200, 1e307, 1.0])
def test_sobol_indices_do_not_depend_on_the_unit_of_the_result(
    campaigns: Any, factor: float
) -> None:
    """Scaled by a power of two, so the indices are the same up to the rounding of the factor."""
    plan = campaigns.plan(DESIGN.format("saltelli", 64))
    rows = campaigns.rows_of(plan, lambda gain, omega: factor * (3.0 * gain + omega))
    own = campaigns.rows_of(plan, lambda gain, omega: 3.0 * gain + omega)
    found, expected = (summarised(plan, part)["sensitivities"] for part in (rows, own))
    for one, other in zip(found, expected, strict=True):
        for index in ("first", "total"):
            assert one[index]["value"] == pytest.approx(other[index]["value"], abs=1e-12)
            assert one[index]["ci95"] == pytest.approx(other[index]["ci95"], abs=1e-12)
    assert math.isfinite(summarised(plan, rows)["distributions"][0]["mean"])


def test_a_rank_correlation_lies_in_its_interval_and_a_constant_parameter_has_none(
    campaigns: Any,
) -> None:
    plan = campaigns.plan(DESIGN.format("random", 40))
    for sign in (1.0, -1.0):
        rows = campaigns.rows_of(plan, lambda gain, omega, sign=sign: sign * gain**3)
        rows = [
            replace(row, values={**row.values, "case.natural_frequency_rad_s": 1.5}) for row in rows
        ]
        found = {one["parameter"]: one["correlation"] for one in
                 summarised(plan, rows)["sensitivities"]}  # fmt: skip
        low, high = found["case.gain"]["ci95"]
        assert found["case.gain"]["value"] == pytest.approx(sign, abs=1e-15)
        assert -1.0 <= low <= found["case.gain"]["value"] <= high <= 1.0 and high > low
        constant = found["case.natural_frequency_rad_s"]
        assert math.isnan(constant["value"]) and constant["ci95"] is None


def test_infinite_results_differ_from_those_without_a_value(campaigns: Any) -> None:
    plan = campaigns.plan(DESIGN.format("random", 9))
    rows = campaigns.rows_of(plan, lambda gain, omega: gain)
    rows[0] = replace(rows[0], results={"y": math.inf})
    rows[1] = replace(rows[1], results={"y": -math.inf})
    rows[2] = replace(rows[2], results={})
    summary = summarised(plan, rows)
    page = campaign_page(summary, {})
    assert "<td>not reached</td>" in page and "<td>−infinity</td>" in page
    written = json.loads(json_text(with_infinities(summary)))["distributions"][0]
    assert (written["least"], written["largest"], written["mean"]) == ("-inf", "inf", None)
    assert written["without_value"] == 1


def test_cases_without_noise_have_no_coverage_and_the_page_says_why(campaigns: Any) -> None:
    """The intervals of their fits have the width of rounding errors, and mean nothing."""
    text = campaigns.quick.replace("[0.01, 0.02]", "[0.0]")
    campaigns.run("exact", text)
    plan = campaigns.plan(text)
    summary = summarised(plan, finished_rows(plan, campaigns.folder / "exact"))
    assert summary["coverage"] == []
    assert set(summary["without_noise"]) >= {"gain", "delay_s", "natural_frequency_rad_s"}
    assert "There is no coverage of" in campaign_page(summary, {})
    campaigns.run("noisy")
    plan = campaigns.plan()
    summary = summarised(plan, finished_rows(plan, campaigns.folder / "noisy"))
    assert summary["coverage"] and summary["without_noise"] == []


def test_one_line_names_the_most_important_parameters_of_the_first_result(campaigns: Any) -> None:
    plan = campaigns.plan(DESIGN.format("saltelli", 64))
    rows = campaigns.rows_of(plan, lambda gain, omega: gain + 3.0 * omega)
    rows = [replace(row, results={"y": row.results["y"], "a": 1.0}) for row in rows]
    line = most_important(summarised(plan, rows), rows)
    assert re.fullmatch(
        r"y depends most on case\.natural_frequency_rad_s \(total Sobol index 0\.9\d?, 0\.\d+ to "
        r"[01]\.?\d*, rises\), case\.gain \(total Sobol index 0\.\d+, 0\.\d+ to 0\.\d+, rises\)",
        line,
    ), line
    plan = campaigns.plan(DESIGN.format("random", 40))
    rows = campaigns.rows_of(plan, lambda gain, omega: -gain)
    line = most_important(summarised(plan, rows), rows)
    # the interval of the other parameter, which has no effect, contains 0
    assert line == "y depends most on case.gain (rank correlation -1, -1 to -1)"
    rows = campaigns.rows_of(plan, lambda gain, omega: math.sin(1e5 * gain))
    line = most_important(summarised(plan, rows), rows)
    assert line == "y: each rank correlation has an interval that contains 0"
    points = [replace(row, values=row.values | {"case.delay_s": 0.01}) for row in rows]
    several = summarised(plan, points) | {"sensitivities": [
        {"result": "y", "group": "delay_s = 0.01", "parameter": "case.gain",
         "correlation": {"value": 0.9, "ci95": None}}]}  # fmt: skip
    line = most_important(several, points)
    assert line == ("y at delay_s = 0.01 (first point of the axes) depends most on case.gain (rank "
                    "correlation 0.9)")  # fmt: skip
    few = rows[:4]
    assert most_important({"sensitivities": []}, few) == ""


def test_medians_of_the_same_cases_leave_out_those_without_a_value_in_both(campaigns: Any) -> None:
    """The larger devices fail here, so the median of the others alone would be smaller here."""
    plan = campaigns.plan(DESIGN.format("random", 60))
    rows = campaigns.rows_of(plan, lambda gain, omega: gain + 0.1)
    there = np.array([row.results["y"] - 0.1 for row in rows])
    rows = [row if there[k] < 0.6 else replace(row, results={}, error="it failed")
            for k, row in enumerate(rows)]  # fmt: skip
    (found,) = compared(rows, {"y": there}, in_pairs=True)
    assert found["difference"]["value"] == pytest.approx(0.1)
    (apart,) = compared(rows, {"y": there})
    assert apart["difference"]["value"] < 0.0
    page = campaign_page(summarised(plan, rows), {})
    assert "of 60 cases failed. All distributions" in page


def test_coverage_counts_intervals_that_contain_the_truth(campaigns: Any) -> None:
    plan = campaigns.plan(DESIGN.format("random", 20))
    rows = [
        CaseRow(f"{k}", k, plan.values(k), {"y": 0.0, "y.low": -1.0, "y.high": 1.0,
                                            "y.true": 2.0 if k < 3 else 0.5})
        for k in range(20)
    ]  # fmt: skip
    (found,) = summarised(plan, rows)["coverage"]
    assert (found["inside"], found["count"]) == (17, 20)
    # Clopper and Pearson: tables for 17 of 20
    assert found["share"]["ci95"] == pytest.approx([0.6211, 0.9679], abs=1e-4)


def test_an_interval_without_ends_does_not_count_as_one_that_contains_the_truth(
    campaigns: Any,
) -> None:
    plan = campaigns.plan(DESIGN.format("random", 20))
    endless = {"y": 0.0, "y.low": -math.inf, "y.high": math.inf, "y.true": 2.0}
    positive = endless | {"y.low": 0.0, "y.std": math.inf}
    wrong = endless | {"y.low": -1.0, "y.high": 1.0}
    results = [endless] * 10 + [positive] * 5 + [wrong] * 4
    rows = [CaseRow(f"{k}", k, plan.values(k), results[k]) for k in range(19)]
    rows.append(CaseRow("19", 19, plan.values(19), error="it failed"))
    summary = summarised(plan, rows)
    (found,) = summary["coverage"]
    assert (found["inside"], found["count"], found["without_interval"]) == (0, 4, 16)
    page = campaign_page(summary, {})
    assert "Without an interval" in page and "<td>16</td>" in page


def test_what_was_not_reached_ranks_above_all_in_a_correlation(campaigns: Any) -> None:
    """The result falls with the gain until it is not reached: the numbers alone say -1."""
    plan = campaigns.plan(DESIGN.format("random", 64))
    rows = campaigns.rows_of(plan, lambda gain, omega: -gain if gain < 0.3 else math.inf)
    found = {one["parameter"]: one for one in summarised(plan, rows)["sensitivities"]}
    assert found["case.gain"]["correlation"]["value"] > 0.5
    assert (found["case.gain"]["count"], found["case.gain"]["without_value"]) == (64, 0)


def test_what_was_not_reached_is_larger_than_any_number(campaigns: Any) -> None:
    plan = campaigns.plan(DESIGN.format("random", 21))
    rows = campaigns.rows_of(plan, lambda gain, omega: gain)
    rows = [replace(row, results={"y": math.inf}) if row.index < 12 else row for row in rows]
    summary = summarised(plan, rows)
    assert summary["distributions"][0]["median"]["value"] == math.inf
    values = {"y": {"": groups_of(plan.campaign, rows)[0].present("y")}}
    assert "not reached" in campaign_page(summary, values)


def test_cases_are_grouped_by_the_axes(campaigns: Any) -> None:
    plan = campaigns.plan(campaigns.quick)
    rows = [CaseRow(f"{k}", k, plan.values(k), {"y": float(k)}) for k in range(plan.count)]
    groups = groups_of(plan.campaign, rows)
    assert [group.label for group in groups] == ["noise_std = 0.01", "noise_std = 0.02"]
    assert groups[1].present("y").tolist() == list(range(8, 16))


def test_two_campaigns_are_compared_by_their_medians(campaigns: Any) -> None:
    rng = np.random.default_rng(3)
    rows = [CaseRow(f"{k}", k, {}, {"y": y}) for k, y in enumerate(rng.normal(1.0, 1.0, 400))]
    (found,) = compared(rows, {"y": rng.normal(0.0, 1.0, 400), "z": np.zeros(400)})
    low, high = found["difference"]["ci95"]
    # the standard deviation of a median of 400 is 1.253 / 20
    assert low < 1.0 < high and high - low == pytest.approx(3.92 * 1.253 / 20 * 2**0.5, rel=0.35)
    assert compared(rows, {"y": np.full(400, math.nan)}) == []
    # results that were not reached count as infinite, and most were reached
    (found,) = compared(rows, {"y": np.r_[np.full(300, -1.0), np.full(100, math.inf)]})
    assert found["there"]["value"] == -1.0 and found["difference"]["ci95"] is not None
    assert compared(rows, {"y": np.r_[np.zeros(100), np.full(300, math.inf)]}) == []
    (found,) = compared(rows, {"y": np.r_[np.zeros(400), np.full(7, math.nan)]})
    assert (found["here"]["without_value"], found["there"]["without_value"]) == (0, 7)


def test_the_page_is_self_contained_and_the_same_for_the_same_rows(campaigns: Any) -> None:
    plan = campaigns.plan(DESIGN.format("random", 50))
    rows = campaigns.rows_of(plan, lambda gain, omega: gain + omega)
    rows[3] = replace(rows[3], results={}, error="<b>it failed</b>")
    summary = summarised(plan, rows) | {"comparison": compared(rows, {"y": np.ones(50)}),
                                       "compared_with": "other"}  # fmt: skip
    values = {"y": {"": groups_of(plan.campaign, rows)[0].present("y")}}
    page = campaign_page(summary, values)
    assert page == campaign_page(summary, values)
    assert "SIMULATED" in page and "&lt;b&gt;it failed" in page and "<b>it" not in page
    assert "Sensitivity: rank correlation" in page and "<svg" in page
    for outside in ("http://", "https://", "src=", "@import"):
        assert outside not in page.replace("http://www.w3.org/", "").replace(
            "https://www.w3.org", ""
        )


def test_true_values_without_intervals_have_no_coverage(campaigns: Any) -> None:
    plan = campaigns.plan(DESIGN.format("random", 8))
    rows = [CaseRow(f"{k}", k, plan.values(k), {"y": 0.0, "y.true": 0.5}) for k in range(8)]
    assert summarised(plan, rows)["coverage"] == []


SHARED = """
name = "a"
kind = "transfer"
[parameters]
case.noise_std = {noise}
{drawn}
[design]
{design}
"""
_DRAWN = "case.gain = { uniform = [0.4, 0.6] }"
_RANDOM = 'kind = "random"\nsamples = {}\n'


@pytest.mark.parametrize(
    ("noise", "drawn", "design", "intervals", "coverage"),
    [
        ([0.01, 0.02], _DRAWN, _RANDOM.format(20), True, True),  # 20 devices in each group
        ([0.01, 0.02], _DRAWN, _RANDOM.format(6), False, False),  # one group: 6 devices, twice
        ([0.01, 0.02], "", "repeats = 6\nsame_noise = true", False, False),
        ([0.01, 0.02], "", "repeats = 6", True, True),
        ([0.01], _DRAWN, _RANDOM.format(6) + "repeats = 50", False, False),
        ([0.01], _DRAWN, 'kind = "saltelli"\nsamples = 16', False, False),
        ([k / 1000 for k in range(1, 13)], "", "", False, True),  # no value was drawn
    ],
)
def test_cases_that_share_draws_have_no_interval(
    campaigns: Any, noise: Any, drawn: str, design: str, *, intervals: bool, coverage: bool
) -> None:
    """An interval for 12 independent cases would be too narrow for 6 devices that occur twice."""
    plan = campaigns.plan(SHARED.format(noise=noise, drawn=drawn, design=design))
    rng = np.random.default_rng(1)
    rows = [
        CaseRow(f"{k}", k, plan.values(k), {"y": y, "y.low": y - 1, "y.high": y + 1, "y.true": 0.0})
        for k, y in enumerate(rng.normal(size=plan.count))
    ]
    summary = summarised(plan, rows)
    assert {one["median"]["ci95"] is not None for one in summary["distributions"]} == {intervals}
    assert {one["share"]["ci95"] is not None for one in summary["coverage"]} == {coverage}
    correlations = [one["correlation"] for one in summary["sensitivities"] if "correlation" in one]
    assert all((one["ci95"] is not None) == intervals for one in correlations)
    described = plan.campaign.described()
    assert not draws_are_independent(described, grouped=False) or len(noise) == 1 or not drawn
    (found,) = compared(rows, {"y": rng.normal(size=50)}, independent=False)
    assert found["difference"]["ci95"] is None and found["here"]["ci95"] is None
    campaign_page(summary, {})


def test_groups_of_equal_last_names_have_whole_paths(campaigns: Any) -> None:
    text = """
name = "a"
kind = "geometry"
[base]
twin = "hz"
[parameters]
twin.viscosity.share.0 = [0.1, 0.2]
[design]
repeats = 8
"""
    plan = campaigns.plan(text)
    rows = [CaseRow(f"{k}", k, plan.values(k), {"y": 1.0}) for k in range(plan.count)]
    labels = [group.label for group in groups_of(plan.campaign, rows)]
    assert labels == ["twin.viscosity.share.0 = 0.1", "twin.viscosity.share.0 = 0.2"]


def test_a_comparison_without_pyarrow_names_the_extra(tmp_path: Path, monkeypatch: Any) -> None:
    (tmp_path / TABLE).touch()
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"pip install 'haselab\[campaign\]'"):
        read_results(tmp_path)
