"""Many loops at once: the bits of the C core, the plant's physics, and the summary of a run."""

import itertools

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.special import ndtri
from scipy.stats import kstest

from haselab import _core, _loops
from haselab.base import InputError
from haselab.control.ensemble import simulate_ensemble, trace_ensemble
from haselab.control.gains import PidGains, Saturation
from haselab.control.plants.loop_table import LoopTable, WhiteNoise
from haselab.control.plants.modes import SampledLoops
from haselab.control.simulate import LoopSetting
from haselab.models.plant import Plant, SlowMode

CREEPING = Plant(0.5, 5.11, 0.09, slow_modes=(SlowMode(0.4, 4.7),))
VECTORS = [bits for bits in (256, 512) if bits <= _loops.widest()]
NO_VALUES, NO_SEEDS = np.zeros((0, 0), np.float32), np.zeros(0, np.uint32)
SILENT = NO_VALUES, NO_SEEDS


def run_traces(table, reference, noise=SILENT, *, bits, threads=0):
    shape = (len(table.rows), reference.size)
    measured, u = np.empty(shape, np.float32), np.empty(shape, np.float32)
    table.loops().traces(reference, *noise, measured, u, bits, threads)
    return measured.view(np.uint32), u.view(np.uint32)


def run_summaries(table, reference, ends, noise=SILENT, *, bits, threads=0):
    kept = np.empty((len(table.rows), len(ends)), _loops.SUMMARY)
    table.loops().summaries(reference, *noise, 0.05, np.array(ends, np.uint64), kept, bits, threads)
    return kept.view(np.uint32)


@st.composite
def plants(draw):
    slow = st.tuples(st.floats(-1.0, 1.0), st.floats(0.01, 50.0))
    modes = tuple(SlowMode(*pair) for pair in draw(st.lists(slow, max_size=3)))
    return Plant(
        draw(st.floats(-2.0, 2.0)),
        draw(st.floats(0.5, 900.0)),
        draw(st.floats(0.0, 3.0)),
        draw(st.floats(0.0, 0.04)),
        modes,
    )


@st.composite
def problems(draw):
    """Loops that need not be stable, at 1 kHz, with measurements that may be lost."""
    count = draw(st.integers(1, 70))
    gain = st.one_of(st.just(0.0), st.floats(0.0, 50.0))
    filter_s = st.one_of(st.just(0.0), st.floats(0.0, 0.1))
    few = draw(st.lists(st.tuples(plants(), gain, gain, gain, filter_s), min_size=1, max_size=8))
    chosen = list(itertools.islice(itertools.cycle(few), count))
    low, high = draw(st.floats(-1.0, 0.0)), draw(st.floats(0.001, 1.0))
    start = draw(st.floats(0.0, 1.0))
    setting = LoopSetting(
        1000.0,
        draw(st.sampled_from([0.0, 0.001, 0.0004])),
        Saturation(low, high),
        min(max(start * high, low), high),
    )
    kind = draw(st.sampled_from(["none", "values", "generated"]))
    std = draw(st.sampled_from([0.0, 0.01, 1e3])) * np.linspace(0.5, 1.0, count)
    table = LoopTable.of([c[0] for c in chosen], [PidGains(*c[1:]) for c in chosen], setting, std)
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    samples = draw(st.integers(1, 200))
    reference = np.repeat(rng.uniform(-1.0, 1.0, 5), 40)[:samples].astype(np.float32)
    values = rng.normal(0.0, std[:, None], (count, samples)).astype(np.float32)
    values[rng.random((count, samples)) < draw(st.sampled_from([0.0, 0.1, 0.9]))] = np.nan
    seeds = rng.integers(0, 2**32, 2, dtype=np.uint32)
    noise = {"none": SILENT, "values": (values, NO_SEEDS), "generated": (NO_VALUES, seeds)}
    return table, reference, noise[kind]


@pytest.mark.long
@settings(max_examples=60, deadline=None)
@given(problem=problems(), threads=st.integers(1, 3))
def test_every_vector_unit_gives_the_bits_of_the_sequential_loop(problem, threads):
    table, reference, noise = problem
    cuts = sorted({1, reference.size // 3, reference.size // 2, reference.size} - {0})
    alone = run_traces(table, reference, noise, bits=0)
    summaries = run_summaries(table, reference, cuts, noise, bits=0)
    for bits in VECTORS:
        found = run_traces(table, reference, noise, bits=bits, threads=threads)
        for one, many in zip(alone, found, strict=True):
            np.testing.assert_array_equal(many, one)
        kept = run_summaries(table, reference, cuts, noise, bits=bits, threads=threads)
        np.testing.assert_array_equal(kept, summaries)


@pytest.mark.parametrize("kind", ["silent", "values", "generated"])
def test_long_runs_give_the_same_bits_where_they_are_cut_into_segments(kind):
    spread, laws = random_loops(137, 8)
    setting = LoopSetting(1000.0, 0.0017)
    table = LoopTable.of(spread, laws, setting, np.linspace(0.0, 0.02, 137))
    reference = np.repeat(np.float32([0.08, -0.03, 0.02]), 900)
    values = np.random.default_rng(9).normal(0.0, 0.01, (137, 2700)).astype(np.float32)
    noise = {
        "silent": SILENT,
        "values": (values, NO_SEEDS),
        "generated": (NO_VALUES, np.array([1, 2], np.uint32)),
    }[kind]
    cuts = [5, 1100, 2700]
    alone = run_traces(table, reference, noise, bits=0, threads=1)
    summaries = run_summaries(table, reference, cuts, noise, bits=0, threads=1)
    for bits in VECTORS:
        for one, many in zip(alone, run_traces(table, reference, noise, bits=bits), strict=True):
            np.testing.assert_array_equal(many, one)
        kept = run_summaries(table, reference, cuts, noise, bits=bits)
        np.testing.assert_array_equal(kept, summaries)


@settings(max_examples=40, deadline=None)
@given(problem=problems())
def test_each_controller_is_the_c_core_bit_for_bit(problem):
    """The core's own Pid, fed with the measurements, gives the outputs; NaN becomes 0."""
    table, reference, noise = problem
    measured, u = (x.view(np.float32) for x in run_traces(table, reference, noise, bits=512))
    for row, seen, given_out in list(zip(table.rows, measured, u, strict=True))[:4]:
        low, high = row["u_low"], row["u_high"]
        pid = _core.Pid(row["kp"], row["ki"], row["kd"], 0.001, row["filter_s"], low, high)
        pid.reset(row["u"])
        out = [pid.step(float(r), float(m)) for r, m in zip(reference, seen, strict=True)]
        expected = np.array([_core.limit(value, low, high)[0] for value in out], np.float32)
        np.testing.assert_array_equal(given_out.view(np.uint32), expected.view(np.uint32))


@pytest.mark.parametrize("delay_s", [0.0, 0.0035, 0.0100, 0.0175])
def test_each_plant_answers_its_controller_as_its_differential_equation_does(delay_s):
    """Between measurement and output only the plant is left: an independent exact formula."""
    rng = np.random.default_rng(2)
    chosen = [
        Plant(
            rng.uniform(0.3, 0.7),
            rng.uniform(3.0, 60.0),
            rng.uniform(0.02, 1.5),
            rng.uniform(0.0, 0.004),
            tuple(SlowMode(rng.uniform(0.1, 0.4), rng.uniform(0.2, 9.0)) for _ in range(count)),
        )
        for count in (0, 1, 2, 3) * 5
    ]
    setting = LoopSetting(1000.0, delay_s, Saturation(-0.05, 0.1), 0.01)
    reference = np.repeat([0.08, -0.03, 0.02], 700)
    found = trace_ensemble(chosen, [PidGains(0.8, 3.0, 0.05, 0.02)] * 20, reference, setting)
    assert found.u.max() == np.float32(0.1) and found.u.min() == np.float32(-0.05)
    for plant, u, measured in zip(chosen, found.u.astype(float), found.measured, strict=True):
        start = float(np.float32(0.01))
        moved = plant.simulate(u - start, 1000.0, found.sample_time_s - delay_s)
        expected = moved + start * plant.static_gain
        # One rounding to single precision, and 2100 steps in double on a plant that multiplies
        # by at most 1 / (2 zeta) = 25.
        bound = 2.0**-24 * np.abs(expected).max() + 2100 * 2.0**-53 * 25
        assert np.abs(measured - expected).max() <= bound


@settings(max_examples=25, deadline=None)
@given(problem=problems(), place=st.integers(0, 69))
def test_a_loop_does_not_feel_its_neighbours(problem, place):
    table, reference, noise = problem
    place %= len(table.rows)
    values, seeds = noise
    assume(seeds.size == 0)  # what is generated goes by the place
    alone = LoopTable(table.rows[place : place + 1], table.branches, table.period_s)
    together = run_traces(table, reference, noise, bits=512)
    own = values[place : place + 1] if values.size else values
    single = run_traces(alone, reference, (own, seeds), bits=512)
    for many, one in zip(together, single, strict=True):
        np.testing.assert_array_equal(many[place], one[0])


def random_loops(count, seed):
    rng = np.random.default_rng(seed)
    spread = [
        Plant(0.5 * a, 5.11 * b, 0.3 * c, delay, (SlowMode(0.4, 4.7 * d),))
        for a, b, c, d, delay in zip(*rng.uniform(0.7, 1.3, (4, count)),
                                     rng.uniform(0.0, 0.03, count), strict=True)
    ]  # fmt: skip
    laws = [PidGains(*pair) for pair in rng.uniform((0.0, 0.5), (0.4, 6.0), (count, 2)).tolist()]
    return spread, laws


@pytest.mark.parametrize("samples", [3, 60, 6000, 23000])
def test_summaries_say_what_the_traces_show(samples):
    spread, laws = random_loops(40, 3)
    setting = LoopSetting(1000.0, 0.0023, Saturation(-0.05, 0.1))
    change = min(500, samples // 2)
    reference = np.where(np.arange(samples) < change, 0.01, 0.06)
    found = simulate_ensemble(spread, laws, reference, setting)
    traces = trace_ensemble(spread, laws, reference, setting)
    y, u = (x[:, change:].astype(float) for x in (traces.measured, traces.u))
    # In single precision, as the loops take the difference.
    size = np.abs(np.float32(0.06) - traces.measured[:, change:])
    np.testing.assert_array_equal(found.highest, y.max(axis=1))
    np.testing.assert_array_equal(found.lowest, y.min(axis=1))
    np.testing.assert_allclose(found.overshoot, np.maximum(y.max(axis=1) - 0.06, 0) / 0.05, 1e-5)
    # A sum of at most 1000 terms in single precision.
    expected = size.sum(axis=1, dtype=float) / 1000.0
    np.testing.assert_allclose(found.absolute_error_s, expected, rtol=1000 * 2.0**-24)
    limits = (u <= np.float32(-0.05)) | (u >= np.float32(0.1))
    np.testing.assert_allclose(found.limited_time_s, limits.sum(axis=1) / 1000.0, rtol=1e-12)
    for row, settling_s in zip(size, found.settling_time_s, strict=True):
        step = float(np.float32(0.06)) - float(np.float32(0.01))
        outside = np.flatnonzero(row > np.float32(0.02 * step))
        samples_out = outside[-1] + 1 if outside.size else 0
        late = samples_out > row.size * 9 // 10
        assert np.isnan(settling_s) if late else settling_s == samples_out * 0.001


def test_loops_that_do_not_calm_down_are_those_with_a_pole_outside_the_unit_circle():
    spread, laws = random_loops(400, 4)
    setting = LoopSetting(1000.0, 0.002, Saturation(-10.0, 10.0))
    reference = np.full(40_000, 0.04)
    found = simulate_ensemble(spread, laws, reference, setting)
    poles = SampledLoops.of(spread, laws, period_s=0.001, measurement_delay_s=0.002).poles()
    growth_per_s = np.log(np.abs(poles).max(axis=1)) * 1000.0
    # A swing that shrinks by less than 0.9 in a tenth (4 s) counts as lasting; one that starts
    # at 1e-3 of the step needs ln(0.04 / 1e-3) of growth over 36 s to leave the band.
    clear = (growth_per_s > 0.11) | (growth_per_s < np.log(0.9) / 4.0 - 0.01)
    assert clear.sum() > 350 and found.unstable.sum() > 30
    np.testing.assert_array_equal(found.unstable[clear], growth_per_s[clear] > 0.0)


def test_a_loop_that_creeps_towards_its_reference_is_not_unstable():
    found = simulate_ensemble(
        [Plant(1.0, 20.0, 0.7)],
        [PidGains(0.0, 0.05)],
        np.full(20_000, 0.04),
        LoopSetting(1000.0, 0.005),
    )
    assert np.isnan(found.settling_time_s[0]) and not found.unstable[0]


def test_integrators_stand_still_while_their_outputs_are_clamped():
    spread, _ = random_loops(33, 5)
    setting = LoopSetting(1000.0, 0.002, Saturation(-0.01, 0.01))
    reference = np.repeat([0.05, 0.0], [20_000, 2000])
    found = trace_ensemble(spread, [PidGains(0.0, 2.0)] * 33, reference, setting)
    assert np.all(found.u[:, 1000:20_000] == np.float32(0.01))
    # Frozen at most one increment, 2 * 0.05 / 1000, above the limit; then each sample takes
    # 2 * y / 1000 with y above 0.5 * 0.01 * static gain of about 0.7: at once after the delay.
    left = np.argmax(found.u[:, 20_000:] < np.float32(0.01), axis=1)
    assert left.min() >= 0 and left.max() <= 2 * 0.05 / (2 * 0.0035)


def test_a_lost_measurement_puts_out_zero_and_stops_the_controller():
    noise = np.zeros(100)
    noise[[0, 1, 50]] = np.nan
    setting = LoopSetting(1000.0, 0.005, initial_u=0.02)
    law = PidGains(0.4, 2.0, 0.1, 0.01)
    found = trace_ensemble([CREEPING], [law], np.full(100, 0.03), setting, measurement_noise=noise)
    assert np.flatnonzero(np.isnan(found.measured[0])).tolist() == [0, 1, 50]
    assert np.flatnonzero(found.u[0] == 0.0).tolist() == [0, 1, 50]


def test_common_noise_is_noise_for_each():
    rng = np.random.default_rng(6)
    spread, laws = random_loops(20, 6)
    noise = rng.normal(0.0, 1e-3, 300)
    reference, setting = np.full(300, 0.04), LoopSetting(1000.0, 0.005)
    kept = noise.copy()
    one = trace_ensemble(spread, laws, reference, setting, measurement_noise=noise)
    each = trace_ensemble(
        spread, laws, reference, setting, measurement_noise=np.tile(noise, (20, 1)), threads=2
    )
    np.testing.assert_array_equal(one.measured, each.measured)
    np.testing.assert_array_equal(noise, kept)
    assert np.all(reference == 0.04)


def mixed(x):
    """C. Wellons' triple32."""
    x = x.astype(np.uint32)
    for shift, factor in ((17, 0xED5AD4BB), (11, 0xAC4C1B51), (15, 0x31848BAB)):
        x = (x ^ (x >> np.uint32(shift))) * np.uint32(factor)
    return x ^ (x >> np.uint32(14))


def noise_alone(loops, samples, noise):
    """Measurements of plants that do not move."""
    still = [Plant(0.0, 5.0, 0.1)] * loops
    laws = [PidGains(0.0, 0.0)] * loops
    setting = LoopSetting(1000.0, 0.005)
    run = trace_ensemble(still, laws, np.zeros(samples), setting, measurement_noise=noise)
    return run.measured.astype(float)


def test_generated_noise_is_the_normal_quantile_of_counted_bits():
    seeds = np.random.SeedSequence(11).generate_state(2)
    count = mixed(np.arange(3000, dtype=np.uint32) + seeds[0])
    keys = mixed(np.arange(50, dtype=np.uint32) + seeds[1])
    bits = mixed(count[None, :] ^ keys[:, None])
    middle = ((bits >> 8).astype(float) + 0.5) / 2.0**24
    expected = ndtri(middle)
    found = noise_alone(50, 3000, WhiteNoise(1.0, seed=11))
    # The polynomials: 7e-5 of the quantile, and 2e-6 in the logarithm times its slope of 1 / 8.
    assert np.abs(found / expected - 1.0).max() < 8e-5
    each = noise_alone(50, 3000, WhiteNoise(np.linspace(0.0, 1e-3, 50), seed=11))
    np.testing.assert_allclose(each, found * np.linspace(0.0, 1e-3, 50)[:, None], rtol=2.0**-22)


@pytest.mark.long
def test_generated_noise_is_normal_white_and_independent():
    found = noise_alone(200, 5000, WhiteNoise(1.0, seed=12))
    count = found.size
    # Five standard deviations of each statistic under the null hypothesis.
    assert abs(found.mean()) < 5.0 / np.sqrt(count)
    assert abs(found.var() - 1.0) < 5.0 * np.sqrt(2.0 / count)
    assert abs((found**4).mean() - 3.0) < 5.0 * np.sqrt(96.0 / count)
    for lag in (1, 2, 3, 64):
        assert abs((found[:, lag:] * found[:, :-lag]).mean()) < 5.0 / np.sqrt(count - 200 * lag)
    between = np.corrcoef(found)[np.triu_indices(200, 1)] * np.sqrt(5000)
    assert np.abs(between).max() < 5.5 and abs(between.std() - 1.0) < 0.05
    assert kstest(found[:, ::5].ravel(), "norm").pvalue > 1e-4
    other = noise_alone(200, 5000, WhiteNoise(1.0, seed=13))
    assert abs((found * other).mean()) < 5.0 / np.sqrt(count)


def test_a_constant_reference_of_zero_has_no_step():
    found = simulate_ensemble(
        [CREEPING], [PidGains(0.1, 1.0)], np.zeros(50), LoopSetting(100.0, 0.005)
    )
    assert np.isnan(found.overshoot[0]) and np.isnan(found.settling_time_s[0])
    assert found.absolute_error_s[0] == 0.0 and not found.unstable[0]


MANY_BRANCHES = Plant(0.5, 5.0, 0.1, slow_modes=(SlowMode(0.1, 1.0),) * 4)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"plants": []}, r"0 plants and 1 controllers; there must be one controller per plant"),
        ({"plants": [CREEPING] * 2}, r"2 plants and 1 controllers"),
        ({"plants": [MANY_BRANCHES]}, r"a plant has 4 slow modes; at most 3"),
        ({"plants": [Plant(0.5, 5.0, 0.1, 2000.0)]}, r"the longest delay is 2000006 samples"),
        (
            {"gains": [PidGains(1e39, 0.0)]},
            r"a loop contains the value 1e\+39; it must be in the range of single precision",
        ),
        ({"reference": [0.0, np.nan]}, r"reference has shape \(2,\) or contains NaN"),
        ({"reference": []}, r"reference has shape \(0,\)"),
        (
            {"measurement_noise": [0.0]},
            r"measurement_noise has shape \(1,\) or contains an infinity",
        ),
        ({"measurement_noise": [0.0, np.inf]}, r"measurement_noise has shape \(2,\)"),
        ({"threads": -1}, r"threads = -1; it must be 1 or more, or 0 for all of the machine"),
        ({"measurement_noise": WhiteNoise([1.0, 2.0])}, r"noise has 2 standard deviations"),
    ],
)
def test_loops_that_cannot_be_are_refused_in_one_line(change, words):
    given_in = {"plants": [CREEPING], "gains": [PidGains(0.4, 1.0)], "reference": [0.0, 0.0]}
    given_in |= {"setting": LoopSetting(1000.0, 0.005)} | change
    for run in (simulate_ensemble, trace_ensemble):
        with pytest.raises(InputError, match=words) as caught:
            run(**given_in)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("std", [-1.0, np.nan, np.inf, [[1.0]], []])
def test_noise_that_cannot_be_is_refused(std):
    with pytest.raises(InputError, match="std of the noise has shape"):
        WhiteNoise(std)


def test_a_seed_below_zero_is_refused():
    with pytest.raises(InputError, match=r"seed = -1; it must be 0 or more"):
        WhiteNoise(1.0, seed=-1)
