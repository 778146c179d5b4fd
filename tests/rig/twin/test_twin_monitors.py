"""What stands between the load and its readings: stray, lags, gains, offsets, and the fixture."""

import numpy as np
import pytest

from haselab.base import LimitError
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import TwinBench, describe

OMEGA = 2 * np.pi * 2000.0
LSB_V = 20.0 / 2**16
# A straight line from sample to sample has (omega T)^2 / 12 less of the carrier than the carrier.
LINE = (OMEGA / 200e3) ** 2 / 12
CARRIER_V = 0.2
# Without noise the 100 readings of a period repeat: five standard deviations of a quadrature from
# their rounding, over the weaker monitor's amplitude.
ROUNDING = 5 * LSB_V / np.sqrt(12) * np.sqrt(2 / 100) / CARRIER_V


def bench_of(**amplifier: float) -> TwinBench:
    """Without noise; the sheet is held, so that the carrier's own pull moves nothing."""
    config = TwinConfig.model_validate(
        {"amplifier": amplifier, "load": {"added_inertia_kg": 999.0}}
    )
    return TwinBench(config, 1, noise=False)


def phasors(bench: TwinBench, blocks: int = 4) -> np.ndarray:
    """Carrier of both monitors in V, from settled blocks."""
    bench.sine(2000.0, CARRIER_V)
    bench.read()
    codes = np.concatenate([bench.read() for _ in range(blocks)]).astype(float) * LSB_V
    bench.off()
    bench.read()
    turn = np.exp(-1j * OMEGA * np.arange(len(codes)) / 200e3)
    return 2.0 * (codes * turn[:, None]).mean(axis=0)


def admittance(bench: TwinBench) -> complex:
    """As the nominal description reads it; the skew turns the current by omega skew."""
    d = describe(bench._config)
    v, i = phasors(bench)
    scale_s = d.v_monitor_v_per_v / d.i_monitor_v_per_a
    return complex(scale_s * i / v * np.exp(-1j * OMEGA * d.skew_s))


def test_stray_capacitance_adds_to_what_is_connected():
    for farad in (0.3e-9, 2e-9):
        bare, with_stray = bench_of(), bench_of(stray_f=30e-12)
        for bench in (bare, with_stray):
            bench.connect(farad)
        more = admittance(with_stray) - admittance(bare)
        # The converters' own way of reading a current costs 3 LINE; both readings are rounded.
        bound_s = 4 * LINE * OMEGA * 30e-12 + 2 * ROUNDING * OMEGA * farad
        assert abs(more - 1j * OMEGA * 30e-12) < bound_s


def test_a_reference_with_its_series_resistor_takes_the_actuators_place_and_gives_it_back():
    bench = bench_of()
    actuator = admittance(bench)
    bench.connect(1e-9, 20e3)
    expected = 1 / (20e3 + 1 / (1j * OMEGA * 1e-9))
    assert abs(admittance(bench) / expected - 1) < 4 * LINE + 2 * ROUNDING
    bench.connect(None)
    assert abs(admittance(bench) / actuator - 1) < 4 * ROUNDING


def test_a_reference_moves_nothing_and_stands_what_the_actuator_would_not():
    bench = TwinBench(TwinConfig(), 1, noise=False)
    bench.connect(1e-9)
    length_m = bench._native.length_m
    bench.write(2.0)
    for _ in range(50):
        bench.read()
    bench.wait(1.0)
    assert bench._native.length_m == pytest.approx(length_m, rel=1e-9)  # creep of 120 s is over
    assert bench._native.field_v_m == 0.0


@pytest.mark.parametrize("lags_s", [(3e-6, 0.0), (0.0, 8e-6), (3e-6, 8e-6)])
def test_monitor_lags_turn_and_shrink_as_first_order_systems_do(lags_s):
    v0, i0 = phasors(bench_of())
    v, i = phasors(bench_of(v_monitor_lag_s=lags_s[0], i_monitor_lag_s=lags_s[1]))
    for got, plain, lag_s in ((v, v0, lags_s[0]), (i, i0, lags_s[1])):
        assert abs(got / plain * (1 + 1j * OMEGA * lag_s) - 1) < 2 * LINE + 2 * ROUNDING


def test_gain_errors_and_offsets_belong_to_one_monitor_each():
    v0, i0 = phasors(bench_of())
    v, i = phasors(bench_of(v_monitor_gain_error=0.05, i_monitor_gain_error=-0.12))
    assert abs(v / v0 - 1.05) < 2 * ROUNDING
    assert abs(i / i0 - 0.88) < 2 * ROUNDING
    codes = bench_of(v_monitor_offset_v=0.01, i_monitor_offset_v=-0.02).read()
    np.testing.assert_allclose(codes.mean(axis=0) * LSB_V, [0.01, -0.02], atol=LSB_V / 2)


@pytest.mark.parametrize(
    ("capacitance_f", "series_ohm"),
    [(0.0, 0.0), (-1e-9, 0.0), (1e-3, 0.0), (1e-9, -1.0), (float("nan"), 0.0),
     (1e-9, float("inf"))],
)  # fmt: skip
def test_a_reference_that_cannot_be_is_refused(capacitance_f, series_ohm):
    with pytest.raises(LimitError, match=r"reference of .* is outside .* Use another one"):
        bench_of().connect(capacitance_f, series_ohm)


def test_a_live_fixture_must_not_be_touched():
    bench = bench_of()
    bench.write(0.5)
    with pytest.raises(LimitError, match=r"Do not touch .* output is 0\.5 V .* both off first"):
        bench.connect(1e-9)
    bench.zero()
    bench.sine(2000.0, 0.02)
    with pytest.raises(LimitError, match=r"the carrier 0\.02 V"):
        bench.connect(None)
    bench.off()
    bench.connect(1e-9)
