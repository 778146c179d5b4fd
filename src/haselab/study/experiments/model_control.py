"""Closed loops with controllers that use the physical model (rows S25, S27 and S30)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from haselab.base import InputError
from haselab.control import Saturation
from haselab.controllers import CONTROLLERS, ChosenController, KnownActuator
from haselab.controllers.adaptive.hybrid import reach_of
from haselab.rig import RigDescription
from haselab.runtime.closed_loop import setting_on_rig
from haselab.runtime.loop import LoopSettings
from haselab.safety.feasibility import Drive
from haselab.signals import constant
from haselab.study.analysis import Analysis
from haselab.study.experiment import Experiment, ExperimentResult, NotPlayedError
from haselab.study.experiments.steps import step_reference
from haselab.study.fits.maps import Maps
from haselab.study.fits.model_control import (
    StepGroup,
    mass_errors,
    outer_results,
    set_points,
    step_results,
)
from haselab.study.fits.observe import Observation
from haselab.study.paper.quantity_table import paper_rows
from haselab.study.player import UPDATE_HZ, Player
from haselab.study.quantity import Quantity
from haselab.study.tables import ModelControl

__all__ = ["ModelControlTest"]

_REST, _REST_FRAMES = "rest", 15  # before anything moves, for the camera's reference
_OBSERVER, _OWN, _OTHER, _OUTER = "observer", "hybrid-own", "hybrid-other", "hybrid-outside"
_STEPS = {_OBSERVER: "observer", _OWN: "hybrid", _OTHER: "hybrid"}  # kind, by group of trials
_NOT_BEYOND = "no mass holds the actuator beyond its linear region within the permitted field."


class ModelControlTest(Experiment[ModelControl]):
    """Steps with observer and hybrid, which weighs its mass, also beyond the linear region."""

    table = "model_control"
    title = "Control with the physical model"
    settings_type = ModelControl

    def recordings(self) -> dict[str, str]:
        """See `Experiment`."""
        steps = {
            name: f"step with {kind}"
            for group, kind in _STEPS.items()
            for name in self._names(group)
        }
        outer = {_OUTER: "steps with hybrid"} if self.settings.outer_mass_kg else {}
        return {_REST: "at rest", **steps, **outer}

    def _names(self, group: str) -> list[str]:
        return [f"{group}-{k + 1}" for k in range(self.settings.trials)]

    def drives(self, rig: RigDescription) -> list[Drive]:
        """See `Experiment`; the controllers may put out any drive within the limits."""
        limits = rig.drive_limits
        return [Drive("control with the physical model", np.array([0.0, limits.high, 0.0]))]

    def masses_kg(self) -> tuple[float, ...]:
        """See `Experiment`."""
        outer_kg = self.settings.outer_mass_kg
        return (self.settings.other_mass_kg, *([] if outer_kg is None else [outer_kg]))

    def seconds(self, rig: RigDescription) -> float:
        """See `Experiment`."""
        settings = self.settings
        trial_s = settings.rest_s + settings.zero_s + settings.step_s
        outer_s = settings.rest_s + 3.0 * settings.hold_s if settings.outer_mass_kg else 0.0
        rest_s = settings.rest_s + _REST_FRAMES / settings.frame_rate_hz
        return rest_s + len(_STEPS) * settings.trials * trial_s + outer_s

    def play(self, player: Player) -> None:
        """See `Experiment`."""
        settings, analysis = self.settings, player.analysis
        rest_s = _REST_FRAMES / settings.frame_rate_hz
        player.settle(0.0, settings.rest_s)
        player.play(_REST, constant(0.0, rest_s, UPDATE_HZ), settings.frame_rate_hz)
        for group, kind in _STEPS.items():
            if group == _OTHER:
                player.load(settings.other_mass_kg)
            for name in self._names(group):
                player.settle(0.0, settings.rest_s)
                loop = self._loop(analysis, kind)
                player.close_loop(name, step_reference(settings), loop, settings.frame_rate_hz)
        if (points := self._points(analysis)) and settings.outer_mass_kg:
            player.load(settings.outer_mass_kg)
            player.settle(0.0, settings.rest_s)
            wanted = np.concatenate([constant(s, settings.hold_s, UPDATE_HZ) for s in points])
            loop = self._loop(analysis, "hybrid")
            player.close_loop(_OUTER, wanted, loop, settings.frame_rate_hz)
        player.load(player.mass_kg)

    def fit(self, analysis: Analysis) -> ExperimentResult:
        """See `Experiment`."""
        settings, rig = self.settings, analysis.rig
        zero_m, scale_m = analysis.need(Maps).length_m, rig.scale_m_per_px
        seen = {group: self._seen(analysis, group) for group in _STEPS}
        own_kg, other_kg = (seen[group][0].mass_kg[-1] for group in (_OWN, _OTHER))
        loop = self._loop(analysis, "hybrid")
        found, notes, drawn = step_results(
            [
                StepGroup("observer", "S25.{}_observer", seen[_OBSERVER]),
                StepGroup(f"hybrid, {own_kg:g} kg", "S27.{}_own", seen[_OWN]),
                StepGroup(f"hybrid, {other_kg:g} kg", "S27.{}_other", seen[_OTHER]),
            ],
            loop, zero_m, settings, scale_m,
        )  # fmt: skip
        found |= mass_errors(
            {"S27.mass_error_own": seen[_OWN], "S27.mass_error_other": seen[_OTHER]},
            loop, rig, self.study.sensing.carrier_hz, settings.zero_s,
        )  # fmt: skip
        for name, mass_kg in (("own", own_kg), ("other", other_kg)):
            notes[f"S27.mass_error_{name}"] = (
                f"{mass_kg:g} kg hung; mean of the time after the step"
            )
        charts, missing = [drawn], {}
        if points := self._points(analysis):
            outer, chart = outer_results(
                analysis.observe(_OUTER), points, zero_m, settings, scale_m
            )
            found |= outer
            charts.append(chart)
            notes["S30.error"] = f"hybrid; {settings.outer_mass_kg:g} kg hung"
        else:
            missing = dict.fromkeys(paper_rows("S30."), _NOT_BEYOND)
        return ExperimentResult(found, notes, tuple(charts), missing=missing)

    def _seen(self, analysis: Analysis, group: str) -> Sequence[Observation]:
        return [analysis.observe(name) for name in self._names(group)]

    def rows(self) -> Mapping[str, Quantity]:
        """See `Experiment`."""
        return self.all_rows()

    @staticmethod
    def all_rows() -> Mapping[str, Quantity]:
        """The rows of any settings."""
        metrics = ("rise", "overshoot", "error")
        return paper_rows(*(f"S25.{name}_observer" for name in metrics), "S27.", "S30.")

    # ---- controllers -------------------------------------------------------------------------

    def _known(self, analysis: Analysis) -> KnownActuator:
        known, field = analysis.find(KnownActuator), self.settings.highest_field_v_per_m
        if known is None:
            raise NotPlayedError(
                "needs an actuator file with [model.physical]. Add it with --actuator A.toml."
            )
        return replace(known, highest_field_v_per_m=min(field, known.highest_field_v_per_m))

    def _reach(self, analysis: Analysis) -> tuple[float, float]:
        return reach_of(known := self._known(analysis), known.mass_kg)

    def _points(self, analysis: Analysis) -> tuple[float, ...]:
        """Strains beyond the linear region; none if no mass holds the actuator there.

        They stay where the maps are valid, which were fitted with the rig's own mass.
        """
        outer_kg = self.settings.outer_mass_kg
        if outer_kg is None:
            return ()
        try:
            low, high = reach_of(self._known(analysis), outer_kg)
        except InputError:
            return ()
        return set_points(self.settings, (low, min(high, self._reach(analysis)[1])))

    def _loop(self, analysis: Analysis, kind: str) -> LoopSettings:
        if kind not in self._loops:
            self._loops[kind] = self._make_loop(analysis, kind)
        return self._loops[kind]

    @cached_property
    def _loops(self) -> dict[str, LoopSettings]:
        return {}

    def _make_loop(self, analysis: Analysis, kind: str) -> LoopSettings:
        reach = self._reach(analysis)
        maps, limits = analysis.need(Maps), analysis.rig.drive_limits
        within = maps.voltage_map.reach(reach, limits.low, limits.high) or reach
        loop = LoopSettings(
            ChosenController(CONTROLLERS.find(kind), ()), Saturation(*within), maps.voltage_map,
            maps.strain_map, actuator=self._known(analysis),
        )  # fmt: skip
        return replace(loop, controller=self._chosen(analysis, kind, loop))

    def _chosen(self, analysis: Analysis, kind: str, loop: LoopSettings) -> ChosenController:
        found = CONTROLLERS.find(kind)
        if self.settings.parameters:
            return found.choose(self.settings.parameters)
        if kind != "observer":  # the others take its design
            return found.choose(dict(self._loop(analysis, "observer").controller.values))
        assert found.design is not None
        carrier_hz = self.study.sensing.carrier_hz
        return found.choose(found.design(setting_on_rig(analysis.rig, carrier_hz, loop)))
