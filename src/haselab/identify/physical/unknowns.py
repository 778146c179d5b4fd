"""The numbers that a joint fit estimates: the law's parameters, and those of the instruments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import (
    ADDED_INERTIA,
    DRIFT_LIMITS,
    DRIFT_TIMES,
    DRIFTS,
    ActuatorLaw,
    Scales,
    with_parameters,
)

__all__ = [
    "CAMERA_LATENCY",
    "CAMERA_OFFSET",
    "CAMERA_SCALE",
    "INSTRUMENTS",
    "SENSING_LATENCY",
    "SENSING_SCALE",
    "START_HYSTERESIS",
    "Unknowns",
    "fitted_parameters",
    "shares_of",
    "usual",
]

Floats = NDArray[np.float64]
CAMERA_LATENCY = "camera.latency_s"
CAMERA_OFFSET = "camera.offset_m"
CAMERA_SCALE = "camera.scale"
SENSING_LATENCY = "sensing.latency_s"
SENSING_SCALE = "sensing.scale"
START_HYSTERESIS = "start.hysteresis_n"  # force at the first edge, which the loading left behind
INSTRUMENTS = (CAMERA_LATENCY, CAMERA_OFFSET, CAMERA_SCALE, SENSING_LATENCY, SENSING_SCALE)
_SCALES = {CAMERA_SCALE, SENSING_SCALE}  # 1 where they are not estimated; 0 for the others
# how far a start value may be off: over its distance from its lower bound, or in the unit
_WIDTH = 0.4
_LEAST_WIDTH = 0.02
_WIDTHS = {CAMERA_LATENCY: 2e-3, CAMERA_OFFSET: 1e-3, CAMERA_SCALE: 1e-3, SENSING_LATENCY: 2e-3,
           SENSING_SCALE: 0.05, START_HYSTERESIS: 0.1,
           **{name: 3e-5 for name in DRIFTS if name not in DRIFT_TIMES}}  # fmt: skip
_INERTIA_WIDTH = 0.1  # of the mass
_AT_LIMIT = 1e-6  # relative distance from a limit


def fitted_parameters(law: ActuatorLaw) -> dict[str, float]:
    """Parameters of a law that a joint fit estimates, with their present values.

    A parameter of 0 switches its effect off and stays 0; so do the time constants of branches and
    charge without a share, and the width of a hysteresis without a force.

    Args:
        law: to start from.
    Returns:
        Values by name, see `with_parameters`.
    Example:
        >>> from haselab.actuators import DeaStack
        >>> list(fitted_parameters(DeaStack()))[:2]
        ['actuator.layer_thickness_m', 'actuator.shear_modulus_pa']
    """
    found: dict[str, float] = {}
    for about in law.described():
        if not about.fitted:
            continue
        value = getattr(law, about.name)
        if isinstance(value, tuple):
            found |= {f"{about.key}[{k}]": part for k, part in enumerate(value)}
        else:
            found[about.key] = value
    idle = {name for name, value in found.items() if value == 0.0}
    return {name: value for name, value in found.items() if not idle & {name, *shares_of(name)}}


def shares_of(name: str) -> tuple[str, ...]:
    """The share or force without which a time constant, width or stretch has no effect.

    Args:
        name: of a parameter.
    Returns:
        Possible names; the name itself if it is no such parameter.
    """
    return (
        name.replace("relaxation_s", "share"),
        name.replace("relaxation_s", "relaxation_share"),
        name.replace("hysteresis.width", "hysteresis.force_n"),
        name.replace("hysteresis_width", "hysteresis_n"),
        name.replace("mullins.stretch", "mullins.share"),
        name.replace("mullins.width", "mullins.share"),
    )


def usual(name: str) -> float:
    """Value of a number of the instruments that is not estimated: 1 of a scale, 0 of others."""
    return 1.0 if name in _SCALES else 0.0


@dataclass(frozen=True)
class Unknowns:
    """Names, scales and values of what a fit estimates.

    Positive parameters of the law vary by their logarithm or by a power of their inverse, all
    others by their value.

    Args:
        law: to start from; parameters that are not estimated stay those of this law.
        names: of the parameters of the law, of `ADDED_INERTIA`, of those of `DRIFTS` that the
            records show, of `INSTRUMENTS` and, with hysteresis, of `START_HYSTERESIS`.
        values: in their units. Shape `(P,)`.
        mass_kg: hung mass, the scale of an added inertia.
    """

    law: ActuatorLaw
    names: tuple[str, ...]
    values: Floats
    mass_kg: float

    @classmethod
    def of(
        cls,
        law: ActuatorLaw,
        *,
        added_inertia_kg: float,
        mass_kg: float,
        drifts: Mapping[str, float] = MappingProxyType({}),
    ) -> Unknowns:
        """All numbers that can be estimated for a law, with some of `DRIFTS`."""
        values = fitted_parameters(law)
        more = (START_HYSTERESIS,) if law.losses.hysteresis_n > 0.0 else ()
        names = (*values, ADDED_INERTIA, *drifts, *INSTRUMENTS, *more)
        start = [
            *values.values(),
            added_inertia_kg,
            *drifts.values(),
            *map(usual, (*INSTRUMENTS, *more)),
        ]
        return cls(law, names, np.array(start, dtype=np.float64), mass_kg)

    @property
    def law_names(self) -> tuple[str, ...]:
        """Those of which the motion depends, in order; they come first."""
        others = (*INSTRUMENTS, START_HYSTERESIS)
        return tuple(name for name in self.names if name not in others)

    def with_law(self, law: ActuatorLaw, drifts: Mapping[str, float]) -> Unknowns:
        """All numbers of another law and other drifts, with the values of these where they are.

        Args:
            law: with effects that this one lacks, or without some of its own.
            drifts: all that are estimated; the values of these here count.
        """
        full = Unknowns.of(
            law, added_inertia_kg=self.value(ADDED_INERTIA), mass_kg=self.mass_kg, drifts=drifts
        ).at(self)
        known = [name for name in INSTRUMENTS if name not in self.names]
        return full.without(known) if known else full

    @property
    def drifts(self) -> dict[str, float]:
        """Slow changes with the record's time, see `DRIFTS`."""
        return {name: self.value(name) for name in self.names if name in DRIFTS}

    @property
    def _scales(self) -> Scales:
        found = Scales.of(self.law, self.names)
        positive = np.array([name in _SCALES for name in self.names])
        return Scales(found.by_logarithm | positive, found.inverse_exponent)

    @property
    def by_logarithm(self) -> NDArray[np.bool_]:
        """Which of them vary by their logarithm. Shape `(P,)`."""
        return self._scales.by_logarithm

    @property
    def inverse_exponent(self) -> Floats:
        """Power of the inverse by which they vary; 0 of others. Shape `(P,)`."""
        return self._scales.inverse_exponent

    @property
    def widths(self) -> Floats:
        """How far the start may be off, in what varies. Shape `(P,)`."""
        widths = {ADDED_INERTIA: _INERTIA_WIDTH * self._inertia_kg, **_WIDTHS}
        about = {one.key: one for one in self.law.described()}
        for name, value in zip(self.names, self.values.tolist(), strict=True):
            known = about.get(name.partition("[")[0])
            if known is not None and value > 0.0 and not known.inverse_exponent:
                widths[name] = max(_WIDTH * (1.0 - known.low / value), _LEAST_WIDTH)
        found = np.array([widths.get(name, _WIDTH) for name in self.names])
        power = self.inverse_exponent
        inverse = power > 0.0
        found[inverse] *= power[inverse] / self.values[inverse] ** power[inverse]
        return found

    @property
    def vague_widths(self) -> Floats:
        """The same, but of an inverse at least that at the default of the kind.

        Near its highest value, where the inverse is 0, its own width would be as good as 0,
        and a parameter that nobody knows would look known. Shape `(P,)`.
        """
        usual_law, found = type(self.law)(), self.widths
        fields = {about.key: about.name for about in self.law.described()}
        power = self.inverse_exponent
        for k in np.flatnonzero(power):
            default = float(getattr(usual_law, fields[self.names[k]]))
            found[k] = max(found[k], power[k] * _WIDTH / default ** power[k])
        return found

    @property
    def _inertia_kg(self) -> float:
        return self.mass_kg + self.value(ADDED_INERTIA)

    @property
    def slopes(self) -> Floats:
        """Change of the values per change of what varies. Shape `(P,)`."""
        return self._scales.slopes(self.values)

    @property
    def limits(self) -> tuple[Floats, Floats]:
        """Smallest and largest value of each; infinite where there is no limit. Shapes `(P,)`."""
        ends = {about.key: (about.low, about.high) for about in self.law.described()}
        ends |= DRIFT_LIMITS
        found = [ends.get(name.partition("[")[0], (-np.inf, np.inf)) for name in self.names]
        low, high = np.array(found, dtype=np.float64).reshape(-1, 2).T
        return low, high

    def at_limit(self, step: Floats) -> NDArray[np.bool_]:
        """Which of them are at a limit that a step would cross.

        Args:
            step: changes of what varies. Shape `(P,)`.
        """
        (low, high), change = self.limits, self.slopes * step
        near = 1.0 + _AT_LIMIT
        return ((self.values <= low * near) & (change < 0.0)) | (
            (self.values * near >= high) & (change > 0.0)
        )

    def within_limits(self) -> Unknowns:
        """The same with values beyond a limit moved to it."""
        return Unknowns(self.law, self.names, np.clip(self.values, *self.limits), self.mass_kg)

    def value(self, name: str) -> float:
        """Value of one of them; an instrument's default where it is not estimated."""
        if name in self.names:
            return float(self.values[self.names.index(name)])
        return usual(name)

    def moved(self, step: Floats) -> Unknowns:
        """Change what varies.

        Args:
            step: changes. Shape `(P,)`.
        """
        values = self._scales.moved(self.values, step)
        return Unknowns(self.law, self.names, values, self.mass_kg)

    def distance(self, other: Unknowns) -> Floats:
        """What varies here minus there, of the same names. Shape `(P,)`."""
        return self._scales.varying(self.values) - self._scales.varying(other.values)

    def without(self, names: Sequence[str]) -> Unknowns:
        """Keep some of them at their present values."""
        kept = np.array([name not in names for name in self.names])
        return Unknowns(
            self.present_law(),
            tuple(name for name in self.names if name not in names),
            self.values[kept],
            self.mass_kg,
        )

    def at(self, other: Unknowns) -> Unknowns:
        """These numbers with the values of others where those have them."""
        known = dict(zip(other.names, other.values.tolist(), strict=True))
        pairs = zip(self.names, self.values.tolist(), strict=True)
        values = np.array([known.get(name, value) for name, value in pairs])
        return Unknowns(self.law, self.names, values, self.mass_kg)

    def present_law(self) -> ActuatorLaw:
        """The law with the present values.

        Raises:
            LimitError: A value is outside its limits.
        """
        law_values = dict(zip(self.law_names, self.values.tolist(), strict=False))
        return with_parameters(self.law, law_values)
