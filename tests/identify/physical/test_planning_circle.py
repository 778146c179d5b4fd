"""Records that lack information, the planned experiment, and what both together determine."""

from dataclasses import replace

import numpy as np
import pytest

from haselab.actuators import ADDED_INERTIA, PlanarHasel, SampledLaw, with_parameters
from haselab.identify.physical import fit_actuator
from haselab.identify.physical.outlook import Outlook
from haselab.identify.physical.unknowns import fitted_parameters
from haselab.models.actuator.sections import PhysicalRecords
from haselab.pipelines.planning.catalogue import Range
from haselab.pipelines.planning.foreseen import foreseen
from haselab.pipelines.planning.proposal import Planner
from haselab.pipelines.planning.records import summary_of
from haselab.study.definition import checked_study

MASS_KG, GAIN = 0.25, 5000.0
BENCH = PhysicalRecords(
    gain_v_per_v=GAIN, carrier_v=100.0, length_std_m=4e-6, capacitance_std_f=3e-13
)
TRIANGLE = {
    "low_v": 0.0, "high_v": 1.6, "frequency_hz": 0.5, "cycles": 4, "left_out_cycles": 0,
    "frame_rate_hz": 100.0,
}  # fmt: skip
DROP = {"trials": 1, "settle_s": 2.0, "record_s": 2.0, "frame_rate_hz": 100.0}


def played(law, tables, seed):
    """What a bench records of a law, with noise."""
    study = checked_study({"name": "played", **tables}, "played")
    record = foreseen(study, BENCH, MASS_KG)
    drive, rng = record.drive, np.random.default_rng(seed)
    sampled = SampledLaw(law, 12e3)
    start, _ = sampled.at_rest(drive.voltage_v[0], drive.ripple_v2[0], drive.load_n[0])
    seen = sampled.respond(drive, record.length_time_s, start)
    length_m = seen.length_m + record.length_std_m * rng.standard_normal(seen.length_m.size)
    farad = seen.capacitance_f[record.window]
    farad = farad + record.capacitance_std_f * rng.standard_normal(farad.size)
    return replace(record, name=f"played-{seed}", length_m=length_m, capacitance_f=farad)


def planner_for(fit, records, heaviest_kg):
    outlook = Outlook.of(fit.unknowns(), fit.covariance, fit.excess_variance)
    summary = summary_of(fit, records, GAIN)
    return Planner(outlook, summary, Range(2.0, heaviest_kg, MASS_KG))


def relative(fit, name):
    """Relative standard deviation, as a plan states it."""
    return Outlook.of(fit.unknowns(), fit.covariance).relative_std()[
        list(fit.parameters).index(name)
    ]


def circle(true, start, tables, name, heaviest_kg=0.25):
    """First fit, plan, and the fit of both."""
    first = played(true, tables, 1)
    little = fit_actuator(start, [first], mass_kg=MASS_KG)
    assert little.succeeded, little.status
    proposal = planner_for(little, [first], heaviest_kg).propose(name)
    assert proposal is not None
    second = played(true, proposal.candidate.tables, 2)
    return little, proposal, fit_actuator(start, [first, second], mass_kg=MASS_KG)
