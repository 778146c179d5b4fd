"""The count of unstable poles against poles of the closed loop by three independent routes."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import tf2ss

from haselab.control import PidGains, loop_response, margins
from haselab.models import Plant
from haselab.models.rational import RationalModel

LOOPS = 150  # of each kind; benchmarks/control/margins.py takes 10,000
HIGHEST = 1e3  # rad/s: collocation is exact up to there
MANY = 8
NEAR = 1e-4  # relative distance from the axis at which either count may be right


def random_model(rng, delay_s):
    """1 to 6 poles, up to as many zeros; some unstable, integrating, or without damping."""
    order = int(rng.integers(1, 7))
    poles: list[complex] = []
    while len(poles) < order:
        size = np.exp(rng.uniform(-1.5, 2.5))
        side = -1.0 if rng.random() < 0.85 else 1.0
        if len(poles) + 2 <= order and rng.random() < 0.6:
            zeta = rng.choice([0.0, 0.01, 0.1, 0.5], p=[0.05, 0.15, 0.4, 0.4])
            root = size * complex(side * zeta, np.sqrt(1.0 - zeta**2))
            poles += [root, root.conjugate()]
        else:
            poles.append(0j if rng.random() < 0.1 and 0j not in poles else complex(side * size))
    zeros: list[complex] = []
    for _ in range(int(rng.integers(0, order))):
        zeros.append(complex(rng.choice([-1.0, -1.0, 1.0]) * np.exp(rng.uniform(-1.5, 3.0))))
    top, bottom = np.atleast_1d(np.real(np.poly(zeros))), np.real(np.poly(poles))
    at = 1j * np.exp(rng.uniform(-1.0, 2.5))
    gain = rng.choice([-1.0, 1.0, 1.0]) * np.exp(rng.uniform(-2.0, 1.5))
    gain /= abs(np.polyval(top, at) / np.polyval(bottom, at))
    return RationalModel(tuple(gain * top), tuple(bottom), delay_s)


def random_gains(rng):
    kp, ki, kd = np.exp(rng.uniform(-3.0, 2.0, 3)) * (rng.random(3) < [0.8, 0.7, 0.4])
    kp = kp or float(not ki)
    return PidGains(kp, ki, kd, float(np.exp(rng.uniform(-4.0, -1.0))))


def controller_states(gains):
    """Controllable form of the continuous controller."""
    tau = gains.derivative_filter_s
    top = [gains.kp * tau + gains.kd, gains.kp + gains.ki * tau, gains.ki]
    bottom = [tau, 1.0, 0.0]
    if gains.ki == 0.0:
        top, bottom = top[:2], bottom[:2]
    return tf2ss(np.trim_zeros(np.array(top), "f"), bottom)


def continuous_poles(model, gains, delay_s, nodes=30):
    """Rightmost poles of the loop; the delay by collocation of its history (Breda's method)."""
    a, b, c, _ = tf2ss(model.numerator, model.denominator)
    ac, bc, cc, dc = controller_states(gains)
    n, m = a.shape[0], ac.shape[0]
    now = np.block([[a, np.zeros((n, m))], [-bc @ c, ac]])
    late = np.block([[-b @ dc @ c, b @ cc], [np.zeros((m, n + m))]])
    if delay_s == 0.0:
        return np.linalg.eigvals(now + late)
    x = np.cos(np.pi * np.arange(nodes + 1) / nodes)
    weight = np.r_[2.0, np.ones(nodes - 1), 2.0] * (-1.0) ** np.arange(nodes + 1)
    apart = x[:, None] - x
    slope = np.outer(weight, 1.0 / weight) / (apart + np.eye(nodes + 1))
    slope -= np.diag(slope.sum(axis=1))
    whole = np.kron(slope * 2.0 / delay_s, np.eye(n + m))
    whole[: n + m] = 0.0
    whole[: n + m, : n + m], whole[: n + m, -(n + m) :] = now, late
    return np.linalg.eigvals(whole)


def sampled_poles(model, gains, delay_s, rate_hz):
    """Poles in z of plant, delay line and controller, the delay cut at a fraction of a sample."""
    period = 1.0 / rate_hz
    a, b, c, d = tf2ss(model.numerator, model.denominator)
    n = a.shape[0]
    whole = int(np.floor(delay_s * rate_hz))
    late = delay_s - whole * period

    def held(time):
        block = np.zeros((n + 1, n + 1))
        block[:n, :n], block[:n, n:] = a * time, b * time
        power = expm(block)
        return power[:n, :n], power[:n, n:]

    step, _ = held(period)
    early, new = held(period - late)
    old = early @ held(late)[1]
    size = n + whole + 3  # plant, past outputs u[k-1] .. u[k-whole-1], integrator, filter
    share = period / (period + gains.derivative_filter_s)
    u_row, y_row = np.zeros((1, size)), np.zeros((1, size))
    y_row[:, :n] = c
    y_row[0, n + whole] += d.item()
    change = share * y_row
    change[0, -1] -= share
    grown = -gains.ki * period * y_row
    u_row = grown - gains.kp * y_row - gains.kd / period * change
    u_row[0, -2] += 1.0
    whole_step = np.zeros((size, size))
    whole_step[:n, :n] = step
    whole_step[:n, n + whole] += old[:, 0]
    if whole:
        whole_step[:n, n + whole - 1] += new[:, 0]
    else:
        whole_step[:n] += new @ u_row
    whole_step[n] = u_row
    for k in range(whole):
        whole_step[n + 1 + k, n + k] = 1.0
    whole_step[-2, -2] = 1.0
    whole_step[-2] += grown[0]
    whole_step[-1, -1] = 1.0
    whole_step[-1] += change[0]
    if gains.ki == 0.0:  # an integrator without effect is no part of the loop
        keep = np.arange(size) != size - 2
        whole_step = whole_step[np.ix_(keep, keep)]
    return np.linalg.eigvals(whole_step)


def agrees(kind, seed):
    """Whether both counts are the same; None where a pole is too near the axis to decide."""
    rng = np.random.default_rng([21, seed])
    delay_s = 0.0 if kind == "continuous" else float(np.exp(rng.uniform(-4.0, 0.5)))
    model, gains = random_model(rng, 0.5 * delay_s), random_gains(rng)
    if kind == "sampled":
        rate_hz = 20.0 * np.exp(rng.uniform(-0.5, 2.0))
        z = sampled_poles(model, gains, delay_s, rate_hz)
        off = np.abs(z) - 1.0
    else:
        rate_hz = None
        poles = continuous_poles(model, gains, delay_s)
        if delay_s:
            edge = loop_response(model, gains, HIGHEST, loop_delay_s=0.5 * delay_s, rate_hz=None)
            if abs(edge) > 1.0:  # the chain of delay poles goes on beyond
                return None
            poles = poles[np.abs(poles) < HIGHEST]
        off = poles.real / np.maximum(np.abs(poles), 1e-2)
    if np.abs(off).min() < NEAR:
        return None
    found = margins(model, gains, loop_delay_s=0.5 * delay_s, rate_hz=rate_hz)
    count = int((off > 0.0).sum())
    if count > MANY:  # of a chain of delay poles collocation finds the first ones only
        return found.unstable_poles > MANY
    return found.unstable_poles == count


@pytest.mark.long
@pytest.mark.parametrize("kind", ["continuous", "delayed", "sampled"])
def test_the_encirclement_count_is_the_number_of_unstable_closed_loop_poles(kind):
    agree = [agrees(kind, seed) for seed in range(LOOPS)]
    assert [seed for seed, same in enumerate(agree) if same is False] == []
    assert sum(same is True for same in agree) > 0.9 * LOOPS


def test_an_integrating_loop_around_a_negative_gain_is_unstable():
    found = margins(Plant(-1.0, 10.0, 0.5), PidGains(0.1, 1.0), loop_delay_s=0.0, rate_hz=100.0)
    assert not found.stable
    assert found.phase_margin_deg < 0.0


def test_a_plant_and_its_rational_form_have_the_same_margins():
    plant, gains = Plant(0.7, 12.0, 0.2, 0.013), PidGains(0.3, 2.0, 0.02, 0.01)
    rational = RationalModel.from_plant(plant)
    for rate_hz in (None, 100.0):
        one, two = (
            margins(p, gains, loop_delay_s=0.004, rate_hz=rate_hz) for p in (plant, rational)
        )
        assert two.phase_margin_deg == pytest.approx(one.phase_margin_deg, rel=1e-7)
        assert two.gain_margin_db == pytest.approx(one.gain_margin_db, rel=1e-7)


def test_positive_feedback_at_standstill_limits_the_gain():
    # 1 - 0.5 k is zero at k = 2: a real pole crosses, at frequency 0.
    found = margins(Plant(-0.5, 10.0, 0.9), PidGains(1.0, 0.0), loop_delay_s=0.0, rate_hz=None)
    assert found.stable
    assert found.gain_margin_db == pytest.approx(20.0 * np.log10(2.0), abs=1e-3)
    assert found.gain_margin_rad_s == 0.0


def test_an_undamped_plant_has_margins():
    found = margins(Plant(1.0, 10.0, 0.0), PidGains(0.0, 0.5), loop_delay_s=0.0, rate_hz=100.0)
    assert not found.stable
