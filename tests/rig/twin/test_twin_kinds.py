"""The twin plays every built-in kind: it comes to rest where the law's forces balance."""

import numpy as np
import pytest

from haselab.actuators import equilibrium_m
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import GRAVITY_M_S2, TwinBench, native_bench

KINDS = ["peano-hasel", "curling-hasel"]


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("drive_v", [0.4, 1.0, 2.0])
def test_it_comes_to_rest_at_the_laws_equilibrium(kind, drive_v):
    config = TwinConfig(kind=kind)
    bench, law = native_bench(config, 0, noise=False), config.law
    load_n = config.load.mass_kg * GRAVITY_M_S2
    steps = 200_000  # 20 s; the slowest branch takes 1 s
    bench.move(np.zeros(1), 1, load_n, np.empty(steps))
    lengths_m = np.empty(steps)
    bench.move(np.full(1, drive_v), 1, load_n, lengths_m)
    assert not bench.outside
    expected_m = equilibrium_m(law, 5e3 * drive_v, load_n)
    stroke_m = equilibrium_m(law, 0.0, load_n) - expected_m
    # the table's largest error between its voltages is 1e-3 of the largest force
    assert lengths_m[-1] == pytest.approx(expected_m, abs=1e-3 * stroke_m)
    expected_f = float(law.capacitance_f(expected_m, 5e3 * drive_v))
    assert bench.capacitance(lengths_m[-1], 5e3 * drive_v) == pytest.approx(expected_f, rel=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_its_camera_sees_all_lengths_of_the_study(kind):
    config = TwinConfig(kind=kind)
    law = config.law
    TwinBench(config, 0)  # refuses a sheet that is too narrow
    camera = config.camera
    highest_m = (camera.height_px - camera.top_px) * camera.scale_m_per_px
    assert equilibrium_m(law, 0.0, 5.0) < 0.9 * highest_m
    assert law.width_m < 0.9 * camera.width_px * camera.scale_m_per_px


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("carrier_hz", [2000.0, 1700.0])
def test_zipping_does_not_follow_the_carrier(kind, carrier_hz):
    """The current of a capacitance that does not change has the frequency of its voltage alone."""
    config = TwinConfig(kind=kind)
    bench = native_bench(config, 0, noise=False)
    bench.carrier_v, bench.carrier_rad_s = 0.02, 2.0 * np.pi * carrier_hz
    codes, lengths = np.empty((10, 2000, 2), dtype=np.int16), np.empty(100)
    for block in codes:
        bench.acquire(0.8, 0.8, 0, config.load.mass_kg * GRAVITY_M_S2, block, lengths)
    at_s = np.arange(2000) / config.acquisition.rate_hz
    turns = [np.exp(-2j * np.pi * k * carrier_hz * at_s) for k in (1, 2)]
    window = np.hanning(2000)
    first, second = (abs((codes[-1, :, 1] * window) @ turn) for turn in turns)
    # by a code, evenly distributed, each sample is wrong by 0.29 at most
    noise = 5.0 * 0.29 * np.sqrt((window**2).sum())
    assert second < noise + 1e-4 * first, second / first
