"""A fit that starts at one of almost the same records."""

from dataclasses import replace

import numpy as np

from haselab.identify.free.response import FreeTrial, fit_free_response
from haselab.identify.record import Record
from haselab.identify.transfer.fit import TransferStructure, fit_transfer
from haselab.models import Plant

_CHANGE = 1e-3  # of the noise, between the two records


def test_a_fit_from_nearby_finds_the_minimum_of_the_search():
    """To what a search leaves: it ends where a step gains less than 1e-9 of the cost.

    The cost of N outputs is N variances of the noise, so that is sqrt(1e-9 N) standard deviations.
    """
    rng = np.random.default_rng(5)
    u, time_s = rng.normal(size=500), np.arange(2000) / 400.0
    y = Plant(0.5, 5.11, 0.09, 0.012).simulate(u, 100.0, time_s) + 0.01 * rng.normal(size=2000)
    structure = TransferStructure()
    near = fit_transfer(Record(u, 100.0, y, time_s), structure)
    changed = Record(u, 100.0, y + 0.01 * _CHANGE * rng.normal(size=2000), time_s)
    from_near = fit_transfer(changed, structure, near=near)
    searched = fit_transfer(changed, structure)
    assert from_near.status == searched.status == "ok"
    for name, estimate in searched.parameters.items():
        left = abs(from_near.parameters[name].value - estimate.value)
        assert left <= 3.0 * np.sqrt(1e-9 * 2000) * estimate.std, name
        assert from_near.parameters[name].value != near.parameters[name].value, name


def test_a_fit_without_a_result_nearby_changes_nothing():
    rng = np.random.default_rng(6)
    u, time_s = rng.normal(size=300), np.arange(1200) / 400.0
    y = Plant(0.5, 5.11, 0.09, 0.0).simulate(u, 100.0, time_s) + 0.01 * rng.normal(size=1200)
    record = Record(u, 100.0, y, time_s)
    found = fit_transfer(record, TransferStructure(delay=0.0))
    nothing = replace(found, best=None)
    again = fit_transfer(record, TransferStructure(delay=0.0), near=nothing)
    assert again.parameters == found.parameters


def test_outputs_that_the_fit_nearby_excludes_are_excluded_again():
    rng = np.random.default_rng(8)
    u = np.repeat(rng.choice([-1.0, 1.0], size=200), 20)
    y = Plant(0.6, 9.0, 0.1, 0.02).simulate(u, 200.0, np.arange(u.size) / 200.0)
    y = np.clip(y, -9.0, 0.5) + 0.01 * rng.normal(size=u.size)
    near = fit_transfer(Record.sampled(u, y, 200.0), applied=True)
    changed = Record.sampled(u, y + 0.01 * _CHANGE * rng.normal(size=u.size), 200.0)
    again = fit_transfer(changed, applied=True, near=near)
    for fit in (near, again):
        assert fit.status == "ok"
        assert any("clipped at" in note for note in fit.notes)
        assert fit.records[0].y.size < u.size


def test_a_free_response_from_nearby_is_that_of_the_search():
    """As above, with 1e-10 of the cost."""
    rng = np.random.default_rng(7)
    t = np.arange(800) / 400.0
    x = 0.01 * np.exp(-4.0 * t) * np.cos(32.0 * t - 0.3) + 1e-3 * np.exp(-t / 0.8)
    trials = [FreeTrial(x + 1e-4 * rng.normal(size=t.size), t) for _ in range(2)]
    near = fit_free_response(trials, creep=True)
    moved = [FreeTrial(r.x + 1e-4 * _CHANGE * rng.normal(size=t.size), t) for r in trials]
    from_near = fit_free_response(moved, creep=True, near=near)
    searched = fit_free_response(moved, creep=True)
    for name, estimate in searched.parameters.items():
        left = abs(from_near.parameters[name].value - estimate.value)
        assert left <= 3.0 * np.sqrt(1e-10 * 1600) * estimate.std, name
        assert from_near.parameters[name].value != near.parameters[name].value, name
