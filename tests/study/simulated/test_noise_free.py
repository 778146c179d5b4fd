"""The noise-free bench: its capacitances are those of the twin, whatever its converters round."""

from __future__ import annotations

import numpy as np
import pytest

from haselab.rig.twin.config import twin_of_reading
from haselab.study.definition import builtin_study
from haselab.study.simulated.noise_free import NoiseFreeBench

BLOCKS = 120


@pytest.mark.parametrize("drive_v", [0.6, 1.4])
def test_rounding_moves_no_mean_of_capacitances(drive_v):
    """At rest, all blocks have equal codes; without dither all share an error of up to 0.4 pF."""
    config, study = twin_of_reading("hz"), builtin_study(quick=True)
    quiet = NoiseFreeBench(config, study)
    rig, law = quiet.rig, config.law
    rig.generator.sine(study.sensing.carrier_hz, study.sensing.carrier_v)
    rig.source.write(drive_v)
    rig.stand.wait(60.0)
    quiet.start("rest", 50.0, config.load.mass_kg)
    for _ in range(BLOCKS):
        start_s = rig.acquisition.time_s
        quiet.append_block("rest", rig.acquisition.read(), start_s, drive_v, np.nan)
    quiet.flush("rest")
    quiet.finish()
    seen = quiet.observation("rest")
    true_f = np.interp(seen.sensed_s, seen.frame_time_s, law.capacitance_f(seen.length_m))
    off_f = (seen.capacitance_f - true_f)[1:]  # the carrier begins in the first block
    assert off_f.std() < 0.25e-12
    assert abs(off_f.mean()) < 4.0 * off_f.std() / np.sqrt(BLOCKS)
