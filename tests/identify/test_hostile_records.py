"""Records that no method may answer with numbers: clipped, copied, unrelated, at rest."""

import numpy as np
import pytest
from scipy.signal import lfilter

from haselab.base import InputError
from haselab.cli.identify.common import refuse_copies
from haselab.identify import (
    LoopRecord,
    Record,
    fit_arx,
    fit_capacitance_map,
    fit_creep,
    fit_hysteresis,
    fit_subspace,
    fit_voltage_map,
)
from haselab.identify.clipped import clipping_of
from haselab.identify.statics.columns import plausible_capacitance
from haselab.models import Plant, PronyCreep, VoltageMap

TIME_S = np.arange(1500) / 100.0
RNG = np.random.default_rng(1)
U = np.repeat(RNG.uniform(-1.0, 1.0, 50), 30)
NOISE = 0.005 * RNG.standard_normal(TIME_S.size)
Y = Plant(0.8, 28.0, 0.15).simulate(U, 100.0, TIME_S) + NOISE
STEP = np.where(TIME_S < 1.0, 0.0, 1.0)
CREEP = PronyCreep(1.0, (0.2,), (3.0,)).simulate(STEP, 100.0) + NOISE
TRIANGLE = 1.0 - np.abs((TIME_S / 2.5) % 2.0 - 1.0)
STRAIN = np.linspace(0.0, 0.12, TIME_S.size)
VOLT = VoltageMap(1324.0, 3.124, -280.5, -26.92).voltage_v(STRAIN)


def creep(y):
    return fit_creep(Record.sampled(STEP, y, 100.0), model="prony")


def capacitance_map(strain):
    return fit_capacitance_map(1e-9 * (1.0 + 3.0 * STRAIN), strain)


FITS = {
    "arx": (lambda y: fit_arx(Record.sampled(U, y, 100.0)), Y),
    "subspace": (lambda y: fit_subspace(Record.sampled(U, y, 100.0), 2, bootstrap=0), Y),
    "creep": (creep, CREEP),
    "hysteresis": (lambda y: fit_hysteresis([LoopRecord(TRIANGLE, y, 100.0)]), TRIANGLE + NOISE),
    "voltage-map": (lambda e: fit_voltage_map(e, VOLT), STRAIN + 0.01 * NOISE),
    "capacitance-map": (capacitance_map, STRAIN + 0.01 * NOISE),
}


@pytest.mark.parametrize("name", FITS)
def test_a_clipped_record_has_no_result_but_a_whole_one_has(name):
    fit, values = FITS[name]
    top = float(np.quantile(values, 0.8))
    assert "they are clipped" in fit(np.minimum(values, top)).status
    assert fit(values).status == "ok"


def test_steps_of_a_converter_and_exact_limits_of_a_simulation_are_not_clipping():
    coarse = np.round(Y / 0.02) * 0.02
    for values in (Y, coarse, np.clip(coarse, -0.5, 0.5), np.minimum(TRIANGLE, 0.8), STEP):
        assert clipping_of(values, "outputs") == ""
    # One value in 100 of the noise itself is cut: fewer than 2 %, and rarely three in a row.
    assert clipping_of(np.minimum(NOISE, np.quantile(NOISE, 0.99)), "outputs") == ""


@pytest.mark.parametrize("seed", range(5))
def test_an_equation_whose_output_is_noise_has_no_result(seed):
    noise = np.random.default_rng(seed).standard_normal(TIME_S.size)
    assert "shows no response to the input" in fit_arx(Record.sampled(U, noise, 100.0)).status
    # 10 standard deviations of a gain that 1,500 samples of unit noise and this input give
    weak = noise + 10.0 / np.sqrt(U.size * U.var()) * np.r_[0.0, U[:-1]]
    assert fit_arx(Record.sampled(U, weak, 100.0)).status == "ok"


@pytest.mark.parametrize("noise", ["moving average", "hum", "walk"])
def test_an_equation_whose_output_is_coloured_noise_has_no_result(noise):
    white = np.random.default_rng(4).standard_normal(TIME_S.size)
    v = {
        "moving average": lfilter([1.0, 0.9, 0.8, 0.5], [1.0], white),
        "hum": np.sin(2.0 * np.pi * 12.57 * TIME_S) + 0.1 * white,
        "walk": np.cumsum(white) + 5.0 * white[::-1],
    }[noise]
    v *= np.std(Y) / np.std(v)
    assert "shows no response to the input" in fit_arx(Record.sampled(U, v, 100.0)).status
    # as large as the signal, it does not hide the response
    assert fit_arx(Record.sampled(U, Y + v, 100.0)).status == "ok"
    alone = fit_subspace(Record.sampled(U, v, 100.0), bootstrap=0)
    if noise == "hum":  # poles of the model explain it, so it is only named in a note
        assert any("at 12.57 Hz keeps more than 10 %" in note for note in alone.notes)
    else:
        assert "the output shows no response to the input" in alone.status
    assert fit_subspace(Record.sampled(U, Y + v, 100.0), 2, bootstrap=0).status == "ok"


def test_a_record_and_a_part_of_it_are_refused_as_two_but_a_repetition_is_not(tmp_path):
    again = Y + 0.005 * np.random.default_rng(9).standard_normal(Y.size)
    files = [tmp_path / name for name in ("one.csv", "again.csv", "part.csv")]
    refuse_copies(files[:2], [Y, again])
    for part in (Y[300:900], np.round(Y, 5), Y[5:]):
        with pytest.raises(InputError, match=r"one\.csv and .*part\.csv have the same measured"):
            refuse_copies(files, [Y, again, part])
    refuse_copies(files, [np.zeros(0), np.zeros(0), np.zeros(0)])
    # The first two share a part, which alone is a warning; the third is a copy of the first.
    half = np.r_[Y[:750], again[750:]]
    with pytest.raises(InputError, match=r"one\.csv and .*part\.csv have the same measured"):
        refuse_copies(files, [Y, half, Y.copy()])


def test_picofarads_in_a_column_of_farads_are_refused():
    plausible_capacitance("capacitance_f", 1e-9 * (1.0 + STRAIN))
    with pytest.raises(InputError, match=r"reaches 1120 F; .* add --unit capacitance_f=pF"):
        plausible_capacitance("capacitance_f", 1e3 * (1.0 + STRAIN))


def test_a_subspace_model_that_grows_without_limit_has_no_result():
    growing = Record.sampled(U, np.exp(0.18 * np.arange(U.size)), 100.0)
    status = fit_subspace(growing, bootstrap=0).status
    assert status.startswith("no result: with") and "grows too far" in status
