"""Results of a study by the physical model of its actuator, with the study's own fits.

The fits get the lengths and capacitances of the model's motion instead of the recorded ones. Their
misfit, such as the creep that a second-order model does not have, is then part of the result and no
longer counts as noise: the uncertainty is that of the model's parameters.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from haselab.base import Estimate, ResultError
from haselab.identify.physical import ActuatorFit, MotionRecord
from haselab.identify.physical.misfit import Modelled, modelled
from haselab.rig import RigDescription
from haselab.study.analysis import Analysis
from haselab.study.definition import Study
from haselab.study.experiment import NotPlayedError
from haselab.study.experiments.foreign import rows_of_experiment
from haselab.study.fits.observe import Observation, Source
from haselab.study.pipeline import Findings

__all__ = ["results_of_model"]

Floats = NDArray[np.float64]
_ROWS = ("S14.", "S15.", "S16.", "S17.", "S18.", "S19.", "S20.", "S21.")
_IN_STEPS = ("S15.slope_at_strain", "S15.offset_at_strain")  # a sample more changes the cells
_DRAWS = 8
_SEED = 20181001
_RIDGE = 1e-12  # of a correlation matrix: rounding may make it slightly indefinite


def results_of_model(
    fit: ActuatorFit,
    record: MotionRecord,
    source: Source,
    study: Study,
    rig: RigDescription,
    direct: Findings,
    known: Mapping[type, object] | None = None,
) -> dict[str, Estimate]:
    """Make the fits of rows S14 to S21 on the motion of an identified model.

    Args:
        fit: of the model.
        record: of the study's session, which the model was fitted to.
        source: the recorded observations by name.
        study: that was played.
        rig: nominal values of the bench.
        direct: findings of the same fits on the recorded values; their baseline and controllers,
            which were played, are kept.
        known: values of an actuator file, see `investigate`.
    Returns:
        Results by id, without those that do not vary with the parameters. Their uncertainty is
        that of the model's parameters, from random draws with Student's interval.
    Raises:
        ResultError: The model has no result, or a fit fails on its motion.
    """
    if not fit.succeeded:
        raise ResultError(fit.status)
    unknowns = fit.unknowns()
    centre = modelled(unknowns, record)
    seen: dict[str, Observation] = {}

    def recorded(name: str) -> Observation:
        if name not in seen:
            seen[name] = source(name)
        return seen[name]

    def rows(change: Floats) -> dict[str, Estimate]:
        moved = replace(
            centre,
            length_m=centre.length_m + centre.length_by @ change,
            capacitance_f=centre.capacitance_f + centre.capacitance_by @ change,
        )
        motion = _Motion(recorded, record, moved)
        return _fitted(Analysis(study, rig, motion, repeated=direct.values, known=known))

    middle = rows(np.zeros(unknowns.values.size))
    draws = [rows(change) for change in _draws(fit.covariance, unknowns.slopes)]
    found = {}
    for key, estimate in middle.items():
        moved = np.array([draw[key].value - estimate.value for draw in draws if key in draw])
        if key not in _IN_STEPS and len(moved) == _DRAWS and moved.any():
            std = math.sqrt(float(np.mean(moved**2)))
            reach = std * float(stdtrit(_DRAWS, 0.975))
            ci95 = (estimate.value - reach, estimate.value + reach)
            found[key] = Estimate(estimate.value, std, ci95, estimate.unit)
    return found


def _fitted(analysis: Analysis) -> dict[str, Estimate]:
    found: dict[str, Estimate] = {}
    for experiment in analysis.experiments:
        if any(key.startswith(_ROWS) for key in rows_of_experiment(experiment)):
            with contextlib.suppress(NotPlayedError):
                found |= analysis.outcome(experiment).quantities
    return {key: estimate for key, estimate in found.items() if key.startswith(_ROWS)}


def _draws(covariance: Floats, slopes: Floats) -> Floats:
    """Random changes of what varies, with its covariance. Shape `(K, P)`.

    A triangular factor varies smoothly with the covariance, so equal runs on different processors
    give equal results; eigenvectors may change their signs.
    """
    known = np.isfinite(np.diag(covariance))
    std = np.sqrt(np.diag(covariance)[known])
    correlation = covariance[np.ix_(known, known)] / np.outer(std, std)
    factor = np.linalg.cholesky(correlation + _RIDGE * np.eye(std.size))
    normal = np.random.default_rng(_SEED).standard_normal((_DRAWS, std.size))
    changes = np.zeros((_DRAWS, slopes.size))
    changes[:, known] = std * (normal @ factor.T) / slopes[known]
    return changes


@dataclass(frozen=True)
class _Motion:
    """Observations with the model's lengths and capacitances.

    Args:
        source: of the recorded observations.
        record: that was fitted.
        modelled: at the times of the record.
    """

    source: Source
    record: MotionRecord
    modelled: Modelled

    def __call__(self, name: str) -> Observation:
        seen, record = self.source(name), self.record
        if name not in record.experiments:
            return seen
        index = record.experiments.index(name)
        frames = record.length_experiment == index
        known, at = _matched(seen.frame_time_s, record.length_time_s[frames])
        seen = replace(
            seen,
            frame_time_s=seen.frame_time_s[known],
            length_m=self.modelled.length_m[frames][at],
            spread_m=seen.spread_m[known],
            mass_kg=seen.mass_kg[known],
        )
        blocks = record.capacitance_experiment == index
        if not blocks.any():
            return seen
        used = record.block[blocks]
        # blocks that the record leaves out, such as disturbed ones, lie between those
        sensed_f = np.interp(
            seen.sensed_s, seen.sensed_s[used], self.modelled.capacitance_f[blocks]
        )
        sensed_f[np.isnan(seen.capacitance_f)] = np.nan
        relative = seen.relative_capacitance * (sensed_f / seen.capacitance_f)
        return replace(seen, capacitance_f=sensed_f, relative_capacitance=relative)


def _matched(time_s: Floats, known_s: Floats) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Whether each time is a known one, and the indices of those that are."""
    if not known_s.size:
        return np.zeros(time_s.size, dtype=np.bool_), np.zeros(0, dtype=np.int64)
    at = np.minimum(np.searchsorted(known_s, time_s), known_s.size - 1)
    known = known_s[at] == time_s
    return known, at[known]
