"""Prediction of motions that a physical model was not fitted to: band, errors, bad input."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import erf

from haselab.actuators import GRAVITY_M_S2, Drive, PlanarHasel, SampledLaw, with_parameters
from haselab.base import InputError, ResultError
from haselab.base.estimate import Z95
from haselab.identify.physical import (
    ChannelNoise,
    IdentifiedModel,
    MotionRecord,
    fit_actuator,
    predict_motion,
)
from haselab.identify.physical.misfit import CAPACITANCE, LENGTH, Misfit
from haselab.identify.physical.unknowns import CAMERA_OFFSET, CAMERA_SCALE, Unknowns

MASS_KG, BLOCK_S = 0.25, 0.01
LENGTH_STD_M, CAPACITANCE_STD_F = 4e-6, 3e-13
TRUE = PlanarHasel()
NOISE = ChannelNoise(1.0, LENGTH_STD_M)


def seen(law, seed, *, mass_kg=MASS_KG, duration_s=20.0, noise=1.0, longest_m=0.0):
    """What camera and monitors see of a law under held random voltages, with noise."""
    rng = np.random.default_rng(seed)
    edges = np.arange(0.0, duration_s + 0.5 * BLOCK_S, BLOCK_S)
    count = edges.size - 1
    changes = rng.random(count) < 0.02
    volt = rng.uniform(0.0, 9000.0, count)[np.maximum.accumulate(changes * np.arange(count))]
    drive = Drive(
        edges, volt, np.full(count, mass_kg * GRAVITY_M_S2), np.full(count, mass_kg),
        np.full(count, 5e3),
    )  # fmt: skip
    sampled = SampledLaw(law, 11e3)
    start, _ = sampled.at_rest(
        volt[0], drive.ripple_v2[0], mass_kg * GRAVITY_M_S2, longest_m=longest_m
    )
    times = np.arange(0.0, duration_s, 0.02)
    found = sampled.respond(drive, times, start)
    half, rows = times.size // 2, np.arange(count)
    return MotionRecord(
        f"record-{seed}", drive, times,
        found.length_m + noise * LENGTH_STD_M * rng.standard_normal(times.size),
        np.full(times.size, LENGTH_STD_M), rows, rows,
        found.capacitance_f + noise * CAPACITANCE_STD_F * rng.standard_normal(count),
        np.full(count, CAPACITANCE_STD_F), ("first", "second"),
        (np.arange(times.size) >= half).astype(np.int64), (rows >= count // 2).astype(np.int64),
    )  # fmt: skip


def bound(law=TRUE):
    """Names, values and Cramér-Rao bound of the parameters, of one record."""
    unknowns = Unknowns.of(law, added_inertia_kg=0.0, mass_kg=MASS_KG)
    known = {CAMERA_OFFSET: 2e-6, CAMERA_SCALE: 5e-5}
    _, by = Misfit([seen(law, 1, duration_s=40.0)], known=known).linearised(unknowns)
    size = np.linalg.norm(by, axis=0)
    acts = size > 0.0
    scaled = by[:, acts] / size[acts]
    # what one record hardly determines is known to a tenth of what a start may be off
    prior = np.diag((1.0 / (0.1 * unknowns.widths[acts] * size[acts])) ** 2)
    varying = np.linalg.inv(scaled.T @ scaled + prior) / np.outer(size[acts], size[acts])
    return unknowns, acts, varying


UNKNOWNS, ACTS, VARYING = bound()
VALUES = dict(zip(UNKNOWNS.names, UNKNOWNS.values.tolist(), strict=True))
NAMES = [name for name, acts in zip(UNKNOWNS.names, ACTS, strict=True) if acts]
SLOPES = UNKNOWNS.slopes[ACTS]
MATRIX = VARYING * np.outer(SLOPES, SLOPES)


def model(values=VALUES, names=NAMES, matrix=MATRIX, **noise):
    noise = {"length": NOISE} | noise
    return IdentifiedModel.of(TRUE, values, names, matrix, mass_kg=MASS_KG, **noise)


def drawn(seed):
    """Parameters as another record would have given them."""
    rng = np.random.default_rng(seed)
    size = np.sqrt(np.diag(VARYING))
    low = np.linalg.cholesky(VARYING / np.outer(size, size) + 1e-9 * np.eye(size.size))
    step = np.zeros(ACTS.size)
    step[ACTS] = size * (low @ rng.standard_normal(size.size))
    moved = UNKNOWNS.moved(step)
    return dict(zip(moved.names, moved.values.tolist(), strict=True))


def test_the_band_is_the_spread_of_predictions_by_plausible_parameters():
    # one mass more than any record, which makes the parameters count
    record = seen(TRUE, 2, mass_kg=0.3, duration_s=6.0, noise=0.0)
    found = predict_motion(model(), record, free_offset=True).together(LENGTH)
    count = 60
    errors = np.array([
        predict_motion(model(drawn(seed)), record, free_offset=True).together(LENGTH).error
        for seed in range(count)
    ])  # fmt: skip
    ratio = np.sqrt(np.mean(errors**2, axis=0)) / found.parameter_std
    # a standard deviation of N draws is off by 1 / sqrt(2 N), here 9 %; four of these
    assert abs(np.median(ratio) - 1.0) < 4.0 / np.sqrt(2.0 * count)
    # without their correlations, errors that cancel would add up
    alone = model(matrix=np.diag(np.diag(MATRIX)))
    wide = predict_motion(alone, record, free_offset=True).together(LENGTH)
    assert np.median(wide.parameter_std / found.parameter_std) > 3.0


def test_a_record_that_was_not_fitted_is_inside_the_band():
    found = predict_motion(model(), seen(TRUE, 3, mass_kg=0.2), free_offset=True)
    assert found.status == "ok" and not found.outside
    assert [part.experiment for part in found.parts] == ["first", "second"] * 2
    for part, noise in zip(found.all_parts, (LENGTH_STD_M, CAPACITANCE_STD_F), strict=True):
        # the true parameters leave the noise, and the band allows for other parameters, too
        expected = float(np.mean(erf(Z95 * part.std / noise / np.sqrt(2.0))))
        chance = 4.0 * np.sqrt(0.95 * 0.05 / part.error.size)
        assert part.inside_band == pytest.approx(expected, abs=chance)
        chance = 4.0 / np.sqrt(2.0 * part.error.size)
        assert part.rms_error == pytest.approx(noise, rel=chance + 1e-2)
    assert len(found.chart("title").panels) == 4


@pytest.mark.parametrize("seed", range(4))
def test_plausible_parameters_predict_with_status_ok(seed):
    record = seen(TRUE, 30 + seed, mass_kg=0.2, duration_s=6.0)
    assert predict_motion(model(drawn(seed)), record).status == "ok"


@pytest.mark.parametrize("name", ["electrodes.stiffness_n_per_m", "viscosity.damping_n_s_per_m"])
def test_a_model_error_outside_the_band_is_named(name):
    wrong = VALUES | {name: 1.05 * VALUES[name]}
    found = predict_motion(model(wrong), seen(TRUE, 3), free_offset=True)
    assert found.status.startswith("model error: only ")
    assert {part.experiment for part in found.outside} == {"first", "second"}


def test_an_error_as_large_as_in_an_experiment_of_the_fit_widens_the_band():
    other = with_parameters(TRUE, {"viscosity.damping_n_s_per_m": 2.0})
    record = seen(other, 3)
    error = predict_motion(model(), record, free_offset=True).together(LENGTH).rms_error
    noise = ChannelNoise(1.0, LENGTH_STD_M, error, explained=False)
    wide = predict_motion(model(length=noise), record, free_offset=True).together(LENGTH)
    assert wide.inside_band > 0.85 and not wide.is_outside
    assert noise.model_error == pytest.approx(np.sqrt(error**2 - LENGTH_STD_M**2))


def test_only_the_chosen_experiment_is_compared():
    record = seen(TRUE, 3, duration_s=4.0)
    found = predict_motion(model(), record, experiments=["second"])
    assert [(part.experiment, part.channel) for part in found.parts] == [
        ("second", LENGTH), ("second", CAPACITANCE)]  # fmt: skip
    whole = predict_motion(model(), record)
    np.testing.assert_array_equal(found.parts[0].predicted, whole.parts[1].predicted)


def test_a_moved_camera_is_allowed_for_on_demand():
    record = seen(TRUE, 3, duration_s=4.0)
    moved = replace(record, length_m=record.length_m + 1e-4)
    assert predict_motion(model(), moved).status.startswith("model error")
    found = predict_motion(model(), moved, free_offset=True)
    assert found.status == "ok"
    error = LENGTH_STD_M / np.sqrt(record.length_m.size) + found.parts[0].parameter_std.max()
    assert found.offset_m == pytest.approx(1e-4, abs=4.0 * error)


def test_an_actuator_that_was_stretched_before_is_softer():
    longest_m = 1.55 * TRUE.free_length_m
    record = seen(TRUE, 3, duration_s=4.0, longest_m=longest_m)
    assert predict_motion(model(), record).status.startswith("model error")
    assert predict_motion(model(), record, longest_m=longest_m).status == "ok"


def test_a_parameter_that_the_fit_did_not_determine_is_named():
    name = "viscosity.share[2]"
    kept = [k for k, other in enumerate(NAMES) if other != name]
    found = predict_motion(
        model(names=[NAMES[k] for k in kept], matrix=MATRIX[np.ix_(kept, kept)]),
        seen(TRUE, 3, duration_s=4.0),
    )
    assert found.status.startswith(f"the prediction depends on {name}, which the fit did not")


def test_a_voltage_in_the_wrong_unit_is_named():
    record = seen(TRUE, 3, duration_s=4.0)
    small = replace(record, drive=replace(record.drive, voltage_v=1e-3 * record.drive.voltage_v))
    found = predict_motion(model(), small)
    assert found.status.startswith("the predicted length is worse than the mean of the record")
    large = replace(record, drive=replace(record.drive, voltage_v=3.0 * record.drive.voltage_v))
    with pytest.raises(ResultError, match=r"^The model predicts no motion under this drive: .*"):
        predict_motion(model(), large)


def test_an_unknown_experiment_is_refused():
    with pytest.raises(InputError, match=r"no experiment third .* It has first, second\."):
        predict_motion(model(), seen(TRUE, 3, duration_s=4.0), experiments=["third"])


def test_a_covariance_that_is_none_is_refused():
    with pytest.raises(InputError, match=r"covariance names dielectric\.x, which the parameters"):
        model(names=[*NAMES[:-1], "dielectric.x"])
    skew = MATRIX.copy()
    skew[0, 1] *= 1.1
    with pytest.raises(InputError, match=r"is not finite and symmetric"):
        model(matrix=skew)


@pytest.mark.slow
def test_a_fit_predicts_another_record():
    fit = fit_actuator(TRUE, [seen(TRUE, 5), seen(TRUE, 6, mass_kg=0.35)], mass_kg=MASS_KG)
    found = predict_motion(IdentifiedModel.of_fit(fit), seen(TRUE, 7, mass_kg=0.2))
    assert found.status == "ok"
    for part in found.all_parts:
        assert 0.92 < part.inside_band < 0.99


def test_an_uncertain_zero_does_not_hide_a_wrong_shape():
    """The zero of a caliper, 50 um, is an error of all lengths together, not of each."""
    matrix, at = MATRIX.copy(), NAMES.index(CAMERA_OFFSET)
    matrix[at], matrix[:, at], matrix[at, at] = 0.0, 0.0, 5e-5**2
    uncertain = model(matrix=matrix)
    record = seen(TRUE, 11)
    rest_m = record.length_m[0]
    stretched = replace(record, length_m=rest_m + 1.005 * (record.length_m - rest_m))
    moved = replace(record, length_m=record.length_m + 5e-5)
    right, wrong, shifted = (predict_motion(uncertain, one) for one in (record, stretched, moved))
    assert right.status == "ok" and shifted.status == "ok"
    assert right.together(LENGTH).std.min() > 5e-5
    assert not any(part.is_outside for part in wrong.all_parts)
    assert wrong.status.startswith("model error: without a common offset, only ")
    # a moved camera is another constant
    assert predict_motion(uncertain, moved, free_offset=True).status == "ok"
