r"""Estimates that absorb a wrong mass, voltage, time or length, which leaves no residuals.

A mass stated $a$ times too high makes all forces $a$ times too large: stiffnesses, damping and,
without capacitances, the permittivity grow by $a$, and the lengths are explained as well as before.
A gain, a unit of the times or of the lengths have other patterns. With the logarithm $l_k$ of each
estimate over its start value, its pattern $e_k$ and the deviation $s_k$ that start values have, the
factor minimises

$\sum_k \min\left(\frac{(l_k - e_k \ln a)^2}{s_k^2}, b\right)$

where $b$ bounds the weight of a parameter whose start value is far off for a reason of its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import ADDED_INERTIA, ActuatorLaw
from haselab.identify.physical.result import ActuatorFit
from haselab.identify.physical.unknowns import fitted_parameters

__all__ = ["judge_estimates"]

Floats = NDArray[np.float64]
_INERTIA = "inertia"
_PERMITTIVITY = "permittivity"
# power with which each quantity grows with the factor of a wrong statement, by its unit
_FORCES = {"Pa": 1.0, "N/m": 1.0, "N s/m": 1.0, "N": 1.0, "N m^2": 1.0}
_PATTERNS: dict[str, dict[str, float]] = {
    "mass": {**_FORCES, _PERMITTIVITY: 1.0},
    "gain": {"V": 1.0, _PERMITTIVITY: -2.0},
    "time": {"s": 1.0, "N s/m": 1.0, _INERTIA: 2.0},
    "length": {"m": 1.0, "N/m": -1.0, "N s/m": -1.0, _INERTIA: -1.0},
}
# logarithm by which a start value may be off: one standard deviation
_STDS = {"m": 0.1, "s": 0.6, _PERMITTIVITY: 0.25, _INERTIA: 0.1}
_STD = 0.35
_BOUND = 9.0  # b
_DECISIVE = 8.0  # by which the factor must lower the sum
_LEFT = 3.0  # mean of the sum that it may leave
_LOGARITHMS = np.arange(-9.2, 9.2, 0.02)  # of the factors that are tried
_LEAST = {"mass": 2, "gain": 1, "time": 2, "length": 1}  # parameters of a pattern
_NOTED = {"mass": 1.6, "gain": 1.6, "time": 3.0, "length": 1.4}  # factor of a note
_REFUSED = {"mass": 4.0, "gain": 2.2}  # and from which the numbers would mean nothing
_LIGHT, _SURE = 0.2, 2.5  # inertia that lacks, over the hung mass; over its standard deviation
_SAYS = {
    "mass": "A mass that is stated {factor} times too {more} has the same effect",
    "gain": "A voltage, or a gain of the amplifier, that is stated {factor} times too {more} has "
    "the same effect",
    "time": "Times that are stated {factor} times too {more}, as in a wrong unit, have the same "
    "effect",
    "length": "Lengths that are stated {factor} times too {more}, or a wrong scale of the camera, "
    "have the same effect",
}


def judge_estimates(
    start: ActuatorLaw, fit: ActuatorFit, *, start_inertia_kg: float, sensed: bool
) -> tuple[str, str]:
    """Say what the estimates have absorbed, if they cannot be those of an actuator near the start.

    Args:
        start: where the fit began.
        fit: with parameters.
        start_inertia_kg: without weight, where it began.
        sensed: whether capacitances were recorded.
    Returns:
        Why there can be no numbers, and a note; at most one of them is not empty.
    """
    if fault := _too_light(start, fit):
        return fault, ""
    found = _absorbed(_moved(start, fit, start_inertia_kg, sensed=sensed))
    if found is None:
        return "", ""
    said = found.said
    if found.size > _REFUSED.get(found.cause, math.inf):
        return (
            f"the estimates are not plausible: {said[0].lower()}{said[1:]}. If it is right, start "
            "nearer, by [actuator.parameters]"
        ), ""
    return "", f"{said}; these records cannot tell the difference. Check it."


def _too_light(start: ActuatorLaw, fit: ActuatorFit) -> str:
    """Whether less moves than hangs."""
    added, own_kg = fit.parameters[ADDED_INERTIA], start.moving_mass_kg
    lacking_kg = -(added.value + own_kg)
    # also of one that is not identifiable, whose stated deviation is infinite
    at = list(fit.parameters).index(ADDED_INERTIA)
    std_kg = math.sqrt(float(fit.covariance[at, at]))
    if not lacking_kg > max(_LIGHT * fit.mass_kg, _SURE * std_kg):
        return ""
    share = max(1.0 - lacking_kg / fit.mass_kg, 1e-6)
    return (
        f"the estimates are not plausible: {ADDED_INERTIA} is {added.value:.3g} kg, so only "
        f"{share:.2g} times the hung mass of {fit.mass_kg:.3g} kg would move. The times are stated "
        f"about {math.sqrt(share):.2g} times, or the lengths about {1.0 / share:.2g} times the "
        "true ones, or a mass is wrong. Check their units and the frame rate"
    )


@dataclass(frozen=True)
class _Moved:
    """An estimate over its start value."""

    name: str
    quantity: str  # unit, or what it is
    logarithm: float
    std: float


def _moved(
    start: ActuatorLaw, fit: ActuatorFit, start_inertia_kg: float, *, sensed: bool
) -> list[_Moved]:
    """All that are identifiable and whose unit shows what a wrong statement does to them."""
    units = {about.key: about.unit for about in start.described()}
    found = []
    for name, value in fitted_parameters(start).items():
        if name in fit.not_identifiable or name not in fit.parameters or not value > 0.0:
            continue
        estimate = fit.parameters[name]
        key = name.partition("[")[0]
        quantity = units[key] or (_PERMITTIVITY if key.endswith(_PERMITTIVITY) else "")
        if quantity == _PERMITTIVITY and sensed:
            continue
        if quantity and estimate.value > 0.0:
            std = math.hypot(_STDS.get(quantity, _STD), estimate.std / estimate.value)
            found.append(_Moved(name, quantity, math.log(estimate.value / value), std))
    own_kg = start.moving_mass_kg + fit.mass_kg
    added = fit.parameters[ADDED_INERTIA]
    total_kg = own_kg + added.value
    if ADDED_INERTIA not in fit.not_identifiable and total_kg > 0.0:
        std = math.hypot(_STDS[_INERTIA], added.std / total_kg)
        logarithm = math.log(total_kg / (own_kg + start_inertia_kg))
        found.append(_Moved("the moving inertia", _INERTIA, logarithm, std))
    return found


@dataclass(frozen=True)
class _Absorbed:
    """A wrong statement that explains how the estimates differ from their start values."""

    cause: str
    logarithm: float
    by: tuple[str, ...]

    @property
    def size(self) -> float:
        """The factor, or its inverse: above 1."""
        return math.exp(abs(self.logarithm))

    @property
    def said(self) -> str:
        """The parameters, and what has the same effect."""
        text = _SAYS[self.cause].format(
            factor=f"{self.size:.2g}", more="high" if self.logarithm > 0.0 else "low"
        )
        one = len(self.by) == 1
        return (
            f"{' and '.join([', '.join(self.by[:-1]), self.by[-1]] if not one else self.by)} "
            f"{'differs' if one else 'differ'} from the start values as if by one factor. {text}"
        )


def _absorbed(moved: list[_Moved]) -> _Absorbed | None:
    """The wrong statement that explains most, if it explains nearly all."""
    logarithms = np.array([one.logarithm for one in moved])
    stds = np.array([one.std for one in moved])
    if not moved:
        return None
    before = float(_bounded(logarithms / stds).sum())
    best: tuple[float, _Absorbed] | None = None
    for cause, pattern in _PATTERNS.items():
        powers = np.array([pattern.get(one.quantity, 0.0) for one in moved])
        off = (logarithms - np.outer(_LOGARITHMS, powers)) / stds
        sums = _bounded(off).sum(axis=1)
        k = int(np.argmin(sums))
        explained = (powers != 0.0) & (np.abs(off[k]) < math.sqrt(_BOUND))
        explained &= np.abs(logarithms / stds) > np.abs(off[k])
        names = tuple(one.name for one, one_of in zip(moved, explained, strict=True) if one_of)
        # a stiffer material leaves the permittivity; a wrong mass does not, see the first lines
        electric = any(
            one_of and one.quantity == _PERMITTIVITY
            for one, one_of in zip(moved, explained, strict=True)
        )
        if (
            (electric or cause != "mass")
            and len(names) >= _LEAST[cause]
            and abs(_LOGARITHMS[k]) > math.log(_NOTED[cause])
            and before - sums[k] > _DECISIVE
            and sums[k] < _LEFT * len(moved)
            and (best is None or sums[k] < best[0])
        ):
            best = float(sums[k]), _Absorbed(cause, float(_LOGARITHMS[k]), names)
    return None if best is None else best[1]


def _bounded(values: Floats) -> Floats:
    return np.minimum(values**2, _BOUND)
