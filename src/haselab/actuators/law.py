r"""The base class of an actuator's physical law, and what follows from such a law.

An actuator has one length, and its free energy at a voltage states everything that is reversible:

$E(x, V) = W(x) - \int_0^V q(x, v)\,dv,\quad F = -\partial E/\partial x,\quad q = C(x, V)\,V$

A law states the elastic energy $W$ and the capacitance $C$. The forces are derivatives, so no law
can gain energy from a cycle. `Losses` states what is not reversible.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.actuators.losses import Circuit, Losses
from haselab.base import LimitError, Limits

__all__ = ["VACUUM_F_PER_M", "ActuatorLaw", "LawValues", "Parameter", "parameter"]

Floats = NDArray[np.float64]
Value = float | tuple[float, ...]
AnyValue = TypeVar("AnyValue", float, tuple[float, ...])

VACUUM_F_PER_M = 8.8541878128e-12
_STEP = 5e-4  # of the derivatives, in free lengths
_STENCIL = ((-2.0, 1.0 / 12.0), (-1.0, -8.0 / 12.0), (1.0, 8.0 / 12.0), (2.0, -1.0 / 12.0))
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(8)
_LEAST_V = 1.0  # at which the force over the voltage squared is that at 0 V
_LOSSES = {field.name for field in dataclasses.fields(Losses)}
_KEY = "haselab"


@dataclass(frozen=True)
class Parameter:
    """One parameter of a law, which a file may set and a fit may estimate.

    Args:
        name: of the field of the law.
        key: in TWIN.toml, with its table.
        unit: SI; empty for a ratio.
        low: smallest permitted value.
        high: largest permitted value.
        description: short text for people.
        fitted: whether `identify actuator` estimates it; False: measured otherwise.
        inverse_exponent: see `parameter`.
    """

    name: str
    key: str
    unit: str
    low: float
    high: float
    description: str
    fitted: bool = True
    inverse_exponent: int = 0


def parameter(
    default: AnyValue,
    *,
    unit: str,
    low: float,
    high: float,
    description: str,
    key: str = "",
    fitted: bool = True,
    inverse_exponent: int = 0,
) -> AnyValue:
    """A field of a law with its unit and limits.

    Args:
        default: value if a file does not set one; a tuple if the number of values is free.
        unit: SI; empty for a ratio.
        low: smallest permitted value.
        high: largest permitted value.
        description: short text for people.
        key: in TWIN.toml; empty: the name of the field in the table `actuator`.
        fitted: whether `identify actuator` estimates it; False: measured otherwise, such as a
            width, or without effect on motion and capacitance.
        inverse_exponent: power of its inverse in which the forces are nearly linear, such as 2 of a
            locking stretch; 0: it is varied by its logarithm.
    Returns:
        The dataclass field.
    """
    about = {
        "key": key,
        "unit": unit,
        "low": low,
        "high": high,
        "description": description,
        "fitted": fitted,
        "inverse_exponent": inverse_exponent,
    }
    field: AnyValue = dataclasses.field(default=default, metadata={_KEY: about})
    return field


@dataclass(frozen=True)
class LawValues:
    """Forces and capacitances of a law on a grid.

    Args:
        law: to which they belong.
        lengths_m: of the grid. Shape `(L,)`.
        elastic_n: elastic force. Shape `(L,)`.
        capacitance_f: differential. Shape `(V, L)`.
        pull_n_v2: electric force over the voltage squared; at 0 V its limit. Shape `(V, L)`.
        solution: what the law solved, from which a similar law may start; None: nothing.
    """

    law: ActuatorLaw
    lengths_m: Floats
    elastic_n: Floats
    capacitance_f: Floats
    pull_n_v2: Floats
    solution: Floats | LawValues | None = None


@dataclass(frozen=True)
class ActuatorLaw(abc.ABC):
    """The physics of one kind of actuator. Subclass it as a frozen dataclass of `parameter` fields.

    `kind` is its name in TWIN.toml. Lengths and voltages are arrays of any shape. The functions are
    evaluated up to 0.2 % of the free length outside `length_limits_m`. Override a force where it
    has a closed form; the tests compare it with the derivative.

    Args: those of the subclass.
    Raises:
        LimitError: a parameter outside its limits.
    """

    kind: ClassVar[str]

    def __post_init__(self) -> None:
        for about in self.described():
            values = getattr(self, about.name)
            for value in values if isinstance(values, tuple) else (values,):
                if not about.low <= value <= about.high:
                    raise LimitError(
                        f"{about.key} = {value:g} is outside [{about.low:g}, {about.high:g}]"
                        f"{' ' + about.unit if about.unit else ''}. Change it."
                    )

    # ---- what a law states ---------------------------------------------------------------------

    @property
    @abc.abstractmethod
    def free_length_m(self) -> float:
        """Length without load or voltage."""

    @property
    @abc.abstractmethod
    def length_limits_m(self) -> Limits:
        """Lengths for which the law is valid."""

    @abc.abstractmethod
    def elastic_energy_j(self, length_m: ArrayLike) -> Floats:
        """Energy stored in the material."""

    @abc.abstractmethod
    def capacitance_f(self, length_m: ArrayLike, voltage_v: ArrayLike = 0.0) -> Floats:
        """Charge over voltage."""

    @abc.abstractmethod
    def gap_m(self, length_m: ArrayLike) -> Floats:
        """Thickness of the dielectric between two electrodes: voltage over field."""

    @property
    def losses(self) -> Losses:
        """Damping, viscoelasticity, softening and charge creep."""
        return Losses()

    @property
    def circuit(self) -> Circuit:
        """Series resistance, leakage and breakdown."""
        return Circuit()

    @property
    def moving_mass_kg(self) -> float:
        """The actuator's own mass, as it acts at the moving end."""
        return 0.0

    @property
    def width_m(self) -> float:
        """Width that the camera sees."""
        return 0.03

    @property
    def area_m2(self) -> float:
        """Cross-section that carries the load, undeformed."""
        return 1e-4

    @property
    def lateral_stretch(self) -> float:
        """Stretch across the length that the clamps fix; 1 where they fix none."""
        return 1.0

    # ---- what follows ----------------------------------------------------------------------------

    def on_grid(
        self, lengths_m: Floats, voltages_v: Floats, near: LawValues | None = None
    ) -> LawValues:
        """Evaluate the law at all pairs of some lengths and voltages.

        Args:
            lengths_m: Shape `(L,)`.
            voltages_v: Shape `(V,)`.
            near: those of a law with slightly different parameters, on the same grid. A law that
                solves equations may start from them; the result must not depend on it by more than
                the square of the difference.
        Returns:
            Forces and capacitances.
        """
        capacitance = [self.differential_capacitance_f(lengths_m, v) for v in voltages_v]
        acting_v = np.maximum(voltages_v, _LEAST_V)
        pull = [self.electric_force_n(lengths_m, v) / v**2 for v in acting_v]
        elastic_n = self.elastic_force_n(lengths_m)
        return LawValues(self, lengths_m, elastic_n, np.stack(capacitance), np.stack(pull))

    def same_statics(self, other: ActuatorLaw) -> bool:
        """Whether another law of this kind differs at most in fields that `Losses` has too.

        Forces and capacitances are then taken as the same. Override it in a law in which they
        depend on such a field.

        Args:
            other: any law.
        """
        return type(other) is type(self) and all(
            getattr(self, field.name) == getattr(other, field.name)
            for field in dataclasses.fields(self)
            if field.name not in _LOSSES
        )

    def coenergy_j(self, length_m: ArrayLike, voltage_v: ArrayLike) -> Floats:
        """Electric co-energy: the integral of the charge over the voltage.

        Args:
            length_m: Shape `(...)`.
            voltage_v: broadcasts with it.
        Returns:
            Co-energy, in J, with the broadcast shape.
        """
        length, voltage = np.broadcast_arrays(
            np.asarray(length_m, dtype=np.float64), np.asarray(voltage_v, dtype=np.float64)
        )
        share = 0.5 * (_NODES + 1.0)
        capacitance = self.capacitance_f(length[..., None], share * voltage[..., None])
        return np.asarray(0.5 * voltage**2 * (capacitance * share * _WEIGHTS).sum(axis=-1))

    def energy_j(self, length_m: ArrayLike, voltage_v: ArrayLike) -> Floats:
        """Free energy at a voltage: elastic energy minus electric co-energy.

        Args:
            length_m: Shape `(...)`.
            voltage_v: broadcasts with it.
        Returns:
            Energy, in J, with the broadcast shape.
        """
        return np.asarray(self.elastic_energy_j(length_m) - self.coenergy_j(length_m, voltage_v))

    def elastic_force_n(self, length_m: ArrayLike) -> Floats:
        """Force with which the material pulls back, softened: the derivative of its energy.

        Args:
            length_m: Shape `(...)`.
        Returns:
            Force, in N, positive against elongation. Shape `(...)`.
        """
        length = np.asarray(length_m, dtype=np.float64)
        step_m = _STEP * self.free_length_m
        parts = [w * self.elastic_energy_j(length + k * step_m) for k, w in _STENCIL]
        return np.asarray(sum(parts) / step_m)

    def electric_force_n(self, length_m: ArrayLike, voltage_v: ArrayLike) -> Floats:
        """Force of the field along the length: the derivative of the co-energy.

        Args:
            length_m: Shape `(...)`.
            voltage_v: broadcasts with it.
        Returns:
            Force, in N, positive in elongation, with the broadcast shape.
        """
        length = np.asarray(length_m, dtype=np.float64)
        step_m = _STEP * self.free_length_m
        parts = [w * self.coenergy_j(length + k * step_m, voltage_v) for k, w in _STENCIL]
        return np.asarray(sum(parts) / step_m)

    def differential_capacitance_f(self, length_m: ArrayLike, voltage_v: ArrayLike) -> Floats:
        """Slope of the charge over the voltage: what a small carrier senses.

        Args:
            length_m: Shape `(...)`.
            voltage_v: broadcasts with it.
        Returns:
            Capacitance, in F, with the broadcast shape.
        """
        voltage = np.asarray(voltage_v, dtype=np.float64)
        step_v = np.maximum(1e-3 * np.abs(voltage), 1.0)
        parts = [
            w * self.capacitance_f(length_m, voltage + k * step_v) * (voltage + k * step_v)
            for k, w in _STENCIL
        ]
        return np.asarray(sum(parts) / step_v)

    def elastic_rivals(self) -> Mapping[str, ActuatorLaw]:
        """Laws with the same parameters and another elastic energy, by their description.

        `identify actuator` compares them with this law.
        """
        return {}

    @classmethod
    @functools.cache
    def described(cls) -> tuple[Parameter, ...]:
        """All parameters of the law, with units and limits."""
        found = []
        for field in dataclasses.fields(cls):
            about = dict(field.metadata.get(_KEY, {}))
            if about:
                about["key"] = about["key"] or f"actuator.{field.name}"
                found.append(Parameter(name=field.name, **about))
        return tuple(found)

    def parameters(self) -> Mapping[str, Value]:
        """Values by the names of TWIN.toml, such as `shell.shear_modulus_pa`."""
        return {about.key: getattr(self, about.name) for about in self.described()}
