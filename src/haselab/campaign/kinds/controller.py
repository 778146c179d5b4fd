"""Case kind `controller`: a task of the scoreboard on a device that the controller does not know.

The controller is designed from the model of the public device of the task, as on the scoreboard.
The twin that is played may differ from it in every parameter.
"""

from __future__ import annotations

import copy
import functools
import math
from dataclasses import replace

import numpy as np
from pydantic import Field

from haselab.base import HaselabError, InputError, ResultError
from haselab.campaign.kinds.base_files import LABELS, TWIN, twin_of
from haselab.campaign.kinds.case_kind import CaseKind, Inputs, Results
from haselab.controllers import CONTROLLERS, KnownActuator
from haselab.scoreboard.board import known_in_class, seeded
from haselab.scoreboard.devices import find_device
from haselab.scoreboard.entrants import Designed, designed, entering_kinds
from haselab.scoreboard.knowledge import identified, known_by
from haselab.scoreboard.loop_class import CLASSES
from haselab.scoreboard.plant import WITHOUT_EFFECT
from haselab.scoreboard.play import Scenario, play
from haselab.scoreboard.tasks import TASKS
from haselab.scoreboard.tasks.task import Task
from haselab.store.toml import Section

__all__ = ["CONTROLLER", "ControllerSettings"]

_OVER_FIELD = 1.02  # of the permitted field: what a sensed length may miss, as on the scoreboard
_MONITORS = (
    "twin.acquisition.rate_hz", "twin.acquisition.bits", "twin.acquisition.range_v",
    "twin.acquisition.v_noise_v", "twin.acquisition.i_noise_v",
    "twin.amplifier.volt_per_monitor_volt", "twin.amplifier.ampere_per_monitor_volt",
)  # fmt: skip


class ControllerSettings(Section):
    """The task, and what plays it."""

    task: str = Field("T1", description="of the scoreboard", examples=["T3"])
    controller: str = Field("pi", description="kind of controller", examples=["observer"])
    loop: str = Field("host-100hz", description="class of the loop", examples=["chip-1khz"])


class _Controller(CaseKind):
    name = "controller"
    files = (TWIN,)
    settings = ControllerSettings
    ignored = (
        *LABELS,
        *(f"twin.{key}" for key in WITHOUT_EFFECT),
        "twin.acquisition.output_delay_s",  # the class of the loop has its own timing and limits
        "twin.actuator.series_ohm", "twin.actuator.leakage_ohm",
    )  # fmt: skip

    def ignored_by(self, inputs: Inputs) -> tuple[str, ...]:
        """See `CaseKind`: a loop may have a noise of its own, instead of that of the monitors."""
        loop = CLASSES.get(inputs.settings(ControllerSettings).loop)
        return () if loop is None or loop.relative_noise is None else _MONITORS

    def check(self, inputs: Inputs) -> None:
        case, twin = inputs.settings(ControllerSettings), twin_of(inputs)
        for what, name, names in (("task", case.task, TASKS), ("loop", case.loop, CLASSES)):
            if name not in names:
                raise InputError(
                    f"case.{what} is {name!r}, but must be one of {', '.join(names)}. Change it."
                )
        task, loop = TASKS[case.task], CLASSES[case.loop]
        (kind,) = entering_kinds((case.controller,))
        if task.drawn:
            raise InputError(
                f"The task {task.name} draws its own devices, so the twin of the campaign would "
                "have no effect. Choose another case.task."
            )
        if case.loop not in task.classes or not loop.suits(kind):
            raise InputError(
                f"The controller {kind.name!r} does not play {task.name} in the loop {case.loop}. "
                "Change case.loop."
            )
        needed = find_device(task.device).config.kind
        if twin.kind != needed:
            raise InputError(
                f"The twin has kind = {twin.kind!r}, but the task {task.name} is played on a "
                f"{needed}. Change base.twin or case.task."
            )

    def compute(self, inputs: Inputs, rng: np.random.Generator) -> Results:
        self.check(inputs)
        case = inputs.settings(ControllerSettings)
        task, loop = TASKS[case.task], CLASSES[case.loop]
        known = known_in_class(_known(task.device), find_device(task.device), loop)
        design = _design(case.controller, case.loop, task.device)
        if design.chosen is None:
            raise ResultError(f"Controller {case.controller!r} has {design.reason}")
        twin = twin_of(inputs)
        scenario = _scenario(task, known, twin.load.mass_kg, rng)
        scenario = replace(scenario, device=replace(scenario.device, config=twin))
        with seeded(_entropy(rng)):
            trace = play(scenario, design.chosen, loop, known, rng)
        done = {} if trace.failure else dict(task.score(trace, scenario))
        too_high = trace.peak_field_v_per_m > _OVER_FIELD * scenario.device.field_v_per_m
        return {
            **{metric.name: _or_worst(done.get(metric.name, math.nan)) for metric in task.metrics},
            "violates": float(bool(trace.failure) or too_high),
        }


def _scenario(
    task: Task, known: KnownActuator, mass_kg: float, rng: np.random.Generator
) -> Scenario:
    """The task, whose changes of the load are relative to the mass that hangs on the twin."""
    again = copy.deepcopy(rng)
    asked = task.scenario(known, rng)
    return task.scenario(replace(known, mass_kg=mass_kg), again) if asked.loads else asked


def _entropy(rng: np.random.Generator) -> list[int]:
    """Numbers of a case for other generators; its own does not change."""
    return [int(number) for number in rng.bit_generator.seed_seq.generate_state(4)]


def _or_worst(number: float) -> float:
    """A number of a task; what was not done is worse than any number."""
    return math.inf if math.isnan(number) else number


@functools.cache
def _known(device: str) -> KnownActuator:
    """What controllers know of a public device; the same in every process."""
    public = find_device(device)
    return known_by(public, identified(public))


@functools.cache
def _design(controller: str, loop: str, device: str) -> Designed:
    known = known_in_class(_known(device), find_device(device), CLASSES[loop])
    try:
        with seeded([0]):
            return designed(CONTROLLERS.find(controller), CLASSES[loop], known)
    except HaselabError as error:
        return Designed(None, f"no design: {error}")


CONTROLLER = _Controller()
