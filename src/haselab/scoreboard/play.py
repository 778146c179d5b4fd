"""One controller plays one task on one device, update by update."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, SafetyError, described, is_real
from haselab.base.exits import no_exit
from haselab.controllers import (
    ChosenController,
    ControllerSetting,
    KnownActuator,
    Measurement,
)
from haselab.runtime.loop import RunningController
from haselab.scoreboard.devices import Device
from haselab.scoreboard.loop_class import STEP_S, LoopClass
from haselab.scoreboard.plant import FastPlant

__all__ = ["Scenario", "Trace", "play", "setting_for"]

Floats = NDArray[np.float64]
TRACE_S = 1e-3  # of the true strain in a trace
_SETTLE_S = 20.0  # at the voltage of the first reference, before the loop closes
_MAP_POINTS = 1001
_LATE_PERIODS, _LATE_ROW = 5.0, 5
_WAITS = 0.01  # share of the processor below which a step waits by itself


@dataclass(frozen=True)
class Scenario:
    """A task on one device.

    Args:
        device: true.
        zero_m: length at strain 0.
        duration_s: scored, from time 0.
        reference: desired strain at times, which may be before 0. Shape `(N,)` to `(N,)`.
        loads: times and hung masses from then on, rising.
        events: times, desired strains before and after, of the steps that are scored.
        lead_s: how long the loop is closed before time 0.
    """

    device: Device
    zero_m: float
    duration_s: float
    reference: Callable[[Floats], Floats]
    loads: tuple[tuple[float, float], ...] = ()
    events: tuple[tuple[float, float, float], ...] = ()
    lead_s: float = 4.0


@dataclass(frozen=True)
class Trace:
    """What happened. Times are from the beginning of the scored part.

    Args:
        time_s: every 1 ms. Shape `(N,)`.
        strain: true. Shape `(N,)`.
        update_s: beginning of each update. Shape `(K,)`.
        reference: desired strain of each update. Shape `(K,)`.
        drive_v: computed in each update. Shape `(K,)`.
        estimated_kg: by the controller; NaN where it gives none. Shape `(K,)`.
        peak_field_v_per_m: largest field.
        failure: why the task ended early; empty: it did not.
        step_s: mean processor time of a step of the controller.
    """

    time_s: Floats
    strain: Floats
    update_s: Floats
    reference: Floats
    drive_v: Floats
    estimated_kg: Floats
    peak_field_v_per_m: float
    failure: str = ""
    step_s: float = field(default=math.nan, compare=False)

    def between(self, from_s: float, to_s: float) -> tuple[Floats, Floats]:
        """Times and true strains of a part."""
        first, last = np.searchsorted(self.time_s, [from_s - 1e-9, to_s - 1e-9])
        return self.time_s[first:last], self.strain[first:last]

    def wanted(self, time_s: Floats) -> Floats:
        """Desired strain at times: that of the update that was under way."""
        at = np.searchsorted(self.update_s, time_s + 1e-9, side="right") - 1
        return self.reference[np.maximum(at, 0)]


def setting_for(
    chosen: ChosenController, loop: LoopClass, known: KnownActuator, start_v: float
) -> ControllerSetting:
    """Timing and limits of a loop on the scoreboard, for a controller.

    Args:
        chosen: the controller.
        loop: class.
        known: identified actuator.
        start_v: drive before the first step.
    """
    if chosen.kind.output == "voltage":
        low, high, start = known.low_v, known.high_v, start_v
    else:
        low, high = known.reachable()
        start = 0.0
    if loop.relative_noise is not None:
        farad = known.sensing_scale * known.static_capacitance_f(0.0)
        known = replace(known, capacitance_noise_f=loop.relative_noise * farad)
    rate = loop.slew_of(chosen.kind) if chosen.kind.output == "voltage" else math.inf
    return ControllerSetting(
        loop.period_s, low, high, start, loop.delay_s, known, loop.sensed_before_s, rate
    )


class _Player:
    """A controller, and the way from what it returns to a voltage."""

    def __init__(
        self, chosen: ChosenController, loop: LoopClass, known: KnownActuator, start_v: float
    ) -> None:
        setting = setting_for(chosen, loop, known, start_v)
        self._running = RunningController(chosen, setting)
        self._known, self._loop, self._in_volts = known, loop, chosen.kind.output == "voltage"
        self._slew_v = loop.slew_of(chosen.kind) * loop.period_s
        self._late = 0
        self.spent_s = 0.0
        self.drive_v = start_v
        if not self._in_volts:
            self._map_strain = np.linspace(setting.drive_low, setting.drive_high, _MAP_POINTS)
            self._map_v = np.array([known.static_drive_v(float(s)) for s in self._map_strain])

    def step(self, reference: float, measured: Measurement) -> float:
        """The voltage of the next update.

        Raises:
            SafetyError: The controller failed, or is late.
        """
        wall_s, began_s = time.perf_counter(), time.thread_time()
        found = self._running.step(reference, measured)
        spent_s, wall_s = time.thread_time() - began_s, time.perf_counter() - wall_s
        self.spent_s += spent_s
        # Other programs delay a step, which must not count. But none of them takes so much of the
        # processor: such a step sleeps, or waits for a file or for another computer.
        own_s = wall_s if spent_s < _WAITS * wall_s else spent_s
        late = own_s > _LATE_PERIODS * self._loop.period_s
        self._late = self._late + 1 if late else 0
        if self._late >= _LATE_ROW:
            raise SafetyError(
                f"{self._late} steps in a row took longer than {_LATE_PERIODS:g} periods"
            )
        if found is None:
            return self.drive_v
        wanted_v = found
        if not self._in_volts:
            wanted_v = float(np.interp(found, self._map_strain, self._map_v))
        if self._loop.drive_step_v:
            wanted_v = round(wanted_v / self._loop.drive_step_v) * self._loop.drive_step_v
        known, slew_v = self._known, self._slew_v
        low_v = max(known.low_v, self.drive_v - slew_v)
        self.drive_v = min(max(wanted_v, low_v), known.high_v, self.drive_v + slew_v)
        return self.drive_v

    def estimated_kg(self) -> float:
        """Hung mass, as the controller estimates it.

        Raises:
            SafetyError: The attribute of the controller raises an exception.
        """
        try:
            with no_exit():
                found = getattr(self._running.controller, "estimated_load_kg", math.nan)
        except Exception as error:  # code of another package may raise anything
            raise SafetyError(f"estimated_load_kg failed: {described(error)}") from error
        return float(found) if is_real(found) else math.nan


def play(
    scenario: Scenario,
    chosen: ChosenController,
    loop: LoopClass,
    known: KnownActuator,
    rng: np.random.Generator,
) -> Trace:
    """Play a task.

    Args:
        scenario: task and true device.
        chosen: controller.
        loop: class.
        known: what the controller knows.
        rng: of the sensor's noise.
    Returns:
        What happened; a controller that fails ends it early.
    """
    period_s = loop.period_s
    lead, count = round(scenario.lead_s / period_s), round(scenario.duration_s / period_s)
    update_s = period_s * np.arange(-lead, count, dtype=np.float64)
    ahead = chosen.kind.preview_steps(period_s)
    coming_s = period_s * np.arange(count, count + ahead, dtype=np.float64)
    wanted = scenario.reference(np.concatenate([update_s, coming_s])).tolist()
    reference = np.array(wanted[: update_s.size])
    plant = FastPlant(scenario.device, loop, rng, lead + count)
    plant.train()
    start_v = min(known.static_drive_v(float(reference[0])), known.high_v)
    plant.hold(start_v, _SETTLE_S)
    drives_v, estimates = np.full(lead + count, np.nan), np.full(lead + count, np.nan)
    failure, spent_s = "", math.nan
    try:
        player = _Player(chosen, loop, replace(known), start_v)
    except InputError as error:
        failure, count, lead = str(error), 0, 0
    done = 0
    loads = list(scenario.loads)
    for k in range(lead + count):
        while loads and loads[0][0] <= update_s[k] + 1e-9:
            plant.hang(loads.pop(0)[1])
        before_v = player.drive_v
        farad = plant.update(before_v)
        done = k + 1
        drives_v[k] = before_v
        if plant.broken:
            failure = plant.broken
            break
        measured = Measurement(
            known.strain(known.sensed_length_m(farad, before_v)), farad, before_v,
            float(update_s[k]) + period_s, preview=tuple(wanted[k + 1 : k + 1 + ahead]),
        )  # fmt: skip
        try:
            player.step(wanted[k], measured)
            estimates[k] = player.estimated_kg()
        except SafetyError as error:
            failure = str(error)
            break
    if done:
        spent_s = player.spent_s / done
    parts = (update_s[:done], reference[:done], drives_v[:done], estimates[:done])
    return _trace(scenario, loop, plant, failure, spent_s, parts)


def _trace(
    scenario: Scenario, loop: LoopClass, plant: FastPlant, failure: str, spent_s: float,
    updates: tuple[Floats, Floats, Floats, Floats],
) -> Trace:  # fmt: skip
    every, device = round(TRACE_S / STEP_S), scenario.device
    lengths_m = plant.true_lengths_m[every - 1 :: every]
    time_s = TRACE_S * np.arange(1.0, lengths_m.size + 1.0) - scenario.lead_s
    volt = device.config.amplifier.gain * np.abs(updates[2])
    held = np.repeat(volt, loop.steps)[every - 1 :: every][: lengths_m.size]
    gap_m = device.law.gap_m(lengths_m) if lengths_m.size else np.ones(0)
    peak = float((held / gap_m).max()) if lengths_m.size else 0.0
    return Trace(time_s, lengths_m / scenario.zero_m - 1.0, *updates, peak, failure, spent_s)
