"""Clocks that drift, lost outputs and rows, and a slew limit are named; nothing else is."""

import numpy as np
import pytest

from haselab.identify.record import Record
from haselab.identify.transfer.fit import fit_transfer
from haselab.models import Plant, SlowMode

RATE_HZ = 100.0
COUNT = 3000
TIME_S = np.arange(COUNT) / RATE_HZ
PLANT = Plant(0.6, 9.0, 0.1, 0.13)
TRUTH = {"gain": 0.6, "natural_frequency_rad_s": 9.0, "damping_ratio": 0.1, "delay_s": 0.13}
NAMED = ("clock", "slew", "lost", "late", "missing")


def levels(rng, count=COUNT, every=15):
    return np.repeat(rng.uniform(-1.0, 1.0, count // every), every)


def output(u, times_s, rng, plant=PLANT, rate_hz=RATE_HZ):
    y = plant.simulate(u, rate_hz, times_s)
    return y + 0.01 * rng.normal(size=y.size)


def is_right(fit):
    assert fit.status == "ok"
    for name, value in TRUTH.items():
        assert abs(fit.parameters[name].value - value) < 5.0 * fit.parameters[name].std, name


@pytest.mark.long
@pytest.mark.parametrize("part", [3e-3, -8e-4])
def test_two_clocks_that_differ_are_named(part):
    rng = np.random.default_rng(1)
    u = levels(rng)
    fit = fit_transfer([Record.sampled(u, output(u, TIME_S * (1.0 + part), rng), RATE_HZ, 0.0)])
    assert fit.status.startswith("no result: the clock of the output seems to run")
    assert ("slower" if part > 0.0 else "faster") in fit.status


@pytest.mark.long
@pytest.mark.parametrize("samples", [3.0, 10.0])
def test_a_slew_limit_is_named_with_its_rate(samples):
    rng = np.random.default_rng(2)
    u = levels(rng)
    rate, fine = 0.6 * RATE_HZ / samples, 16
    now, applied = 0.0, []
    for target in np.repeat(u, fine).tolist():
        now += min(max(target - now, -rate / RATE_HZ / fine), rate / RATE_HZ / fine)
        applied.append(now)
    y = output(np.array(applied), TIME_S, rng, rate_hz=RATE_HZ * fine)
    fit = fit_transfer([Record.sampled(u, y, RATE_HZ, 0.0)])
    assert fit.status.startswith("no result: the applied input seems to be limited to a rate of")
    named = float(fit.status.split("rate of ")[1].split()[0])
    assert named == pytest.approx(rate, rel=0.05)


@pytest.mark.long
@pytest.mark.parametrize("lost", [4, 40])
def test_lost_outputs_are_counted_and_the_later_times_corrected(lost):
    """40 outputs are longer than the delay: without them the output comes before its input."""
    rng = np.random.default_rng(3)
    u = levels(rng)
    longer_s = np.arange(COUNT + lost) / RATE_HZ
    y = np.delete(output(u, longer_s, rng), np.s_[900 : 900 + lost])
    fit = fit_transfer([Record.sampled(u, y, RATE_HZ, 0.0)])
    is_right(fit)
    assert any(note.startswith(f"{lost} outputs before ") for note in fit.notes)


@pytest.mark.long
def test_a_record_with_missing_rows_is_cut_there():
    rng = np.random.default_rng(4)
    u = levels(rng, COUNT + 105)
    y = output(u, np.arange(u.size) / RATE_HZ, rng)
    gap = np.s_[1700:1805]
    fit = fit_transfer([Record.sampled(np.delete(u, gap), np.delete(y, gap), RATE_HZ, 0.0)])
    is_right(fit)
    assert any(note.startswith("Rows seem to be missing at ") for note in fit.notes)


OTHERS = {
    "plain": PLANT,
    "creep": Plant(0.6, 9.0, 0.1, 0.13, (SlowMode(0.2, 5.0),)),
    "slow creep": Plant(0.6, 9.0, 0.1, 0.13, (SlowMode(0.1, 40.0),)),
}


@pytest.mark.long
@pytest.mark.parametrize("name", [*OTHERS, "second mode", "cubic input"])
def test_what_another_structure_explains_is_no_fault_of_the_record(name):
    rng = np.random.default_rng(5)
    u = levels(rng)
    if name in OTHERS:
        y = output(u, TIME_S, rng, OTHERS[name])
    elif name == "second mode":
        y = output(u, TIME_S, rng) + Plant(0.2, 21.0, 0.05).simulate(u, RATE_HZ, TIME_S)
    else:
        y = output(u - 0.3 * u**3, TIME_S, rng)
    fit = fit_transfer([Record.sampled(u, y, RATE_HZ, 0.0)])
    text = " ".join([fit.status, *fit.notes])
    assert not any(word in text for word in NAMED)
