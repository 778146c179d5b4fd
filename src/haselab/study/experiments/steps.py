"""Steps of the desired strain in open and closed loop (rows S10, S22, S24 and S25)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from haselab.base import InputError, JsonObject, ResultError, table_at
from haselab.controllers import KnownActuator
from haselab.rig import RigDescription
from haselab.runtime.loop import LoopSettings
from haselab.safety.feasibility import Drive
from haselab.signals import constant
from haselab.study.analysis import Analysis
from haselab.study.definition import Study
from haselab.study.experiment import Experiment, ExperimentResult
from haselab.study.experiments.predicted import map_errors, predicted_metrics
from haselab.study.fits.dynamics import Dynamics
from haselab.study.fits.further import further_trials, rows_without, saturating_reference
from haselab.study.fits.loops import Loops, loop_saturation
from haselab.study.fits.maps import Maps, require_open_steps
from haselab.study.fits.observe import Observation
from haselab.study.fits.paper_chain import PrintedChain
from haselab.study.fits.trials import Comparison, compare_trials
from haselab.study.own_controller import OWN, own_controller, own_names
from haselab.study.paper.quantity_table import paper_rows
from haselab.study.player import UPDATE_HZ, Player
from haselab.study.quantity import Quantity
from haselab.study.tables import Steps, StepTimes

__all__ = ["StepTest", "closed_names", "open_names", "step_reference", "unplayed_trials"]

_CLOSED = {
    "pi": "PI step",
    "pid": "PID step",
    "printed": "PI step with the paper's sensing chain",
    "late": "PI step with extra delay",
    "saturating": "PI step that saturates",
}
_COMPARED = {"pi": "PI", "pid": "PID", OWN: OWN}  # with the open loop


def open_names(study: Study) -> list[str]:
    """Names of the recordings of the open-loop trials."""
    return [f"open-{k + 1}" for k in range(study.steps.open_trials)]


def closed_names(study: Study, group: str) -> list[str]:
    """Names of the recordings of a group of closed-loop trials.

    Args:
        study: their numbers.
        group: `pi`, `pid`, `printed`, `late`, `saturating` or `OWN`.
    """
    if group == OWN:
        return own_names(study)
    steps = study.steps
    trials = {
        "pi": steps.pi_trials,
        "pid": steps.pid_trials,
        "printed": steps.paper_chain_trials,
        "late": steps.extra_delay_trials,
        "saturating": steps.saturating_trials,
    }[group]
    return [f"{group}-{k + 1}" for k in range(trials)]


def unplayed_trials(study: Study) -> str:
    """Say which closed-loop trials will not be played; empty if there are none.

    Args:
        study: with or without `[steps]`.
    """
    missing = [f"[{table}]" for table in ("chirp", "control") if not study.has(table)]
    if not study.has("steps") or not missing:
        return ""
    counts = {f"steps.{group}_trials": len(closed_names(study, group)) for group in ("pi", "pid")}
    asked = [f"{key} = {count}" for key, count in counts.items() if count]
    if not asked:
        return ""
    return (
        f"The study does not play {' and '.join(asked)}: PI and PID are designed from [chirp] and "
        f"[control], and it has no {' and no '.join(missing)}. Add what is missing, or set "
        "steps.custom_trials to play the controller of the actuator file."
    )


def step_reference(steps: StepTimes) -> np.ndarray[tuple[int], np.dtype[np.float64]]:
    """Desired strain of a trial, one value per block: zero, then the step."""
    zero = constant(0.0, steps.zero_s, UPDATE_HZ)
    return np.concatenate([zero, constant(steps.step, steps.step_s, UPDATE_HZ)])


class StepTest(Experiment[Steps]):
    """Open-loop steps with the voltage map, then closed loops with the controllers of [control]."""

    table = "steps"
    title = "Step trials"
    settings_type = Steps
    gives = (Comparison,)
    report_figures = ("fig6", "sensing", "further")

    def recordings(self) -> dict[str, str]:
        """See `Experiment`."""
        closed = {
            name: kind for group, kind in _CLOSED.items()
            for name in closed_names(self.study, group)
        }  # fmt: skip
        if own := own_names(self.study):
            closed |= dict.fromkeys(own, f"step with {self.study.control.kind}")
        return dict.fromkeys(open_names(self.study), "open-loop step") | closed

    def drives(self, rig: RigDescription) -> list[Drive]:
        """See `Experiment`.

        The trials start at zero strain, the baseline voltage. The voltage of the step depends on
        the map, which is not known yet, so the highest possible one is declared.
        """
        low_v, high_v = rig.drive_limits.low, rig.drive_limits.high
        highest_v = high_v if high_v >= -low_v else low_v
        values_v = np.array([0.0, self.study.nominal_baseline_v, highest_v])
        drives = [Drive("step trials", values_v)]
        if self.settings.paper_chain_trials:
            name = "step trials with the paper's sensing chain"
            carrier_v = self.settings.paper_chain_carrier_v
            drives.append(Drive(name, values_v, carrier_v=carrier_v))
        return drives

    def check(self) -> None:
        """See `Experiment`: the trials in open loop that the fit of the chirp needs."""
        if not self.settings.open_trials and self.study.has("chirp"):
            raise InputError(
                "steps.open_trials is 0, but the fit of [chirp] needs trials in open loop. Use at "
                "least 1, or remove [chirp]."
            )

    def seconds(self, rig: RigDescription) -> float:
        """See `Experiment`."""
        s = self.settings
        return len(self.recordings()) * (s.rest_s + s.zero_s + s.step_s)

    def play(self, player: Player) -> None:
        """See `Experiment`."""
        steps, analysis = self.settings, player.analysis
        to_volt, limits_v = analysis.to_play(Maps).voltage_map, analysis.rig.drive_limits
        if steps.open_trials:
            require_open_steps(to_volt, steps.step, limits_v.low, limits_v.high)
        for name in open_names(self.study):
            player.settle(0.0, steps.rest_s)
            drive_v = to_volt.voltage_v(step_reference(steps))
            # Zero strain may be just outside the drive.
            player.play(name, np.clip(drive_v, limits_v.low, limits_v.high), steps.frame_rate_hz)
        player.rest()  # while the controllers are designed
        for group, loop in self._loops(analysis).items():
            saturates = group == "saturating"
            reference = saturating_reference(steps) if saturates else step_reference(steps)
            for name in closed_names(self.study, group):
                player.settle(0.0, steps.rest_s)
                player.close_loop(name, reference, loop, steps.frame_rate_hz)

    def _loops(self, analysis: Analysis) -> dict[str, LoopSettings]:
        """Settings of the closed loops, by group of trials; an own controller needs no design."""
        maps, steps = analysis.to_play(Maps), self.settings
        loops = analysis.repeated(Loops) or analysis.find(Loops)
        own, by_video = own_controller(self.study), steps.feedback == "video"
        video_zero_px = maps.length_m / analysis.rig.scale_m_per_px if by_video else None
        if loops is None:
            if own is None:
                return {}
            saturation = loop_saturation(self.study, analysis.rig, maps.voltage_map)
            alone = LoopSettings(
                own, saturation, maps.voltage_map, maps.strain_map, video_zero_px,
                actuator=analysis.find(KnownActuator),
            )  # fmt: skip
            return {OWN: alone}
        feedthrough = loops.setting.feedthrough or math.nan
        pi = LoopSettings(
            loops.pi.controller(),
            loops.setting.saturation,
            maps.voltage_map,
            replace(maps.strain_map, feedthrough=feedthrough),
            video_zero_px,
        )
        found = {
            "pi": pi,
            "pid": replace(pi, controller=loops.pid.controller()),
            "late": replace(
                pi,
                controller=loops.delayed_pi.controller(),
                extra_delay_blocks=steps.extra_delay_blocks,
            ),
            "saturating": pi,
        }
        if steps.paper_chain_trials:
            found["printed"] = replace(
                pi,
                printed_chain=True,
                carrier_v=steps.paper_chain_carrier_v,
                strain_map=analysis.to_play(PrintedChain).strain_map,
                video_zero_px=None,
            )
        if own is not None:
            found[OWN] = replace(pi, controller=own, actuator=analysis.find(KnownActuator))
        return found

    def fit(self, analysis: Analysis) -> ExperimentResult:
        """See `Experiment`; without a design, the open loop and the study's own controller."""
        maps, scale = analysis.need(Maps), analysis.rig.scale_m_per_px
        opened = [analysis.observe(name) for name in open_names(self.study)]
        try:
            loops = analysis.need(Loops)
        except ResultError as reason:  # also a design that failed
            own, lost = self._closed_trials(analysis, (OWN,))
            alone = compare_trials({"open loop": opened, **own}, maps, self.study, scale)
            alone = replace(alone, failed={**lost, **alone.failed})
            missing = {
                key: alone.reason(key) or str(reason)
                for key in self.rows() if key not in alone.quantities
            }  # fmt: skip
            return ExperimentResult(
                alone.quantities, alone.notes, figures=alone.figures, values=(alone,),
                missing=missing,
            )  # fmt: skip
        seen, lost = self._closed_trials(analysis, (*_CLOSED, OWN))
        closed = {name: seen[group] for group, name in _COMPARED.items() if group in seen}
        found = compare_trials({"open loop": opened, **closed}, maps, self.study, scale)
        found = replace(found, failed={**lost, **found.failed})
        predictions = self._predictions(analysis, loops, found)
        further = further_trials(seen, found.groups.get("PI"), maps, loops, self.study, scale)
        reasons = {key: why for key in self.rows() if (why := found.reason(key))}
        return ExperimentResult(
            {**found.quantities, **further.quantities},
            {**found.notes, **further.notes},
            figures={
                **found.figures,
                **further.figures,
                "steps": {**table_at(found.figures, "steps"), **predictions},
            },
            values=(found,),
            missing={**reasons, **further.missing, **rows_without(lost)},
        )

    def _predictions(self, analysis: Analysis, loops: Loops, found: Comparison) -> JsonObject:
        """Metrics that the plant predicts, and what the strain map explains of final errors."""
        plant = analysis.need(Dynamics).plant
        predictions: JsonObject = {"predicted": predicted_metrics(found.groups, plant, loops)}
        if self.settings.feedback == "capacitance":
            closed = {name: seen for name, seen in found.groups.items() if name in ("PI", "PID")}
            predictions["map_error"] = map_errors(closed)
        return predictions

    def _closed_trials(
        self, analysis: Analysis, groups: Sequence[str]
    ) -> tuple[dict[str, Sequence[Observation]], dict[str, str]]:
        """The trials in closed loop by group, and why others are missing if the run ended early."""
        seen: dict[str, Sequence[Observation]] = {}
        lost: dict[str, str] = {}
        for group in groups:
            try:
                if names := closed_names(self.study, group):
                    seen[group] = [analysis.observe(name) for name in names]
            except ResultError as reason:
                lost[_COMPARED.get(group, group)] = str(reason)
        return seen, lost

    def rows(self) -> Mapping[str, Quantity]:
        """See `Experiment`."""
        own = ("rise", "overshoot", "error") if own_names(self.study) else ()
        return paper_rows(
            "S10.", "S22.saturated_", "S22.recovery_", "S24.", "S25.rise_pid", "S25.overshoot_pid",
            "S25.error_pid", *(f"S25.{name}_own" for name in own),
        )  # fmt: skip
