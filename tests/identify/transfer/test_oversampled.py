"""Records that were sampled much faster than the output moves."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.signal import chirp, cont2discrete, lfilter

import haselab.identify.transfer.fit as module
from haselab.identify.noise import whiteness_p
from haselab.identify.record import Record
from haselab.identify.transfer.fit import fit_transfer
from haselab.identify.transfer.layout import TransferStructure
from haselab.identify.transfer.oversampled import at_lower_rate

OMEGA, ZETA, GAIN = 28.0, 0.12, 0.5
TRUTH = {"natural_frequency_rad_s": OMEGA, "damping_ratio": ZETA, "gain": GAIN}


def response(u: np.ndarray, rate_hz: float, hold: str) -> np.ndarray:
    """Of one resonance without delay, by scipy: exact for a held or piecewise linear input."""
    plant = ([GAIN * OMEGA**2], [1.0, 2.0 * ZETA * OMEGA, OMEGA**2])
    (b,), a, _ = cont2discrete(plant, 1.0 / rate_hz, {"zero": "zoh", "first": "foh"}[hold])
    return np.asarray(lfilter(b, a, u))


def record(kind: str, rate_hz: float, noise: float, hold: str, seed: int = 1) -> Record:
    rng, time_s = np.random.default_rng(seed), np.arange(round(20 * rate_hz)) / rate_hz
    u = 0.4 * chirp(time_s, 0.1, 20.0, 12.0, method="log", phi=-90.0)
    if kind == "steps":
        u = np.repeat(rng.choice([0.0, 0.3, 0.6, 1.0], 20), round(rate_hz))
        u[: round(rate_hz)] = 0.0
    y = response(u, rate_hz, hold) + noise * rng.standard_normal(u.size)
    return Record.sampled(u, y, rate_hz, 0.0, hold=hold)


@pytest.mark.parametrize("kind", ["chirp", "steps"])
@pytest.mark.parametrize("hold", ["zero", "first"])
@pytest.mark.parametrize("rate_hz", [1000.0, 5000.0])
def test_a_filtered_record_is_of_the_same_plant(kind: str, hold: str, rate_hz: float) -> None:
    """Without noise; straight lines between the inputs do not follow the edges of steps exactly.

    A delay that was wrong by a thousandth of a sample shows, too.
    """
    kept = at_lower_rate([record(kind, rate_hz, 0.0, hold)], 2)
    assert kept
    slower = kept[0]
    assert slower.y.size < 7000 < rate_hz * 20
    fit = fit_transfer(slower)
    found = {name: fit.parameters[name].value for name in TRUTH}
    assert found == pytest.approx(TRUTH, rel=1e-6 if kind == "chirp" else 5e-6)
    assert abs(fit.parameters["delay_s"].value) < 1e-7


def test_white_noise_stays_white_and_keeps_its_power() -> None:
    """Of 40 records, as many as a test at 5 % rejects; the sum of the squares by the rate."""
    rejected, shares = 0, []
    for seed in range(40):
        fast = record("chirp", 5000.0, 0.01, "zero", seed)
        clean = record("chirp", 5000.0, 0.0, "zero", seed)
        kept = [at_lower_rate([one], 2) for one in (fast, clean)]
        assert kept[0] and kept[1]
        if kept[0][0].y.size != kept[1][0].y.size:
            continue
        noise = kept[0][0].y - kept[1][0].y
        rejected += whiteness_p([noise]) < 0.05
        every = 5000.0 / kept[0][0].input_rate_hz
        shares.append(float(noise @ noise) / noise.size * every / 0.01**2)
    assert len(shares) > 20
    assert rejected <= 2 + 4.0 * math.sqrt(0.05 * len(shares))
    assert np.mean(shares) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize("slow_modes", [0, 1])
def test_a_long_record_has_the_fit_of_a_search_on_all_outputs(
    slow_modes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same minimum: within a thousandth of a standard deviation."""
    long = record("chirp", 1000.0, 0.01, "zero")
    structure = TransferStructure(slow_modes=slow_modes)
    fast = fit_transfer(long, structure)
    monkeypatch.setattr(module, "at_lower_rate", lambda records, poles: None)
    whole = fit_transfer(long, structure)
    assert fast.status == whole.status and len(fast.residuals[0]) == long.y.size
    for name, one in whole.parameters.items():
        if math.isfinite(one.std):
            assert abs(fast.parameters[name].value - one.value) < 1e-2 * one.std, name
            assert fast.parameters[name].std == pytest.approx(one.std, rel=0.02), name


def test_slow_residuals_below_the_noise_are_not_called_white() -> None:
    """At the full rate, the lags of the test reach 4 ms, and the noise hides the slow residuals."""
    fast = record("chirp", 10_000.0, 0.02, "zero")
    drift = 0.004 * np.sin(2.0 * np.pi * 0.7 * fast.output_time_s)
    drifting = Record.sampled(fast.u, fast.y + drift, 10_000.0, 0.0)
    assert fit_transfer(fast).residual_whiteness_p > 1e-3
    fit = fit_transfer(drifting)
    assert fit.residual_whiteness_p < 1e-6
    assert any("not white" in note for note in fit.notes)


def test_records_that_cannot_be_filtered_stay_as_they_are() -> None:
    long = record("chirp", 1000.0, 0.0, "zero")
    uneven = long.output_time_s + 2e-4 * np.sin(np.arange(long.y.size))
    assert at_lower_rate([Record(long.u, 1000.0, long.y, np.sort(uneven))], 2) is None
    assert at_lower_rate([Record.sampled(long.u[:9000], long.y[:9000], 1000.0)], 2) is None
