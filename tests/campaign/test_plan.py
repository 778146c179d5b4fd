"""Points, hashes and random numbers of the cases."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import stats

DRAWN = """
name = "a"
kind = "transfer"
seed = 3
[parameters]
case.gain = {{ uniform = [0.4, 0.6] }}
case.damping_ratio = {{ log-uniform = [0.05, 0.2] }}
case.natural_frequency_rad_s = {{ normal = [33.0, 2.0] }}
case.delay_s = {{ choice = [0.01, 0.02] }}
[design]
kind = "{kind}"
samples = 256
"""
# marginal distribution of each parameter, from scipy and not from the code under test
TRUE = {
    "case.gain": stats.uniform(0.4, 0.2),
    "case.damping_ratio": stats.loguniform(0.05, 0.2),
    "case.natural_frequency_rad_s": stats.norm(33.0, 2.0),
}


@pytest.mark.parametrize("kind", ["sobol", "latin-hypercube", "random"])
def test_drawn_values_have_their_distributions(campaigns: Any, kind: str) -> None:
    """Kolmogorov's statistic: of independent draws, above 0.122 in one of a thousand sets of 256.

    A Sobol or Latin hypercube design is within 1/256 of its distribution, or little more.
    """
    plan = campaigns.plan(DRAWN.format(kind=kind))
    values = [plan.values(index) for index in range(plan.count)]
    for path, distribution in TRUE.items():
        column = [row[path] for row in values]
        distance = stats.kstest(column, distribution.cdf).statistic
        assert distance < (0.122 if kind == "random" else 2.5 / 256), path
    late = sum(row["case.delay_s"] == 0.02 for row in values)
    assert abs(late - 128) <= (4.0 * 8.0 if kind == "random" else 1)


def test_a_grid_has_each_combination_once_and_each_repeat(campaigns: Any) -> None:
    text = 'name = "a"\nkind = "transfer"\n[parameters]\ncase.gain = [0.4, 0.5, 0.6]\n'
    plan = campaigns.plan(text + "case.delay_s = [0.01, 0.02]\n[design]\nrepeats = 2\n")
    values = [tuple(plan.values(index).values()) for index in range(plan.count)]
    assert plan.count == 12 and len(set(values)) == 6
    assert all(values.count(one) == 2 for one in values)


def test_every_case_has_a_hash_of_its_own_that_follows_from_values_base_and_seed(
    campaigns: Any,
) -> None:
    text = DRAWN.format(kind="sobol").replace("256", "8")
    plan = campaigns.plan(text)
    first = plan.hashes()
    assert len(set(first)) == plan.count
    assert campaigns.plan(text).hashes() == first
    for changed in (
        text.replace("seed = 3", "seed = 4"),
        text.replace("[0.4, 0.6]", "[0.4, 0.61]"),
        text.replace("[parameters]", "[case]\nnoise_std = 0.02\n[parameters]"),
    ):
        assert not set(campaigns.plan(changed).hashes()) & set(first)
    plan.code = "another version"
    assert not set(plan.hashes()) & set(first)


def test_cases_keep_their_hash_when_an_axis_gets_further_values(campaigns: Any) -> None:
    """The seed belongs to the place on the axes, so values are added at the end."""
    text = 'name = "a"\nkind = "transfer"\n[parameters]\ncase.gain = [0.4, 0.5{}]\n'
    short, long = (campaigns.plan(text.format(more)).hashes() for more in ("", ", 0.6"))
    assert short == long[:2]


def test_cases_have_independent_noise_and_on_request_the_same_along_the_axes(
    campaigns: Any,
) -> None:
    text = 'name = "a"\nkind = "transfer"\n[parameters]\ncase.gain = [0.4, 0.5]\n[design]\n'
    own, same = (campaigns.plan(f"{text}repeats = 2\nsame_noise = {word}\n")
                 for word in ("false", "true"))  # fmt: skip

    def numbers(plan: Any) -> list[float]:
        seeds = [
            np.random.SeedSequence(plan.problem.seed, spawn_key=plan.job(index, "").key)
            for index in range(plan.count)
        ]
        return [float(np.random.default_rng(seed).random()) for seed in seeds]

    assert len(set(numbers(own))) == 4
    assert numbers(same)[:2] == numbers(same)[2:] and len(set(numbers(same))) == 2
