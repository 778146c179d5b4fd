"""One physical model from all records: recovery, model errors, contradictions."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.actuators import (
    ADDED_INERTIA,
    DRIFTS,
    GRAVITY_M_S2,
    DeaStack,
    Drive,
    PlanarHasel,
    SampledLaw,
    with_parameters,
)
from haselab.base import InputError
from haselab.identify.physical import MotionRecord, fit_actuator
from haselab.identify.physical.misfit import SHARED_PX, TRACKED_ZERO_M, Misfit, SharedErrors
from haselab.identify.physical.model_error import excess_energy, hidden_std, widen_std
from haselab.identify.physical.plausible import find_implausible
from haselab.identify.physical.residuals import ChannelResiduals, notes_of
from haselab.identify.physical.result import result_of
from haselab.identify.physical.search import SearchResult
from haselab.identify.physical.unknowns import Unknowns, fitted_parameters

MASS_KG = 0.25
LENGTH_STD_M, CAPACITANCE_STD_F = 4e-6, 3e-13
BLOCK_S = 0.01


def drive(duration_s: float, seed: int) -> Drive:
    """Held random voltages, most of them long, and a lift of the mass in the middle."""
    rng = np.random.default_rng(seed)
    edges = np.arange(0.0, duration_s + 0.5 * BLOCK_S, BLOCK_S)
    count = edges.size - 1
    changes = rng.random(count) < np.where(np.arange(count) % 1000 < 300, 0.2, 0.003)
    volt = rng.uniform(0.0, 9500.0, count)[np.maximum.accumulate(changes * np.arange(count))]
    volt[:100] = 0.0
    pull = np.full(count, MASS_KG * GRAVITY_M_S2)
    for k in range(1, 9):  # loads tell the shell from the electrodes
        pull[count * k // 10 : count * k // 10 + 300] *= 0.4 * k
    volt[pull > 1.2 * pull[0]] = 0.0
    return Drive(edges, volt, pull, np.full(count, MASS_KG), np.full(count, 5e3))


def record(law, seed=1, *, duration_s=60.0, scale=1.0, mass_scale=1.0, drifts=None):
    """What camera and monitors see of a law, with noise."""
    rng = np.random.default_rng(100 + seed)
    acts = drive(duration_s, seed)
    sampled = SampledLaw(law, 11e3, drifts=drifts or {})
    start, _ = sampled.at_rest(acts.voltage_v[0], acts.ripple_v2[0], acts.load_n[0])
    times = np.arange(0.0, duration_s, 0.02)
    seen = sampled.respond(acts, times, start)
    count = acts.voltage_v.size
    stated = replace(acts, load_n=mass_scale * acts.load_n, mass_kg=mass_scale * acts.mass_kg)
    return MotionRecord(
        f"record-{seed}", stated, times,
        seen.length_m + LENGTH_STD_M * rng.standard_normal(times.size),
        np.full(times.size, LENGTH_STD_M), np.arange(count), np.arange(count),
        scale * seen.capacitance_f + CAPACITANCE_STD_F * rng.standard_normal(count),
        np.full(count, CAPACITANCE_STD_F), ("all",), np.zeros(times.size, int),
        np.zeros(count, int),
    )  # fmt: skip


TRUE = PlanarHasel()
START = with_parameters(
    TRUE,
    {
        "shell.shear_modulus_pa": 12.5e3,
        "electrodes.stiffness_n_per_m": 180.0,
        "viscosity.share[0]": 0.03,
        "viscosity.share[2]": 0.4,
        "viscosity.relaxation_s[1]": 1.4,
        "viscosity.relaxation_s[2]": 4.0,
        "viscosity.damping_n_s_per_m": 2.3,
        "dielectric.permittivity": 2.5,
    },
)


@pytest.mark.long
def test_parameters_are_found_within_their_intervals():
    fit = fit_actuator(START, [record(TRUE, 1), record(TRUE, 2)], mass_kg=MASS_KG)
    assert fit.status == "ok"
    ones = {"camera.scale": 1.0, "sensing.scale": 1.0}
    truth = {**fitted_parameters(TRUE), ADDED_INERTIA: 0.0, **ones}
    far = []
    for name, found in fit.parameters.items():
        true, (low, high) = truth.get(name, 0.0), found.ci95
        half = high - found.value if true > found.value else found.value - low
        far.append((true - found.value) / half)
    # 23 correlated numbers: one in 20 is outside by chance, by twice as far one in 10,000
    assert np.mean(np.abs(far) < 1.0) > 0.8 and np.abs(far).max() < 2.0, dict(
        zip(fit.parameters, far, strict=True)
    )
    count = sum(part.size for part in fit.residuals)
    assert fit.chi_squared_ratio == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / count))
    assert fit.length_rms_m == pytest.approx(LENGTH_STD_M, rel=0.05)
    assert fit.capacitance_rms_f == pytest.approx(CAPACITANCE_STD_F, rel=0.05)
    point = fit.linear_models[0]
    assert point.voltage_v == 0.0 and point.gain_m_per_v == pytest.approx(0.0, abs=1e-12)
    assert len(fit.chart().panels[0].curves) == 2


def deviations(fit, law):
    ones = {"camera.scale": 1.0, "sensing.scale": 1.0}
    truth = {**fitted_parameters(law), ADDED_INERTIA: 0.0, **ones}
    return {n: (e.value - truth.get(n, 0.0)) / e.std for n, e in fit.parameters.items()}


def with_a_branch_more():
    shares, times = TRUE.losses.branch_share, TRUE.losses.branch_relaxation_s
    return replace(TRUE, branch_share=(*shares, 0.05), branch_relaxation_s=(*times, 12.0))


def test_creep_does_not_look_like_swapped_masses():
    # under 2.94 N, soon after a high voltage, the actuator is shorter than later under 2.45 N
    assert find_implausible(START, [record(with_a_branch_more(), 3)]) == ""


@pytest.mark.slow
def test_a_branch_that_the_law_lacks_is_found():
    more = with_a_branch_more()
    fit = fit_actuator(START, [record(more, 3)], mass_kg=MASS_KG)
    assert fit.status == "ok"
    assert fit.rejected_laws[0].law.startswith("without a branch of about ")
    far = deviations(fit, more)
    assert "viscosity.share[3]" in far and max(map(abs, far.values())) < 4.0, far


@pytest.mark.slow
def test_softening_that_the_law_lacks_is_found():
    fit = fit_actuator(replace(START, softening_share=0.0), [record(TRUE, 3)], mass_kg=MASS_KG)
    assert fit.status == "ok"
    assert fit.rejected_laws[0].law == "without softening"
    assert fit.rejected_laws[0].log_evidence < -5.0
    laws = [rival.law for rival in fit.rejected_laws]
    assert len(set(laws)) == len(laws)
    far = deviations(fit, TRUE)
    assert "mullins.share" in far and max(map(abs, far.values())) < 4.0, far
    assert fit.answer()["rejected_laws"][0]["law"] == "without softening"


def refused(records):
    fit = fit_actuator(START, records, mass_kg=records[-1].drive.mass_kg[0])
    assert not fit.succeeded and not fit.parameters
    return fit.status


@pytest.mark.slow
def test_records_of_two_actuators_give_no_numbers():
    other = replace(TRUE, electrode_stiffness_n_per_m=220.0)
    records = [record(TRUE, 4, duration_s=15.0), record(other, 5, duration_s=15.0)]
    found = refused(records)
    assert found.startswith("the records contradict ") and "of one actuator" in found


@pytest.mark.long
def test_a_record_of_another_kind_is_refused_after_one_search(monkeypatch):
    """Further searches, with more effects and another noise, would take ten times as long."""
    calls = []
    for name in ("search_with_all_effects", "refine", "find_extended_law"):
        monkeypatch.setattr(f"haselab.identify.physical.fit.{name}", lambda *_: calls.append(1))
    seen = record(TRUE, 4, duration_s=15.0)
    fit = fit_actuator(DeaStack(), [seen], mass_kg=MASS_KG)
    assert fit.status.startswith("the records contradict the model: ") and not fit.parameters
    assert not calls


@pytest.mark.long
def test_a_wrong_mass_gives_no_numbers():
    found = refused([record(TRUE, 4, duration_s=15.0, mass_scale=2.0)])
    assert found.startswith("the records contradict each other: the capacitances ")
    assert "Check the mass" in found


@pytest.mark.long
def test_capacitances_that_contradict_the_forces_by_little_have_a_note():
    fit = fit_actuator(TRUE, [record(TRUE, 4, duration_s=15.0, scale=1.1)], mass_kg=MASS_KG)
    assert fit.succeeded
    (note,) = fit.notes
    assert note.startswith("The capacitances are 1.1")
    assert fit.answer()["notes"] == [note]


@pytest.mark.long
def test_intervals_allow_for_an_error_of_the_cameras_scale_that_capacitances_show():
    seen = record(TRUE, 4, duration_s=15.0)
    fit = fit_actuator(TRUE, [replace(seen, length_m=1.01 * seen.length_m)], mass_kg=MASS_KG)
    (note,) = fit.notes
    assert "a mass or the camera's scale is wrong" in note
    truth = fitted_parameters(TRUE) | {ADDED_INERTIA: 0.0}
    outside = {
        name: found
        for name, found in fit.parameters.items()
        if name in truth and not found.ci95[0] <= truth[name] <= found.ci95[1]
    }
    assert outside == {}
    assert fit.parameters["shell.length_m"].value > 1.009 * truth["shell.length_m"]


@pytest.mark.long
def test_lengths_alone_have_a_note_on_what_they_do_not_show():
    seen, none, no = record(TRUE, 4, duration_s=15.0), np.zeros(0), np.zeros(0, int)
    alone = replace(
        seen, window=no, window_of=no, capacitance_f=none, capacitance_std_f=none,
        capacitance_experiment=no,
    )  # fmt: skip
    (note,) = fit_actuator(TRUE, [alone], mass_kg=MASS_KG).notes
    assert note.startswith("Without capacitances, the fit cannot detect a wrong gain")


def test_a_monitor_that_contradicts_the_stated_voltage_is_named():
    seen = replace(record(TRUE, 4, duration_s=5.0), voltage_ratio=0.98)
    parts = np.random.default_rng(1).standard_normal((2, 500))
    white = ChannelResiduals([parts[0]], [parts[1]], 1.0)
    (note,) = notes_of(0.0, white, [seen])
    assert note.startswith("record-4: the voltage by the monitor is 0.98 times drive times gain")
    assert notes_of(0.0, white, [replace(seen, voltage_ratio=0.995)]) == ()
    assert notes_of(0.0, white, [replace(seen, voltage_ratio=math.nan)]) == ()
    fault = find_implausible(TRUE, [replace(seen, voltage_ratio=0.9)])
    assert fault.startswith("record-4: the voltage by the monitor is 0.9 times drive times gain")


@pytest.mark.parametrize(("size", "contradicts"), [(1e-3, False), (10.0, True)])
def test_a_scale_that_is_hardly_known_is_no_contradiction(size, contradicts):
    misfit = Misfit([record(TRUE, 1, duration_s=5.0)])
    unknowns = Unknowns.of(TRUE, added_inertia_kg=0.0, mass_kg=MASS_KG)
    at = unknowns.names.index("sensing.scale")
    values = unknowns.values.copy()
    values[at] = 1.36
    rng, rows = np.random.default_rng(1), sum(part.rows.size for part in misfit.segments)
    jacobian = rng.standard_normal((rows, values.size))
    jacobian[:, at] *= size  # its standard deviation is about 1 / (size sqrt(rows))
    found = SearchResult(
        replace(unknowns, values=values), rng.standard_normal(rows), jacobian, 0.0 * values, True, 1
    )
    fit = result_of(misfit, found, [], [])
    assert ("the capacitances are 1.36 times" in fit.status) == contradicts
    assert ("sensing.scale" in fit.not_identifiable) == (not contradicts)


@pytest.mark.long
def test_a_camera_that_was_moved_between_two_sessions_is_named():
    first, second = record(TRUE, 4, duration_s=15.0), record(TRUE, 5, duration_s=15.0)
    second = replace(second, length_m=second.length_m + 5e-5)
    unknowns = Unknowns.of(TRUE, added_inertia_kg=0.0, mass_kg=MASS_KG)
    zeros = Misfit([first, second], known={"camera.offset_m": TRACKED_ZERO_M}).zeros(unknowns)
    # each has the standard deviation 1
    assert abs(zeros[0]) < 4.0 and zeros[1] == pytest.approx(5e-5 / TRACKED_ZERO_M, abs=4.0)
    found = refused([first, second])
    assert "record-5 are shifted by about 5" in found or "record-4 are shifted by about -5" in found
    assert "--zero-std-m" in found


def test_a_collapse_whose_derivatives_grow_without_limit_is_no_motion():
    seen = record(TRUE, 1, duration_s=30.0)
    # 12: the squares of the derivatives overflow, 30: they themselves
    for permittivity in (12.0, 30.0):
        collapses = {
            "dielectric.permittivity": permittivity,
            "dielectric.capacitance_exponent": 4.0,
        }
        law = with_parameters(TRUE, collapses)
        unknowns = Unknowns.of(law, added_inertia_kg=0.0, mass_kg=MASS_KG)
        assert Misfit([seen]).linearised(unknowns) is None


@given(st.lists(st.floats(-0.3, 0.3), min_size=23, max_size=23))
def test_what_varies_is_the_distance(steps):
    start = Unknowns.of(TRUE, added_inertia_kg=0.01, mass_kg=MASS_KG)
    step = 0.5 * np.array(steps) * start.widths
    moved = start.moved(step)
    np.testing.assert_allclose(moved.distance(start), step, rtol=1e-9, atol=1e-12)
    little = 1e-6 * start.widths
    by = (start.moved(little).values - start.moved(-little).values) / (2.0 * little)
    np.testing.assert_allclose(by, start.slopes, rtol=1e-6)


def test_no_record_is_refused():
    with pytest.raises(InputError, match=r"There is no record of the actuator's motion"):
        fit_actuator(TRUE, [], mass_kg=MASS_KG)


def test_the_zero_of_the_camera_may_move_between_records():
    """The misfit of an offset is its own square, not once more that of each length."""
    records = [record(TRUE, seed, duration_s=2.0) for seed in (1, 2)]
    moved = replace(records[1], length_m=records[1].length_m + 2.0 * TRACKED_ZERO_M)
    start = Unknowns.of(TRUE, added_inertia_kg=0.0, mass_kg=MASS_KG)

    def squares(*seen):
        return float(np.sum(Misfit(seen).residuals(start) ** 2))

    # mean of 100 lengths with 4 um of noise: 0.4 um, which moves the 2 deviations by 0.2
    change = squares(records[0], moved) - squares(*records)
    assert 0.5 < change < 10.0
    # all lengths of a lone record share the offset that is estimated
    assert squares(moved) - squares(records[1]) > 50.0


@given(st.lists(st.floats(0.03, 0.05), min_size=3, max_size=20), st.floats(1e-7, 1e-5))
def test_shared_errors_of_tracking_are_whitened(lengths, std_m):
    count = len(lengths)
    stds = np.linspace(std_m, 2.0 * std_m, count)
    seen = replace(
        record(TRUE, duration_s=0.05), length_time_s=np.arange(count) * 1e-3,
        length_m=np.array(lengths), length_std_m=stds, length_experiment=np.zeros(count, int),
        pixel_m=3e-3,
    )  # fmt: skip
    white = SharedErrors.of(seen, stds).whitened(np.eye(count))
    pixel = np.floor(seen.length_m / seen.pixel_m)
    shared = (SHARED_PX * seen.pixel_m) ** 2 * (pixel[:, None] == pixel)
    covariance = np.diag(stds**2) + shared
    both = white @ (covariance / np.outer(stds, stds)) @ white.T
    np.testing.assert_allclose(both, np.eye(count), atol=1e-6)
    zero = SharedErrors.of_zero(SharedErrors.of(seen, stds), stds, TRACKED_ZERO_M)
    white, covariance = zero.whitened(white), covariance + TRACKED_ZERO_M**2
    both = white @ (covariance / np.outer(stds, stds)) @ white.T
    np.testing.assert_allclose(both, np.eye(count), atol=1e-6)


@pytest.mark.slow
def test_hysteresis_that_the_law_lacks_is_found():
    more = replace(TRUE, hysteresis_n=0.05, hysteresis_width=0.02)
    fit = fit_actuator(START, [record(more, 3)], mass_kg=MASS_KG)
    assert fit.status == "ok"
    assert "without hysteresis" in [rival.law for rival in fit.rejected_laws]
    far = deviations(fit, more)
    assert "hysteresis.force_n" in far and max(map(abs, far.values())) < 4.0, far


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "law", "drifts"),
    [
        ("drift of the stiffness", TRUE, {DRIFTS[0]: -1e-4, DRIFTS[1]: 200.0}),
        ("drift of the permittivity", TRUE, {DRIFTS[2]: 2e-5, DRIFTS[3]: 200.0}),
        ("charge creep", replace(TRUE, charge_share=0.08, charge_relaxation_s=5.7), {}),
    ],
)
def test_an_effect_without_which_the_search_may_fail_is_found(words, law, drifts):
    fit = fit_actuator(START, [record(law, 3, drifts=drifts)], mass_kg=MASS_KG)
    assert fit.status == "ok"
    assert f"without {words}" in [rival.law for rival in fit.rejected_laws]
    truth = {name: value for name, value in drifts.items() if name in (DRIFTS[0], DRIFTS[2])}
    far = deviations(fit, law)
    far |= {n: (fit.parameters[n].value - v) / fit.parameters[n].std for n, v in truth.items()}
    judged = {n: z for n, z in far.items() if n not in set(DRIFTS) - set(truth)}
    assert max(map(abs, judged.values())) < 4.0, judged


def test_a_model_error_that_is_hidden_by_as_much_as_it_shows_is_one_deviation():
    """A line fitted to a line and a parabola that has equal parts along and across the line."""
    x = np.linspace(0.0, 1.0, 400)
    jacobian = np.column_stack([x, np.zeros(400)])
    across = x**2 - x * (x**2 @ x) / (x @ x)
    error = x / np.linalg.norm(x) + across / np.linalg.norm(across)
    moved = float(error @ x / (x @ x))
    residuals = error - moved * x
    std = hidden_std(jacobian, excess_energy([([residuals[:100], residuals[100:]], 0.0)]))
    assert std[0] == pytest.approx(abs(moved), rel=1e-9)
    assert std[1] == np.inf
    noisy = excess_energy([([np.full(50, 2.0)], 1.0), ([np.full(10, 1.0)], 2.0)])
    assert noisy == pytest.approx(50.0 * 3.0 - 10.0 * 3.0)


def test_a_hidden_error_of_any_direction_has_the_energy_of_the_visible_one():
    """Errors in the space of the parameters, of random directions and one energy."""
    rng = np.random.default_rng(1)
    jacobian = rng.standard_normal((300, 5)) * np.array([1.0, 10.0, 0.1, 3.0, 1.0])
    basis = np.linalg.qr(jacobian)[0]
    draws, energy = 4000, 7.0
    ways = rng.standard_normal((draws, 5))
    ways *= np.sqrt(energy) / np.linalg.norm(ways, axis=1, keepdims=True)
    moved = np.linalg.lstsq(jacobian, (ways @ basis.T).T, rcond=None)[0]
    stated = energy / 5.0 * np.diag(np.linalg.inv(jacobian.T @ jacobian))
    # the square of a direction's part has the relative spread sqrt(2 * 4 / 7)
    chance = 4.0 * np.sqrt(8.0 / 7.0 / draws)
    np.testing.assert_allclose(np.mean(moved**2, axis=1), stated, rtol=chance)


def test_covariances_only_grow():
    covariance = np.array([[4.0, 1.0], [1.0, 1.0]])
    grown = widen_std(covariance, np.array([1.0, 3.0]))
    np.testing.assert_allclose(grown, [[4.0, 3.0], [3.0, 9.0]])


@pytest.mark.long
def test_softening_that_is_over_before_the_record_is_not_identifiable():
    """The hung mass alone stretches the actuator beyond the transition of the Mullins effect."""
    softened = replace(TRUE, softening_stretch=1.30, softening_transition=0.02)
    fit = fit_actuator(softened, [record(softened, 5, duration_s=15.0)], mass_kg=MASS_KG)
    assert fit.succeeded
    assert {"mullins.share", "mullins.stretch", "mullins.width"} <= set(fit.not_identifiable)
    assert fit.parameters["mullins.share"].std == math.inf
