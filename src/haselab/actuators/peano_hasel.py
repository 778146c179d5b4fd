"""The Peano-HASEL: pouches in series that contract when their electrodes zip."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit, spence

from haselab.actuators.law import VACUUM_F_PER_M, ActuatorLaw, LawValues, parameter
from haselab.actuators.losses import Circuit, Losses
from haselab.actuators.pouch import Pouch
from haselab.base import LimitError, Limits
from haselab.base.root import root

__all__ = ["PeanoHasel"]

Floats = NDArray[np.float64]
_SLACK, _TAUT = 0.05, 0.10  # of the rest length, beyond the ideal pouch's shortest and longest
_STEEPEST = 60.0  # ln of (1 - cos) / cos at the end of the electrodes
_GRID = np.geomspace(1e-9, 40.0, 250)  # of ln(ds/dz) above its first value
_ITERATIONS = 200
_CLOSE, _CLOSEST = 1e-10, 1e-13  # last step of Newton's iteration, and of halving
_SMALL = 0.15  # of half_zipped_v: below it a difference of two forces would lose digits
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(4)


class _State(NamedTuple):
    """Where one pouch rests at a given length and voltage."""

    y: Floats  # ln(ds/dz)
    zipped_m: Floats
    stretch_m: Floats  # of the film; negative: slack
    tension_n: Floats
    tension_per_pull: Floats  # by the energy that zipping a metre sets free


class _Balance(NamedTuple):
    """What one pouch does at a state of zipping y = ln(ds/dz); `_by`: derivatives by y."""

    steep: Floats  # ds/dz
    zipped_m: Floats
    zipped_by: Floats
    needed_n: Floats  # force along the zipped length that the film must hold
    needed_by: Floats
    pouch_m: Floats  # distance of the ends, without the stretch of the film that it needs
    stretch_m: Floats
    length_by: Floats  # of both together
    possible: NDArray[np.bool_]


@dataclass(frozen=True)
class PeanoHasel(ActuatorLaw):
    r"""Pouches in series: the ideal pouch of Kellaris (2019), with a compliant film in series.

    A `Pouch` of stroke $s$ and zipped length $z$ lies in series with a film of stiffness $k$, which
    pulls but does not push. Of one pouch of length $x$, with
    $\kappa = \varepsilon\varepsilon_0 w/2t$:

    $E(x, V) = \min_z\left[\Phi(x - h + s(z)) + U(z) - \theta \ln z
    - \tfrac12 \kappa z V^2\right] - \tfrac12 C_u V^2$

    $\Phi' = k\delta \ln(1 + e^{u/\delta})$ is the film's tension: it becomes taut over the length
    $\delta$. The resistance of the films to zipping, $U' = \tfrac12 \kappa V_h^2\,z/(L_e - z)$,
    lets a slack pouch zip half its electrodes at $V_h$, and $\theta$ a share of them at 0 V, which
    rounds the onset of zipping. The bracket is convex in $z$, so there is one minimum, and it is a
    smooth function: by the envelope theorem the force is the film's tension and the charge is
    $(C_u + \kappa z) V$. The ideal pouch is the limit of a stiff film with $\delta$ and $V_h$ of 0.

    A carrier senses the capacitance at a constant zipped length: zipping does not follow kilohertz.

    The tests compare the ideal pouch with published numbers. Unvalidated: film, rounding,
    resistance to zipping and losses. Real actuators are stronger when blocked, because they zip
    unevenly.

    Args:
        pouches: number of pouches in series.
        pouch_length_m: length of the film of one pouch.
        electrode_length_m: of that, the part with electrodes.
        pouch_width_m: across the load.
        film_thickness_m: of one film; two lie between the electrodes.
        permittivity: relative, of the film.
        film_stiffness_n_per_m: of one pouch, with its seals.
        restoring_n_per_m: of one pouch: stiffness that straightens a slack film.
        rounding_m: length over which the film becomes taut, per pouch.
        half_zipped_v: voltage that zips half the electrodes of a slack pouch.
        zipped_share: electrodes of a slack pouch that touch at 0 V; rounds the onset of zipping.
        unzipped_share: capacitance of the unzipped electrodes over that of the zipped ones.
        own_mass_kg: of the actuator, as it acts at the moving end.
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
        LimitError: a parameter outside its limits, an electrode too long for the pouch, or a film
            too soft to straighten.
    Source: Kellaris et al., Extreme Mech. Lett. 29 (2019), 100449; Rothemund, Kirkman and
        Keplinger, PNAS 117 (2020), 16207, for the speed of zipping.
    Example:
        >>> law = PeanoHasel()
        >>> ideal_n = law.ideal_force_n(law.pouch.rest_angle_rad, 1e4)
        >>> round(1e3 * law.free_length_m, 1), round(float(ideal_n), 1)
        (96.4, 45.2)
    """

    kind: ClassVar[str] = "peano-hasel"

    # fmt: off
    pouches: float = parameter(
        5.0, unit="", low=1.0, high=1e3, description="number of pouches in series", fitted=False)
    pouch_length_m: float = parameter(
        0.02, unit="m", low=1e-3, high=0.2, description="film of one pouch")
    electrode_length_m: float = parameter(
        0.01, unit="m", low=5e-4, high=0.18, description="part of it with electrodes", fitted=False)
    pouch_width_m: float = parameter(
        0.05, unit="m", low=1e-3, high=1.0, description="across the load", fitted=False)
    film_thickness_m: float = parameter(
        18e-6, unit="m", low=1e-6, high=1e-3, description="one film; two are between electrodes",
        fitted=False)
    permittivity: float = parameter(
        2.2, unit="", low=1.0, high=100.0, description="relative, of the film")
    film_stiffness_n_per_m: float = parameter(
        25e3, unit="N/m", low=1.0, high=1e8, description="one pouch with its seals")
    restoring_n_per_m: float = parameter(
        10.0, unit="N/m", low=1e-3, high=1e5, description="one pouch; straightens a slack film")
    rounding_m: float = parameter(
        8e-5, unit="m", low=1e-7, high=1e-2, description="the film becomes taut over it")
    half_zipped_v: float = parameter(
        2e3, unit="V", low=1.0, high=1e5, description="zips half of a slack pouch")
    zipped_share: float = parameter(
        0.15, unit="", low=1e-4, high=0.5, description="of a slack pouch at 0 V; rounds the onset")
    unzipped_share: float = parameter(
        0.1, unit="", low=1e-3, high=1.0, description="unzipped over zipped capacitance")
    own_mass_kg: float = parameter(
        0.005, unit="kg", low=0.0, high=10.0, description="acting at the moving end", fitted=False)
    damping_n_s_per_m: float = parameter(
        6.0, unit="N s/m", low=1e-6, high=1e4, description="linear damper")
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
        if float(self.elastic_force_n(self.length_limits_m.low)) > 0.0:
            raise LimitError(
                f"actuator.restoring_n_per_m = {self.restoring_n_per_m:g} is too small to "
                f"straighten a film that becomes taut over rounding_m = {self.rounding_m:g}. Raise "
                "it, or lower actuator.rounding_m."
            )

    @cached_property
    def pouch(self) -> Pouch:
        """Geometry of one ideal pouch."""
        return Pouch(self.pouch_length_m, self.electrode_length_m)

    @property
    def zipped_f_per_m(self) -> float:
        """Capacitance of one pouch per zipped length, kappa."""
        gap_m = 2.0 * self.film_thickness_m
        return VACUUM_F_PER_M * self.permittivity * self.pouch_width_m / gap_m

    def ideal_force_n(self, angle_rad: ArrayLike, voltage_v: ArrayLike) -> Floats:
        """Force of the ideal pouch, whose film does not stretch.

        Args:
            angle_rad: half angle of its arcs. Shape `(...)`.
            voltage_v: broadcasts with it.
        Returns:
            Force, in N, with the broadcast shape.
        """
        slope = self.pouch.zipped_per_stroke(angle_rad)
        return np.asarray(0.5 * np.asarray(voltage_v) ** 2 * self.zipped_f_per_m * slope)

    def ideal_capacitance_f(self, angle_rad: ArrayLike) -> Floats:
        """Capacitance of all ideal pouches, of the zipped parts only.

        Args:
            angle_rad: half angle of their arcs. Shape `(...)`.
        Returns:
            Capacitance, in F. Shape `(...)`.
        """
        return np.asarray(self.pouches * self.zipped_f_per_m * self.pouch.zipped_m(angle_rad))

    @cached_property
    def free_length_m(self) -> float:
        """Length at which the film's rounded tension and its restoring stiffness balance."""
        limits = self.length_limits_m

        def force_n(length_m: float) -> float:
            return float(self.elastic_force_n(length_m))

        return root(force_n, limits.low, limits.high, xtol=1e-15)

    @property
    def length_limits_m(self) -> Limits:
        """From 5 % below the ideal pouch's shortest length to 10 % above its longest."""
        rest_m = self.pouch.rest_m
        low_m = (1.0 - _SLACK) * rest_m - self.pouch.longest_stroke_m
        return Limits("length", self.pouches * low_m, self.pouches * (1.0 + _TAUT) * rest_m, "m")

    @property
    def width_m(self) -> float:
        """Of the pouches."""
        return self.pouch_width_m

    @property
    def area_m2(self) -> float:
        """Of both films."""
        return 2.0 * self.film_thickness_m * self.pouch_width_m

    @property
    def moving_mass_kg(self) -> float:
        """As set."""
        return self.own_mass_kg

    def on_grid(
        self, lengths_m: Floats, voltages_v: Floats, near: LawValues | None = None
    ) -> LawValues:
        """All pouches at once, each state for the force and the capacitance."""
        if near and self.same_statics(near.law) and np.array_equal(near.lengths_m, lengths_m):
            return near
        length, count = lengths_m / self.pouches, voltages_v.size
        acting_v = np.maximum(voltages_v, 1.0)
        small = acting_v < _SMALL * self.half_zipped_v
        within_v = acting_v[small, None] * np.sqrt(0.5 * (_NODES + 1.0))
        every_v = np.concatenate([[0.0], acting_v, within_v.ravel()])
        known = near.solution if near else None
        if not isinstance(known, np.ndarray) or known.shape != (every_v.size, length.size):
            known = None
        found = self._state(length, every_v[:, None], known)
        at_rest_n = found.tension_n[0]
        pull_n_v2 = (at_rest_n - found.tension_n[1 : 1 + count]) / acting_v[:, None] ** 2
        if small.any():  # see `electric_force_n`
            slopes = found.tension_per_pull[1 + count :].reshape(-1, _NODES.size, length.size)
            mean = 0.5 * np.einsum("vnl,n->vl", slopes, _WEIGHTS)
            pull_n_v2[small] = -0.5 * self.zipped_f_per_m * mean
        zipped_m = np.where(
            voltages_v[:, None] < 1.0, found.zipped_m[:1], found.zipped_m[1 : 1 + count]
        )
        return LawValues(
            self, lengths_m, at_rest_n + self.restoring_n_per_m * (length - self.pouch.rest_m),
            self.pouches * (self._unzipped_f + self.zipped_f_per_m * zipped_m),
            pull_n_v2, found.y,
        )  # fmt: skip

    def elastic_energy_j(self, length_m: ArrayLike) -> Floats:
        """Of the films at 0 V."""
        length = np.asarray(length_m, dtype=np.float64) / self.pouches
        spring = 0.5 * self.restoring_n_per_m * (length - self.pouch.rest_m) ** 2
        return np.asarray(self.pouches * (self._energy_j(length, 0.0) + spring))

    def elastic_force_n(self, length_m: ArrayLike) -> Floats:
        """Tension of the films at 0 V."""
        length = np.asarray(length_m, dtype=np.float64) / self.pouches
        spring = self.restoring_n_per_m * (length - self.pouch.rest_m)
        return np.asarray(self._state(length, 0.0).tension_n + spring)

    def coenergy_j(self, length_m: ArrayLike, voltage_v: ArrayLike) -> Floats:
        """Energy of the pouches at 0 V minus that at the voltage."""
        length = np.asarray(length_m, dtype=np.float64) / self.pouches
        voltage = np.asarray(voltage_v, dtype=np.float64)
        zipping = self._energy_j(length, 0.0) - self._energy_j(length, voltage)
        return np.asarray(self.pouches * (zipping + 0.5 * self._unzipped_f * voltage**2))

    def electric_force_n(self, length_m: ArrayLike, voltage_v: ArrayLike) -> Floats:
        """What the voltage adds to the films' tension."""
        length, voltage = np.broadcast_arrays(
            np.asarray(length_m, dtype=np.float64) / self.pouches,
            np.abs(np.asarray(voltage_v, dtype=np.float64)),
        )
        at_rest_n = self._state(length, 0.0).tension_n
        added = np.array(at_rest_n - self._state(length, voltage).tension_n)
        small = voltage < _SMALL * self.half_zipped_v
        if small.any():  # integral of the slope over the voltage squared
            squares = voltage[small, None] ** 2 * 0.5 * (_NODES + 1.0)
            slopes = self._state(length[small, None], np.sqrt(squares)).tension_per_pull
            mean = 0.5 * (slopes * _WEIGHTS).sum(axis=-1)
            added[small] = -0.5 * voltage[small] ** 2 * self.zipped_f_per_m * mean
        return added

    def capacitance_f(self, length_m: ArrayLike, voltage_v: ArrayLike = 0.0) -> Floats:
        """Of the zipped and the unzipped electrodes of all pouches."""
        length = np.asarray(length_m, dtype=np.float64) / self.pouches
        zipped_m = self._state(length, np.asarray(voltage_v, dtype=np.float64)).zipped_m
        return np.asarray(self.pouches * (self._unzipped_f + self.zipped_f_per_m * zipped_m))

    def differential_capacitance_f(self, length_m: ArrayLike, voltage_v: ArrayLike) -> Floats:
        """That at a constant zipped length: zipping is too slow for a carrier."""
        return self.capacitance_f(length_m, voltage_v)

    def gap_m(self, length_m: ArrayLike) -> Floats:
        """Of both films, where they are zipped."""
        return np.full(np.shape(length_m), 2.0 * self.film_thickness_m)

    @property
    def losses(self) -> Losses:
        """Viscoelastic film, oil, charge that stays."""
        return Losses(
            self.damping_n_s_per_m, self.branch_share, self.branch_relaxation_s,
            charge_share=self.charge_share, charge_relaxation_s=self.charge_relaxation_s,
            hysteresis_n=self.hysteresis_n, hysteresis_width=self.hysteresis_width,
        )  # fmt: skip

    @property
    def circuit(self) -> Circuit:
        """Electrodes in series."""
        return Circuit(self.series_ohm, self.leakage_ohm, self.breakdown_v_per_m)

    # ---- one pouch -------------------------------------------------------------------------------

    @property
    def _unzipped_f(self) -> float:
        return self.unzipped_share * self.zipped_f_per_m * self.electrode_length_m

    @property
    def _rounding_j(self) -> float:
        """Of the onset of zipping, theta."""
        length_m = self.zipped_share**2 / (1.0 - self.zipped_share) * self.electrode_length_m
        return float(self._pull_n(self.half_zipped_v)) * length_m

    def _pull_n(self, voltage_v: ArrayLike) -> Floats:
        """Energy that zipping sets free, per zipped length."""
        return np.asarray(0.5 * self.zipped_f_per_m * np.asarray(voltage_v) ** 2)

    def _energy_j(self, length: Floats, voltage_v: ArrayLike) -> Floats:
        """The minimum of the class's docstring without C_u."""
        voltage = np.asarray(voltage_v, dtype=np.float64)
        state = self._state(length, voltage)
        rounding_j = self.film_stiffness_n_per_m * self.rounding_m**2
        film_j = rounding_j * _softplus_integral(state.stretch_m / self.rounding_m)
        rounded_j = self._rounding_j * np.log(state.zipped_m / self.electrode_length_m)
        used = state.zipped_m / self.electrode_length_m
        resisted_j = -self._pull_n(self.half_zipped_v) * self.electrode_length_m * (
            used + np.log1p(-used))  # fmt: skip
        zipping_j = self._pull_n(voltage) * state.zipped_m
        return np.asarray(film_j + resisted_j - rounded_j - zipping_j)

    def _state(self, length: Floats, voltage_v: ArrayLike, near: Floats | None = None) -> _State:
        r"""Solve the balance of zipping, $T\,ds/dz = \tfrac12\kappa V^2 + \theta/z - U'$.

        In $y = \ln(ds/dz)$ the tension is explicit, and so is the length, which falls with y.
        The solution of a similar law is near enough for two steps of Newton.
        """
        length, pull_n = np.broadcast_arrays(length, self._pull_n(voltage_v))
        wanted_m, pulls_n = length.ravel(), pull_n.ravel()
        with np.errstate(all="ignore"):  # outside the bracket some terms are infinite
            y = self._solved(wanted_m, pulls_n) if near is None else near.ravel()
            if near is not None:
                y = y + self._left(y, self._balance(y, pulls_n), wanted_m)
            found = self._balance(y, pulls_n)
            left = 0.0 if near is None else self._left(y, found, wanted_m)
        stretch_m = wanted_m - found.pouch_m
        tension_n, rise_n, slope_n = self._tension(found, stretch_m)
        # what is left of a similar law's solution counts linearly
        zipped_m, tension_n = found.zipped_m + found.zipped_by * left, tension_n + rise_n * left
        parts = (y + left, zipped_m, stretch_m, tension_n, rise_n / slope_n)
        return _State(*(np.reshape(part, length.shape) for part in parts))

    def _solved(self, wanted_m: Floats, pulls_n: Floats) -> Floats:
        """Values of y in a bracket, which is halved where a step of Newton leaves it."""
        left = np.arange(wanted_m.size)
        y, low, high = self._start(wanted_m, pulls_n)
        for _ in range(_ITERATIONS):
            at, wanted = y[left], wanted_m[left]
            balance = self._balance(at, pulls_n[left])
            new, over_m, slack = self._newton(at, balance, wanted)
            longer = np.where(balance.possible, over_m > 0.0, balance.zipped_m <= 0.0)
            low[left] = np.where(longer, at, low[left])
            high[left] = np.where(longer, high[left], at)
            inside = (low[left] < new) & (new < high[left]) & (balance.possible | slack)
            # where all electrodes are zipped the step is 0 without being near a solution
            left_over = balance.zipped_m < self.electrode_length_m
            close = left_over & (np.abs(new - at) <= _CLOSE * np.abs(at))
            y[left] = np.where(inside, new, 0.5 * (low[left] + high[left]))
            halved = high[left] - low[left] <= _CLOSEST * np.abs(at)
            y[left[close]] = new[close]
            left = left[~(close | halved)]
            if left.size == 0:
                break
        return y

    def _left(self, y: Floats, balance: _Balance, wanted_m: Floats) -> Floats:
        """Newton's step, where there is one."""
        step = self._newton(y, balance, wanted_m)[0] - y
        return np.where(np.isfinite(step), step, 0.0)

    def _newton(
        self, y: Floats, balance: _Balance, wanted_m: Floats
    ) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Newton's next y, the length beyond the wanted one, and whether the film is slack."""
        over_m = balance.pouch_m + balance.stretch_m - wanted_m
        stretch_m = wanted_m - balance.pouch_m
        # the logarithm of a slack film's tension misleads Newton
        slack = ~(np.minimum(stretch_m, balance.stretch_m) > -2.0 * self.rounding_m)
        tension_n, _, slope_n = self._tension(balance, stretch_m)
        missing_n = tension_n * balance.steep - balance.needed_n
        return y - np.where(slack, missing_n / slope_n, over_m / balance.length_by), over_m, slack

    def _tension(self, balance: _Balance, stretch_m: Floats) -> tuple[Floats, Floats, Floats]:
        """Tension at a stretch, its derivative by y, and that of what it lacks for balance."""
        stretch, stiffness = stretch_m / self.rounding_m, self.film_stiffness_n_per_m
        tension_n = stiffness * self.rounding_m * np.logaddexp(0.0, stretch)
        rise_n = stiffness * expit(stretch) * balance.steep * balance.zipped_by
        return tension_n, rise_n, (tension_n + rise_n) * balance.steep - balance.needed_by

    def _start(self, wanted_m: Floats, pulls_n: Floats) -> tuple[Floats, Floats, Floats]:
        """First value and bracket of y: from a grid at each voltage if there are only a few."""
        first = -math.log(float(self.pouch.zipped_per_stroke(self.pouch.rest_angle_rad)))
        low, high = np.full(wanted_m.size, first), np.full(wanted_m.size, _STEEPEST)
        y, pulls = low + 1.0, np.unique(pulls_n)
        if pulls.size * _GRID.size > wanted_m.size:
            return y, low, high
        grid = first + _GRID
        for pull_n in pulls:
            balance, here = self._balance(grid, pull_n), pulls_n == pull_n
            nodes = grid[balance.possible]
            lengths_m = (balance.pouch_m + balance.stretch_m)[balance.possible]
            y[here] = np.interp(wanted_m[here], lengths_m[::-1], nodes[::-1])
            after = np.searchsorted(-lengths_m, -wanted_m[here])
            low[here] = np.append(first, nodes)[after]
            high[here] = np.append(grid, _STEEPEST)[after]
        return y, low, high

    def _balance(self, y: Floats, pull_n: Floats | float) -> _Balance:
        pouch, stiffness, rounding_m = self.pouch, self.film_stiffness_n_per_m, self.rounding_m
        steep = np.exp(y)
        cosine = 1.0 / (1.0 + steep)
        sine = np.sqrt(steep * (steep + 2.0)) * cosine
        arcs = pouch.arcs(np.arctan2(sine, cosine), sine, cosine)
        zipped_m = arcs.zipped_m
        zipped_by = arcs.zipped_per_rad * cosine**2 * steep / sine
        left_m = self.electrode_length_m - zipped_m
        resisted_n = self._pull_n(self.half_zipped_v) * zipped_m / left_m
        rounded_n = self._rounding_j / zipped_m
        needed_n = pull_n + rounded_n - resisted_n
        needed_by = (
            -zipped_by / zipped_m * (rounded_n + resisted_n * self.electrode_length_m / left_m)
        )
        tension_n = needed_n / steep
        share = tension_n / (stiffness * rounding_m)
        slack = -np.expm1(-share)
        stretch_m = rounding_m * (share + np.log(slack))
        compliance = 1.0 / (stiffness * slack)
        return _Balance(
            steep, zipped_m, zipped_by, needed_n, needed_by,
            pouch.rest_m - arcs.stroke_m, stretch_m,
            compliance * (needed_by / steep - tension_n) - steep * zipped_by,
            (needed_n > 0.0) & (zipped_m > 0.0) & (left_m > 0.0),
        )  # fmt: skip


def _softplus_integral(x: Floats) -> Floats:
    """Integral of ln(1 + e^t) up to x."""
    tail = -spence(1.0 + np.exp(-np.abs(x)))
    return np.asarray(np.where(x > 0.0, 0.5 * x**2 + math.pi**2 / 6.0 - tail, tail))
