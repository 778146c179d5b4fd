r"""What a controller may know of its actuator: the identified law and the bench's limits.

All forces act along the length, and the electric one depends on the square of the voltage:

$F_u = k(x, V)\,(V^2 + r)$

with the mean square $r$ of the carrier. `k`, the elastic force and the gap are read from the table
of the law, so that a controller can call them in each update.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from haselab.actuators import (
    ACTUATORS,
    ADDED_INERTIA,
    GRAVITY_M_S2,
    ActuatorLaw,
    LawTable,
    equilibrium_m,
    feedthrough,
    law_table,
    measured_parameters,
    with_parameters,
    with_stated,
)
from haselab.base import InputError, LimitError
from haselab.models.actuator import ActuatorTables
from haselab.models.actuator.sections import PhysicalRecords

__all__ = ["KnownActuator", "known_actuator"]

Floats = NDArray[np.float64]
_USUAL_GAIN = 5000.0
_FAR = 3.0  # widths of the reachable range: farther, no load moves it
_NEWTON_STEPS = 8  # each doubles the correct digits
# A loop near 0 V needs this share of the largest pull, besides what creep takes from it. With two
# thirds of it, loops of a curling HASEL sometimes lost the length after the largest step.
_KEPT_PULL, _MOST_KEPT = 0.075, 0.5
_BLIND = 5.0  # times less capacitance per length at the lowest drive than at the one that holds
_USUAL_NOISE = 2e-4  # strain, where it is not known
# Of the reachable range: steps for slopes, and what is left out at its ends, where the drive is 0.
_SLOPE_STEP, _INSIDE = 1e-4, 0.01
_SENSED_POINTS = 401  # strains among which the end of the sensed range is found
_BENCH = ("camera.", "sensing.", "start.")  # parameters of a fit that are none of the law


@dataclass(frozen=True)
class KnownActuator:
    """An actuator as its file describes it, for controllers that use its physics.

    Args:
        law: identified.
        mass_kg: hung mass.
        zero_length_m: length at strain 0, in lengths of the law.
        low_v: lowest drive, before the amplifier.
        high_v: highest drive.
        gain_v_per_v: of the amplifier.
        added_inertia_kg: inertia without weight.
        carrier_v2: mean square of the carrier's voltage at the actuator.
        sensing_scale: sensed capacitance over that of the law.
        capacitance_noise_f: standard deviation of the capacitance of one update; NaN: not known.
        highest_field_v_per_m: that the dielectric may have.
        longest_m: longest length so far, which softened the actuator; 0: it is new.
    Raises:
        InputError: The law cannot be sampled.
    Example:
        >>> from haselab.actuators import DeaStack
        >>> known = KnownActuator(DeaStack(), 0.1, 0.036, 0.0, 1.0, 3000.0)
        >>> pull_n = known.pull_n(0.036, 0.8)
        >>> round(known.drive_v(0.036, pull_n), 9)
        0.8
    """

    law: ActuatorLaw
    mass_kg: float
    zero_length_m: float
    low_v: float
    high_v: float
    gain_v_per_v: float
    added_inertia_kg: float = 0.0
    carrier_v2: float = 0.0
    sensing_scale: float = 1.0
    capacitance_noise_f: float = math.nan
    highest_field_v_per_m: float = math.inf
    longest_m: float = 0.0

    # ---- lengths -----------------------------------------------------------------------------

    def strain(self, length_m: float) -> float:
        """Strain of a length, in m."""
        return length_m / self.zero_length_m - 1.0

    def length_m(self, strain: float) -> float:
        """Length of a strain, in m."""
        return self.zero_length_m * (1.0 + strain)

    def sensed_length_m(self, capacitance_f: float, drive_v: float = 0.0) -> float:
        """Length that has a sensed capacitance.

        Args:
            capacitance_f: sensed, in F; NaN gives NaN.
            drive_v: in force, in V; it matters only where the capacitance depends on it.
        Returns:
            Length, in m, within the limits of the law.
        """
        farad = capacitance_f / self.sensing_scale
        rows, lengths_m = self._by_capacitance
        if len(rows) == 1:
            return float(np.interp(farad, rows[0], lengths_m))
        row, share = self._row(drive_v)
        found = [float(np.interp(farad, rows[k], lengths_m)) for k in (row, row + 1)]
        return found[0] + share * (found[1] - found[0])

    def static_capacitance_f(self, strain: float) -> float:
        """Capacitance while a strain is held for long, in F, without the error of sensing."""
        return float(self.law.capacitance_f(self.length_m(strain), self._holding_v(strain)))

    def length_noise_m(self, strain: float) -> float:
        """Standard deviation of a sensed length while its strain is held for long.

        It is 0.02 % of the length at strain 0 where the noise of the capacitance is not known, and
        at most that of any length that the law has.
        """
        if math.isnan(self.capacitance_noise_f):
            return _USUAL_NOISE * self.zero_length_m
        length_m, step_m = self.length_m(strain), self.table.step_m
        near = np.array([length_m - step_m, length_m + step_m])
        ends = self.law.capacitance_f(near, self._holding_v(strain))
        change_f = abs(float(ends[1] - ends[0])) * self.sensing_scale
        any_m = float(self._lengths_m[-1] - self._lengths_m[0]) / math.sqrt(12.0)
        noise = 2.0 * step_m * self.capacitance_noise_f
        return any_m if noise >= any_m * change_f else noise / change_f

    def _holding_v(self, strain: float) -> float:
        """Voltage at the actuator that holds a strain for long, at most the highest one, in V."""
        drive_v = min(self.static_drive_v(strain), max(self.high_v, -self.low_v))
        return self.gain_v_per_v * drive_v

    # ---- forces ------------------------------------------------------------------------------

    def elastic_n(self, length_m: float) -> float:
        """Elastic force of the relaxed actuator, softened by its longest length so far."""
        longest = max(length_m, self.longest_m) / self.law.free_length_m
        force = float(np.interp(length_m, self._lengths_m, self.table.elastic_n))
        return force * float(self.law.losses.softening(longest))

    def pull_per_v2(self, length_m: float, drive_v: float = 0.0) -> float:
        """Electric force over the mean square of the actuator's voltage, in N/V^2."""
        rows = self.table.pull_n_v2
        if len(rows) == 1:
            return float(np.interp(length_m, self._lengths_m, rows[0]))
        row, share = self._row(drive_v)
        found = [float(np.interp(length_m, self._lengths_m, rows[k])) for k in (row, row + 1)]
        return found[0] + share * (found[1] - found[0])

    def pull_n(self, length_m: float, drive_v: float) -> float:
        """Electric force at a drive, carrier included, in N."""
        volt = self.gain_v_per_v * drive_v
        return self.pull_per_v2(length_m, drive_v) * (volt * volt + self.carrier_v2)

    def drive_v(self, length_m: float, pull_n: float) -> float:
        """Drive that pulls with a force, positive; 0 V for what the carrier alone exceeds.

        Args:
            length_m: present, in m.
            pull_n: wanted, in N.
        Returns:
            Drive, in V, not limited, but at most what the table of the law reaches.
        """
        rows = self.table.pull_n_v2
        if len(rows) == 1:
            square = pull_n / self.pull_per_v2(length_m) - self.carrier_v2
            return math.sqrt(max(square, 0.0)) / self.gain_v_per_v
        place = (length_m - self.table.low_m) / self.table.step_m
        column = min(max(int(place), 0), rows.shape[1] - 2)
        share = min(max(place - column, 0.0), 1.0)
        volts = self.table.step_v * np.arange(len(rows), dtype=np.float64)
        per_v2 = rows[:, column] + share * (rows[:, column + 1] - rows[:, column])
        forces = per_v2 * (volts * volts + self.carrier_v2)
        step = 1 if forces[-1] > forces[0] else -1
        volt = float(np.interp(pull_n, forces[::step], volts[::step]))
        if forces.min() < pull_n < forces.max():
            volt = self._exact_v(volt, pull_n, per_v2)
        return volt / self.gain_v_per_v

    def _exact_v(self, volt: float, pull_n: float, per_v2: Floats) -> float:
        """Voltage for which `pull_n` gives this force, by Newton from one between the same rows.

        Args:
            volt: where to start.
            pull_n: wanted, in N.
            per_v2: force over the mean square of the voltage, in N/V^2, one for each row.
        """
        step_v = self.table.step_v
        row = min(int(volt / step_v), per_v2.size - 2)
        slope = float(per_v2[row + 1] - per_v2[row]) / step_v
        for _ in range(_NEWTON_STEPS):
            square = volt * volt + self.carrier_v2
            per = float(per_v2[row]) + slope * (volt - row * step_v)
            steep = slope * square + 2.0 * per * volt
            if steep == 0.0:
                break
            nearer = volt - (per * square - pull_n) / steep
            volt, before = min(max(nearer, row * step_v), (row + 1) * step_v), volt
            if abs(volt - before) <= 1e-12 * step_v:
                break
        return volt

    def highest_drive_v(self, length_m: float) -> float:
        """Highest drive at a length: that of the limits, or of the highest field, in V."""
        gap_m = float(np.interp(length_m, self._lengths_m, self.table.gap_m))
        return min(self.high_v, self.highest_field_v_per_m * gap_m / self.gain_v_per_v)

    # ---- equilibria --------------------------------------------------------------------------

    def static_pull_n(self, strain: float, mass_kg: float | None = None) -> float:
        """Electric force that holds a strain for long, negative below what the weight stretches.

        Args:
            strain: wanted.
            mass_kg: hung; None: the known one.
        Returns:
            Force, in N.
        """
        mass = self.mass_kg if mass_kg is None else mass_kg
        return self.elastic_n(self.length_m(strain)) - GRAVITY_M_S2 * mass

    def static_drive_v(self, strain: float, mass_kg: float | None = None) -> float:
        """Drive that holds a strain for long, in V; 0 below what the weight alone stretches."""
        return self.drive_v(self.length_m(strain), self.static_pull_n(strain, mass_kg))

    def reachable(self, mass_kg: float | None = None) -> tuple[float, float]:
        """Lowest and highest strain that can be held for long within drive limits and field.

        The range ends where a higher drive would no longer move the actuator further (pull-in).

        Args:
            mass_kg: hung; None: the known one.
        Returns:
            Both strains; the one without drive is the lower one where the actuator elongates.
        Raises:
            InputError: No strain can be held with this mass.
        """
        mass = self.mass_kg if mass_kg is None else mass_kg
        step = 1 if self.elongates else -1  # along the grid, as the drive rises
        table, lengths = self.table, self._lengths_m[::step]
        longest = np.maximum(lengths, self.longest_m) / self.law.free_length_m
        softened = table.elastic_n[::step] * self.law.losses.softening(longest)
        needed_n = softened - GRAVITY_M_S2 * mass
        if len(table.pull_n_v2) == 1:  # as `drive_v`, at once
            squares = needed_n / table.pull_n_v2[0, ::step] - self.carrier_v2
            drives_v = np.sqrt(np.maximum(squares, 0.0)) / self.gain_v_per_v
        else:
            drives_v = np.array([
                self.drive_v(float(length), float(force))
                for length, force in zip(lengths, needed_n, strict=True)
            ])  # fmt: skip
        field_v = self.highest_field_v_per_m * table.gap_m[::step] / self.gain_v_per_v
        first = int(np.argmax(drives_v > max(self.low_v, 0.0)))
        after = drives_v[first:]
        ends = (after > np.minimum(self.high_v, field_v[first:])) | (
            np.diff(after, prepend=0.0) <= 0.0
        )
        last = first + (int(np.argmax(ends)) if ends.any() else after.size) - 1
        if last <= first:
            raise InputError(
                f"No strain can be held with {mass:g} kg within {self.high_v:g} V and a field of "
                f"{self.highest_field_v_per_m:g} V/m. Use another mass."
            )
        found = self.strain(float(lengths[first])), self.strain(float(lengths[last]))
        return min(found), max(found)

    def sensed_range(self) -> tuple[float, float]:
        """The reachable strains at which the capacitance keeps determining the length.

        Where the pouches of an actuator are slack near 0 V, the capacitance hardly depends on the
        length. A loop that comes there loses the length, so the range ends before, but not before
        strain 0, where loops start.

        Returns:
            Lowest and highest strain; the reachable range if the lowest drive is not blind.
        Raises:
            InputError: See `reachable`.
        """
        low, high = self.reachable()
        end = self._last_sensed
        if end is None:
            return low, high
        return (
            (min(end, max(low, 0.0)), high) if self.elongates else (low, max(end, min(high, 0.0)))
        )

    @cached_property
    def _last_sensed(self) -> float | None:
        """Strain nearest to that of the lowest drive that loops can sense; None: all of them."""
        if not self.capacitance_follows_drive:
            return None
        low, high = self.reachable()
        strains = np.linspace(*((low, high) if self.elongates else (high, low)), _SENSED_POINTS)
        pulls = np.abs([self.static_pull_n(strain) for strain in strains.tolist()])
        share = min(_KEPT_PULL + sum(self.law.losses.branch_share), _MOST_KEPT)
        end = float(strains[np.argmax(pulls >= share * pulls[-1])])
        driven, idle = (self._per_length(end, v) for v in (self.static_drive_v(end), self.low_v))
        return end if _BLIND * idle < driven else None

    @property
    def capacitance_follows_drive(self) -> bool:
        """Whether the capacitance at one length depends on the voltage, as that of pouches."""
        return len(self.table.pull_n_v2) > 1

    def feedthrough(self, strain: float) -> float:
        """Feedthrough of the drive to the sensed strain, see `LoopSetting`.

        Args:
            strain: that is held, within the reachable ones.
        Returns:
            What the change of the voltage at constant length contributes to the change of the
            capacitance, as a fraction of it; 0 for a capacitance that depends on the length alone.
        Raises:
            InputError: See `reachable`.
        """
        if not self.capacitance_follows_drive:
            return 0.0
        low, high = self.reachable()
        step, inside = _SLOPE_STEP * (high - low), _INSIDE * (high - low)
        middle = min(max(strain, low + inside), high - inside)
        lengths = [self.length_m(middle + side * step) for side in (-1.0, 1.0)]
        volts = [
            self.gain_v_per_v * self.static_drive_v(middle + side * step) for side in (-1.0, 1.0)
        ]
        return feedthrough(
            self.law,
            0.5 * sum(lengths),
            0.5 * sum(volts),
            (lengths[1] - lengths[0]) / (volts[1] - volts[0]),
        )

    @cached_property
    def slack_f(self) -> float:
        """Sensed capacitance at 0 V if it hardly depends on the length there; else 0."""
        if (end := self._last_sensed) is None:
            return 0.0
        return float(self.law.capacitance_f(self.length_m(end))) * self.sensing_scale

    def _per_length(self, strain: float, drive_v: float) -> float:
        """Capacitance per length at a drive, in F/m, positive."""
        ends_m = self.length_m(strain) + self.table.step_m * np.array([-1.0, 1.0])
        volt = max(self.gain_v_per_v * abs(drive_v), math.sqrt(self.carrier_v2))
        ends_f = self.law.differential_capacitance_f(ends_m, volt)
        return abs(float(ends_f[1] - ends_f[0]))

    def limited_strain(self, strain: float) -> float:
        """A desired strain, at most three times the width of the reachable range beyond its ends.

        An actuator that cannot reach a strain goes to the end of its range, and another load moves
        that range. Farther away, the plans and integrators of a controller lose their accuracy.

        Args:
            strain: desired, also in percent by mistake.
        """
        low, high = self._wanted_ends
        return min(max(strain, low), high)

    # ---- tables ------------------------------------------------------------------------------

    @cached_property
    def _wanted_ends(self) -> tuple[float, float]:
        try:
            low, high = self.reachable()
        except InputError:
            return -math.inf, math.inf
        return low - _FAR * (high - low), high + _FAR * (high - low)

    @cached_property
    def table(self) -> LawTable:
        """The law on a grid, up to the highest voltage with the carrier."""
        peak_v = math.sqrt(2.0 * self.carrier_v2)
        return law_table(self.law, self.gain_v_per_v * max(self.high_v, -self.low_v) + peak_v)

    @cached_property
    def _lengths_m(self) -> Floats:
        knots = np.arange(self.table.elastic_n.size, dtype=np.float64)
        return np.asarray(self.table.low_m + self.table.step_m * knots)

    @cached_property
    def elastic_knots_n(self) -> list[float]:
        """`elastic_n` at the lengths of the table."""
        return [self.elastic_n(length_m) for length_m in self._lengths_m.tolist()]

    @cached_property
    def elongates(self) -> bool:
        """Whether a voltage makes the actuator longer."""
        return bool(np.median(self.table.pull_n_v2[0]) > 0.0)

    @cached_property
    def _by_capacitance(self) -> tuple[Floats, Floats]:
        """Rising capacitances, one row for each voltage, and their lengths."""
        step = 1 if np.median(np.diff(self.table.capacitance_f[0])) > 0.0 else -1
        rows = np.maximum.accumulate(self.table.capacitance_f[:, ::step], axis=1)
        return np.ascontiguousarray(rows), np.ascontiguousarray(self._lengths_m[::step])

    def _row(self, drive_v: float) -> tuple[int, float]:
        """Row of the table below a drive, and the share of the way to the next."""
        place = abs(self.gain_v_per_v * drive_v) / self.table.step_v
        row = min(int(place), len(self.table.pull_n_v2) - 2)
        return row, place - row


def known_actuator(tables: ActuatorTables, source: object = "") -> KnownActuator | None:
    """What an actuator file says of its actuator.

    Args:
        tables: of the file.
        source: file, for messages.
    Returns:
        The actuator; None: the file has no `[model.physical]`.
    Raises:
        InputError: A parameter is unknown or out of range, or the file lacks the mass, the length
            at strain 0 or the limits of the drive.
    """
    model = tables.model.physical if tables.model else None
    if model is None:
        return None
    where = f" {source}" if source else ""
    low_v, high_v = tables.drive.low_v, tables.drive.high_v
    mass_kg = model.mass_kg or tables.actuator.mass_kg
    zero_m = tables.actuator.geometry.zero_length_m
    absent = [
        name
        for name, value in (
            ("actuator.mass_kg", mass_kg),
            ("actuator.geometry.zero_length_m", zero_m),
            ("drive.high_v", high_v),
        )
        if value is None
    ]
    if absent:
        raise InputError(
            f"[model.physical] needs {', '.join(absent)} for a controller. Add "
            f"{'it' if len(absent) == 1 else 'them'} to the actuator file.{where}"
        )
    assert mass_kg is not None and zero_m is not None and high_v is not None
    own = {name: value for name, value in model.parameters.items() if not name.startswith(_BENCH)}
    try:
        law = with_stated(ACTUATORS.find(model.kind)(), tables.actuator.parameters)
        model.check_measured(measured_parameters(law))
        law = with_parameters(law, own)
    except (InputError, LimitError) as error:
        raise InputError(f"[model.physical]: {error}{where}") from error
    records, given = model.records, model.parameters
    gain = tables.drive.gain_v_per_v or (records.gain_v_per_v if records else _USUAL_GAIN)
    shown = (zero_m - given.get("camera.offset_m", 0.0)) / given.get("camera.scale", 1.0)
    noise = model.residuals.capacitance_noise_f
    return KnownActuator(
        law=law,
        mass_kg=mass_kg,
        zero_length_m=shown,
        low_v=0.0 if low_v is None else low_v,
        high_v=high_v,
        gain_v_per_v=gain,
        added_inertia_kg=given.get(ADDED_INERTIA, 0.0),
        carrier_v2=0.5 * records.carrier_v**2 if records else 0.0,
        sensing_scale=given.get("sensing.scale", 1.0),
        capacitance_noise_f=math.nan if noise is None else noise,
        highest_field_v_per_m=tables.drive.highest_field_v_per_m or math.inf,
        longest_m=_longest_m(law, gain, mass_kg, records),
    )


def _longest_m(
    law: ActuatorLaw, gain_v_per_v: float, mass_kg: float, records: PhysicalRecords | None
) -> float:
    """Longest length of the records, from their highest voltage and heaviest mass; 0: not known."""
    found = [0.0]
    if records is not None:
        highest_v = gain_v_per_v * records.highest_drive_v
        for volt, mass in ((highest_v, mass_kg), (0.0, records.heaviest_kg)):
            with contextlib.suppress(LimitError):
                found.append(equilibrium_m(law, volt, GRAVITY_M_S2 * mass))
    return max(found)
