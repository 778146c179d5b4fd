"""The curling HASEL: zipping cells on an elastic strip that hangs, and curls up under voltage."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.actuators.law import ActuatorLaw, LawValues, parameter
from haselab.actuators.losses import Circuit, Losses
from haselab.actuators.peano_hasel import PeanoHasel
from haselab.base import LimitError, Limits
from haselab.base.root import root

__all__ = ["CurlingHasel"]

Floats = NDArray[np.float64]
_STRAIGHTEST, _MOST_CURLED = 0.28, 1.8  # rad, of the whole strip
_NEWTON = 60
_CLOSE = 1e-12  # last step of Newton's iteration, after which the error is that of rounding


@dataclass(frozen=True)
class CurlingHasel(ActuatorLaw):
    r"""Cells on an elastic strip that is clamped at its upper end, with the load at its tip.

    The strip bends evenly, by the angle $\varphi$ from clamp to tip. The length is the vertical
    distance of clamp and tip:

    $x = L\,\sin\varphi/\varphi,\quad
    E(x, V) = \tfrac12 \frac{B}{L}(\varphi - \varphi_0)^2 + E_c(x_0 - e\varphi, V)$

    with the strip's length $L$, bending stiffness $B$ and curl $\varphi_0$ without load. The cells
    are those of a `PeanoHasel`, of energy $E_c$ and length $x_0$ at rest. They lie at a distance
    $e$ from the strip's neutral plane, so that bending shortens them by $e\varphi$. The load
    straightens the strip, the voltage curls it.

    Unvalidated: no measured curve of such an actuator was found that states its geometry. The
    strip's even curvature is an assumption too: a load at the tip bends the clamped end most.

    Args:
        cells: number of cells, n.
        cell_length_m: length of one cell and of the film of its pouch.
        electrode_length_m: of that, the part with electrodes.
        strip_width_m: across the load.
        film_thickness_m: of one film; two lie between the electrodes.
        permittivity: relative, of the film.
        film_stiffness_n_per_m: see `PeanoHasel`.
        rounding_m: see `PeanoHasel`.
        half_zipped_v: see `PeanoHasel`.
        zipped_share: see `PeanoHasel`.
        unzipped_share: see `PeanoHasel`.
        lever_m: distance of the cells from the neutral plane, e.
        bending_n_m2: bending stiffness of the strip, B.
        curl_rad: angle from clamp to tip with neither load nor voltage.
        own_mass_kg: of the actuator, as it acts at the tip.
        damping_n_s_per_m: see `Losses`.
        branch_share: see `Losses`.
        branch_relaxation_s: see `Losses`.
        charge_share: see `Losses`.
        charge_relaxation_s: see `Losses`.
        hysteresis_n: see `Losses`.
        hysteresis_width: see `Losses`.
        series_ohm: see `Circuit`.
        leakage_ohm: see `Circuit`.
        breakdown_v_per_m: see `Circuit`.
    Raises:
        LimitError: a parameter outside its limits, or a curl that the cells cannot have.
    Source: Cisneros, Wu, Rabenorosoa and Le Gorrec, arXiv:2402.11970, for cells that share one
        angle, with springs and a zipped length that depends on it; `PeanoHasel` for the cells.
    Example:
        >>> law = CurlingHasel()
        >>> round(1e3 * law.free_length_m, 1)
        81.0
    """

    kind: ClassVar[str] = "curling-hasel"

    # fmt: off
    cells: float = parameter(
        5.0, unit="", low=1.0, high=100.0, description="number of cells", fitted=False)
    cell_length_m: float = parameter(
        0.02, unit="m", low=1e-3, high=0.2, description="one cell and the film of its pouch")
    electrode_length_m: float = parameter(
        0.01, unit="m", low=5e-4, high=0.18, description="part of it with electrodes", fitted=False)
    strip_width_m: float = parameter(
        0.05, unit="m", low=1e-3, high=1.0, description="across the load", fitted=False)
    film_thickness_m: float = parameter(
        18e-6, unit="m", low=1e-6, high=1e-3, description="one film; two are between electrodes",
        fitted=False)
    permittivity: float = parameter(
        2.2, unit="", low=1.0, high=100.0, description="relative, of the film")
    film_stiffness_n_per_m: float = parameter(
        25e3, unit="N/m", low=1.0, high=1e8, description="one cell with its seals")
    rounding_m: float = parameter(
        8e-5, unit="m", low=1e-7, high=1e-2, description="the film becomes taut over it")
    half_zipped_v: float = parameter(
        2e3, unit="V", low=1.0, high=1e5, description="zips half of a slack pouch")
    zipped_share: float = parameter(
        0.15, unit="", low=1e-4, high=0.5, description="of a slack pouch at 0 V; rounds the onset")
    unzipped_share: float = parameter(
        0.1, unit="", low=1e-3, high=1.0, description="unzipped over zipped capacitance")
    lever_m: float = parameter(
        6e-3, unit="m", low=1e-4, high=0.1, description="pouches from the neutral plane")
    bending_n_m2: float = parameter(
        1e-2, unit="N m^2", low=1e-7, high=100.0, description="stiffness of the strip")
    curl_rad: float = parameter(
        1.1, unit="rad", low=0.3, high=1.7, description="clamp to tip, neither load nor voltage")
    own_mass_kg: float = parameter(
        0.01, unit="kg", low=0.0, high=10.0, description="acting at the tip", fitted=False)
    damping_n_s_per_m: float = parameter(
        8.0, unit="N s/m", low=1e-6, high=1e4, description="linear damper")
    branch_share: tuple[float, ...] = parameter(
        (0.05,), unit="", low=0.0, high=10.0, description="of each viscoelastic branch")
    branch_relaxation_s: tuple[float, ...] = parameter(
        (1.0,), unit="s", low=1e-3, high=1e6, description="of each branch")
    charge_share: float = parameter(
        0.0, unit="", low=0.0, high=1.0, description="of the voltage that acts late")
    charge_relaxation_s: float = parameter(
        5.0, unit="s", low=0.01, high=1e4, description="of that part")
    hysteresis_n: float = parameter(0.0, unit="N", low=0.0, high=1e3,
        description="largest force of the hysteresis, 0: none")
    hysteresis_width: float = parameter(0.02, unit="", low=1e-4, high=1.0,
        description="stretch within which it follows a reversal")
    series_ohm: float = parameter(
        5e3, unit="ohm", low=0.0, high=1e8, description="of the electrodes", fitted=False)
    leakage_ohm: float = parameter(
        2e10, unit="ohm", low=1e6, high=1e18, description="of the dielectric", fitted=False)
    breakdown_v_per_m: float = parameter(
        450e6, unit="V/m", low=1e6, high=1e10, description="field that destroys the film",
        fitted=False)
    # fmt: on

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.curl_rad < self._most_rad:
            raise LimitError(
                f"actuator.curl_rad = {self.curl_rad:g} is not below {self._most_rad:.3g} rad, "
                "where the cells are shortest. Lower it or actuator.lever_m."
            )

    @cached_property
    def cell_law(self) -> PeanoHasel:
        """All cells in series, without the strip."""
        return PeanoHasel(
            pouches=self.cells,
            pouch_length_m=self.cell_length_m,
            electrode_length_m=self.electrode_length_m,
            pouch_width_m=self.strip_width_m,
            film_thickness_m=self.film_thickness_m,
            permittivity=self.permittivity,
            film_stiffness_n_per_m=self.film_stiffness_n_per_m,
            rounding_m=self.rounding_m,
            half_zipped_v=self.half_zipped_v,
            zipped_share=self.zipped_share,
            unzipped_share=self.unzipped_share,
        )

    @property
    def strip_m(self) -> float:
        """Length of the strip."""
        return self.cells * self.cell_length_m

    @cached_property
    def free_length_m(self) -> float:
        """Height at which strip and cells balance at 0 V."""
        limits = self.length_limits_m

        def force_n(length_m: float) -> float:
            return float(self.elastic_force_n(length_m))

        return root(force_n, limits.low, limits.high, xtol=1e-15)

    @property
    def length_limits_m(self) -> Limits:
        """From 1.8 rad, or the curl at which the cells are shortest, to 0.28 rad."""
        ends = (self._most_rad, _STRAIGHTEST)
        low, high = (self.strip_m * math.sin(angle) / angle for angle in ends)
        return Limits("length", low, high, "m")

    @property
    def width_m(self) -> float:
        """Of the strip."""
        return self.strip_width_m

    @property
    def area_m2(self) -> float:
        """Of both films."""
        return 2.0 * self.film_thickness_m * self.strip_width_m

    @property
    def moving_mass_kg(self) -> float:
        """As set."""
        return self.own_mass_kg

    def curl_rad_at(self, length_m: ArrayLike) -> Floats:
        """Angle from clamp to tip.

        Args:
            length_m: vertical distance of both. Shape `(...)`.
        Returns:
            Angle, in rad. Shape `(...)`.
        """
        share = np.asarray(length_m, dtype=np.float64) / self.strip_m
        # sin(a) / a falls from 1 at 0 to 0 at pi, nearly as 1 - (a / pi)^2 does
        angle = math.pi * np.sqrt(1.0 - share)
        for _ in range(_NEWTON):
            step = (np.sin(angle) / angle - share) / _slope(angle)
            angle = angle - step
            if (np.abs(step) <= _CLOSE * angle).all():
                break
        return np.asarray(angle)

    def on_grid(
        self, lengths_m: Floats, voltages_v: Floats, near: LawValues | None = None
    ) -> LawValues:
        """Strip, and all cells at once."""
        curl = self.curl_rad_at(lengths_m)
        known = near.solution if near else None
        known = known if isinstance(known, LawValues) else None
        cells = self.cell_law.on_grid(self._cells_m(curl), voltages_v, known)
        lever = -self.lever_m / (self.strip_m * _slope(curl))
        strip_n_m = self.bending_n_m2 / self.strip_m * (curl - self.curl_rad)
        elastic_n = strip_n_m / (self.strip_m * _slope(curl)) + lever * cells.elastic_n
        pull_n_v2 = lever * cells.pull_n_v2
        return LawValues(self, lengths_m, elastic_n, cells.capacitance_f, pull_n_v2, cells)

    def elastic_energy_j(self, length_m: ArrayLike) -> Floats:
        """Of strip and cells at 0 V."""
        curl = self.curl_rad_at(length_m)
        strip_j = 0.5 * self.bending_n_m2 / self.strip_m * (curl - self.curl_rad) ** 2
        return np.asarray(strip_j + self.cell_law.elastic_energy_j(self._cells_m(curl)))

    def elastic_force_n(self, length_m: ArrayLike) -> Floats:
        """Moment of strip and cells at 0 V over the lever of the tip."""
        curl = self.curl_rad_at(length_m)
        strip_n_m = self.bending_n_m2 / self.strip_m * (curl - self.curl_rad)
        cells_n_m = -self.lever_m * self.cell_law.elastic_force_n(self._cells_m(curl))
        return np.asarray((strip_n_m + cells_n_m) / (self.strip_m * _slope(curl)))

    def coenergy_j(self, length_m: ArrayLike, voltage_v: ArrayLike) -> Floats:
        """Of the cells."""
        return self.cell_law.coenergy_j(self._cells_m(self.curl_rad_at(length_m)), voltage_v)

    def electric_force_n(self, length_m: ArrayLike, voltage_v: ArrayLike) -> Floats:
        """What the voltage adds to the cells' moment, over the lever of the tip."""
        curl = self.curl_rad_at(length_m)
        added_n = self.cell_law.electric_force_n(self._cells_m(curl), voltage_v)
        return np.asarray(-self.lever_m * added_n / (self.strip_m * _slope(curl)))

    def capacitance_f(self, length_m: ArrayLike, voltage_v: ArrayLike = 0.0) -> Floats:
        """Of the cells."""
        return self.cell_law.capacitance_f(self._cells_m(self.curl_rad_at(length_m)), voltage_v)

    def differential_capacitance_f(self, length_m: ArrayLike, voltage_v: ArrayLike) -> Floats:
        """That at a constant zipped length: zipping is too slow for a carrier."""
        return self.capacitance_f(length_m, voltage_v)

    def gap_m(self, length_m: ArrayLike) -> Floats:
        """Of both films, where they are zipped."""
        return np.full(np.shape(length_m), 2.0 * self.film_thickness_m)

    @property
    def losses(self) -> Losses:
        """Viscoelastic strip, oil, charge that stays."""
        return Losses(
            self.damping_n_s_per_m, self.branch_share, self.branch_relaxation_s,
            charge_share=self.charge_share, charge_relaxation_s=self.charge_relaxation_s,
            hysteresis_n=self.hysteresis_n, hysteresis_width=self.hysteresis_width,
        )  # fmt: skip

    @property
    def circuit(self) -> Circuit:
        """Electrodes in series."""
        return Circuit(self.series_ohm, self.leakage_ohm, self.breakdown_v_per_m)

    @property
    def _most_rad(self) -> float:
        longest_m = self.cells * self.cell_law.pouch.rest_m
        shortest_m = self.cell_law.length_limits_m.low
        return min(_MOST_CURLED, (longest_m - shortest_m) / self.lever_m)

    def _cells_m(self, curl: Floats) -> Floats:
        return np.asarray(self.cells * self.cell_law.pouch.rest_m - self.lever_m * curl)


def _slope(angle: Floats) -> Floats:
    """Of sin(a) / a."""
    return np.asarray((np.cos(angle) - np.sin(angle) / angle) / angle)
