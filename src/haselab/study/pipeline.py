"""The study in its order: play, fit, design, play on; or the fits alone from what was recorded."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from haselab.base import Estimate, InputError, ResultError
from haselab.rig import RigDescription
from haselab.runtime.loop import LoopSettings
from haselab.runtime.runner import Runner, counted_s
from haselab.study.definition import Study
from haselab.study.experiments import play as experiments
from haselab.study.experiments.cycles import Cycles
from haselab.study.experiments.dynamics import Dynamics, fit_chirp_and_steps
from haselab.study.experiments.free import Free, fit_free
from haselab.study.experiments.further import further_trials
from haselab.study.experiments.maps import Maps, fit_maps
from haselab.study.experiments.observe import TRIANGLE, Observation, Source
from haselab.study.experiments.paper_chain import PrintedChain, compare_chain
from haselab.study.experiments.static import fit_static
from haselab.study.experiments.trials import compare_trials
from haselab.study.loops import Loops, design_loops, measured_latency
from haselab.study.own_controller import OWN, own_controller, own_names
from haselab.study.point import find_point

__all__ = ["Findings", "Played", "investigate"]

_SEED = 20181001  # of the design's search; the data have their own seed


@dataclass(frozen=True)
class Played:
    """What another run of the study has put out, to be repeated exactly.

    Args:
        baseline_v: of zero strain.
        maps: for the step trials.
        chain: eq. 5 of the printed chain, for the trial that it closes; None without one.
        loops: the controllers.
    """

    baseline_v: float
    maps: Maps
    chain: PrintedChain | None
    loops: Loops


@dataclass(frozen=True)
class Findings:
    """All that a study has found.

    Args:
        quantities: estimates by id.
        notes: by id, what the reader should know.
        figures: sections of analysis.json.
        played: baseline, maps and controllers.
        dynamics: the plant.
        sensing_error: rms of self-sensed against camera strain in the trials, part of the span.
    """

    quantities: dict[str, Estimate]
    notes: dict[str, str]
    figures: dict[str, Any]
    played: Played
    dynamics: Dynamics
    sensing_error: float

    @property
    def maps(self) -> Maps:
        """Of the triangle test."""
        return self.played.maps

    @property
    def loops(self) -> Loops:
        """The controllers."""
        return self.played.loops


def _settings(played: Played, study: Study, rig: RigDescription) -> dict[str, LoopSettings]:
    """The closed loops by the group of trials that they play."""
    maps, loops = played.maps, played.loops
    by_video = study.steps.feedback == "video"
    pi = LoopSettings(
        loops.pi.controller(),
        loops.setting.saturation,
        maps.voltage_map,
        maps.strain_map,
        maps.length_m / rig.scale_m_per_px if by_video else None,
    )
    found = {
        "pi": pi,
        "pid": replace(pi, controller=loops.pid.controller()),
        "late": replace(
            pi,
            controller=loops.delayed_pi.controller(),
            extra_delay_blocks=study.steps.extra_delay_blocks,
        ),
        "saturating": pi,
    }
    if played.chain is not None:
        found["printed"] = replace(
            pi,
            printed_chain=True,
            carrier_v=study.steps.printed_chain_carrier_v,
            strain_map=played.chain.strain_map,
            video_zero_px=None,
        )
    own = own_controller(study.control)
    if own is not None:
        found[OWN] = replace(pi, controller=own)
    return found


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
    control: Played | None = None,
    designed: Callable[[Maps, Dynamics, Loops], None] = lambda maps, dynamics, loops: None,
) -> Findings:
    """Rows S6 to S25.

    With a runner each experiment is played before it is looked at; without one the source holds
    them all already. The fits do not know the difference.

    Args:
        source: observations by the experiment's name.
        study: what is played and fitted.
        rig: nominal values of the bench.
        runner: plays the experiments; None when they are recorded already.
        told: hears which fit is under way.
        control: baseline, maps and controllers for the experiments instead of those found here: to
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
        experiments.play_static_loads(runner, study)
        experiments.play_holds(runner, study)
    told("static load, operating point, maps")
    triangle, loaded = source(TRIANGLE), source("static")
    holds = [source(name) for name in experiments.hold_names(study)]
    with _fitting("Static load"):
        static = fit_static(loaded, study, rig)
    with _fitting("Operating point"):
        cycles = Cycles.of(triangle, study, rig)
        point = find_point(
            holds, cycles, static, study, rig, control.baseline_v if control else None
        )
    with _fitting("Maps"):
        maps = fit_maps(cycles, point.baseline_v)
    with _fitting("Paper's sensing chain"):
        chain = _chain(cycles, maps, study, rig)
    if runner is not None:
        experiments.play_free_responses(runner, study, point.baseline_v)
        experiments.play_chirp(runner, study, point.baseline_v)
        experiments.play_open_steps(runner, study, (control.maps if control else maps).voltage_map)
        runner.rest()  # while the fits are made
    told("free response")
    rings = [source(name) for name in experiments.free_names(study)]
    with _fitting("Free response"):
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
            control.loops if control else None,
        )  # fmt: skip
    designed(maps, dynamics, loops)
    found = Played(point.baseline_v, maps, chain, loops)
    names = {group: experiments.closed_names(study, group) for group in ("pi", "pid")} | {
        group: experiments.further_names(study, group) for group in experiments.FURTHER
    }
    names[OWN] = own_names(study)
    if runner is not None:
        for group, loop in _settings(control or found, study, rig).items():
            experiments.play_closed_steps(runner, study, names[group], loop)
    told("step trials")
    trials = {group: [source(name) for name in names[group]] for group in names}
    groups: dict[str, Sequence[Observation]] = {"open loop": opened, "PI": trials["pi"]}
    if trials["pid"]:
        groups["PID"] = trials["pid"]
    if trials[OWN]:
        groups[OWN] = trials[OWN]
    with _fitting("Step trials"):
        comparison = compare_trials(groups, maps, study, rig.scale_m_per_px)
        further, counted, drawn = further_trials(
            trials, comparison.groups["PI"], maps, loops, study, rig.scale_m_per_px
        )
    static.figures["static"]["operating_point"] = point.figures
    validation = _against_chirp(free, dynamics)
    parts: tuple[Any, ...] = (
        maps, static, point, free, dynamics, loops, comparison, *([chain] if chain else []),
    )  # fmt: skip
    return Findings(
        quantities=_joined([*(part.quantities for part in parts), validation, further]),
        notes=_joined_notes([*(getattr(part, "notes", {}) for part in parts), counted]),
        figures=_joined([*(part.figures for part in parts if part is not point), drawn]),
        played=found,
        dynamics=dynamics,
        sensing_error=comparison.sensing_error,
    )


def _chain(cycles: Cycles, maps: Maps, study: Study, rig: RigDescription) -> PrintedChain | None:
    """The printed chain against the lock-in, over the cycles that count."""
    seen = cycles.seen
    if seen.lockin is None or seen.printed is None:
        return None
    counted = seen.sensed_s >= cycles.from_s
    strain = np.interp(seen.sensed_s, seen.frame_time_s, seen.length_m / maps.length_m - 1.0)
    return compare_chain(
        seen.printed.taken(counted),
        seen.lockin.taken(counted),
        strain[counted],
        seen.drive_v[counted],
        seen.sensed_s[counted],
        study.sensing.carrier_hz * rig.block_s,
        study.sensing.carrier_hz * counted_s(rig, study.sensing.carrier_hz),
    )


def _against_chirp(free: Free, dynamics: Dynamics) -> dict[str, Estimate]:
    """Natural frequency of the free response over that of the chirp, less 1."""
    swing, sweep = free.quantities["S19.omega_0"], dynamics.quantities["S20.omega_n"]
    ratio = swing.value / sweep.value
    std = ratio * float(np.hypot(swing.std / swing.value, sweep.std / sweep.value))
    return {"S19.chirp_difference": Estimate.normal(ratio - 1.0, std, "")}


def _joined_notes(parts: Sequence[Mapping[str, str]]) -> dict[str, str]:
    """All notes by id, those of one id in the order of the parts."""
    found: dict[str, str] = {}
    for key, told in (item for part in parts for item in part.items()):
        found[key] = f"{found[key]}; {told}" if key in found else told
    return found


def _joined(parts: list[Mapping[str, Any]]) -> dict[str, Any]:
    return {key: value for part in parts for key, value in part.items()}
