"""What every fit offers, whatever was fitted."""

import functools

import numpy as np
import pytest

from haselab.base import InputError, ResultError, to_plain
from haselab.identify import (
    ArxOrders,
    CurveFit,
    Fit,
    FreeTrial,
    LoopRecord,
    Record,
    RecordFit,
    TransferStructure,
    VoltageStructure,
    choose_transfer,
    estimate_frequency_response,
    find_regions,
    fit_arx,
    fit_capacitance_map,
    fit_creep,
    fit_duffing,
    fit_free_response,
    fit_hammerstein,
    fit_hyperelastic,
    fit_hysteresis,
    fit_map,
    fit_subspace,
    fit_transfer,
    fit_voltage_map,
    fit_voltage_plant,
)
from haselab.identify.fit import rescaled
from haselab.identify.noise import whiteness_p
from haselab.models import Gent, Plant, PrandtlIshlinskii, PronyCreep, VoltageMap, VoltagePlant
from haselab.models.filters import lfilter

RATE_HZ = 100.0
PLANT = Plant(0.5, 9.0, 0.15, 0.02)
NOISE = 0.002
TIME_S = np.arange(1500) / RATE_HZ
HELD = np.repeat(np.random.default_rng(1).normal(size=30), 50)
NEW = np.repeat(np.random.default_rng(2).normal(size=20), 50)
NEW_S = np.arange(NEW.size) / RATE_HZ
STRETCH = np.linspace(1.1, 2.5, 60)
STRAIN = np.linspace(-0.04, 0.14, 200)
TRIANGLES = np.tile(np.r_[np.linspace(0, 2, 150), np.linspace(2, 0, 150)], 3)
PLAYS = PrandtlIshlinskii(1.0, (0.2, 0.5), (0.4, 0.3))
CURVE = VoltageMap(1324.0, 3.124, -280.5, -26.92)
LAW = Gent(15e3, 40.0)
PULLED = VoltagePlant("mechanical", (0.02,), 8.0, 0.2, 0.01, 0.3, 2.0)
SWING_S = np.arange(800) / 400.0


def noise(size: int, std: float = NOISE) -> np.ndarray:
    return std * np.random.default_rng(7).normal(size=size)


def swing(time_s: np.ndarray, amplitude: float, phase_rad: float) -> np.ndarray:
    return amplitude * np.exp(-4.0 * time_s) * np.cos(32.0 * time_s - phase_rad)


def moved(u: np.ndarray) -> np.ndarray:
    return PLANT.simulate(u, RATE_HZ, np.arange(u.size) / RATE_HZ)


def equation(u: np.ndarray) -> np.ndarray:
    return lfilter([0.0, 0.0, 0.5], [1.0, -1.2, 0.5], u)


def broken(x: np.ndarray) -> np.ndarray:
    return np.where(x < 1.6, 5.0 * x, 8.0 + 2.0 * (x - 1.6))


WHITE, WHITE_NEW = np.random.default_rng(3).normal(size=(2, 800))
VOLTS = np.repeat(np.random.default_rng(4).uniform(0.5, 3.0, 60), 25)
VOLTS_NEW = np.repeat(np.random.default_rng(5).uniform(0.5, 3.0, 40), 25)
CREEP = PronyCreep(1.0, (0.2,), (3.0,))
STEP = np.r_[np.zeros(100), np.ones(1900)]


def pulled(u: np.ndarray) -> np.ndarray:
    return PULLED.simulate(u, RATE_HZ, np.arange(u.size) / RATE_HZ)


def sampled(u: np.ndarray, y: np.ndarray) -> Record:
    return Record.sampled(u, y + noise(y.size), RATE_HZ, 0.0)


# Each fit of input and output, a new input, and the truth of its answer.
RECORDS = {
    "transfer": (lambda: fit_transfer(sampled(HELD, moved(HELD))), NEW, moved),
    "response": (
        lambda: estimate_frequency_response(sampled(HELD, moved(HELD))).fit(),
        NEW, moved,
    ),
    "arx": (
        lambda: fit_arx(sampled(WHITE, equation(WHITE)), ArxOrders(2, 1, 2), remove_means=False),
        WHITE_NEW, equation,
    ),
    "subspace": (
        lambda: fit_subspace(sampled(WHITE, equation(WHITE)), 2, remove_means=False),
        WHITE_NEW, equation,
    ),
    "hammerstein": (
        lambda: fit_hammerstein(
            [sampled(HELD, moved(HELD + 0.3 * HELD**2))], TransferStructure(offset=False)
        ),
        NEW, lambda u: moved(u + 0.3 * u**2),
    ),
    "spring": (lambda: fit_duffing(sampled(HELD, moved(HELD))), NEW, moved),
    "creep": (lambda: fit_creep(sampled(STEP, CREEP.simulate(STEP, RATE_HZ)), "prony"),
              NEW, lambda u: CREEP.simulate(u, RATE_HZ)),
    "voltage plant": (
        lambda: fit_voltage_plant(
            [sampled(VOLTS, pulled(VOLTS))], VoltageStructure(powers=1)
        ),
        VOLTS_NEW, pulled,
    ),
}  # fmt: skip
# Each fit of a curve, new abscissas, and the truth there.
CURVES = {
    "capacitance map": (
        lambda: fit_capacitance_map((STRAIN + 0.3) / 5e6, STRAIN + noise(200, 1e-4)),
        np.linspace(6e-8, 8e-8, 9), lambda c: 5e6 * c - 0.3,
    ),
    "voltage map": (
        lambda: fit_voltage_map(STRAIN, CURVE.voltage_v(STRAIN) + noise(200, 2.0)),
        np.linspace(-0.03, 0.13, 9), CURVE.voltage_v,
    ),
    "map": (lambda: fit_map(STRETCH, np.tanh(STRETCH) + noise(60)), STRETCH[5:-5:7], np.tanh),
    "regions": (
        lambda: find_regions(STRETCH, broken(STRETCH) + noise(60)),
        np.array([1.2, 1.5, 2.0]), broken,
    ),
    "hyperelastic": (
        lambda: fit_hyperelastic(STRETCH, uniaxial(STRETCH) + noise(60, 50.0), "gent"),
        np.array([1.3, 2.0]), lambda x: uniaxial(x),
    ),
    "free response": (
        lambda: fit_free_response(
            [FreeTrial(swing(SWING_S, 0.01, 0.3) + noise(800, 1e-4), SWING_S)]
        ),
        SWING_S[::37], lambda t: swing(t, 0.01, 0.3),
    ),
}  # fmt: skip


def uniaxial(x: np.ndarray) -> np.ndarray:
    return LAW.nominal_stress_pa(x, 1.0 / np.sqrt(x))


def loops() -> Fit:
    y = PLAYS.simulate(TRIANGLES)
    return fit_hysteresis(LoopRecord(TRIANGLES, y + noise(y.size, 0.005), RATE_HZ))


@functools.cache
def fitted(name: str) -> Fit:
    return loops() if name == "hysteresis" else ({**RECORDS, **CURVES})[name][0]()


EVERY = (*RECORDS, *CURVES, "hysteresis")


@pytest.mark.long
@pytest.mark.parametrize("name", EVERY)
def test_covariance_and_intervals_of_all_parameters_agree(name):
    fit = fitted(name)
    assert fit.succeeded, fit.status
    std = np.array([estimate.std for estimate in fit.parameters.values()])
    assert fit.covariance.shape == (std.size, std.size)
    assert np.sqrt(np.diag(fit.covariance)) == pytest.approx(std, rel=1e-9)
    told = np.isfinite(std) & (std > 0.0)
    correlation = fit.covariance[np.ix_(told, told)] / np.outer(std[told], std[told])
    assert correlation == pytest.approx(correlation.T)
    assert np.linalg.eigvalsh(correlation).min() > -1e-6
    assert not np.isnan(np.concatenate(fit.residuals)).any()


@pytest.mark.long
@pytest.mark.parametrize("name", EVERY)
def test_each_fit_says_its_numbers_as_text_html_json_and_figure(name):
    fit = fitted(name)
    lines = str(fit).splitlines()
    assert lines == fit.summary().splitlines()
    assert lines[0] == f"{type(fit).__name__}: ok"
    for parameter, estimate in fit.parameters.items():
        (line,) = [line for line in lines if line.startswith(f"{parameter} ")]
        assert np.isnan(estimate.value) or f"{estimate.value:.6g}" in line
        assert line.endswith(estimate.unit)
        assert f"<td>{parameter}</td>" in fit._repr_html_()
    assert to_plain(fit.answer())["status"] == "ok"
    figure = fit.plot()
    assert figure.axes and "<svg" in figure._repr_svg_()


@pytest.mark.long
@pytest.mark.parametrize("name", RECORDS)
def test_a_new_input_gives_the_output_of_the_true_plant(name):
    fit, (_, u, truth) = fitted(name), RECORDS[name]
    assert isinstance(fit, RecordFit)
    output = truth(u)
    # The noise is 0.002; a fit to hundreds of samples and a few numbers is nearer than that.
    swing_of = np.ptp(output)
    assert np.sqrt(np.mean((fit.simulate(u, RATE_HZ) - output) ** 2)) < max(NOISE, 0.01 * swing_of)
    times = np.arange(u.size) / RATE_HZ
    record = Record(u, RATE_HZ, 3.0 + output + noise(u.size), times, float(u[0]))
    found = fit.compare(record)
    # A constant of the new record is no error of the model.
    assert found.fit_percent > 95.0
    assert found.rms_error < 0.02 * swing_of
    assert found.predicted.size == u.size


@pytest.mark.long
@pytest.mark.parametrize("name", CURVES)
def test_new_abscissas_give_the_true_curve(name):
    fit, (_, x, truth) = fitted(name), CURVES[name]
    assert isinstance(fit, CurveFit)
    noise_std = np.std(np.concatenate(fit.residuals))
    assert np.abs(fit.simulate(x) - truth(x)).max() < 3.0 * noise_std


@pytest.mark.long
def test_a_curve_is_compared_with_new_pairs():
    fit = fitted("voltage map")
    assert fit.compare(STRAIN, CURVE.voltage_v(STRAIN)).rms_error < 1.0
    assert fit.compare(STRAIN, CURVE.voltage_v(STRAIN) + 50.0).rms_error == pytest.approx(50, abs=1)
    with pytest.raises(InputError, match="one y for each x"):
        fit.compare(STRAIN, STRAIN[1:])


@pytest.mark.long
def test_another_free_motion_has_its_own_amplitude_and_phase():
    fit = fitted("free response")
    new = 0.5 + swing(SWING_S, 0.03, 1.1)
    assert fit.compare(SWING_S, new).fit_percent > 99.0
    slower = 0.5 + 0.03 * np.exp(-4.0 * SWING_S) * np.cos(25.0 * SWING_S)
    assert fit.compare(SWING_S, slower).fit_percent < 60.0


@pytest.mark.long
def test_loops_are_simulated_and_compared():
    fit = fitted("hysteresis")
    new = np.r_[np.linspace(0, 1.5, 100), np.linspace(1.5, 0.2, 100), np.linspace(0.2, 2, 100)]
    new = np.tile(np.r_[new, np.linspace(2, 0, 100)], 2)
    y = PLAYS.simulate(new)
    assert np.abs(fit.simulate(new) - y).max() < 0.01
    assert fit.compare(LoopRecord(new, y, RATE_HZ)).fit_percent > 98.0


@pytest.mark.long
def test_the_voltage_maps_band_follows_from_its_parameters():
    # The band comes from other numbers than a1, b1, a2, b2: both ways must agree.
    fit = fitted("voltage map")
    values = np.array([estimate.value for estimate in fit.parameters.values()])

    def volts(numbers: np.ndarray) -> np.ndarray:
        return numbers[0] * np.exp(numbers[1] * STRAIN) + numbers[2] * np.exp(numbers[3] * STRAIN)

    steps = 1e-6 * np.abs(values)
    slopes = np.stack(
        [
            (volts(values + step) - volts(values - step)) / (2.0 * step.max())
            for step in np.diag(steps)
        ],
        axis=1,
    )
    std = np.sqrt(np.einsum("ni,ij,nj->n", slopes, fit.covariance, slopes))
    assert std == pytest.approx(fit.curve_std(STRAIN), rel=1e-4)


@pytest.mark.long
def test_frequency_and_damping_of_a_free_response_follow_from_decay_and_frequency():
    fit = fitted("free response")
    damped, decay, natural = (e.value for e in list(fit.parameters.values())[:3])
    assert natural == pytest.approx(np.hypot(damped, decay))
    of_natural = np.array([damped, decay]) / natural
    of_ratio = np.array([-decay * damped, damped**2]) / natural**3
    slope = np.stack([of_natural, of_ratio])
    assert fit.covariance[2:4, 2:4] == pytest.approx(
        slope @ fit.covariance[:2, :2] @ slope.T, rel=1e-9
    )


@pytest.mark.long
def test_a_sampled_model_takes_one_record_at_its_own_rate():
    fit = fitted("arx")
    with pytest.raises(InputError, match=r"2 records were given.*fit_transfer"):
        fit_arx([sampled(WHITE, equation(WHITE))] * 2)
    with pytest.raises(InputError, match="records is empty"):
        fit_arx([])
    with pytest.raises(InputError, match=r"valid at that rate only"):
        fit.simulate(WHITE, 50.0)
    late = Record(HELD, RATE_HZ, moved(HELD), TIME_S + 0.003)
    with pytest.raises(InputError, match="other times"):
        fit_subspace(late)


def test_a_fit_without_a_result_says_why_and_does_nothing_else():
    fit = fit_map(np.tile([0.0, 1.0], 10), np.random.default_rng(1).normal(size=20))
    assert "no result" in fit.summary() and "no result" in fit._repr_html_()
    for use in (lambda: fit.simulate([1.0]), lambda: fit.compare([1.0], [1.0]), fit.plot):
        with pytest.raises(ResultError, match="no result: x has only 2 distinct values"):
            use()


def test_rescaling_keeps_correlations_and_marks_what_is_not_identifiable():
    covariance = np.array([[4.0, 3.0, 0.1], [3.0, 9.0, 0.2], [0.1, 0.2, 1.0]])
    found = rescaled(covariance, np.array([4.0, 3.0, np.inf]))
    assert found[:2, :2] == pytest.approx(np.array([[16.0, 6.0], [6.0, 9.0]]))
    assert np.isinf(found[2]).all() and np.isinf(found[:, 2]).all()


@pytest.mark.parametrize("wrong", [None, "u.csv", 3.0, {"u": [1.0], "y": [1.0]}, [[1.0, 2.0]]])
@pytest.mark.parametrize(
    "fit", [fit_transfer, fit_arx, fit_hysteresis, fit_free_response, fit_duffing, choose_transfer]
)
def test_what_is_no_record_is_refused_with_how_to_make_one(fit, wrong):
    with pytest.raises(InputError, match=r" is .*; it must be a .*\. Make .* haselab\."):
        fit(wrong)


def test_residuals_without_a_finite_autocovariance_are_not_white():
    assert whiteness_p([np.array([1.0])]) == 1.0
    assert whiteness_p([np.array([1e200, -1e200, 1.0])]) == 0.0
    assert whiteness_p([np.zeros(3)]) == 1.0
