"""Intervals where the misfit is not quadratic."""

import numpy as np
import pytest

from haselab.actuators import GRAVITY_M_S2, Drive, PlanarHasel, SampledLaw
from haselab.base import Estimate
from haselab.identify.physical import fit_actuator
from haselab.pipelines.motion_table import motion_of_table

MASS_KG, STD_M = 0.25, 4e-6
TRUE = PlanarHasel(
    shear_modulus_pa=14.02e3, locking_stretch=4.233, length_m=0.05719,
    electrode_stiffness_n_per_m=159.0, electrode_stiffening=0.1156,
    branch_share=(0.021, 0.02452, 0.3644), branch_relaxation_s=(0.07229, 0.9851, 3.456),
    damping_n_s_per_m=2.031, softening_share=0.06554, softening_stretch=1.467,
    softening_transition=0.02259, permittivity=3.051, capacitance_exponent=3.028,
)  # fmt: skip
BRANCHES = {"viscosity.share[1]": 0.02452, "viscosity.relaxation_s[2]": 3.456}


@pytest.mark.long
def test_branches_that_imitate_each_other_have_intervals_that_contain_the_truth():
    # 5 s of a free response after 1 s of voltage: three branches, one mass, lengths alone
    time_s = np.arange(0.0, 6.0, 0.01)
    volt = np.where(time_s < 1.0, 7200.0, 0.0)
    same = np.full(time_s.size, MASS_KG)
    drive = Drive(np.append(time_s, 6.0), volt, GRAVITY_M_S2 * same, same, 0.0 * same)
    sampled = SampledLaw(TRUE, 11e3)
    start, _ = sampled.at_rest(7200.0, 0.0, float(drive.load_n[0]))
    length_m = sampled.respond(drive, time_s, start).length_m
    length_m = length_m + STD_M * np.random.default_rng(7).standard_normal(time_s.size)
    record = motion_of_table("free", time_s, volt, mass_kg=MASS_KG, length_m=length_m)
    fit = fit_actuator(PlanarHasel(), [record], mass_kg=MASS_KG, camera_bias_m=5e-5)
    assert fit.status == "ok"
    for name, truth in BRANCHES.items():
        found = fit.parameters[name]
        quadratic = Estimate.lognormal(found.value, found.std / found.value, found.unit).ci95
        assert not quadratic[0] <= truth <= quadratic[1]
        assert found.ci95[0] <= truth <= found.ci95[1]
