"""Results of a study by the physical model of its actuator, with the study's own fits.

The fits get the lengths and capacitances of the model's motion instead of the recorded ones. Their
misfit, such as the creep that a second-order model does not have, is then part of the result and no
longer counts as noise: the uncertainty is that of the model's parameters.
"""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, Estimate, ResultError
from haselab.identify.physical import ActuatorFit, MotionRecord
from haselab.identify.physical.misfit import ModelledRecord, model_record
from haselab.rig import RigDescription
from haselab.runtime.helper_process import HelperProcess
from haselab.study.analysis import Analysis, Given
from haselab.study.definition import Study
from haselab.study.experiment import NotPlayedError
from haselab.study.experiments.foreign import rows_of_experiment
from haselab.study.fits.observe import Observation, Source
from haselab.study.pipeline import Findings

__all__ = ["results_of_model"]

Floats = NDArray[np.float64]
_ROWS = ("S14.", "S15.", "S16.", "S17.", "S18.", "S19.", "S20.", "S21.")
_SHORT_RUN = 3  # lost blocks that the model's capacitances fill
_PATIENCE_S = 600.0  # of all fits in the second process
# One sample more changes the cells of the map at strain; errors of the map limit the feedthrough.
_DIRECT = ("S15.slope_at_strain", "S15.offset_at_strain", "S20.feedthrough")


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
        that of the model's parameters: the fits are repeated with the motion changed by one
        standard deviation along each principal axis of the parameters' covariance.
    Raises:
        ResultError: The model has no result, or a fit fails on its motion.
    """
    if not fit.succeeded:
        raise ResultError(fit.status)
    unknowns = fit.unknowns()
    with _second_process() as helper:  # it loads its modules during the first fit
        centre = model_record(unknowns, record)
        seen: dict[str, Observation] = {}

        def recorded(name: str) -> Observation:
            if name not in seen:
                seen[name] = source(name)
            return seen[name]

        problem = _Problem(centre, record, study, rig, direct.values, known)
        middle, near = problem.fitted(recorded, np.zeros(unknowns.values.size))
        problem = replace(problem, near=near)
        changes = _axes(fit.covariance, unknowns.slopes)
        # that of no change, which is found in the same way, shares what the searches leave
        changes = np.vstack([0.0 * changes[:1], changes])
        still, *axes = _along(problem, recorded, seen, changes, helper)
    found = {}
    for key, estimate in middle.items():
        ends = [along[key].value for along in axes if key in along and key in still]
        moved = np.array([end - still[key].value for end in ends])
        if key not in _DIRECT and len(moved) == len(axes) and moved.any():
            std = float(np.linalg.norm(moved))
            found[key] = Estimate.normal(estimate.value, std, estimate.unit)
    return found


@contextlib.contextmanager
def _second_process() -> Iterator[HelperProcess | None]:
    """A process for half of the fits; None if it cannot be started."""
    try:
        helper = HelperProcess([__name__], _PATIENCE_S)
    except DeviceError:
        yield None
        return
    try:
        yield helper
    finally:
        helper.close()


@dataclass(frozen=True)
class _Problem:
    """The fits on a model's motion, see `results_of_model`.

    Args:
        near: values that the fits found on almost the same motion, where they start; empty: none.
    """

    centre: ModelledRecord
    record: MotionRecord
    study: Study
    rig: RigDescription
    values: Mapping[type, object]
    known: Mapping[type, object] | None
    near: Mapping[type, object] = field(default_factory=dict)

    def fitted(
        self, source: Source, change: Floats
    ) -> tuple[dict[str, Estimate], dict[type, object]]:
        """Results and values after a change of what varies."""
        centre = self.centre
        moved = replace(
            centre,
            length_m=centre.length_m + centre.length_by @ change,
            capacitance_f=centre.capacitance_f + centre.capacitance_by @ change,
        )
        motion = _Motion(source, self.record, moved)
        given = Given(self.values, self.known or {}, self.near)
        return _fitted(Analysis(self.study, self.rig, motion, given=given))


def _rows_of_changes(
    problem: _Problem, source: Source, changes: Floats
) -> list[dict[str, Estimate]]:
    """Results after each of some changes; a function of the module, for a helper process."""
    return [problem.fitted(source, change)[0] for change in changes]


def _along(
    problem: _Problem,
    source: Source,
    seen: Mapping[str, Observation],
    changes: Floats,
    helper: HelperProcess | None,
) -> list[dict[str, Estimate]]:
    """Results after each change; a second process makes half of these fits.

    It makes none where a value of another package cannot be sent to it, or if it ends early.
    """
    try:
        pickle.dumps((problem.values, problem.known, problem.near, problem.study))
    except (pickle.PicklingError, TypeError, AttributeError):
        helper = None
    if helper is None:
        return _rows_of_changes(problem, source, changes)
    half = len(changes) // 2
    with contextlib.ExitStack() as opened:
        pool = opened.enter_context(ThreadPoolExecutor(1))
        opened.callback(helper.close)  # first, also if this process is interrupted meanwhile
        sent = pool.submit(helper.call, _rows_of_changes, problem, seen.__getitem__, changes[half:])
        found = _rows_of_changes(problem, source, changes[:half])
        try:
            return found + sent.result()
        except (DeviceError, KeyError):
            return found + _rows_of_changes(problem, source, changes[half:])


def _fitted(analysis: Analysis) -> tuple[dict[str, Estimate], dict[type, object]]:
    found: dict[str, Estimate] = {}
    values: dict[type, object] = {}
    for experiment in analysis.experiments:
        if any(key.startswith(_ROWS) for key in rows_of_experiment(experiment)):
            with contextlib.suppress(NotPlayedError):
                outcome = analysis.outcome(experiment)
                found |= outcome.quantities
                values |= {type(value): value for value in outcome.values}
    return {key: estimate for key, estimate in found.items() if key.startswith(_ROWS)}, values


def _axes(covariance: Floats, slopes: Floats) -> Floats:
    """Changes of what varies whose outer products sum to its covariance. Shape `(K, P)`.

    Random draws would have to be many: eight leave the same rows up to twice too narrow in every
    study.
    """
    known = np.isfinite(np.diag(covariance))
    std = np.sqrt(np.diag(covariance)[known])
    correlation = covariance[np.ix_(known, known)] / np.outer(std, std)
    size, axis = np.linalg.eigh(correlation)
    changes = np.zeros((size.size, slopes.size))
    axes = std[:, None] * axis * np.sqrt(np.maximum(size, 0.0))
    changes[:, known] = axes.T / slopes[known]
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
    modelled: ModelledRecord

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
        # A few lost blocks move a straight line through a curve, but not the model's.
        lost = np.isnan(seen.capacitance_f)
        sensed_f[_long_runs(lost)] = np.nan
        scale = seen.relative_capacitance / seen.capacitance_f
        if not lost.all():
            scale = np.interp(seen.sensed_s, seen.sensed_s[~lost], scale[~lost])
        return replace(seen, capacitance_f=sensed_f, relative_capacitance=scale * sensed_f)


def _long_runs(lost: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Lost blocks in runs that are too long to be filled, or at an end."""
    edges = np.flatnonzero(np.diff(lost, prepend=False, append=False))
    found = lost.copy()
    for first, after in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
        if after - first <= _SHORT_RUN and first > 0 and after < lost.size:
            found[first:after] = False
    return found


def _matched(time_s: Floats, known_s: Floats) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Whether each time is a known one, and the indices of those that are."""
    if not known_s.size:
        return np.zeros(time_s.size, dtype=np.bool_), np.zeros(0, dtype=np.int64)
    at = np.minimum(np.searchsorted(known_s, time_s), known_s.size - 1)
    known = known_s[at] == time_s
    return known, at[known]
