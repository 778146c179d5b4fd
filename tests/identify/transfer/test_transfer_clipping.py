"""Which inputs and outputs count as clipped: none that is only held, slow or nonlinear."""

import numpy as np
import pytest
from scipy.signal import max_len_seq

from haselab.identify.record import Record
from haselab.identify.transfer.fit import fit_transfer
from haselab.models import Plant, SlowMode

RATE_HZ = 100.0
COUNT = 3000
PLANT = Plant(0.6, 9.0, 0.1, 0.02)
CREEPING = Plant(0.6, 9.0, 0.1, 0.02, (SlowMode(0.25, 4.0),))
NOISE = 0.003  # 45 dB below the inputs of unit peak
TIME_S = np.arange(COUNT) / RATE_HZ


def chirp(stop_hz):
    return np.sin(2 * np.pi * (0.05 * TIME_S + 0.5 * (stop_hz - 0.05) * TIME_S**2 / TIME_S[-1]))


def triangle(rate_hz):
    return 2.0 / np.pi * np.arcsin(np.sin(2 * np.pi * rate_hz * TIME_S))


def multisine():
    rng = np.random.default_rng(21)
    u = sum(
        np.sin(2 * np.pi * k * TIME_S / 10.0 + p)
        for k, p in zip(range(1, 40, 3), rng.uniform(0.0, 6.0, 13), strict=True)
    )
    return u / np.abs(u).max()


def two_tones():
    u = np.sin(2 * np.pi * 0.3 * TIME_S) + np.sin(2 * np.pi * 1.7 * TIME_S)
    return u / np.abs(u).max()


def staircase():
    levels = np.random.default_rng(22).uniform(-1.0, 1.0, size=COUNT // 75)
    return np.repeat(levels / np.abs(levels).max(), 75)


SMOOTH = {
    "chirp to 1 Hz": chirp(1.0),
    "chirp to 3 Hz": chirp(3.0),
    "chirp to 10 Hz": chirp(10.0),
    "triangle": triangle(0.37),
    "multisine": multisine(),
    "two tones": two_tones(),
    "staircase": staircase(),
}
BINARY = {
    "prbs": np.repeat(2.0 * max_len_seq(9)[0] - 1.0, 6)[:COUNT],
    "step": np.where(TIME_S > 4.0, 1.0, 0.0),
}


def held(u, every):
    return np.repeat(u[::every], every)[: u.size]


def quantised(u, bits):
    step = 2.0 / 2**bits
    return step * np.round(u / step)


def fitted(applied, recorded, plant=PLANT):
    times = np.arange(applied.size) / RATE_HZ
    noise = NOISE * np.random.default_rng(23).normal(size=applied.size)
    y = plant.simulate(applied, RATE_HZ, times) + noise
    return fit_transfer([Record.sampled(recorded, y, RATE_HZ, 0.0)])


def is_clipped(fit):
    return "clipped" in fit.status or any("clipped" in note for note in fit.notes)


@pytest.mark.parametrize(
    ("every", "plant"), [(1, PLANT), (10, CREEPING)], ids=["plain", "held, creeping"]
)
@pytest.mark.parametrize("name", [*SMOOTH, *BINARY])
def test_an_input_without_a_limit_is_not_called_clipped(name, every, plant):
    u = held((SMOOTH | BINARY)[name], every)
    assert not is_clipped(fitted(u, u, plant))


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("name", SMOOTH)
def test_a_quantised_input_is_not_called_clipped(name, bits):
    u = SMOOTH[name]
    assert not is_clipped(fitted(quantised(u, bits), u, CREEPING))


@pytest.mark.parametrize("curve", [lambda u: u + 0.3 * u**2, lambda u: u - 0.25 * u**3])
@pytest.mark.parametrize("name", ["chirp to 3 Hz", "multisine", "staircase"])
def test_an_input_that_bends_is_not_called_clipped(name, curve):
    u = SMOOTH[name]
    assert not is_clipped(fitted(curve(u), u))


@pytest.mark.long
def test_most_inputs_that_were_clipped_unseen_are_named():
    """A slow drive or a shallow limit looks like a curve: docs/identify/identification.md."""
    named = [
        "input seems to have been clipped" in fitted(np.clip(u, -level, level), u).status
        for u in SMOOTH.values()
        for level in (0.9, 0.8, 0.6)
    ]
    assert sum(named) >= 16
    assert len(named) == 21
