"""A stack of dielectric elastomer layers that contracts along its height."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.actuators.law import VACUUM_F_PER_M, ActuatorLaw, parameter
from haselab.actuators.losses import Circuit, Losses
from haselab.base import Limits
from haselab.models import Gent

__all__ = ["DeaStack"]

Floats = NDArray[np.float64]
_SHORTEST, _LONGEST = 0.25, 4.0  # of the free length
_OF_LOCKING = 0.9
_SHARE_OF_MASS = 1.0 / 3.0  # of a rod that one end moves


@dataclass(frozen=True)
class DeaStack(ActuatorLaw):
    r"""Layers in parallel electrically, in series mechanically; free to widen, volume constant.

    With the stretch $\lambda = x/x_0$ of the height, thickness $d\lambda$ and area $A/\lambda$:

    $W = -\tfrac12 \mu J_m A x_0 \ln(1 - J/J_m),\ J = \lambda^2 + 2/\lambda - 3, \qquad
    C = N \varepsilon\varepsilon_0 A / (d\,\lambda^2)$

    so that the field presses with $\varepsilon\varepsilon_0 (V/(d\lambda))^2$ on the deformed area.
    Without load a soft stack collapses at $\lambda = 0.63$ and
    $V/d = 0.69\sqrt{\mu/(\varepsilon\varepsilon_0)}$.

    Args:
        layers: number of dielectric layers, N.
        layer_thickness_m: undeformed, d.
        side_m: of the square cross-section.
        shear_modulus_pa: mu.
        extension_limit: J_m of Gent's law; a large one is neo-Hooke.
        permittivity: relative.
        density_kg_m3: of the elastomer.
        damping_n_s_per_m: see `Losses`.
        branch_share: see `Losses`.
        branch_relaxation_s: see `Losses`.
        hysteresis_n: see `Losses`.
        hysteresis_width: see `Losses`.
        series_ohm: see `Circuit`.
        leakage_ohm: see `Circuit`.
        breakdown_v_per_m: see `Circuit`.
    Source: Pelrine, Kornbluh and Joseph, Sens. Actuators A 64 (1998), 77, for the pressure; Suo,
        Acta Mech. Solida Sin. 23 (2010), 549, for energy and collapse; Gent (1996) for the rubber.
    Example:
        >>> stack = DeaStack()
        >>> round(1e3 * stack.free_length_m, 1), round(float(stack.electric_force_n(0.035, 5e3)), 3)
        (35.0, -0.847)
    """

    kind: ClassVar[str] = "dea-stack"

    # fmt: off
    layers: float = parameter(
        50.0, unit="", low=1.0, high=1e5, description="number of dielectric layers", fitted=False)
    layer_thickness_m: float = parameter(
        0.7e-3, unit="m", low=1e-6, high=1e-2, description="undeformed")
    side_m: float = parameter(
        0.025, unit="m", low=1e-3, high=0.3, description="of the square cross-section",
        fitted=False)
    shear_modulus_pa: float = parameter(
        15e3, unit="Pa", low=1.0, high=1e8, description="of the elastomer")
    extension_limit: float = parameter(
        80.0, unit="", low=5.0, high=1e6, description="J_m of Gent's law; a large one is neo-Hooke",
        inverse_exponent=1)
    permittivity: float = parameter(3.0, unit="", low=1.0, high=1e3, description="relative")
    density_kg_m3: float = parameter(
        1000.0, unit="kg/m^3", low=1.0, high=1e5, description="of the elastomer", fitted=False)
    damping_n_s_per_m: float = parameter(
        2.0, unit="N s/m", low=1e-6, high=1e4, description="linear damper")
    branch_share: tuple[float, ...] = parameter(
        (0.05, 0.1), unit="", low=0.0, high=10.0, description="of each viscoelastic branch")
    branch_relaxation_s: tuple[float, ...] = parameter(
        (0.1, 3.0), unit="s", low=1e-3, high=1e6, description="of each branch")
    hysteresis_n: float = parameter(0.0, unit="N", low=0.0, high=1e3,
        description="largest force of the hysteresis, 0: none")
    hysteresis_width: float = parameter(0.02, unit="", low=1e-4, high=1.0,
        description="stretch within which it follows a reversal")
    series_ohm: float = parameter(
        5e3, unit="ohm", low=0.0, high=1e8, description="of the electrodes", fitted=False)
    leakage_ohm: float = parameter(
        2e10, unit="ohm", low=1e6, high=1e18, description="of the dielectric", fitted=False)
    breakdown_v_per_m: float = parameter(
        60e6, unit="V/m", low=1e5, high=1e10, description="field that destroys it", fitted=False)
    # fmt: on

    @property
    def free_length_m(self) -> float:
        """Height of all layers."""
        return self.layers * self.layer_thickness_m

    @property
    def length_limits_m(self) -> Limits:
        """From 0.25 to 4 times the height, at most to 90 % of the stretch that locks the chains."""
        locked = math.sqrt(self.extension_limit + 3.0)
        shortest = max(_SHORTEST, 2.0 / (_OF_LOCKING * (self.extension_limit + 3.0)))
        longest = min(_LONGEST, _OF_LOCKING * locked)
        height_m = self.free_length_m
        return Limits("length", shortest * height_m, longest * height_m, "m")

    @property
    def area_m2(self) -> float:
        """Undeformed."""
        return self.side_m**2

    @property
    def width_m(self) -> float:
        """Undeformed."""
        return self.side_m

    @property
    def moving_mass_kg(self) -> float:
        """A third of the stack, as of a rod that stretches evenly."""
        return _SHARE_OF_MASS * self.density_kg_m3 * self.area_m2 * self.free_length_m

    def elastic_energy_j(self, length_m: ArrayLike) -> Floats:
        """Gent's energy of the whole volume."""
        stretch = np.asarray(length_m, dtype=np.float64) / self.free_length_m
        used = (stretch**2 + 2.0 / stretch - 3.0) / self.extension_limit
        modulus_j = self.shear_modulus_pa * self.area_m2 * self.free_length_m
        return np.asarray(-0.5 * modulus_j * self.extension_limit * np.log1p(-used))

    def elastic_force_n(self, length_m: ArrayLike) -> Floats:
        """Gent's nominal stress on the undeformed area."""
        law = Gent(self.shear_modulus_pa, self.extension_limit)
        return self.area_m2 * law.nominal_stress_pa(np.asarray(length_m) / self.free_length_m)

    def capacitance_f(self, length_m: ArrayLike, voltage_v: ArrayLike = 0.0) -> Floats:
        """All layers in parallel; the voltage has no effect."""
        stretch = np.asarray(length_m, dtype=np.float64) / self.free_length_m
        layer_f = VACUUM_F_PER_M * self.permittivity * self.area_m2 / self.layer_thickness_m
        return np.asarray(self.layers * layer_f / stretch**2 + np.zeros(np.shape(voltage_v)))

    def electric_force_n(self, length_m: ArrayLike, voltage_v: ArrayLike) -> Floats:
        """Pressure of the field on the deformed area, which contracts the stack."""
        stretch = np.asarray(length_m, dtype=np.float64) / self.free_length_m
        field_v_m = np.asarray(voltage_v) / self.gap_m(length_m)
        pressure_pa = VACUUM_F_PER_M * self.permittivity * field_v_m**2
        return np.asarray(-pressure_pa * self.area_m2 / stretch)

    def gap_m(self, length_m: ArrayLike) -> Floats:
        """Thickness of a layer."""
        return np.asarray(length_m, dtype=np.float64) / self.layers

    @property
    def losses(self) -> Losses:
        """Viscoelastic rubber; neither softening nor charge creep."""
        return Losses(
            self.damping_n_s_per_m, self.branch_share, self.branch_relaxation_s,
            hysteresis_n=self.hysteresis_n, hysteresis_width=self.hysteresis_width,
        )  # fmt: skip

    @property
    def circuit(self) -> Circuit:
        """Electrodes in series."""
        return Circuit(self.series_ohm, self.leakage_ohm, self.breakdown_v_per_m)
