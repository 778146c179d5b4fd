"""How much a fit of a long record simulates: counted, not timed."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from haselab.identify.record import Record
from haselab.identify.transfer.checks.timing import timing_cause
from haselab.identify.transfer.fit import fit_transfer
from haselab.identify.transfer.layout import TransferStructure, layout_of
from haselab.identify.transfer.oversampled import at_lower_rate
from haselab.identify.transfer.problem import Found, TransferProblem
from haselab.identify.transfer.search import best_fit
from haselab.identify.transfer.start import delay_margin_s
from haselab.models import Plant

PLANT = Plant(0.6, 60.0, 0.2, 0.004)


def curved(count: int, rate_hz: float) -> Record:
    """A record of the square of the input: no linear fit leaves white residuals."""
    rng = np.random.default_rng(4)
    every = round(0.05 * rate_hz)
    u = np.repeat(rng.uniform(0.5, 2.5, count // every + 1), every)[:count]
    y = PLANT.simulate(u**2, rate_hz, np.arange(count) / rate_hz)
    return Record.sampled(u, y + 0.01 * rng.normal(size=count), rate_hz, 0.0)


class Work:
    """Counts the searches of a problem, by the number of its outputs."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.seen: Counter[int] = Counter()
        minimise, create = TransferProblem.minimise, TransferProblem.__init__
        sizes: dict[int, int] = {}

        def created(problem: TransferProblem, layout, records, *more, **named) -> None:
            create(problem, layout, records, *more, **named)
            sizes[id(problem)] = sum(one.y.size for one in records)

        def counted(problem: TransferProblem, *more, **named) -> Found:
            self.seen[sizes[id(problem)]] += 1
            return minimise(problem, *more, **named)

        monkeypatch.setattr(TransferProblem, "__init__", created)
        monkeypatch.setattr(TransferProblem, "minimise", counted)

    def on_most_of(self, record: Record) -> int:
        """Searches on at least half of the outputs of a record."""
        whole = sum(times for size, times in self.seen.items() if 2 * size >= record.y.size)
        print(f"{whole} searches on all outputs; by outputs {dict(self.seen)}")
        return whole


@pytest.mark.long
def test_wrong_times_are_searched_for_on_a_part_of_the_outputs(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """500 Hz is no rate to lower. From two starts at 12 slew limits, 24 searches alone.

    On all outputs are 3 searches for each of two causes, and up to 15 cuts of the record.
    """
    record, layout = curved(30_000, 500.0), layout_of(TransferStructure())
    best = best_fit(layout, [record])
    assert best is not None and best.whiteness_p < 1e-3
    work = Work(monkeypatch)
    assert timing_cause(layout, best) is None
    assert 0 < work.on_most_of(record) < 26


@pytest.mark.long
def test_a_fast_record_is_searched_at_a_lower_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    """On all outputs: the fit, its profile and its check alone."""
    record = curved(100_000, 10_000.0)
    work = Work(monkeypatch)
    fit = fit_transfer(record)
    assert fit.succeeded and fit.residual_whiteness_p < 1e-3
    assert work.on_most_of(record) < 16


def test_interference_that_is_weaker_than_the_noise_does_not_set_the_rate() -> None:
    """A tone in a narrow band stands out of the spectrum there; its power is 1e-6 of the output's.

    The noise of all frequencies above it is 1e-2 of the power.
    """
    rng = np.random.default_rng(5)
    record = curved(60_000, 5000.0)
    std = float(record.y.std())
    tone = 1e-3 * std * np.sin(2.0 * np.pi * 900.0 * record.output_time_s)
    noise = 0.1 * std * rng.normal(size=record.y.size)
    rates = []
    for y in (record.y + noise, record.y + noise + 10.0 * tone):
        kept = at_lower_rate([Record.sampled(record.u, y, 5000.0, 0.0)], 2)
        assert kept
        rates.append(kept[0].input_rate_hz)
    assert rates[0] == pytest.approx(rates[1], rel=0.3) and rates[1] < 2500.0


def test_what_has_decayed_is_zero() -> None:
    """Numbers near the smallest double take a hundred times as long: a free motion ends before.

    The decay rate is 12 s^-1 and the record 100 s long: e^-1200 would pass all of them.
    """
    record = curved(20_000, 200.0)
    problem = TransferProblem(layout_of(TransferStructure()), [record], delay_margin_s([record]))
    found = problem.project(np.array([np.log(60.0), np.log(0.2), 0.004]))
    (own,) = problem.columns(found).own
    size = np.abs(own[:, :2])
    assert (size[-1] == 0.0).all() and (size[0] > 0.0).any()
    assert not ((size > 0.0) & (size < 1e-150)).any()
