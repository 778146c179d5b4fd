"""Hybrid by sensed weight: the actuator weighs its load, and the load decides how it is controlled.

An inner `observer` estimates the hung mass. From it follow

- the model: its weight and inertia, the forces that its plans may use, and the gains of the Kalman
  filter, which are those of the nearest mass of a bank;
- the reachable set-points: a desired strain is limited to what drive and field can hold with this
  mass, short of the strain at which the field pulls the actuator in;
- whether there is a feedback at all: with a mass for which no strain can be held, the drive goes to
  0 V, at which no field can harm the actuator.

Source: D. Liberzon, Switching in Systems and Control (2003), ch. 6, for the hysteresis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from haselab.base import InputError
from haselab.controllers.kind import ControllerKind
from haselab.controllers.known_actuator import KnownActuator
from haselab.controllers.observer import ObserverController
from haselab.controllers.observer_design import OBSERVER, design_observer
from haselab.controllers.observer_law import ObserverLaw
from haselab.controllers.protocol import ControllerSetting, Measurement

__all__ = ["HYBRID", "HybridController", "design_hybrid", "reach_of"]

_MODELS = (0.5, 0.7, 1.0, 1.4, 2.0)  # of the known mass
_OTHER, _PAUSE_S = 0.03, 0.1  # change of the mass that changes the model, and how soon again
_LIGHTEST, _HEAVIEST, _MASSES = 0.2, 3.0, 57  # of the known mass, of the table of set-points
_SAME = 0.01  # change of the mass that does not change the set-points
_WEIGHED_S = 0.1  # time constant of the mass
_PULL_IN = 0.02  # of the reachable range, kept from its driven end


def reach_of(known: KnownActuator, mass_kg: float) -> tuple[float, float]:
    """Strains that a hung mass leaves to the controller, the margin from pull-in taken off.

    Args:
        known: the actuator.
        mass_kg: hung.
    Raises:
        InputError: No strain can be held with this mass.
    """
    low, high = known.reachable(mass_kg)
    margin = _PULL_IN * (high - low)
    return (low, high - margin) if known.elongates else (low + margin, high)


class HybridController:
    """An `observer` whose model, set-points and feedback follow the sensed weight.

    Args:
        bandwidth_rad_s: see `ObserverController`.
        load_n: see there.
        shake_m_s2: see there.
        reserve: see there.
    """

    def __init__(
        self, bandwidth_rad_s: float, load_n: float, shake_m_s2: float, reserve: float
    ) -> None:
        self._values = bandwidth_rad_s, load_n, shake_m_s2
        self._inner = ObserverController(bandwidth_rad_s, load_n, shake_m_s2, reserve)

    def start(self, setting: ControllerSetting) -> None:
        """See `Controller`."""
        known = setting.actuator
        assert known is not None, "the kind needs it"
        self._known, self._period_s = known, setting.period_s
        self._laws = [
            (loaded.mass_kg, ObserverLaw(replace(setting, actuator=loaded), *self._values))
            for loaded in (replace(known, mass_kg=share * known.mass_kg) for share in _MODELS)
            if _holds(loaded, loaded.mass_kg)
        ]
        self._inner.start(setting)
        self._model_kg, self._pause_s = known.mass_kg, 0.0
        masses = known.mass_kg * np.linspace(_LIGHTEST, _HEAVIEST, _MASSES)
        held = [float(mass) for mass in masses if _holds(known, float(mass))]
        self._masses_kg = np.array(held)
        self._ends = np.array([reach_of(known, mass) for mass in held])
        self._low_v, self._most_v = (
            max(setting.drive_low, 0.0),
            (setting.highest_rate_per_s * setting.period_s),
        )
        self._forget = math.exp(-setting.period_s / _WEIGHED_S)
        self._mass_kg = self._set_kg = known.mass_kg
        self._reach = self._reach_with(known.mass_kg)

    @property
    def estimated_load_kg(self) -> float:
        """Hung mass, by the inner observer."""
        return self._inner.estimated_load_kg

    def step(self, reference: float, measurement: Measurement) -> float:
        """See `Controller`; without a valid measurement the observer goes on alone."""
        low, high = self._reach
        wanted = [min(max(value, low), high) for value in (reference, *measurement.preview)]
        drive_v = self._inner.step(wanted[0], replace(measurement, preview=tuple(wanted[1:])))
        self._weigh()
        if not self._holds_now():
            drive_v = max(self._low_v, measurement.voltage_v - self._most_v)
            self._inner.put_out(drive_v)
        return drive_v

    def _weigh(self) -> None:
        """Let set-points and model follow the weight."""
        sensed_kg = self._inner.estimated_load_kg
        self._mass_kg = sensed_kg + self._forget * (self._mass_kg - sensed_kg)
        if abs(self._mass_kg - self._set_kg) > _SAME * self._set_kg:
            self._set_kg = self._mass_kg
            self._reach = self._reach_with(self._mass_kg)
        self._pause_s -= self._period_s
        other = abs(self._mass_kg - self._model_kg) > _OTHER * self._model_kg
        if other and self._pause_s <= 0.0 and self._holds_now():
            self._model_kg, self._pause_s = self._mass_kg, _PAUSE_S
            law = min(self._laws, key=lambda one: abs(math.log(one[0] / self._mass_kg)))[1]
            known = replace(self._known, mass_kg=self._mass_kg)
            self._inner.exchange(known, law.hung(known))

    def _holds_now(self) -> bool:
        """Whether any strain can be held with the present weight."""
        return bool(self._masses_kg[0] <= self._set_kg <= self._masses_kg[-1])

    def _reach_with(self, mass_kg: float) -> tuple[float, float]:
        low, high = (float(np.interp(mass_kg, self._masses_kg, ends)) for ends in self._ends.T)
        return low, high


def _holds(known: KnownActuator, mass_kg: float) -> bool:
    try:
        low, high = known.reachable(mass_kg)
    except InputError:
        return False
    return high > low


def design_hybrid(setting: ControllerSetting) -> Mapping[str, float]:
    """Take the design of `observer`, which `design --controller observer` describes.

    The inverse dynamics with the sensed mass keep the error's decay the same with
    all masses, so the demands of `observer` on the peak sensitivity are those with the known mass.

    Args:
        setting: timing and limits of the loop, and the actuator.
    Returns:
        The parameters of `HybridController`.
    Raises:
        ResultError: No parameters keep the loop stable.
    """
    return design_observer(setting)


HYBRID = ControllerKind(
    "hybrid",
    HybridController,
    OBSERVER.parameters,
    output="voltage",
    needs_actuator=True,
    design=design_hybrid,
    preview_s=OBSERVER.preview_s,
)
