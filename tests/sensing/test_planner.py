"""The planner's numbers against simulated blocks: noise, steps, mains, folding; and its words."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import signal

from haselab.base import InputError
from haselab.sensing.carrier_plan import CarrierRequest, evaluate_carrier, plan_carrier

REQUEST = CarrierRequest()


class Bench:
    """Blocks of both monitors in physical units, and C from them by plain least squares."""

    def __init__(self, request: CarrierRequest, carrier_hz: float) -> None:
        self.r, self.omega = request, 2 * np.pi * carrier_hz
        self.time_s = np.arange(round(request.block_s * request.rate_hz)) / request.rate_hz
        self.y = 1 / (request.series_ohm + 1 / (1j * self.omega * request.capacitance_f))
        choice = evaluate_carrier(request, carrier_hz)
        self.v_v = choice.v_peak_v * request.volt_per_monitor_volt

    def carrier(self, phase_rad: float) -> tuple[np.ndarray, np.ndarray]:
        turn = self.v_v * np.exp(1j * (self.omega * self.time_s + phase_rad))
        return turn.real, (self.y * turn).real

    def step(self, at_s: float) -> tuple[np.ndarray, np.ndarray]:
        """Output and current after one step, by scipy's step response of the chain."""
        r, w = self.r, 2 * np.pi * self.r.bandwidth_hz
        amplifier = [1, 2 * r.damping_ratio * w, w * w]
        load = [r.series_ohm * r.capacitance_f, 1]
        h = r.step_v * r.volt_per_monitor_volt
        after = self.time_s > at_s
        late = np.concatenate([[0.0], self.time_s[after] - at_s])
        out = []
        for numerator, denominator in (
            ([h * w * w], amplifier),
            ([h * w * w * r.capacitance_f, 0], np.polymul(amplifier, load)),
        ):
            wave = np.zeros(self.time_s.size)
            # scipy wants even times: a fine grid from the step on, and between its points a spline
            fine = np.linspace(0, late[-1], 40 * late.size)
            wave[after] = np.interp(late[1:], *signal.step((numerator, denominator), T=fine))
            out.append(wave)
        return out[0], out[1]

    def capacitance_f(self, v: np.ndarray, i: np.ndarray, counts: np.ndarray | None = None):
        counts = np.ones(self.time_s.size, dtype=bool) if counts is None else counts
        angle = self.omega * self.time_s
        basis = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle), self.time_s], axis=1)
        x = np.linalg.lstsq(basis[counts], v[..., counts].T, rcond=None)[0]
        y = np.linalg.lstsq(basis[counts], i[..., counts].T, rcond=None)[0]
        z = (x[0] - 1j * x[1]) / (y[0] - 1j * y[1])
        return -1 / (self.omega * z.imag)


def relative(bench: Bench, v: np.ndarray, i: np.ndarray, **settings: np.ndarray) -> np.ndarray:
    return np.atleast_1d(bench.capacitance_f(v, i, **settings)) / bench.r.capacitance_f - 1


@pytest.mark.parametrize("carrier_hz", [825.0, 2000.0, 5575.0])
def test_the_noise_is_the_scatter_of_simulated_blocks(carrier_hz):
    bench, rng = Bench(REQUEST, carrier_hz), np.random.default_rng(1)
    v, i = bench.carrier(0.3)
    blocks = 1500
    noise = REQUEST.noise_v * rng.standard_normal((2, blocks, v.size))
    error = relative(
        bench,
        v + REQUEST.volt_per_monitor_volt * noise[0],
        i + REQUEST.ampere_per_monitor_volt * noise[1],
    )
    expected = evaluate_carrier(REQUEST, carrier_hz).noise
    assert error.std() == pytest.approx(expected, rel=5 / np.sqrt(2 * blocks))


@pytest.mark.long
@pytest.mark.parametrize("carrier_hz", [2000.0, 2025.0, 5575.0])
@pytest.mark.parametrize("update_s", [0.0, 0.003])
def test_the_leak_of_a_step_is_that_of_a_simulated_step(carrier_hz, update_s):
    request = replace(REQUEST, update_s=update_s)
    bench = Bench(request, carrier_hz)
    step_v, step_a = bench.step(update_s)
    errors = []
    for phase in 2 * np.pi * np.arange(16) / 16:
        v, i = bench.carrier(phase)
        errors.append(relative(bench, v + step_v, i + step_a)[0])
    rms = np.sqrt(np.mean(np.square(errors)))
    # To first order in the leak, which is at most 3 % here; the earlier step has died out.
    assert evaluate_carrier(request, carrier_hz).step == pytest.approx(rms, rel=0.06)


def test_a_blank_that_covers_the_step_leaves_nothing_of_it():
    request = replace(REQUEST, update_s=0.002, blank_s=1.5e-3)
    choice = evaluate_carrier(request, 2000.0)
    # The amplifier's exponential: e^-(0.6 * 2 pi 6000 * 1.5 ms) = e^-34 of the step.
    assert choice.step < np.exp(-30)
    unblanked = evaluate_carrier(replace(request, blank_s=0.0), 2000.0)
    assert unblanked.step > 1e-5
    # 300 of 2,000 samples and a level more cost noise: at least their share.
    assert choice.noise > unblanked.noise * np.sqrt(2000 / 1700) * 0.999


@pytest.mark.long
@pytest.mark.parametrize(("carrier_hz", "averages_out"), [(2000.0, False), (2025.0, True)])
def test_only_off_the_staircase_a_step_averages_out(carrier_hz, averages_out):
    """Row D17: on the 20th harmonic of the staircase each block has the same error."""
    bench = Bench(REQUEST, carrier_hz)
    step = bench.step(0.0)
    errors = []
    for k in range(100):  # a second of updates of one height; the carrier runs on
        v, i = bench.carrier(bench.omega * REQUEST.block_s * k)
        errors.append(relative(bench, v + step[0], i + step[1])[0])
    choice = evaluate_carrier(REQUEST, carrier_hz)
    rms, mean = np.sqrt(np.mean(np.square(errors))), abs(np.mean(errors))
    if averages_out:
        assert choice.step_average < 1e-3 * choice.step
        assert mean < 0.1 * rms  # what is left is the square of the leak
    else:
        assert choice.step_average == pytest.approx(choice.step)
        assert np.ptp(errors) < 1e-6 * rms
        assert 0.0 < mean < 1.5 * choice.step  # anything up to sqrt 2, by the carrier's phase


@pytest.mark.parametrize("carrier_hz", [1000.0, 1025.0, 2010.0])
def test_the_mains_leak_as_simulated_lines_do(carrier_hz):
    request = replace(REQUEST, rate_hz=20e3, mains_v=5e-3, step_v=0.0, distortion=0.0)
    bench, rng = Bench(request, carrier_hz), np.random.default_rng(3)
    orders = np.arange(1, 201)
    angle = 2 * np.pi * request.mains_hz * np.outer(orders, bench.time_s)
    blocks = 1500
    lines = []
    for scale in (request.volt_per_monitor_volt, request.ampere_per_monitor_volt):
        phase = rng.uniform(0, 2 * np.pi, (blocks, orders.size))
        peaks = scale * request.mains_v / orders
        lines.append(
            (peaks * np.cos(phase)) @ np.cos(angle) - (peaks * np.sin(phase)) @ np.sin(angle)
        )
    # A strong line far off leaks into one quadrature more than into the other: all phases count.
    errors = []
    for phase in 2 * np.pi * np.arange(8) / 8:
        v, i = bench.carrier(phase)
        errors.append(relative(bench, v + lines[0], i + lines[1]))
    expected = evaluate_carrier(request, carrier_hz).mains
    assert np.std(errors) == pytest.approx(expected, rel=5 / np.sqrt(2 * blocks))


def test_harmonics_that_fold_back_are_named():
    choice = evaluate_carrier(REQUEST, 12.5e3)  # 200 kHz / 16
    assert "Harmonics 15, 17, 31, 33 of the carrier alias onto it" in " ".join(choice.remarks)
    assert choice.alias > 0.0
    assert evaluate_carrier(REQUEST, 5575.0).alias == 0.0


def test_amplitudes_and_roll_off_are_those_of_the_chain():
    low, high = evaluate_carrier(REQUEST, 500.0), evaluate_carrier(REQUEST, 12e3)
    assert low.v_peak_v == pytest.approx(0.02, rel=0.01)
    w = 12e3 / 6e3
    gain = 1 / np.hypot(1 - w**2, 2 * 0.6 * w)
    assert high.v_peak_v == pytest.approx(0.02 * gain)
    z = abs(5e3 + 1 / (2j * np.pi * 12e3 * 1e-9))
    assert high.i_peak_v == pytest.approx(100 * gain / z / 2e-3)
    assert low.strain_std == pytest.approx(0.276 * low.total)


@pytest.mark.long
def test_the_choice_is_off_the_staircase_and_better_than_the_papers():
    plan, paper = plan_carrier(REQUEST), evaluate_carrier(REQUEST, 2000.0)
    assert plan.chosen.total < 0.5 * paper.total
    assert plan.chosen.step_average < 1e-6
    assert (plan.chosen.carrier_hz / 100) % 1 > 0.1
    assert min(c.total for c in plan.candidates) <= plan.chosen.total
    assert "harmonic 20 of the 100 Hz staircase" in paper.remarks[0]
    assert "the same phase, which averaging does not remove" in paper.remarks[0]
    assert any("blank" in reason for reason in plan.reasons)


@pytest.mark.long
def test_the_unknown_time_of_an_update_is_the_mean_over_its_places():
    unknown = evaluate_carrier(replace(REQUEST, update_s=None), 2025.0)
    places = [evaluate_carrier(replace(REQUEST, update_s=s), 2025.0).step
              for s in (np.arange(16) + 0.5) / 16 * 0.01]  # fmt: skip
    assert unknown.step == pytest.approx(np.sqrt(np.mean(np.square(places))), rel=1e-6)
    reasons = plan_carrier(replace(REQUEST, update_s=None)).reasons
    assert any("let the lock-in search" in reason for reason in reasons)


@pytest.mark.long
def test_current_limit_and_range_bound_the_choice():
    plan = plan_carrier(replace(REQUEST, current_limit_a=2e-3))
    assert plan.chosen.i_peak_v * 2e-3 <= 1e-3
    assert any(not c.usable and "more than half" in c.remarks[-1] for c in plan.candidates)
    with pytest.raises(InputError, match=r"no carrier stays within half of the current limit"):
        plan_carrier(replace(REQUEST, current_limit_a=1e-6))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rate_hz": 0.0}, "rate_hz = 0; it must be above 0"),
        ({"noise_v": float("nan")}, "noise_v = nan"),
        ({"capacitance_f": -1e-9}, "capacitance_f = -1e-09"),
        ({"step_v": -1.0}, "step_v = -1; it must be 0 or more"),
        ({"update_s": 0.01}, r"update_s = 0\.01 s is outside the block, \[0, 0\.01\)"),
        ({"blank_s": 0.008}, "three quarters of a block"),
        ({"damping_ratio": 1.2}, "damping_ratio"),
    ],
)
def test_what_cannot_be_is_refused(changes, words):
    with pytest.raises(InputError, match=words):
        replace(REQUEST, **changes)


def test_no_possible_carrier_is_reported():
    with pytest.raises(InputError, match="No carrier has 4 periods"):
        plan_carrier(replace(REQUEST, block_s=0.002, update_hz=500.0, bandwidth_hz=200.0))
    for carrier_hz in (100.0, 80e3):
        with pytest.raises(
            InputError, match="at least 2 periods and 3 samples per period are needed"
        ):
            evaluate_carrier(REQUEST, carrier_hz)
