"""Records that lack information, the planned experiment, and what both together determine."""

from dataclasses import replace

import numpy as np
import pytest

from haselab.actuators import PlanarHasel, SampledLaw, with_parameters
from haselab.base import InputError
from haselab.identify.physical import fit_actuator
from haselab.identify.physical.information import RELATIVE, covariance_of, vague_information
from haselab.identify.physical.misfit import Misfit
from haselab.identify.physical.outlook import Outlook
from haselab.identify.physical.unknowns import Unknowns, fitted_parameters
from haselab.models.actuator.sections import PhysicalRecords
from haselab.pipelines.planning.catalogue import Range
from haselab.pipelines.planning.planned_record import planned_record
from haselab.pipelines.planning.proposal import Planner
from haselab.pipelines.planning.records import summary_of
from haselab.study.definition import checked_study

MASS_KG, GAIN = 0.25, 5000.0
TRUE = PlanarHasel()
OFF = {
    "shell.shear_modulus_pa": 14e3, "electrodes.stiffness_n_per_m": 165.0,
    "viscosity.damping_n_s_per_m": 2.0, "dielectric.permittivity": 2.8,
}  # fmt: skip
BENCH = PhysicalRecords(
    gain_v_per_v=GAIN, carrier_v=100.0, length_std_m=4e-6, capacitance_std_f=3e-13
)
TRIANGLE = {
    "low_v": 0.0, "high_v": 1.6, "frequency_hz": 0.5, "cycles": 4, "skipped_cycles": 0,
    "frame_rate_hz": 100.0,
}  # fmt: skip
DROP = {"trials": 1, "settle_s": 2.0, "record_s": 2.0, "frame_rate_hz": 100.0}


def played(law, tables, seed):
    """What a bench records of a law, with noise."""
    study = checked_study({"name": "played", **tables}, "played")
    record = planned_record(study, BENCH, MASS_KG)
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


POINT = {"baseline_v": 0.8}
SHORT = {"operating_point": POINT, "triangle": TRIANGLE, "free_response": DROP}
LIGHT = {"masses_kg": [0.0, 0.1, 0.2, 0.25, 0.3, 0.4, 0.5], "settle_s": 2.0, "frame_rate_hz": 50.0}
SWEEP = {
    "amplitude_v": 0.2, "start_hz": 0.5, "stop_hz": 8.0, "duration_s": 10.0, "hold_s": 2.0,
    "frame_rate_hz": 100.0,
}  # fmt: skip


@pytest.mark.slow
def test_a_locking_stretch_is_determined_by_the_planned_loads():
    name = "shell.locking_stretch"
    start = with_parameters(TRUE, {**OFF, name: 4.5})
    little, proposal, both = circle(TRUE, start, {**SHORT, "static_load": LIGHT}, name, 0.5)
    assert little.not_identifiable == (name,) and np.isinf(little.parameters[name].std)
    assert proposal.status == "ok" and "static_load" in proposal.candidate.tables
    assert any("heavier than any mass so far" in note for note in proposal.notes)
    agrees(both, proposal, TRUE)
    assert name not in both.not_identifiable


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "value", "first", "tables"),
    [
        ("viscosity.relaxation_s[2]", 20.0, 14.0, SHORT),
        ("mullins.share", 0.06, 0.05, {"operating_point": POINT, "chirp": SWEEP}),
    ],
)
def test_what_is_known_little_is_known_as_well_as_planned(name, value, first, tables):
    """A relaxation ten times as long as the record, and the softening of a small motion."""
    true = with_parameters(TRUE, {name: value})
    little, proposal, both = circle(true, with_parameters(true, {**OFF, name: first}), tables, name)
    assert proposal.status == "ok"
    assert proposal.before == pytest.approx(relative(little, name), rel=1e-6)
    assert proposal.after < 0.5 * proposal.before
    assert both.status == "ok" and name not in both.not_identifiable
    agrees(both, proposal, true)


def agrees(fit, proposal, true):
    """Predicted standard deviation, within the linear range; truth within three of them."""
    name = proposal.parameter
    assert 1.0 / 1.5 < relative(fit, name) / proposal.after < 1.5
    found = fit.parameters[name]
    assert abs(found.value - fitted_parameters(true)[name]) < 3.0 * found.std


def test_the_information_of_an_experiment_is_that_of_its_record():
    """The covariance of a fit at its minimum, from the same experiment played and foreseen."""
    record = played(TRUE, SHORT, 3)
    unknowns = Unknowns.of(TRUE, added_inertia_kg=0.0, mass_kg=MASS_KG)
    prior = np.diag(vague_information(unknowns) ** -1.0)
    slopes = unknowns.slopes
    outlook = Outlook.of(unknowns, prior * np.outer(slopes, slopes))
    np.testing.assert_allclose(outlook.relative_std(), 4.0, rtol=1e-6)
    linear = Misfit([record]).linearised(unknowns)
    assert linear is not None
    joint = covariance_of([linear[1], np.diag(np.sqrt(vague_information(unknowns)))])
    expected = np.sqrt(np.diag(joint)) / (RELATIVE * unknowns.vague_widths)
    found = outlook.relative_std([outlook.information(record)])
    np.testing.assert_allclose(found, expected, rtol=1e-5)


def test_a_planned_drop_lasts_as_long_as_it_is_played():
    record = played(TRUE, SHORT, 3)
    seconds = 0.2 + 4 / 0.5 + 1.0 + 2.0 + 0.1 + 2.0  # lead, triangles, lifting, wait, lead, record
    assert np.ptp(record.drive.edge_s) == pytest.approx(seconds, abs=0.02)
    assert record.experiments == ("triangle", "free-1")
    assert record.drive.load_n.min() == 0.0
    assert record.drive.voltage_v.max() == pytest.approx(GAIN * 1.6, rel=0.02)
    steps = {**SHORT, "steps": {"step": 0.04, "zero_s": 2.0, "step_s": 2.0, "rest_s": 1.0,
             "frame_rate_hz": 20.0, "open_trials": 1, "pi_trials": 0, "pid_trials": 0}}  # fmt: skip
    study = checked_study({"name": "steps", **steps}, "steps")
    with pytest.raises(InputError, match=r"closed loop cannot be foreseen. Leave out \[steps\]"):
        planned_record(study, BENCH, MASS_KG)


def test_a_covariance_that_is_none_is_refused():
    unknowns = Unknowns.of(TRUE, added_inertia_kg=0.0, mass_kg=MASS_KG)
    size = unknowns.values.size
    with pytest.raises(InputError, match=r"not finite and positive"):
        Outlook.of(unknowns, np.full((size, size), np.inf))
    with pytest.raises(InputError, match=r"negative eigenvalue"):
        Outlook.of(unknowns, np.eye(size) + np.full((size, size), -0.5) + 0.5 * np.eye(size))
