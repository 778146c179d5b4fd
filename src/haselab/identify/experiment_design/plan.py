"""Experiment design: find the drive that best identifies a parameter or separates hypotheses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from haselab.base import InputError, JsonObject, checked
from haselab.identify.experiment_design.drives import BenchLimits, DriveCandidate, candidate_drives
from haselab.identify.model_comparison.voltage_plant import (
    VoltageStructure,
    fit_voltage_plant,
    predicted_std,
    spread_indices,
)
from haselab.identify.record import Record
from haselab.models.voltage_plant import VoltagePlant

__all__ = ["Accuracy", "ExperimentPlan", "PlannedExperiment", "goals_of", "plan_experiment"]

Floats = NDArray[np.float64]
_OUTPUTS = 400  # of a planned record
_DOUBT = 2.0  # factor by which the systematic part is uncertain
_TURN = 2.0 * math.pi
_SECOND = (2.7, 0.1)  # frequency of an assumed second mode relative to the first one, and its share
_NUMBERS = (
    "natural_frequency_rad_s", "damping_ratio", "delay_s", "creep_share", "creep_time_constant_s",
    "gain_1",
)  # fmt: skip


@dataclass(frozen=True)
class Accuracy:
    """How well the output is measured, and how well the model describes it.

    Args:
        noise_std: of an independent sample, in the unit of the output.
        samples_per_s: independent samples per second.
        systematic: model error relative to the output's variation (root mean square).
    Raises:
        InputError: a value out of range.
    """

    noise_std: float = 1e-4
    samples_per_s: float = 2.0
    systematic: float = 0.05

    def __post_init__(self) -> None:
        if not (self.noise_std > 0.0 and self.samples_per_s > 0.0 and 0.0 <= self.systematic < 1.0):
            raise InputError(
                f"noise_std = {self.noise_std:g}, samples_per_s = {self.samples_per_s:g}, "
                f"systematic = {self.systematic:g}; they must be above 0, above 0, and 0 to 1."
            )


@dataclass(frozen=True)
class PlannedExperiment:
    """One candidate drive with its predicted results.

    Args:
        name: for tables.
        says: description in words.
        drive_v: one value per update, in V. Shape `(N,)`.
        std: predicted standard deviation by name; relative for frequencies, damping, time
            constants and gains.
        probability: of a right decision whichever hypothesis is true; NaN where a parameter is the
            goal.
        separation: root mean square between a wrong hypothesis's best fit and the truth, relative
            to the unexplained part; the smaller of both directions. NaN where a parameter is the
            goal.
        score: rank criterion; larger is better.
    """

    name: str
    says: str
    drive_v: Floats
    std: dict[str, float]
    probability: float
    separation: float
    score: float

    def to_dict(self) -> JsonObject:
        """The result for JSON, without the drive."""
        return {
            "name": self.name,
            "says": self.says,
            "lowest_v": float(self.drive_v.min()),
            "highest_v": float(self.drive_v.max()),
            "std": self.std,
            "probability": self.probability,
            "separation": self.separation,
        }


@dataclass(frozen=True)
class ExperimentPlan:
    """Candidate drives, the best first.

    Args:
        status: "ok", or why there is no result.
        goal: the requested goal.
        ranked: candidates, the best first.
        update_hz: updates of the drives a second, in Hz.
        notes: remarks for the user, one sentence each.
    """

    status: str
    goal: str
    ranked: tuple[PlannedExperiment, ...]
    update_hz: float
    notes: tuple[str, ...]

    @property
    def succeeded(self) -> bool:
        """Whether a drive reaches the goal better than chance."""
        return self.status == "ok"

    @property
    def chosen(self) -> PlannedExperiment:
        """The best candidate drive."""
        return self.ranked[0]

    def answer(self) -> JsonObject:
        """The result under its public JSON keys."""
        return {
            "goal": self.goal,
            "chosen": self.chosen.name,
            "says": self.chosen.says,
            "duration_s": self.chosen.drive_v.size / self.update_hz,
            "ranked": [planned.to_dict() for planned in self.ranked],
            "status": self.status,
            "notes": list(self.notes),
        }


def goals_of(plant: VoltagePlant) -> tuple[str, ...]:
    """All goals of `plan_experiment` for a plant.

    Args:
        plant: prior knowledge of the actuator.
    Returns:
        Names of questions, "all", names of parameters.
    """
    known = _NUMBERS if plant.creep_share else tuple(n for n in _NUMBERS if "creep" not in n)
    return ("creep", "reading", "modes", "all", *known)


@checked
def plan_experiment(
    plant: VoltagePlant,
    goal: str,
    limits: BenchLimits,
    *,
    accuracy: Accuracy | None = None,
    duration_s: float = 40.0,
    baseline_v: float = 1.0,
    risk: float = 0.01,
) -> ExperimentPlan:
    r"""Rank drives by the expected result of a fit to their records.

    For a parameter: its standard deviation, $(c'F^{-1}c)^{1/2}$; for "all": $\ln\det F$. For a
    question: each hypothesis in turn is assumed to be true, the other is fitted to its prediction,
    and the remaining distance, relative to noise and model error, gives the probability that
    `compare` makes the right decision.

    Args:
        plant: prior knowledge of the actuator.
        goal: "creep", "reading", "modes", "all", or the name of a parameter.
        limits: of the bench.
        accuracy: of the output and of the model.
        duration_s: of the drive, in s.
        baseline_v: drive at which the actuator has settled before, in V.
        risk: of a wrong decision.
    Returns:
        The plan; `status` says "ok" or why no candidate reaches the goal.
    Raises:
        InputError: an unknown goal, a baseline outside the window, a duration too short.
    Source: Atkinson and Fedorov, Biometrika 62 (1975), 57, for discriminating between models.
    Example:
        >>> plant = VoltagePlant("mechanical", (0.06,), 5.11, 0.09, 0.0, 0.3, 4.0)
        >>> unipolar, bipolar = BenchLimits(0.0, 2.0), BenchLimits(-2.0, 2.0)
        >>> plan_experiment(plant, "creep", bipolar, duration_s=20.0).chosen.name[:11]
        'alternation'
    """
    if goal not in goals_of(plant):
        raise InputError(f"goal = {goal}; it must be one of {', '.join(goals_of(plant))}.")
    accuracy = accuracy or Accuracy()
    drives = candidate_drives(plant, limits, duration_s, baseline_v, goal)
    if not drives:
        reason = "no result: no drive stays inside the limits; allow a higher slew or larger output"
        return ExperimentPlan(reason, goal, (), limits.update_hz, ())
    truths = _truths(plant, goal)
    planned = [_planned(plant, truths, drive, (goal, limits, accuracy, risk)) for drive in drives]
    ranked = sorted(planned, key=lambda candidate: -candidate.score)
    notes = _notes(plant, goal, limits, ranked)
    status = "ok"
    if not math.isfinite(ranked[0].score):
        status = f"no result: no candidate identifies {goal}; plan a longer drive or a wider window"
    return ExperimentPlan(status, goal, tuple(ranked), limits.update_hz, notes)


def _truths(plant: VoltagePlant, goal: str) -> list[tuple[VoltagePlant, VoltagePlant]]:
    """Pairs of true plant and alternative."""
    if goal == "creep":
        share = plant.creep_share or 0.3
        kinds = [replace(plant, creep=kind, creep_share=share)
                 for kind in ("mechanical", "electrical")]  # fmt: skip
        return [(kinds[0], kinds[1]), (kinds[1], kinds[0])]
    if goal == "reading":
        omega = plant.natural_frequency_rad_s
        # The other interpretation of the frequency axis is a factor of 2 pi above or below.
        other = omega * _TURN if omega < math.sqrt(_TURN) * 5.1 else omega / _TURN
        alternative = replace(plant, natural_frequency_rad_s=other)
        return [(plant, alternative), (alternative, plant)]
    if goal == "modes":
        omega, damping = plant.natural_frequency_rad_s, plant.damping_ratio
        second = plant.second_mode or (_SECOND[0] * omega, damping, _SECOND[1])
        return [(replace(plant, second_mode=second), replace(plant, second_mode=None))]
    return []


def _record(plant: VoltagePlant, drive: DriveCandidate, limits: BenchLimits) -> Record:
    """Simulated record of a plant, sampled fast enough for its fastest motion."""
    count = drive.drive_v.size
    time_s = spread_indices(count, _OUTPUTS) / limits.update_hz
    y = plant.simulate(drive.drive_v, limits.update_hz, time_s, limits.slew_v_s)
    return Record(drive.drive_v, limits.update_hz, y, time_s, None)


def _planned(
    plant: VoltagePlant,
    truths: Sequence[tuple[VoltagePlant, VoltagePlant]],
    drive: DriveCandidate,
    task: tuple[str, BenchLimits, Accuracy, float],
) -> PlannedExperiment:
    goal, limits, accuracy, risk = task
    samples = max(accuracy.samples_per_s * drive.drive_v.size / limits.update_hz, 2.0)
    record = _record(plant, drive, limits)
    left_out = accuracy.systematic * float(record.y.std())
    std, log_det = predicted_std(
        plant, [record], math.hypot(accuracy.noise_std, left_out), samples
    )  # fmt: skip
    if not truths:
        score = log_det if goal == "all" else -std[goal]
        return PlannedExperiment(
            drive.name, drive.says, drive.drive_v, std, math.nan, math.nan, score
        )
    outlook = [_outlook(truth, alternative, drive, (limits, accuracy, risk, samples))
               for truth, alternative in truths]  # fmt: skip
    probability = min(p for p, _ in outlook)
    separation = min(s for _, s in outlook)
    return PlannedExperiment(
        drive.name, drive.says, drive.drive_v, std, probability, separation, separation
    )


def _outlook(
    truth: VoltagePlant,
    alternative: VoltagePlant,
    drive: DriveCandidate,
    task: tuple[BenchLimits, Accuracy, float, float],
) -> tuple[float, float]:
    """Probability of a right decision, and distance of the alternative's best fit."""
    limits, accuracy, risk, samples = task
    record = _record(truth, drive, limits)
    far = 1.5  # the alternative's frequency stays within this factor
    structure = VoltageStructure(
        alternative.creep,
        len(alternative.gains),
        lowest_rad_s=alternative.natural_frequency_rad_s / far,
        highest_rad_s=alternative.natural_frequency_rad_s * far,
        slew_v_s=limits.slew_v_s,
    )
    starts = [alternative]
    if alternative.creep != truth.creep:
        starts.append(replace(alternative, creep_share=0.02))  # the wrong creep may fit best at 0
    fit = fit_voltage_plant([record], structure, starts)
    distance = math.sqrt(float((fit.residuals[0] ** 2).mean()))
    left_out = accuracy.systematic * float(record.y.std())
    ratio = distance / math.hypot(accuracy.noise_std, left_out)
    # Gain of log-likelihood with its scatter, compared with the threshold of the odds.
    gain = 0.5 * samples * math.log1p(ratio**2)
    scatter = math.sqrt(samples) * ratio / (1.0 + ratio**2)
    by_odds = float(ndtr((gain + math.log(risk)) / max(scatter, 1e-9)))
    if left_out == 0.0 or distance == 0.0:
        return (by_odds if distance else 0.0), ratio
    by_misfit = float(ndtr(math.log(distance / left_out) / math.log(_DOUBT)))
    return min(by_odds, by_misfit), ratio


def _notes(
    plant: VoltagePlant, goal: str, limits: BenchLimits, ranked: Sequence[PlannedExperiment]
) -> tuple[str, ...]:
    best = ranked[0]
    notes = []
    if math.isfinite(best.probability):
        notes.append(
            f"{best.name} {best.says}: probability of a right decision "
            f"{best.probability:.2g}; the hypotheses differ by {best.separation:.2g} times the "
            "unexplained part."
        )
        if best.probability < 0.9:
            notes.append("'cannot tell' is likely. Use a wider window or a longer drive.")
    elif goal in best.std:
        relative = "" if goal in ("delay_s", "creep_share") else " (relative)"
        notes.append(f"{best.name} {best.says}: {goal} to within {best.std[goal]:.2g}{relative}.")
    if goal == "creep" and limits.low_v >= 0.0:
        notes.append(
            f"The window [{limits.low_v:g}, {limits.high_v:g}] V has one polarity. Alternating "
            "polarity separates the hypotheses best; it requires a bipolar amplifier and a window "
            "below 0 V."
        )
    if goal == "modes" and plant.second_mode is None:
        notes.append(
            f"A second mode at {_SECOND[0]:g} times the first one's frequency with a share of "
            f"{_SECOND[1]:g} was assumed."
        )
    return tuple(notes)
