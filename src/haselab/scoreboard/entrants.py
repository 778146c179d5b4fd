"""The controllers that enter: each kind with the parameters of its automatic design."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass

import numpy as np

from haselab.actuators import GRAVITY_M_S2, linearise
from haselab.base import HaselabError, InputError, ResultError
from haselab.base.exits import no_exit
from haselab.control import DesignSpec, LoopSetting, Saturation, design_pid
from haselab.control.plants.general import AnyPlant
from haselab.controllers import CONTROLLERS, ChosenController, ControllerKind, KnownActuator
from haselab.models.rational import RationalModel
from haselab.scoreboard.loop_class import LoopClass
from haselab.scoreboard.play import setting_for

__all__ = ["PAPER_PI", "Designed", "designed", "entering_kinds", "plant_at_zero"]

PAPER_PI = {"kp": 0.85, "ki": 1.5}  # of the reference study
_STEP = 1e-3  # strain, of the slope of the static drive
_SMALL = 1e-9  # of the largest coefficient: rounding errors of the conversion
_SEED = 1  # of the search for gains
_ONE_SIGN = "no design: the controller needs a drive of both signs. Use the task T6-bipolar."


@dataclass(frozen=True)
class Designed:
    """A controller for one device in one class.

    Args:
        chosen: with its parameters; None: there is no design.
        reason: why there is none.
    """

    chosen: ChosenController | None
    reason: str = ""


def entering_kinds(names: tuple[str, ...] = ()) -> tuple[ControllerKind, ...]:
    """Kinds that can enter: those with a design, or with values for all parameters.

    Args:
        names: of the wanted kinds; empty: all that can enter.
    Returns:
        The kinds, by name.
    Raises:
        InputError: A kind is not registered, or lacks a design.
    """
    if names:
        kinds = [CONTROLLERS.find(name) for name in dict.fromkeys(names)]
    else:
        kinds = [kind for kind in CONTROLLERS.usable().values() if not _lacks(kind)]
    for kind in kinds:
        if lacks := _lacks(kind):
            raise InputError(
                f"Controller {kind.name!r} cannot enter the scoreboard: it has no automatic "
                f"design, and {', '.join(lacks)} without a default. Give the kind a design, "
                "or its parameters defaults."
            )
    return tuple(sorted(kinds, key=lambda kind: kind.name))


def _lacks(kind: ControllerKind) -> list[str]:
    if kind.design is not None or kind.name in ("pi", "pid"):
        return []
    return [parameter.name for parameter in kind.parameters if parameter.default is None]


def designed(kind: ControllerKind, loop: LoopClass, known: KnownActuator) -> Designed:
    """Design a controller from what is known of the actuator.

    Args:
        kind: of the controller.
        loop: class.
        known: identified actuator.
    Returns:
        The controller, or why there is none.
    """
    try:
        if kind.name == "pi":
            return Designed(kind.choose(PAPER_PI))
        if kind.name == "pid":
            return Designed(kind.choose(_pid_gains(loop, known)))
        if kind.design is None:
            return Designed(kind.choose())
        if kind.alternates and known.low_v >= 0.0:
            return Designed(None, _ONE_SIGN)
        blank = ChosenController(kind, ())
        with no_exit():
            return Designed(kind.choose(kind.design(setting_for(blank, loop, known, 0.0))))
    except HaselabError as error:
        return Designed(None, f"no design: {error}")
    except Exception as error:  # a design of another package may raise anything
        return Designed(None, f"no design: {type(error).__name__}: {error}")


def _pid_gains(loop: LoopClass, known: KnownActuator) -> dict[str, float]:
    """Gains of `haselab design` for the identified model at strain 0."""
    setting = LoopSetting(loop.period_s**-1, loop.delay_s, Saturation(*known.reachable()))
    rng = np.random.default_rng(_SEED)
    model = plant_at_zero(known)
    plant: AnyPlant = model
    with contextlib.suppress(InputError):  # a zero in the resonance
        plant = model.to_plant()  # the search is then much faster
    found = design_pid(plant, DesignSpec(), setting, rng=rng)
    if not found.nominal.margins.stable:
        raise ResultError("no stable PID was found")
    gains = found.gains
    return {"kp": gains.kp, "ki": gains.ki, "kd": gains.kd,
            "derivative_filter_s": gains.derivative_filter_s}  # fmt: skip


def plant_at_zero(known: KnownActuator) -> RationalModel:
    """The actuator about strain 0, from corrected strain to strain.

    Args:
        known: identified actuator.
    Returns:
        A rational model of static gain 1.
    """
    from scipy.signal import ss2tf  # slow to import

    volt = known.gain_v_per_v * known.static_drive_v(0.0)
    load_n, inertia_kg = GRAVITY_M_S2 * known.mass_kg, known.mass_kg + known.added_inertia_kg
    point = linearise(known.law, float(np.hypot(volt, np.sqrt(known.carrier_v2))), load_n,
                      inertia_kg, longest_m=known.longest_m or None)  # fmt: skip
    slope_v = (known.static_drive_v(_STEP) - known.static_drive_v(-_STEP)) / (2.0 * _STEP)
    b = point.b[:, None] * slope_v * known.gain_v_per_v
    top, bottom = ss2tf(point.a, b, point.c[None] / known.zero_length_m, np.zeros((1, 1)))
    row = np.where(np.abs(top[0]) < _SMALL * np.abs(top[0]).max(), 0.0, top[0])
    row = np.trim_zeros(row, "f")
    row = row * (bottom[-1] / row[-1])  # the static gain is 1 by definition
    return RationalModel(tuple(row.tolist()), tuple(bottom.tolist()))
