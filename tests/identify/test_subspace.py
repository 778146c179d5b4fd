"""Subspace models: SLICOT's published run on the hair dryer, exact records, correct intervals."""

import re

import numpy as np
import pytest
from scipy.signal import lfilter

from haselab.base import InputError, ResultError
from haselab.identify import fit_subspace, fit_transfer
from haselab.identify.noise import fit_percent
from haselab.identify.record import Record
from haselab.identify.transfer.fit import TransferStructure
from haselab.models import StateSpaceModel

RATE_HZ = 12.5
TOP, BOTTOM = [0.0, 0.3, 0.1, 0.05], [1.0, -1.6, 0.95, -0.2]
HALF_DIGIT = 5e-5


@pytest.fixture(scope="module")
def dryer(shared_data):
    return np.loadtxt(shared_data / "identification/hair-dryer.csv", delimiter=",").T


def printed(path, title, rows):
    """Numbers in the lines below a title of one of SLICOT's result files."""
    text = path.read_text(encoding="ascii").partition(title)[2]
    lines = [line for line in text.splitlines()[1:] if line.strip()][:rows]
    return np.array([float(n) for line in lines for n in re.findall(r"-?\d+\.\d+", line)])


@pytest.fixture(scope="module")
def published(shared_data):
    """The model of order 4 that SLICOT prints, to its four decimals."""
    path = shared_data / "identification/hair-dryer-slicot-IB01BD.res"
    return StateSpaceModel(
        printed(path, "state matrix A", 4).reshape(4, 4), printed(path, "input matrix B", 4),
        printed(path, "output matrix C", 1),
        float(printed(path, "input-output matrix D", 1)[0]), RATE_HZ,
    )  # fmt: skip


def test_the_hair_dryer_has_the_published_singular_values_to_every_digit(dryer, shared_data):
    u, y = dryer
    path = shared_data / "identification/hair-dryer-slicot-IB01AD.res"
    lines = printed(path, "singular values are", 2)
    fit = fit_subspace(Record.sampled(u, y, RATE_HZ), remove_means=False, bootstrap=0)
    assert fit.singular_values == pytest.approx(lines, abs=1.01 * HALF_DIGIT)
    # The largest gap is after the order that SLICOT finds.
    assert fit.plant.b.size == 4


def test_the_hair_dryer_has_the_published_poles_within_their_rounding(dryer, published):
    u, y = dryer
    poles = fit_subspace(Record.sampled(u, y, RATE_HZ), remove_means=False, bootstrap=0).plant.poles
    values, right = np.linalg.eig(published.a)
    left = np.linalg.inv(right)
    # First order: the condition of a pole times the size of half a digit in 16 elements.
    condition = np.linalg.norm(right, axis=0) * np.linalg.norm(left, axis=1)
    for value, spread in zip(values, condition * 4.0 * HALF_DIGIT, strict=True):
        assert np.abs(poles - value).min() <= spread
    # The digits of data/SOURCES.md: two units in the fourth.
    for known in (0.4758 + 0.2001j, 0.4758 - 0.2001j, 0.7455, 0.9611):
        assert np.abs(poles - known).min() <= 2.5e-4


def test_ours_explain_the_hair_dryer_no_worse_than_the_published_model(dryer, published):
    u, y = dryer
    forced, free = published.simulate(u), published.responses(u)[1]
    # The published model too gets its best first state and an offset.
    columns = np.column_stack([free, np.ones(u.size)])
    state = np.linalg.lstsq(columns, y - forced, rcond=None)[0]
    known = fit_percent([y], [forced + columns @ state])
    fit = fit_subspace(Record.sampled(u, y, RATE_HZ), 4, bootstrap=0)
    assert fit.fit_percent >= known
    # Two poles and a delay, in continuous time, against four states.
    transfer = fit_transfer([Record.sampled(u, y, RATE_HZ)], TransferStructure(poles=2))
    assert transfer.succeeded
    assert transfer.answer()["fit_percent"] >= known - 0.5
    # The published gain belongs to a record with its means; rounding of A moves it by
    # half a digit over 1 - 0.9611, 26 times: so much it supports and no more.
    gain = transfer.answer()["gain"]
    assert abs(gain.value - fit.static_gain.value) <= 0.02
    poles = sorted(abs(complex(p).real) for p in transfer.answer()["poles"])
    dominant = -np.log(0.7455) * RATE_HZ
    assert poles[0] == pytest.approx(dominant, rel=0.1)


def test_a_record_without_noise_gives_its_equation():
    u = np.random.default_rng(1).normal(size=400)
    fit = fit_subspace(
        Record.sampled(u, lfilter(TOP, BOTTOM, u), RATE_HZ), remove_means=False, bootstrap=0
    )
    assert np.poly(fit.plant.a) == pytest.approx(BOTTOM, abs=1e-9)
    assert fit.plant.static_gain == pytest.approx(sum(TOP) / sum(BOTTOM), rel=1e-9)
    assert fit.fit_percent == pytest.approx(100.0, abs=1e-6)
    in_motion = fit_subspace(
        Record.sampled(u[100:], lfilter(TOP, BOTTOM, u)[100:], RATE_HZ),
        remove_means=False,
        bootstrap=0,
    )
    assert in_motion.fit_percent == pytest.approx(100.0, abs=1e-6)


@pytest.mark.long
def test_intervals_of_poles_and_gain_cover_the_truth():
    runs, inside = 60, np.zeros(3)
    roots = np.roots(BOTTOM)
    pair = np.log(roots[np.argmax(roots.imag)]) * RATE_HZ
    truth = [sum(TOP) / sum(BOTTOM), abs(pair), -pair.real / abs(pair)]
    for run in range(runs):
        u, e = np.random.default_rng([41, run]).normal(size=(2, 600))
        y = lfilter(TOP, BOTTOM, u) + 0.1 * e
        fit = fit_subspace(
            Record.sampled(u, y, RATE_HZ), 3, remove_means=False, block_rows=8, seed=run
        )
        (mode,) = [m for m in fit.modes if "damping_ratio" in m]
        estimates = [fit.static_gain, mode["natural_frequency_rad_s"], mode["damping_ratio"]]
        inside += [e.ci95[0] <= t <= e.ci95[1] for e, t in zip(estimates, truth, strict=True)]
    # Binomial: 3 spreads below 95 %, and the width from 50 repeats is known to a tenth, which
    # takes 1 % of the coverage.
    assert (inside / runs >= 0.94 - 3 * np.sqrt(0.95 * 0.05 / runs)).all()


def test_without_repeats_the_intervals_are_open():
    u = np.random.default_rng(2).normal(size=300)
    y = lfilter(TOP, BOTTOM, u) + 0.01 * np.random.default_rng(3).normal(size=300)
    fit = fit_subspace(Record.sampled(u, y, RATE_HZ), 3, bootstrap=0)
    assert fit.static_gain.std == np.inf and np.isfinite(fit.static_gain.value)


def test_too_many_states_give_no_result_and_bad_records_are_refused():
    u = np.random.default_rng(4).normal(size=300)
    y = lfilter(TOP, BOTTOM, u)
    fit = fit_subspace(Record.sampled(u, y, RATE_HZ), 8, remove_means=False)
    assert fit.status.startswith("no result: the data do not support 8 states")
    with pytest.raises(ResultError, match="do not support 8 states"):
        _ = fit.plant
    with pytest.raises(InputError, match="order = 15; it must be 1 to 10"):
        fit_subspace(Record.sampled(u, y, RATE_HZ), 15)
    with pytest.raises(InputError, match="120 samples or more"):
        fit_subspace(Record.sampled(u[:100], y[:100], RATE_HZ))
    with pytest.raises(InputError, match="excites nothing"):
        fit_subspace(Record.sampled(np.zeros(300), y, RATE_HZ))
    with pytest.raises(InputError, match="must be equally long"):
        fit_subspace(Record.sampled(u[:200], y, RATE_HZ))
    with pytest.raises(InputError, match="finite"):
        fit_subspace(Record.sampled(u, np.where(np.arange(300) == 5, np.nan, y), RATE_HZ))
    with pytest.raises(InputError, match="state model has shapes"):
        StateSpaceModel(np.eye(2), [1.0], [1.0], 0.0, 1.0)
