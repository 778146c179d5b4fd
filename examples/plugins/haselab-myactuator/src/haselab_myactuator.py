"""A strip of dielectric elastomer between two clamps: the law of one actuator."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.actuators import VACUUM_F_PER_M, ActuatorLaw, Losses, parameter
from haselab.base import Limits

__all__ = ["DeaStrip"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class DeaStrip(ActuatorLaw):
    r"""A wide strip with a weight: the clamps hold its width, so it stretches in pure shear.

    $W = \tfrac12 \mu\,V_0\,(\lambda^2 + \lambda^{-2} - 2),\quad C = C_0\,\lambda^2$
    """

    kind: ClassVar[str] = "dea-strip"

    free_m: float = parameter(0.04, unit="m", low=0.005, high=0.2, description="free length")
    across_m: float = parameter(0.12, unit="m", low=0.005, high=0.3, description="width")
    thickness_m: float = parameter(8e-4, unit="m", low=1e-5, high=1e-2, description="undeformed")
    modulus_pa: float = parameter(2e4, unit="Pa", low=1.0, high=1e8, description="shear modulus")
    permittivity: float = parameter(4.0, unit="", low=1.0, high=1e3, description="relative")
    damping_n_s_per_m: float = parameter(1.5, unit="N s/m", low=1e-3, high=1e4, description="loss")
    creep_share: float = parameter(0.2, unit="", low=0.0, high=10.0, description="slow stiffness")
    creep_s: float = parameter(2.0, unit="s", low=1e-3, high=1e6, description="its time constant")

    @property
    def free_length_m(self) -> float:
        """Length without load and voltage."""
        return self.free_m

    @property
    def length_limits_m(self) -> Limits:
        """Where the law is valid."""
        return Limits("length", 0.6 * self.free_m, 4.0 * self.free_m, "m")

    @property
    def width_m(self) -> float:
        """What the camera sees."""
        return self.across_m

    @property
    def area_m2(self) -> float:
        """Cross-section that carries the load."""
        return self.across_m * self.thickness_m

    def elastic_energy_j(self, length_m: ArrayLike) -> Floats:
        """Neo-Hookean, in pure shear."""
        stretch = np.asarray(length_m) / self.free_m
        volume_m3 = self.area_m2 * self.free_m
        return np.asarray(0.5 * self.modulus_pa * volume_m3 * (stretch**2 + stretch**-2 - 2.0))

    def capacitance_f(self, length_m: ArrayLike, voltage_v: ArrayLike = 0.0) -> Floats:
        """Plates that grow and come closer; the voltage has no effect."""
        stretch = np.asarray(length_m) / self.free_m
        plate_m = self.across_m * self.free_m / self.thickness_m
        same = np.zeros(np.shape(voltage_v))
        return np.asarray(VACUUM_F_PER_M * self.permittivity * plate_m * stretch**2 + same)

    def gap_m(self, length_m: ArrayLike) -> Floats:
        """Thickness at constant volume."""
        return np.asarray(self.thickness_m * self.free_m / np.asarray(length_m))

    @property
    def losses(self) -> Losses:
        """A damper and one viscoelastic branch."""
        return Losses(self.damping_n_s_per_m, (self.creep_share,), (self.creep_s,))
