"""The planar HASEL of the reference study: the twin's built-in law, in Python."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.actuators.law import VACUUM_F_PER_M, ActuatorLaw, parameter
from haselab.actuators.losses import Circuit, Losses
from haselab.base import LimitError, Limits
from haselab.models import ArrudaBoyceSeries
from haselab.models.hyperelastic import Gent, HyperelasticLaw

__all__ = ["PlanarHasel"]

Floats = NDArray[np.float64]
_SERIES = np.array([1 / 2, 1 / 20, 11 / 1050, 19 / 7000, 519 / 673750])
_ORDER = np.arange(1, 6)
_SHORTEST = 0.5  # of the free length: a sheet that is pushed folds
_LONGEST = 15.0  # of the free length: no elastomer stretches so far, and a table resolves it
_OF_LOCKING = 0.9  # stretch up to which the series of five terms follows the chains


@dataclass(frozen=True)
class PlanarHasel(ActuatorLaw):
    r"""Oil-filled elastomer shell under a fixed lateral stretch, with gel electrodes.

    Arruda-Boyce shell, cubic electrode spring, and a capacitance that follows a power of the
    length: $C = C_0 (x/x_0)^n$.

    Args:
        shear_modulus_pa: of the shell's chains.
        locking_stretch: at which the chains are straight.
        length_m: of the shell between the clamps, before the lateral stretch.
        shell_width_m: undeformed.
        shell_thickness_m: undeformed, without oil.
        shell_lateral_stretch: that the clamps fix.
        electrode_stiffness_n_per_m: of the electrodes, at the free length.
        electrode_stiffening: their cubic term over the linear one.
        branch_share: see `Losses`.
        branch_relaxation_s: see `Losses`.
        damping_n_s_per_m: see `Losses`.
        softening_share: see `Losses`.
        softening_stretch: see `Losses`.
        softening_transition: see `Losses`.
        oil_volume_m3: of the liquid dielectric.
        permittivity: of oil and shell together, relative.
        capacitance_exponent: n; 2 in pure shear, 4 in equal biaxial stretch.
        hysteresis_n: see `Losses`.
        hysteresis_width: see `Losses`.
        series_ohm: see `Circuit`.
        leakage_ohm: see `Circuit`.
        charge_share: see `Losses`.
        charge_relaxation_s: see `Losses`.
        breakdown_v_per_m: see `Circuit`.
    Source: docs/adr/study/0003-parameters-of-the-twin.md; Arruda and Boyce (1993), eq. 19.
    Example:
        >>> law = PlanarHasel()
        >>> round(1e3 * law.free_length_m, 1), round(1e12 * float(law.capacitance_f(0.036)))
        (36.0, 177)
    """

    kind: ClassVar[str] = "planar-hasel"

    # fmt: off
    shear_modulus_pa: float = parameter(15.6e3, unit="Pa", low=0.0, high=1e7,
        description="of the shell", key="shell.shear_modulus_pa")
    locking_stretch: float = parameter(3.92, unit="", low=1.5, high=50.0,
        description="at which the chains are straight", key="shell.locking_stretch",
        inverse_exponent=2)
    length_m: float = parameter(0.0624, unit="m", low=0.01, high=0.2,
        description="between clamps, unstretched", key="shell.length_m")
    shell_width_m: float = parameter(
        0.0498, unit="m", low=0.005, high=0.3, description="unstretched", key="shell.width_m",
        fitted=False)
    shell_thickness_m: float = parameter(1.2e-3, unit="m", low=1e-4, high=1e-2,
        description="unstretched, without oil", key="shell.thickness_m", fitted=False)
    shell_lateral_stretch: float = parameter(3.0, unit="", low=1.0, high=5.0,
        description="fixed by the clamps", key="shell.lateral_stretch", fitted=False)
    electrode_stiffness_n_per_m: float = parameter(150.0, unit="N/m", low=0.0, high=1e5,
        description="of the gel", key="electrodes.stiffness_n_per_m")
    electrode_stiffening: float = parameter(0.1, unit="", low=0.0, high=100.0,
        description="cubic term over the linear one", key="electrodes.stiffening")
    branch_share: tuple[float, ...] = parameter((0.02, 0.02, 0.5), unit="", low=0.0, high=10.0,
        description="of each viscoelastic branch", key="viscosity.share")
    branch_relaxation_s: tuple[float, ...] = parameter((0.1, 1.0, 3.2), unit="s", low=1e-3,
        high=1e18, description="of each branch", key="viscosity.relaxation_s")
    damping_n_s_per_m: float = parameter(1.85, unit="N s/m", low=0.0, high=1e4,
        description="linear damper", key="viscosity.damping_n_s_per_m")
    softening_share: float = parameter(0.06, unit="", low=0.0, high=2.0,
        description="stiffness lost in the first cycle", key="mullins.share")
    softening_stretch: float = parameter(1.45, unit="", low=1.0, high=5.0,
        description="where half of it is lost", key="mullins.stretch")
    softening_transition: float = parameter(
        0.02, unit="", low=0.001, high=1.0, description="of the transition", key="mullins.width")
    oil_volume_m3: float = parameter(0.6e-6, unit="m^3", low=0.0, high=1e-4,
        description="of the liquid dielectric", key="dielectric.oil_volume_m3", fitted=False)
    permittivity: float = parameter(
        3.0, unit="", low=1.0, high=100.0, description="relative", key="dielectric.permittivity")
    capacitance_exponent: float = parameter(3.33, unit="", low=1.0, high=4.0,
        description="d ln C / d ln length", key="dielectric.capacitance_exponent")
    series_ohm: float = parameter(5e3, unit="ohm", low=0.0, high=1e8,
        description="of the electrodes", key="dielectric.series_ohm", fitted=False)
    leakage_ohm: float = parameter(2e10, unit="ohm", low=1e6, high=1e18,
        description="of the dielectric", key="dielectric.leakage_ohm", fitted=False)
    charge_share: float = parameter(0.0, unit="", low=0.0, high=1.0,
        description="of the voltage that acts late", key="dielectric.relaxation_share")
    charge_relaxation_s: float = parameter(
        5.7, unit="s", low=0.01, high=1e4, description="of that part",
        key="dielectric.relaxation_s")
    hysteresis_n: float = parameter(0.0, unit="N", low=0.0, high=1e3,
        description="largest force of the hysteresis, 0: none",
        key="hysteresis.force_n")
    hysteresis_width: float = parameter(0.02, unit="", low=1e-4, high=1.0,
        description="stretch within which it follows a reversal",
        key="hysteresis.width")
    breakdown_v_per_m: float = parameter(40e6, unit="V/m", low=1e5, high=1e18,
        description="field that destroys it", key="dielectric.breakdown_v_per_m", fitted=False)
    # fmt: on

    @property
    def free_length_m(self) -> float:
        """Length of the clamped sheet with neither load nor voltage."""
        return self.length_m / math.sqrt(self.shell_lateral_stretch)

    @property
    def length_limits_m(self) -> Limits:
        """From half the free length to 90 % of the stretch at which the chains lock, at most 15."""
        squared = 3.0 * self.locking_stretch**2 - self.shell_lateral_stretch**2
        if squared <= 0.0:
            raise LimitError(
                f"shell.lateral_stretch = {self.shell_lateral_stretch:g} is beyond the stretch of "
                f"{math.sqrt(3.0) * self.locking_stretch:.3g} at which the chains lock. Lower it, "
                "or raise shell.locking_stretch."
            )
        locked = math.sqrt(squared)
        high = _OF_LOCKING * locked * math.sqrt(self.shell_lateral_stretch) * self.free_length_m
        high = min(high, _LONGEST * self.free_length_m)
        return Limits("length", _SHORTEST * self.free_length_m, high, "m")

    @property
    def free_gap_m(self) -> float:
        """Thickness of shell and oil at the free length."""
        oil_m = self.oil_volume_m3 / (self.length_m * self.shell_width_m)
        return (self.shell_thickness_m + oil_m) * (1.0 / math.sqrt(self.shell_lateral_stretch))

    @property
    def free_capacitance_f(self) -> float:
        """Plate formula at the free length."""
        plate = VACUUM_F_PER_M * self.permittivity * self.free_length_m * self.width_m
        return plate / self.free_gap_m

    @property
    def series_coefficients_pa(self) -> Floats:
        """Of the derivative of the shell's energy density by its first invariant. Shape `(5,)`."""
        return np.asarray(
            self.shear_modulus_pa * _ORDER * _SERIES / self.locking_stretch ** (2.0 * _ORDER - 2.0)
        )

    @property
    def width_m(self) -> float:
        """Between the clamps' ends."""
        return self.shell_width_m * self.shell_lateral_stretch

    @property
    def area_m2(self) -> float:
        """Of the undeformed shell."""
        return self.shell_width_m * self.shell_thickness_m

    @property
    def lateral_stretch(self) -> float:
        """Of the shell, fixed by the clamps."""
        return self.shell_lateral_stretch

    def _shell_energy_pa(self, invariant: Floats) -> Floats:
        """Energy density of the shell."""
        terms = self.series_coefficients_pa / _ORDER
        density = sum(c * (invariant**i - 3.0**i) for c, i in zip(terms, _ORDER, strict=True))
        return np.asarray(density)

    @property
    def _shell(self) -> HyperelasticLaw:
        return ArrudaBoyceSeries(self.shear_modulus_pa, self.locking_stretch)

    def elastic_energy_j(self, length_m: ArrayLike) -> Floats:
        """Of shell and electrodes."""
        length = np.asarray(length_m, dtype=np.float64)
        square, lateral = (length / self.length_m) ** 2, self.shell_lateral_stretch**2
        density = self._shell_energy_pa(square + lateral + 1.0 / (square * lateral))
        strain = length / self.free_length_m - 1.0
        spring = 0.5 * strain**2 + 0.25 * self.electrode_stiffening * strain**4
        stiffness_j = self.electrode_stiffness_n_per_m * self.free_length_m**2
        return np.asarray(self.area_m2 * self.length_m * density + stiffness_j * spring)

    def elastic_force_n(self, length_m: ArrayLike) -> Floats:
        """Of shell and electrodes, in closed form."""
        length = np.asarray(length_m, dtype=np.float64)
        stress = self._shell.nominal_stress_pa(length / self.length_m, self.shell_lateral_stretch)
        strain = length / self.free_length_m - 1.0
        spring_n = self.electrode_stiffness_n_per_m * self.free_length_m * strain
        return np.asarray(
            self.area_m2 * stress + spring_n * (1.0 + self.electrode_stiffening * strain**2)
        )

    def capacitance_f(self, length_m: ArrayLike, voltage_v: ArrayLike = 0.0) -> Floats:
        """Power law of the length; the voltage has no effect."""
        stretch = np.asarray(length_m) / self.free_length_m
        unchanged = np.zeros(np.shape(voltage_v))
        return np.asarray(self.free_capacitance_f * stretch**self.capacitance_exponent + unchanged)

    def electric_force_n(self, length_m: ArrayLike, voltage_v: ArrayLike) -> Floats:
        """Half the voltage squared times the slope of the capacitance, in closed form."""
        slope = self.capacitance_exponent * self.capacitance_f(length_m) / np.asarray(length_m)
        return np.asarray(0.5 * np.asarray(voltage_v) ** 2 * slope)

    def gap_m(self, length_m: ArrayLike) -> Floats:
        """The volume is constant, so the gap follows the capacitance to the power of -1/2."""
        stretch = np.asarray(length_m) / self.free_length_m
        return np.asarray(self.free_gap_m * stretch ** (-0.5 * self.capacitance_exponent))

    @property
    def losses(self) -> Losses:
        """Viscoelastic shell, Mullins effect, oil charge."""
        return Losses(
            self.damping_n_s_per_m,
            self.branch_share,
            self.branch_relaxation_s,
            self.softening_share,
            self.softening_stretch,
            self.softening_transition,
            self.charge_share,
            self.charge_relaxation_s,
            self.hysteresis_n,
            self.hysteresis_width,
        )

    @property
    def circuit(self) -> Circuit:
        """Gel electrodes in series."""
        return Circuit(self.series_ohm, self.leakage_ohm, self.breakdown_v_per_m)

    def elastic_rivals(self) -> Mapping[str, ActuatorLaw]:
        """See `ActuatorLaw`."""
        return {"Gent's law of the shell": _GentHasel(**asdict(self))}


@dataclass(frozen=True)
class _GentHasel(PlanarHasel):
    """A planar HASEL whose shell follows Gent's law, with the same largest first invariant."""

    @property
    def _extension_limit(self) -> float:
        return 3.0 * self.locking_stretch**2 - 3.0

    @property
    def _shell(self) -> HyperelasticLaw:
        return Gent(self.shear_modulus_pa, self._extension_limit)

    def _shell_energy_pa(self, invariant: Floats) -> Floats:
        limit = self._extension_limit
        used = (invariant - 3.0) / limit
        return np.asarray(-0.5 * self.shear_modulus_pa * limit * np.log1p(-used))

    def elastic_rivals(self) -> Mapping[str, ActuatorLaw]:
        return {}
