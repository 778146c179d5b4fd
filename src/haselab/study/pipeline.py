"""The study in its order: play, fit, design, play on; or the fits alone from what was recorded."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from haselab.base import Estimate, InputError, ResultError
from haselab.control import PidGains
from haselab.rig import RigDescription
from haselab.runtime.runner import LoopSettings, Runner
from haselab.study import experiments
from haselab.study.definition import Study
from haselab.study.dynamics import Dynamics, fit_chirp_and_steps, fit_free
from haselab.study.loops import Loops, design_loops, measured_latency
from haselab.study.maps import Maps, fit_maps
from haselab.study.observe import Observation, Source
from haselab.study.static import fit_static
from haselab.study.trials import compare_trials

__all__ = ["Findings", "investigate"]

_SEED = 20181001  # of the design's search; the data have their own seed


@dataclass(frozen=True)
class Findings:
    """All that a study has found.

    Args:
        quantities: estimates by id.
        notes: by id, what the reader should know.
        figures: sections of analysis.json.
        maps: of the triangle test.
        dynamics: the plant.
        loops: the controllers.
        sensing_error: rms of self-sensed against camera strain in the trials, part of the span.
    """

    quantities: dict[str, Estimate]
    notes: dict[str, str]
    figures: dict[str, Any]
    maps: Maps
    dynamics: Dynamics
    loops: Loops
    sensing_error: float


def _loop(
    maps: Maps, gains: PidGains, loops: Loops, study: Study, rig: RigDescription
) -> LoopSettings:
    by_video = study.steps.feedback == "video"
    return LoopSettings(
        gains,
        loops.setting.saturation,
        maps.voltage_map,
        maps.strain_map,
        maps.length_m / rig.scale_m_per_px if by_video else None,
    )


@contextlib.contextmanager
def _fitting(what: str) -> Iterator[None]:
    """A fit that refuses recorded data has no result: the user gave it nothing wrong.

    Raises:
        ResultError: in place of an `InputError`.
    """
    try:
        yield
    except InputError as error:
        raise ResultError(
            f"{what}: the recorded data give no result. {error} What was recorded is kept."
        ) from error


def investigate(
    source: Source,
    study: Study,
    rig: RigDescription,
    runner: Runner | None = None,
    told: Callable[[str], None] = lambda what: None,
    control: tuple[Maps, Loops] | None = None,
    designed: Callable[[Maps, Dynamics, Loops], None] = lambda maps, dynamics, loops: None,
) -> Findings:
    """Rows S11 to S25.

    With a runner each experiment is played before it is looked at; without one the source holds
    them all already. The fits do not know the difference.

    Args:
        source: observations by the experiment's name.
        study: what is played and fitted.
        rig: nominal values of the bench.
        runner: plays the experiments; None when they are recorded already.
        told: hears which fit is under way.
        control: maps and controllers for the step trials instead of those found here: to
            repeat exactly what another run of the study has put out.
        designed: hears what was found as soon as the controllers are designed.
    Returns:
        All results.
    Raises:
        ResultError: a fit without a result.
        InputError: an experiment is missing from the source.
    """
    if runner is not None:
        experiments.play_triangle(runner, study)
    told("maps")
    observed = source("triangle")
    with _fitting("Maps"):
        maps = fit_maps(observed, study, rig)
    if runner is not None:
        experiments.play_static_loads(runner, study)
        experiments.play_free_responses(runner, study)
        experiments.play_chirp(runner, study)
        experiments.play_open_steps(runner, study, (control[0] if control else maps).voltage_map)
        runner.rest()  # while the fits are made
    told("static load, free response")
    observed = source("static")
    rings = [source(name) for name in experiments.free_names(study)]
    with _fitting("Static load, free response"):
        static = fit_static(observed, study, rig, maps.length_m)
        free = fit_free(rings)
    told("transfer function")
    opened = [source(name) for name in experiments.open_names(study)]
    observed = source("chirp")
    with _fitting("Transfer function"):
        dynamics = fit_chirp_and_steps(observed, opened, maps, study, rig)
    told("controllers")
    rng = np.random.default_rng(_SEED)
    with _fitting("Controllers"):
        loops = design_loops(
            dynamics, maps.voltage_map, study, rig, rng, measured_latency(opened, rig),
            control[1] if control else None,
        )  # fmt: skip
    designed(maps, dynamics, loops)
    if runner is not None:
        played_maps, played = control if control else (maps, loops)
        for group, gains in (("pi", played.pi), ("pid", played.pid)):
            loop = _loop(played_maps, gains, played, study, rig)
            experiments.play_closed_steps(runner, study, group, loop)
    told("step trials")
    groups: dict[str, Sequence[Observation]] = {"open loop": opened}
    for title, group in (("PI", "pi"), ("PID", "pid")):
        names = experiments.closed_names(study, group)
        if names:
            groups[title] = [source(name) for name in names]
    with _fitting("Step trials"):
        comparison = compare_trials(groups, maps, study, rig.scale_m_per_px)
    parts: tuple[Any, ...] = (maps, static, free, dynamics, loops, comparison)
    return Findings(
        quantities=_joined([part.quantities for part in parts]),
        notes={**static.notes, **loops.notes},
        figures=_joined([part.figures for part in parts]),
        maps=maps,
        dynamics=dynamics,
        loops=loops,
        sensing_error=comparison.sensing_error,
    )


def _joined(parts: list[Mapping[str, Any]]) -> dict[str, Any]:
    return {key: value for part in parts for key, value in part.items()}
