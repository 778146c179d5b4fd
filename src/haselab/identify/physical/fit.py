r"""Identify one physical model of an actuator jointly from all its experiments.

Lengths and capacitances of all records are compared with one simulated motion. With residuals $r$
over their standard deviations and their derivatives $J$ by the parameters, the estimate minimises
$r^\top r$, and its covariance is

$\Sigma = (J^\top J)^{-1}$

where the standard deviations are those of the residuals themselves, channel by channel. Coloured
residuals and a model error (`model_error`) make it larger.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import ActuatorLaw
from haselab.actuators.response import ADDED_INERTIA
from haselab.base import InputError
from haselab.identify.physical.misfit import CAPACITANCE, LENGTH, TRACKED_ZERO_M, Misfit
from haselab.identify.physical.misstated import WrongScale, find_wrong_scale, suspect_scale
from haselab.identify.physical.plausible import (
    find_implausible,
    judge_estimates,
    motion_before_drive,
)
from haselab.identify.physical.profile import extend_intervals
from haselab.identify.physical.record import MotionRecord
from haselab.identify.physical.residuals import (
    channel_of,
    channel_residuals,
    rms_of,
    status_of,
)
from haselab.identify.physical.result import ActuatorFit, result_of
from haselab.identify.physical.rivals import (
    Rival,
    compare_elastic_laws,
    find_extended_law,
    search_with_all_effects,
)
from haselab.identify.physical.search import SearchResult, refine, search
from haselab.identify.physical.unknowns import CAMERA_OFFSET, CAMERA_SCALE, Unknowns

__all__ = ["fit_actuator"]

Floats = NDArray[np.float64]
_MOST_ADDED = 2  # effects that the given law lacks
_EXPLAINS = 0.1  # of a model error, which an effect must explain to be added
_ROUNDS = 3  # of the noise's estimate
_SAME_NOISE = 0.02
_USUAL_INERTIA = 0.05  # clamp and linkage over the hung mass
# Added inertia over the hung mass: further starts, if the records contradict the model.
_LARGE_INERTIAS = (1.0, 4.0)
_NOTED_INERTIA, _SEEN_INERTIA = 0.7, 2.0  # which a note mentions; in its standard deviations
_MOST_INERTIA = 4.0  # of them, that is accepted: a time that is wrong by 2 imitates 3
_SAME_EFFECT = "A wrong mass or a wrong unit of time has the same effect"
_APART = 2.0  # rms over noise from which records are compared alone
_FEW_STEPS = 8  # from what explains one record to what explains all, if that exists
_MOVED = 4.0  # standard deviations of the zero; above, the lengths of a record count as shifted
_LEAST_VALUES = 2  # for each unknown, without which nobody sees the noise
_CONTRADICT = (
    "the records contradict each other: the law explains each alone, but not all together. Check "
    "that all are of one actuator, and mass, units and gain of each"
)


def fit_actuator(
    law: ActuatorLaw,
    records: Sequence[MotionRecord],
    *,
    mass_kg: float,
    added_inertia_kg: float | None = None,
    camera_bias_m: float = TRACKED_ZERO_M,
    camera_scale_std: float = 5e-5,
    clock_std: float = 0.0,
    on_stage: Callable[[str], None] = lambda what: None,
) -> ActuatorFit:
    """Identify a physical model from records.

    Args:
        law: kind of the actuator, and where to start; what it declares as measured stays.
        records: of one actuator.
        mass_kg: hung mass, the scale of an added inertia.
        added_inertia_kg: where to start with that; None: 5 % of the hung mass.
        camera_bias_m: standard deviation of the error that all lengths share, and of a further
            one that those of each of several records share; a track of 0.02 px is usual.
        camera_scale_std: relative standard deviation of the camera's scale, with the slow
            errors of tracking over the picture.
        clock_std: relative standard deviation of the stated times.
        on_stage: called with the name of each stage of the search as it begins.
    Returns:
        The model, with the covariance of its parameters.
    Raises:
        InputError: There is no record.
    """
    if not records:
        raise InputError("There is no record of the actuator's motion. Give at least one.")
    if fault := find_implausible(law, records, added_inertia_kg or 0.0):
        return ActuatorFit(status=fault, kind=law.kind)
    known = {CAMERA_OFFSET: camera_bias_m, CAMERA_SCALE: camera_scale_std}

    def fit_from(inertia_kg: float) -> ActuatorFit:
        start = Unknowns.of(law, added_inertia_kg=inertia_kg, mass_kg=mass_kg)
        return _fit(law, records, start, known, clock_std, on_stage)

    if added_inertia_kg is not None:
        fit = fit_from(added_inertia_kg)
    else:
        fit = fit_from(_USUAL_INERTIA * mass_kg)
        if fit.contradicted:
            on_stage("search with a larger added inertia")
            others = (fit_from(share * mass_kg) for share in _LARGE_INERTIAS)
            fit = _with_large_inertia(fit, others, mass_kg)
    if fit.succeeded:
        begun_kg = _USUAL_INERTIA * mass_kg if added_inertia_kg is None else added_inertia_kg
        sensed = any(record.capacitance_f.size for record in records)
        fault, note = judge_estimates(law, fit, start_inertia_kg=begun_kg, sensed=sensed)
        if fault:
            return ActuatorFit(status=fault, kind=law.kind, evaluations=fit.evaluations)
        fit = replace(fit, notes=(*fit.notes, note)) if note else fit
        if added_inertia_kg is None:
            fit = _with_inertia_note(fit, mass_kg)
    else:
        for remark in (remark for record in records for remark in record.repeated_remarks):
            fit = replace(fit, status=f"{fit.status}. {remark}. Record with finer steps")
    if moving := motion_before_drive(records):
        if fit.succeeded:
            return replace(fit, notes=(*fit.notes, f"{moving}."))
        return replace(fit, status=f"{fit.status}. {moving}")
    return fit


def _with_large_inertia(
    fit: ActuatorFit, others: Iterable[ActuatorFit], mass_kg: float
) -> ActuatorFit:
    """The first of the other fits that explains the records, if its inertia is plausible.

    Args:
        fit: from the usual inertia, which the records contradict.
        others: from larger ones.
        mass_kg: hung on the actuator.
    """
    found = next((other for other in others if other.status == "ok"), None)
    if found is None:
        return fit
    inertia = found.parameters[ADDED_INERTIA]
    times = inertia.value / mass_kg
    if ADDED_INERTIA not in found.not_identifiable and times <= _MOST_INERTIA:
        return found
    said = (
        f"An added inertia of {inertia.value:.2g} kg, {times:.2g} times the hung mass, would "
        f"explain them. {_SAME_EFFECT}. Check both; if they are right, begin there with "
        f"--added-inertia-kg {inertia.value:.2g}"
    )
    return replace(fit, status=f"{fit.status}. {said}")


def _with_inertia_note(fit: ActuatorFit, mass_kg: float) -> ActuatorFit:
    """The fit with a note if it has a large inertia that nobody stated."""
    times, at = fit.parameters[ADDED_INERTIA].value / mass_kg, list(fit.parameters)
    # one that is not identifiable has no finite deviation there
    std = float(fit.covariance.diagonal()[at.index(ADDED_INERTIA)]) ** 0.5 / mass_kg
    if times < max(_NOTED_INERTIA, _SEEN_INERTIA * std):
        return fit
    note = f"The added inertia is {times:.2g} times the hung mass. {_SAME_EFFECT}; check both."
    return replace(fit, notes=(note, *fit.notes))


def _fit(
    law: ActuatorLaw,
    records: Sequence[MotionRecord],
    start: Unknowns,
    known: Mapping[str, float],
    clock: float,
    on_stage: Callable[[str], None],
) -> ActuatorFit:
    """Identify a model from plausible records.

    Args:
        law: kind of the actuator.
        records: of one actuator.
        start: where the search begins.
        known: standard deviations of what is known of the camera beforehand.
        clock: relative standard deviation of the stated times.
        on_stage: see `fit_actuator`.
    """
    count = sum(record.length_m.size + record.capacitance_f.size for record in records)
    if count < _LEAST_VALUES * start.values.size:
        return ActuatorFit(
            status=f"the records have {count} values, too few for the {start.values.size} unknowns "
            "of the model. Record longer",
            kind=law.kind,
        )
    # far from the minimum, errors of tracking that a pixel shares would only hide the misfit
    plain = Misfit([replace(record, pixel_m=0.0) for record in records], known=known)
    # records hardly separate the camera's scale from the actuator's size: it is estimated last
    on_stage("first search")
    found = search(plain, start.without((CAMERA_SCALE,)))
    if found is None:
        return ActuatorFit(
            status="the start values describe no motion: the actuator has no equilibrium under the "
            f"first load and voltage ({_first_acts(records)}). Check the mass (kg), the voltage "
            "(V) and the start values in [actuator.parameters]",
            kind=law.kind,
        )
    rejected: list[Rival] = []
    # no effect of a few per cent explains what a constant length or capacitance explains better
    if not found.converged and channel_residuals(plain, found).share > 0.0:
        on_stage("search with further effects, because the first one did not converge")
        found, rejected = search_with_all_effects(plain, start.without((CAMERA_SCALE,)), found)
    if not (found.converged or rejected):
        on_stage("search for what is wrong, because no search converged")
        found, fault = _judge_early(plain, start.without((CAMERA_SCALE,)), found)
        if fault is not None:
            return replace(fault, kind=law.kind, evaluations=found.evaluations)
    lacking = start
    if rejected:
        start = start.with_law(found.unknowns.present_law(), found.unknowns.drifts)
    on_stage("search with the noise of the records")
    misfit, found = _weighed(
        Misfit(records, known=known, strict=True), start.at(found.unknowns), found, start
    )
    anew = _from_start(misfit, start, found)
    if anew is not None and anew is not found:
        misfit, found = _weighed(misfit, start.at(anew.unknowns), anew, start)
    on_stage("comparison with other causes and further effects")
    scaled = _scale_instead(misfit, lacking, found, rejected) if rejected else None
    if scaled is None:
        misfit, found, more, scaled = _with_effects(misfit, start, found)
        rejected += more
    if scaled is not None and scaled.negligible:
        # no wrong scale: on its way, the search has found a better minimum
        nearer = refine(misfit, scaled.found.unknowns, found.evaluations)
        if nearer is not None and rms_of([nearer.residuals]) < rms_of([found.residuals]):
            misfit, found = _weighed(misfit, nearer.unknowns, nearer, start)
        scaled = None
    if scaled is not None:
        misfit, found = _weighed(scaled.misfit, scaled.found.unknowns, scaled.found, start)
    seen = channel_residuals(misfit, found)
    if len(records) > 1 and seen.excess[0] > _APART and _each_alone(misfit, start):
        return ActuatorFit(status=_CONTRADICT, kind=law.kind, evaluations=found.evaluations)
    if len(records) > 1 and (moved := _moved_zero(misfit, found)):
        return ActuatorFit(status=moved, kind=law.kind, evaluations=found.evaluations)
    # beside a model error, the evidence for another elastic law would mean nothing
    certain = seen.explained and scaled is None
    on_stage("comparison with other elastic laws")
    others = compare_elastic_laws(misfit, found) if certain else []
    rejected += [rival for rival in others if rival.log_evidence < 0.0]
    preferred = [rival for rival in others if rival.log_evidence > 0.0]
    found = _ordered(found)
    fit = result_of(misfit, found, rejected, preferred, scaled, clock=clock)
    return extend_intervals(fit, misfit, found, start)


def _first_acts(records: Sequence[MotionRecord]) -> str:
    """Load and voltage with which each record begins, the heaviest one."""
    drive = max((record.drive for record in records), key=lambda drive: float(drive.load_n[0]))
    return f"{drive.load_n[0]:.3g} N, {drive.voltage_v[0]:.3g} V"


def _moved_zero(misfit: Misfit, found: SearchResult) -> str:
    """Say which record's lengths are shifted by more than their zero's uncertainty explains."""
    zeros = np.array(misfit.zeros(found.unknowns))
    k = int(np.argmax(np.abs(zeros)))
    if abs(zeros[k]) <= _MOVED:
        return ""
    std_m = misfit.own_zero_std_m
    if not channel_residuals(misfit, found).explained:
        # another error of the model may also shift the lengths
        known = {**misfit.known, CAMERA_OFFSET: _MOVED * abs(float(zeros[k])) * std_m}
        free = replace(misfit, known=known)
        again = refine(free, found.unknowns, found.evaluations)
        if again is None or not channel_residuals(free, again).explained:
            return ""
    shift_um = 1e6 * std_m * float(zeros[k] - np.delete(zeros, k).mean())
    return (
        f"the lengths of {misfit.records[k].name} are shifted by about {shift_um:.2g} um relative "
        "to those of the other records, but the assumed standard deviation of their zero is "
        f"{1e6 * std_m:g} um. If the camera or the marks were moved, or the zero is less certain, "
        "state a larger value with --zero-std-m (in Python: camera_bias_m)"
    )


def _with_effects(
    misfit: Misfit, start: Unknowns, found: SearchResult
) -> tuple[Misfit, SearchResult, list[Rival], WrongScale | None]:
    """Add effects that the law lacks, as long as the records prefer one decisively.

    Args:
        misfit: to minimise.
        start: where the user began.
        found: before.
    Returns:
        Misfit with its noise, minimum, the laws without these effects, and lengths of a wrong scale
            if they explain the records as well as a further effect.
    """
    rejected: list[Rival] = []
    for _ in range(_MOST_ADDED):
        better = find_extended_law(misfit, found)
        if better is None:
            break
        again = refine(misfit, better.start, found.evaluations)
        if again is not None and again.converged and not _explains(misfit, found, again):
            break
        # before another search, which takes long
        if scaled := find_wrong_scale(misfit, found, again, (better.effect,)):
            return misfit, found, rejected, scaled
        again = _from_start(misfit, better.start.at(start), again, explained=True)
        if again is None or not _explains(misfit, found, again):
            break
        misfit, found = _weighed(misfit, again.unknowns, again, start)
        rejected.append(Rival(f"without {better.effect}", -better.log_evidence))
    suspect = not channel_residuals(misfit, found).explained or suspect_scale(misfit, found)
    return misfit, found, rejected, find_wrong_scale(misfit, found) if suspect else None


def _scale_instead(
    misfit: Misfit, lacking: Unknowns, found: SearchResult, rejected: Sequence[Rival]
) -> WrongScale | None:
    """Lengths of a wrong scale, if they explain the records as well as all effects of a search.

    Args:
        misfit: that was minimised.
        lacking: numbers of the law without these effects.
        found: minimum with them.
        rejected: laws without each of them.
    """
    without = refine(misfit, lacking.at(found.unknowns), found.evaluations)
    words = tuple(rival.law.removeprefix("without ") for rival in rejected)
    return None if without is None else find_wrong_scale(misfit, without, found, words)


def _explains(misfit: Misfit, before: SearchResult, after: SearchResult) -> bool:
    """Whether an effect explains a part of a model error, and not only imitates a little of it."""
    seen = channel_residuals(misfit, before)
    left = channel_residuals(misfit, after).excess_energy
    return seen.explained or left < (1.0 - _EXPLAINS) * seen.excess_energy


def _judge_early(
    misfit: Misfit, start: Unknowns, found: SearchResult
) -> tuple[SearchResult, ActuatorFit | None]:
    """Judge records for which no search converged, before further ones that take minutes.

    Args:
        misfit: to minimise.
        start: where the user began.
        found: by the searches.
    Returns:
        The best result, which may start from what explains one of the records alone, and the fit
        that says why the records contradict the model or each other; None if that is not certain.
    """
    alone = _each_alone(misfit, start) if len(misfit.records) > 1 else []
    if alone:
        # the parameters of one actuator hardly differ from record to record
        joint = refine(misfit, start.at(alone[0].unknowns), found.evaluations, steps=_FEW_STEPS)
        if joint is not None and rms_of([joint.residuals]) < rms_of([found.residuals]):
            found = joint
    seen = channel_residuals(misfit, found)
    if alone and seen.excess[0] > _APART:
        return found, ActuatorFit(status=_CONTRADICT)
    if found.converged or not seen.misses_a_signal:
        return found, None
    status, _ = status_of(seen, 1.0, (), converged=False)
    return found, ActuatorFit(status=status, contradicted=True)


def _each_alone(misfit: Misfit, start: Unknowns) -> list[SearchResult]:
    """What explains each record alone, with parameters of its own; empty if one is not explained.

    Args:
        misfit: of all records.
        start: where the user began.
    """
    found: list[SearchResult] = []
    for record in misfit.records:
        own = replace(misfit, records=[record])
        part = search(own, start)
        if part is None or not channel_residuals(own, part).explained:
            return []
        found.append(part)
    return found


def _ordered(found: SearchResult) -> SearchResult:
    """Viscoelastic branches in the order of their relaxation times."""
    unknowns = found.unknowns
    keys = {about.name: about.key for about in unknowns.law.described()}
    shares, times = (
        [k for k, name in enumerate(unknowns.names) if name.startswith(f"{keys.get(field)}[")]
        for field in ("branch_share", "branch_relaxation_s")
    )
    if len(shares) != len(times):
        return found
    order = np.argsort(unknowns.values[times])
    moved = np.arange(unknowns.values.size)
    for places in (shares, times):
        moved[places] = np.array(places, dtype=np.int64)[order]
    return replace(
        found,
        unknowns=replace(unknowns, values=unknowns.values[moved]),
        jacobian=found.jacobian[:, moved],
        left=found.left[moved],
    )


def _from_start(
    misfit: Misfit, start: Unknowns, found: SearchResult | None, *, explained: bool = False
) -> SearchResult | None:
    """Search again if the search did not converge, and return the better result.

    The noise is now that of the first result, so the first stages take smaller steps.

    Args:
        misfit: to minimise.
        start: where the user began.
        found: before; None: nothing.
        explained: search again also if the result leaves more than noise.
    """
    left = found is not None and explained and not channel_residuals(misfit, found).explained
    if found is not None and found.converged and not left:
        return found
    anew = search(misfit, start, 0 if found is None else found.evaluations)
    if found is None or (anew is not None and rms_of([anew.residuals]) < rms_of([found.residuals])):
        return anew
    return found


def _weighed(
    misfit: Misfit, start: Unknowns, found: SearchResult, begun: Unknowns
) -> tuple[Misfit, SearchResult]:
    """Estimate the noise and the parameters in turn.

    Args:
        misfit: to minimise.
        start: first values.
        found: before.
        begun: where the user began; values that it lacks begin at `start`.
    """
    begun = start.at(begun)
    for _ in range(_ROUNDS):
        factors = _factors(misfit, found)
        same = np.allclose(factors, (misfit.length_factor, misfit.capacitance_factor),
                           rtol=_SAME_NOISE)  # fmt: skip
        misfit = replace(misfit, length_factor=factors[0], capacitance_factor=factors[1])
        again = refine(misfit, start, found.evaluations, begun=begun)
        if again is None:
            break
        start, found = again.unknowns, again
        if same or not found.converged:
            break
    return misfit, found


def _factors(misfit: Misfit, found: SearchResult) -> tuple[float, float]:
    """True over stated standard deviation of both channels, by the residuals."""
    segments = misfit.segments
    share = 1.0 - found.unknowns.values.size / found.residuals.size
    rms = [rms_of(channel_of(segments, name, found.residuals)) / math.sqrt(share)
           for name in (LENGTH, CAPACITANCE)]  # fmt: skip
    return misfit.length_factor * rms[0], misfit.capacitance_factor * rms[1]
