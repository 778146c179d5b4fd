"""Controller design, on request with margins for a required share of plausible plants."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import Literal

import numpy as np

from haselab.base import InputError
from haselab.control.candidates import Task
from haselab.control.gains import PidGains
from haselab.control.loop_shaping import (
    Design,
    design_pi,
    design_pid,
    design_task,
    evaluate_gains,
)
from haselab.control.plants.general import AnyPlant
from haselab.control.simulate import LoopSetting
from haselab.control.spec import DesignSpec
from haselab.control.stability.plausible import Chance, plausible_margins
from haselab.models.posterior import PlantPosterior

__all__ = ["USUAL_STRUCTURE", "Structure", "design_controller", "evaluate_controller"]

Structure = Literal["pi", "pid"]
USUAL_STRUCTURE: Structure = "pid"
_FEWEST, _MOST = 50, 20_000  # draws
_SEARCHED = 200  # plants used by a search
_ROUNDS = 3


def design_controller(
    model: PlantPosterior | AnyPlant,
    spec: DesignSpec,
    setting: LoopSetting,
    *,
    rng: np.random.Generator,
    structure: Structure = USUAL_STRUCTURE,
    probability: float | None = None,
    draws: int = 400,
    nominal: AnyPlant | None = None,
) -> Design:
    """Design a PI or PID controller, with margins of plausible plants if their spread is known.

    The design for the best plant comes first. If the required share of plausible plants keeps its
    margins, it is the result: no loop with more integral gain meets the demands for the best plant
    alone. Otherwise the search is repeated with the share as a further demand, on other draws than
    those that evaluate its result, so that the reported share is unbiased.

    Args:
        model: the parameters with their covariance, from which plausible plants are drawn; or a
            plant alone.
        spec: specification; phase and gain margin are those of the share.
        setting: rate, measurement delay and saturation.
        rng: random generator of the draws and of the search.
        structure: "pi" or "pid".
        probability: required share of plausible plants that keep both margins; None: report only.
        draws: number of plausible plants for the evaluation.
        nominal: best plant, if it is not the posterior's nominal one.
    Returns:
        The design, with `plausible` if the model has a covariance; a share that was not reached is
        a shortfall, and the gains are then those with the largest share found among loops that
        meet all other demands.
    Raises:
        InputError: as for `design_pi`; a probability or a number of draws outside its range.
        ResultError: as for `design_pi`.
    Source: chance constraint by sampled scenarios, G. C. Calafiore and M. C. Campi, IEEE
        Transactions on Automatic Control 51 (2006), with an independent test of the result.
    Example:
        >>> names = ("gain", "natural_frequency_rad_s", "damping_ratio", "delay_s")
        >>> posterior = PlantPosterior(
        ...     names, (False, True, True, False), np.array([1.0, 32.0, 0.3, 0.01]),
        ...     np.diag([0.01, 0.01, 0.05, 0.0]) ** 2)
        >>> design = design_controller(posterior, DesignSpec(), LoopSetting(), structure="pi",
        ...                           rng=np.random.default_rng(1), draws=100)
        >>> design.plausible.share.value
        1.0
    """
    search = design_pi if structure == "pi" else design_pid
    if not isinstance(model, PlantPosterior):
        if probability is not None:
            raise InputError(
                f"probability = {probability:g} needs the covariance of the model, which a plant "
                "alone does not have. Give a fit, or leave the probability out."
            )
        return search(model, spec, setting, rng=rng)
    _check_draws(draws)
    most = 1.0 - 1.0 / min(draws, _SEARCHED)
    if probability is not None and not 0.0 < probability <= most:
        raise InputError(
            f"probability = {probability:g}; {draws} draws can show a share above 0 and up to "
            f"{most:g}."
        )
    streams = rng.spawn(2)
    plants = model.draw(draws, streams[0])
    best_plant = model.nominal if nominal is None else nominal
    found = _judged(search(best_plant, spec, setting, rng=rng), plants)
    if probability is None or _share(found) >= probability:
        return found
    if found.shortfalls:  # further demands do not help
        return _short(found, probability, reachable=False)
    others = model.draw(min(draws, _SEARCHED), streams[1])
    chance = Chance.of(others, setting, probability)
    error = math.sqrt(probability * (1.0 - probability) / len(others))
    share = probability + 0.5 * error
    for _ in range(_ROUNDS):
        task = Task(best_plant, setting, spec, dataclasses.replace(chance, share=min(share, most)))
        other = _judged(design_task(task, rng, derivative=structure == "pid"), plants)
        if not other.shortfalls and _share(other) > _share(found):
            found = other
        if _share(found) >= probability:
            return found
        share += 0.5 * error + max(probability - _share(other), 0.0)
    return _short(found, probability, reachable=True)


def evaluate_controller(
    model: PlantPosterior | AnyPlant,
    gains: PidGains,
    spec: DesignSpec,
    setting: LoopSetting,
    *,
    rng: np.random.Generator,
    draws: int = 400,
    nominal: AnyPlant | None = None,
) -> Design:
    """Predict what given gains achieve, as `design_controller` does for those that it finds.

    Args:
        model: the parameters with their covariance, from which plausible plants are drawn; or a
            plant alone.
        gains: of the controller.
        spec: specification.
        setting: rate, measurement delay and saturation.
        rng: random generator of the draws; with the same one, the plausible plants are those of
            `design_controller`.
        draws: number of plausible plants.
        nominal: best plant, if it is not the posterior's nominal one.
    Returns:
        The gains with their predictions, and with `plausible` if the model has a covariance.
    Raises:
        InputError: a number of draws outside its range, or a rate outside that of a design.
    Example:
        >>> from haselab.models import Plant
        >>> found = evaluate_controller(
        ...     Plant(1.0, 32.0, 0.3), PidGains(0.0, 20.0), DesignSpec(), LoopSetting(),
        ...     rng=np.random.default_rng(0))
        >>> found.nominal.margins.stable
        False
    """
    if not isinstance(model, PlantPosterior):
        return evaluate_gains(Task(model, setting, spec), gains)
    _check_draws(draws)
    best_plant = model.nominal if nominal is None else nominal
    plants = model.draw(draws, rng.spawn(2)[0])
    return _judged(evaluate_gains(Task(best_plant, setting, spec), gains), plants)


def _check_draws(draws: int) -> None:
    if not _FEWEST <= draws <= _MOST:
        raise InputError(f"draws = {draws}; it must be {_FEWEST} to {_MOST}.")


def _short(design: Design, probability: float, *, reachable: bool) -> Design:
    """The design with the share as a further shortfall."""
    assert design.plausible is not None
    share, spec = design.plausible.share, design.spec
    where = " with gains that meet the other demands" if reachable else ""
    how = "at most " if reachable else ""
    text = (
        f"share of plausible plants that keep {spec.phase_margin_deg:g} deg and "
        f"{spec.gain_margin_db:g} dB: {how}{100.0 * share.value:.4g} % (+- "
        f"{100.0 * share.std:.1g} %){where}; demanded: {100.0 * probability:g} % or more"
    )
    return dataclasses.replace(design, shortfalls=(*design.shortfalls, text))


def _judged(design: Design, plants: Sequence[AnyPlant]) -> Design:
    found = plausible_margins(plants, design.gains, design.setting, design.spec)
    return dataclasses.replace(design, plausible=found)


def _share(design: Design) -> float:
    return math.nan if design.plausible is None else design.plausible.share.value
