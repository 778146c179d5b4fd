r"""Lengths and capacitances of an actuator under given voltages and loads, with derivatives.

The compiled motion steps any law by a table of its forces. Derivatives by the law's parameters
$\theta$ go through what the motion uses of it, its tables $T$ and losses $l$:

$\frac{dy}{d\theta} = \frac{\partial y}{\partial T}\frac{dT}{d\theta}
+ \frac{\partial y}{\partial l}\frac{dl}{d\theta}$

The first factors are exact derivatives of the steps computed; the second are differences of the
law, which is evaluated a few hundred times for that.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab import _motion
from haselab.actuators.law import ActuatorLaw
from haselab.actuators.losses import DRIFTS, drift_pairs
from haselab.actuators.operating_point import equilibrium_m
from haselab.actuators.table import LawTable, at_all_voltages, law_table, solved_voltages
from haselab.actuators.threads import in_threads
from haselab.base import InputError, LimitError

__all__ = [
    "ADDED_INERTIA",
    "GRAVITY_M_S2",
    "Drive",
    "Response",
    "SampledLaw",
    "measured_parameters",
    "motion_parameters",
    "with_parameters",
    "with_stated",
]

Floats = NDArray[np.float64]
ADDED_INERTIA = "load.added_inertia_kg"
GRAVITY_M_S2 = 9.81
_LONGEST_STEP_S = 2.5e-3
_CORES = os.cpu_count() or 1
_VECTOR = 4  # numbers in a register of AVX2
_COLUMNS_EACH = 24  # for fewer columns, another thread costs more: it repeats the motion
_PHASE = 0.1  # of the fastest motion in a step, rad
_SHORTEST_STEP_S = 1e-6
_STEP = 1e-4  # of a parameter, for the derivatives of the law's table
_REMEMBERED = 4  # laws: a search wants the derivatives of the one that it has just simulated


def motion_parameters(law: ActuatorLaw) -> NDArray[np.void]:
    """Losses and own inertia of a law, as the compiled motion takes them.

    Args:
        law: of the actuator.
    Returns:
        One record of the parameters. Shape `(1,)`.
    Raises:
        InputError: The law has more branches than the compiled motion.
    """
    found = _parameters(law)
    found["free_length_m"] = law.free_length_m
    return found


def _parameters(law: ActuatorLaw) -> NDArray[np.void]:
    """The same without the free length, which some laws must solve for."""
    losses, count = law.losses, len(law.losses.branch_share)
    if count > _motion.BRANCHES:
        raise InputError(
            f"The law {law.kind} has {count} viscoelastic branches; at most {_motion.BRANCHES} "
            "can be simulated. Remove some."
        )
    found = np.zeros(1, _motion.PARAMETERS)
    found["softening_share"] = losses.softening_share
    found["softening_stretch"] = losses.softening_stretch
    found["softening_width"] = losses.softening_transition
    found["branch_share"][0, :count] = losses.branch_share
    found["branch_s"][0, :count] = losses.branch_relaxation_s
    found["damping_n_s_m"] = losses.damping_n_s_per_m
    found["inertia_kg"] = law.moving_mass_kg
    found["charge_share"] = losses.charge_share
    found["charge_s"] = losses.charge_relaxation_s
    found["hysteresis_n"] = losses.hysteresis_n
    found["hysteresis_width"] = losses.hysteresis_width
    found["elastic_scale"] = 1.0
    found["step_s"], found["phase"] = _LONGEST_STEP_S, _PHASE
    return found


@dataclass(frozen=True)
class Drive:
    """What acts on an actuator, constant from each edge to the next.

    Args:
        edge_s: rising. Shape `(N + 1,)`.
        voltage_v: of the actuator. Shape `(N,)`.
        load_n: pulls at the moving end. Shape `(N,)`.
        mass_kg: that moves with it, without the actuator's own. Shape `(N,)`.
        ripple_v2: mean square of the carrier's voltage. Shape `(N,)`.
    Raises:
        InputError: The shapes do not fit together, or the edges do not rise.
    """

    edge_s: Floats
    voltage_v: Floats
    load_n: Floats
    mass_kg: Floats
    ripple_v2: Floats

    def __post_init__(self) -> None:
        count = self.voltage_v.size
        parts = (self.load_n, self.mass_kg, self.ripple_v2)
        if count == 0 or self.edge_s.size != count + 1 or any(part.size != count for part in parts):
            raise InputError(
                f"A drive has {self.edge_s.size} edges and {count} voltages. Give one edge more "
                "than voltages, loads, masses and ripples."
            )
        if not (np.diff(self.edge_s) > 0.0).all():
            raise InputError("The edges of a drive do not rise. Sort them, without repeated times.")


@dataclass(frozen=True)
class Response:
    """Simulated motion of an actuator, and its derivatives by P parameters.

    Args:
        length_m: at the wanted times. Shape `(T,)`.
        speed_m_s: at the wanted times. Shape `(T,)`.
        capacitance_f: mean over each interval; 0 where not wanted. Shape `(N,)`.
        drift_f_s: change of the capacitance over each interval, over its duration. Shape `(N,)`.
        end: after the last interval, a record of `haselab._motion.STATE`. Shape `(1,)`.
        length_by: derivatives of the lengths. Shape `(T, P)`.
        capacitance_by: derivatives of the capacitances that were wanted. Shape `(S, P)`.
        end_by: derivatives of the state at the end, in the rows of the compiled motion.
            Shape `(ROWS, P)`.
    """

    length_m: Floats
    speed_m_s: Floats
    capacitance_f: Floats
    drift_f_s: Floats
    end: NDArray[np.void]
    length_by: Floats
    capacitance_by: Floats
    end_by: Floats


def with_parameters(law: ActuatorLaw, values: Mapping[str, float]) -> ActuatorLaw:
    """Replace parameters of a law.

    Args:
        law: to start from.
        values: by the names of `ActuatorLaw.parameters`; one of several values by its index, such
            as `viscosity.share[0]`; the index after the last one adds a value.
    Returns:
        The changed law; `ADDED_INERTIA` and `DRIFTS` are none of its parameters and change nothing.
    Raises:
        InputError: A name is unknown.
        LimitError: A value is outside its limits.
    Example:
        >>> from haselab.actuators import DeaStack
        >>> with_parameters(DeaStack(), {"actuator.branch_share[1]": 0.2}).losses.branch_share
        (0.05, 0.2)
    """
    names = {about.key: about.name for about in law.described()}
    changed: dict[str, float | tuple[float, ...]] = {}
    for key, value in values.items():
        name, _, index = key.partition("[")
        if key == ADDED_INERTIA or key in DRIFTS:
            continue
        if name not in names:
            raise InputError(
                f"{key} is not a parameter of the law {law.kind}. Its parameters are "
                f"{', '.join(names)}."
            )
        field = names[name]
        old = changed.get(field, getattr(law, field))
        if isinstance(old, tuple) != bool(index):
            many = "a list of numbers" if isinstance(old, tuple) else "one number"
            raise InputError(f"{name} is {many}. Change it.")
        if isinstance(old, tuple):
            parts = list(old)
            if not index[:-1].isdigit() or int(index[:-1]) > len(parts):
                raise InputError(f"{key} does not exist: {name} has {len(parts)} values.")
            place = int(index[:-1])
            parts[place : place + 1] = [float(value)]
            changed[field] = tuple(parts)
        else:
            changed[field] = float(value)
    return dataclasses.replace(law, **changed)


def with_stated(law: ActuatorLaw, values: Mapping[str, float]) -> ActuatorLaw:
    """Replace parameters of a law by those of an actuator file, where a list replaces all values.

    Args:
        law: to start from.
        values: see `with_parameters`; those of a list are complete from the index 0 on.
    Returns:
        The changed law, with as many branches as the lists state.
    Raises:
        InputError: A name is unknown, or a list is stated for a number.
        LimitError: A value is outside its limits, or the lists of the branches differ in length.
    Example:
        >>> from haselab.actuators import DeaStack
        >>> stated = {"actuator.branch_share[0]": 0.2, "actuator.branch_relaxation_s[0]": 1.0}
        >>> with_stated(DeaStack(), stated).losses.branch_share
        (0.2,)
    """
    shorter = {}
    for about in law.described():
        stated = {key for key in values if key.startswith(f"{about.key}[")}
        complete = stated == {f"{about.key}[{k}]" for k in range(len(stated))}
        default = getattr(law, about.name)
        if stated and complete and isinstance(default, tuple):
            shorter[about.name] = default[: len(stated)]
    found = with_parameters(dataclasses.replace(law, **shorter), values)
    _ = found.losses  # refuses lists of different lengths
    return found


def measured_parameters(law: ActuatorLaw) -> dict[str, float]:
    """Return the parameters that are measured separately and not fitted, such as a width.

    Args:
        law: has their values.
    Returns:
        Values by name, see `with_parameters`. Parameters of the circuit, such as the breakdown
        field, are left out, because the motion does not depend on them.
    Example:
        >>> from haselab.actuators import DeaStack
        >>> measured_parameters(DeaStack())["actuator.layers"]
        50.0
    """
    circuit = {field.name for field in dataclasses.fields(law.circuit)}
    return {
        about.key: float(getattr(law, about.name))
        for about in law.described()
        if not about.fitted and about.name not in circuit
    }


_LOSSES = (
    ("damping_n_s_m", 0, _motion.DAMPING),
    ("inertia_kg", 0, _motion.INERTIA),
    ("softening_share", 0, _motion.SOFTENING_SHARE),
    ("softening_stretch", 0, _motion.SOFTENING_STRETCH),
    ("softening_width", 0, _motion.SOFTENING_WIDTH),
    ("charge_share", 0, _motion.CHARGE_SHARE),
    ("charge_s", 0, _motion.CHARGE_S),
    ("hysteresis_n", 0, _motion.HYSTERESIS_N),
    ("hysteresis_width", 0, _motion.HYSTERESIS_WIDTH),
    *(("elastic_drift", k, _motion.ELASTIC_DRIFT + k) for k in range(2)),
    *(("electric_drift", k, _motion.ELECTRIC_DRIFT + k) for k in range(2)),
    *(("branch_share", k, _motion.BRANCH_SHARE + k) for k in range(_motion.BRANCHES)),
    *(("branch_s", k, _motion.BRANCH_S + k) for k in range(_motion.BRANCHES)),
)
# places in _LOSSES of what is no parameter of a law
_BESIDE_THE_LAW = {ADDED_INERTIA: 1} | {name: 9 + k for k, name in enumerate(DRIFTS)}
_LENGTH_ROW, _CHARGE_ROW, _LONGEST_ROW, _RELAXED_ROW = (
    0,
    2,
    3,
    4,
)  # of the compiled motion's derivatives


def _values(law: ActuatorLaw) -> dict[str, float]:
    """All parameters of a law; of several values, each by its index."""
    found: dict[str, float] = {}
    for key, value in law.parameters().items():
        if isinstance(value, tuple):
            found |= {f"{key}[{k}]": part for k, part in enumerate(value)}
        else:
            found[key] = value
    return found


def _beside(law: ActuatorLaw, name: str) -> tuple[ActuatorLaw, ActuatorLaw, float]:
    """The law with a parameter a little lower and higher, and the distance; within its limits."""
    value = _values(law).get(name, 0.0)
    ends, step = [], _STEP * (abs(value) or 1.0)
    for wanted in (value - step, value + step):
        try:
            ends.append((with_parameters(law, {name: wanted}), wanted))
        except LimitError:
            ends.append((law, value))
    return ends[0][0], ends[1][0], ends[1][1] - ends[0][1]


def _difference(
    laws: Sequence[ActuatorLaw], lengths_m: Sequence[float], voltage_v: float, longest_m: float
) -> float:
    """Change of the electric minus the elastic force between two laws or lengths."""
    net = []
    for law, length_m in zip(laws, lengths_m, strict=True):
        elastic = law.elastic_force_n(length_m)
        if law.losses.softening_share > 0.0:
            elastic = elastic * law.losses.softening(max(length_m, longest_m) / law.free_length_m)
        net.append(float(law.electric_force_n(length_m, voltage_v) - elastic))
    return net[1] - net[0]


def _same_softening(one: ActuatorLaw, other: ActuatorLaw) -> bool:
    return all(
        getattr(one.losses, name) == getattr(other.losses, name)
        for name in ("softening_share", "softening_stretch", "softening_transition")
    )


def _losses_of(parameters: NDArray[np.void]) -> Floats:
    return np.array([parameters[name].reshape(-1)[k] for name, k, _ in _LOSSES])


@lru_cache(maxsize=_REMEMBERED)
def _remembered_table(law: ActuatorLaw, highest_v: float) -> LawTable:
    return law_table(law, highest_v)


@lru_cache(maxsize=_REMEMBERED)
def _remembered_rest_m(
    law: ActuatorLaw, voltage_v: float, load_n: float, longest_m: float | None
) -> float:
    return equilibrium_m(law, voltage_v, load_n, longest_m=longest_m)


class SampledLaw:
    """A law as the compiled motion takes it, with derivatives by some of its parameters.

    Args:
        law: to sample.
        highest_v: largest voltage that will act.
        by: names of the parameters, see `with_parameters`; `ADDED_INERTIA` and `DRIFTS` too.
        added_inertia_kg: inertia without weight: clamp, oil, linkage.
        drifts: values of some of `DRIFTS` by their names.
    Raises:
        InputError: A name is unknown, or the law is not smooth.
        LimitError: A parameter is at its limit.
    """

    def __init__(
        self,
        law: ActuatorLaw,
        highest_v: float,
        by: Sequence[str] = (),
        *,
        added_inertia_kg: float = 0.0,
        drifts: Mapping[str, float] = MappingProxyType({}),
    ) -> None:
        self.law, self.by = law, tuple(by)
        self.table = _remembered_table(law, highest_v)
        self.parameters = motion_parameters(law)
        self.parameters["inertia_kg"] += added_inertia_kg
        for field, pair in drift_pairs(drifts).items():
            self.parameters[field] = pair
        self._native = _motion.Law(*self.table.arrays())
        knots = np.arange(self.table.elastic_n.size, dtype=np.float64)
        lengths_m = np.asarray(self.table.low_m + self.table.step_m * knots)
        rows = self.table.capacitance_f.shape[0]
        follows = rows > 1
        voltages_v = solved_voltages(highest_v) if follows else np.zeros(1)
        near = self.table.values if follows else None  # otherwise of more voltages
        elastic, free, losses = [], [], []
        pull: list[Floats] = []
        capacitance: list[Floats] = []
        for name in self.by:
            low, high, width = _beside(law, name)
            first, last = (part.on_grid(lengths_m, voltages_v, near) for part in (low, high))
            elastic.append((last.elastic_n - first.elastic_n) / width)
            for found, change in (
                (capacitance, last.capacitance_f - first.capacitance_f),
                (pull, last.pull_n_v2 - first.pull_n_v2),
            ):
                found.append((at_all_voltages(change) if follows else change) / width)
            free.append(self._free_moved_m(low, high) / width)
            changed = _losses_of(_parameters(high)) - _losses_of(_parameters(low))
            if name in _BESIDE_THE_LAW:
                changed[_BESIDE_THE_LAW[name]] += width
            losses.append(changed / width)
        count = len(self.by)
        losses_by = np.reshape(losses, (count, len(_LOSSES)))
        used = np.flatnonzero((losses_by != 0.0).any(axis=0))
        tables = [any(np.any(part) for part in parts)
                  for parts in zip(elastic, pull, capacitance, free, strict=True)]  # fmt: skip
        # a parameter that is one loss, which is its alone, needs no columns but that of the loss
        alone = (losses_by != 0.0).sum(axis=0) == 1
        self._own = np.array(
            [table or list(alone[row != 0.0]) != [True]
             for table, row in zip(tables, losses_by, strict=True)], dtype=bool,
        )  # fmt: skip
        own = np.flatnonzero(self._own)
        self._elastic = np.reshape([elastic[k] for k in own], (own.size, knots.size))
        self._pull = np.reshape([pull[k] for k in own], (own.size, rows, knots.size))
        self._capacitance = np.reshape([capacitance[k] for k in own], self._pull.shape)
        self._free_by = np.array([free[k] for k in own], dtype=np.float64)
        self._kinds = np.array([*range(own.size), *(_LOSSES[k][2] for k in used)], dtype=np.int32)
        # derivatives by the columns of the motion, to those by the parameters
        self._joined = np.vstack([np.eye(count)[own], losses_by[:, used].T])

    def _free_moved_m(self, low: ActuatorLaw, high: ActuatorLaw) -> float:
        """Difference of the free lengths of two laws beside this one, where the forces are 0."""
        free_m = self.law.free_length_m
        step_m = _STEP * free_m
        ends = self.law.elastic_force_n(np.array([free_m - step_m, free_m + step_m]))
        moved_n = float(high.elastic_force_n(free_m)) - float(low.elastic_force_n(free_m))
        return -moved_n * 2.0 * step_m / float(ends[1] - ends[0])

    def at_rest(
        self, voltage_v: float, ripple_v2: float, load_n: float, *, longest_m: float = 0.0
    ) -> tuple[NDArray[np.void], Floats]:
        """State of the relaxed actuator, and its derivatives by the parameters.

        Args:
            voltage_v: that acts.
            ripple_v2: mean square of the carrier's voltage.
            load_n: pulls at the moving end.
            longest_m: largest length before, if that was longer.
        Returns:
            The state, shape `(1,)`, and the derivatives for `respond`, shape `(ROWS, P)`.
        Raises:
            LimitError: There is no equilibrium.
        """
        acting_v = float(np.hypot(voltage_v, np.sqrt(ripple_v2)))
        length_m = _remembered_rest_m(self.law, acting_v, load_n, longest_m or None)
        longest = max(length_m, longest_m)
        branches = len(self.law.losses.branch_share)
        state = np.zeros(1, _motion.STATE)
        state["length_m"], state["longest_m"], state["charge_v"] = length_m, longest, voltage_v
        state["relaxed_n"][0, :branches] = load_n + float(
            self.law.electric_force_n(length_m, acting_v)
        )
        step_m = _STEP * length_m
        ends = [self.law] * 2
        slope = _difference(ends, [length_m - step_m, length_m + step_m], acting_v, longest_m)
        pull = np.diff([self.law.electric_force_n(length_m + s * step_m, acting_v)
                        for s in (-1.0, 1.0)])[0] / (2.0 * step_m)  # fmt: skip
        rows = np.zeros((_motion.ROWS, len(self.by)))
        for column, name in enumerate(self.by):
            low, high, width = _beside(self.law, name)
            if low.same_statics(high) and _same_softening(low, high):
                continue
            force = _difference([low, high], [length_m] * 2, acting_v, longest_m) / width
            moved = -force * 2.0 * step_m / slope
            rows[_LENGTH_ROW, column] = moved
            rows[_LONGEST_ROW, column] = moved if longest == length_m else 0.0
            if not branches:
                continue
            electric = [float(part.electric_force_n(length_m, acting_v)) for part in (low, high)]
            rows[_RELAXED_ROW : _RELAXED_ROW + branches, column] = (
                electric[1] - electric[0]
            ) / width + pull * moved
        return state, rows

    def respond(
        self,
        drive: Drive,
        times_s: ArrayLike,
        start: NDArray[np.void],
        *,
        sensed: ArrayLike | None = None,
        start_by: Floats | None = None,
    ) -> Response:
        """Simulate the motion under a drive.

        Args:
            drive: what acts.
            times_s: of the wanted lengths, rising, within the drive. Shape `(T,)`.
            start: state at the first edge, see `at_rest`. Shape `(1,)`.
            sensed: which intervals' mean capacitance is wanted; None: all. Shape `(N,)`.
            start_by: derivatives of that state, see `rest_by`, followed by any number of columns
                for start values that are parameters themselves. Shape `(ROWS, P + S)`.
        Returns:
            Lengths and capacitances, with derivatives by the parameters and start values if
            there are any.
        Raises:
            InputError: A time is outside the drive.
        """
        times = np.ascontiguousarray(times_s, dtype=np.float64)
        if times.size and not (drive.edge_s[0] <= times[0] and times[-1] <= drive.edge_s[-1]):
            raise InputError(
                f"Lengths were requested from {times[0]:g} to {times[-1]:g} s, but the drive lasts "
                f"from {drive.edge_s[0]:g} to {drive.edge_s[-1]:g} s. Extend the drive."
            )
        count, intervals = len(self.by), drive.voltage_v.size
        acts = np.zeros(intervals, _motion.INPUT)
        acts["volt"], acts["ripple_v2"] = drive.voltage_v, drive.ripple_v2
        acts["load_n"] = drive.load_n
        given = np.zeros((_motion.ROWS, count)) if start_by is None else start_by
        extra = given.shape[1] - count
        kinds = np.concatenate([self._kinds, np.full(extra, _motion.START, dtype=np.int32)])
        # a column that stands for one parameter alone begins with its start
        shares = np.divide(1.0, self._joined, where=self._joined != 0.0, out=0.0 * self._joined)
        shares[self._free_by.size :, self._own] = 0.0
        rows = np.ascontiguousarray(np.hstack([given[:, :count] @ shares.T, given[:, count:]]))
        joined = np.block([
            [self._joined, np.zeros((self._joined.shape[0], extra))],
            [np.zeros((extra, count)), np.eye(extra)],
        ])  # fmt: skip
        wanted = np.ones(intervals, np.uint8) if sensed is None else np.asarray(sensed, np.uint8)
        means_wanted = int(np.count_nonzero(wanted))

        def part(
            chosen: NDArray[np.int64],
        ) -> tuple[NDArray[np.void], tuple[Floats, ...], list[Floats]]:
            """What some of the columns give; the motion itself is the same in each part.

            Columns of zeros make their number a multiple of the processor's vectors.
            """
            moved, size = start.copy(), chosen.size
            padded = -(-size // _VECTOR) * _VECTOR
            seen = (
                np.empty(times.size),
                np.empty(times.size),
                np.empty(intervals),
                np.empty(intervals),
            )
            own_kinds = np.full(padded, _motion.START, dtype=np.int32)
            own_kinds[:size] = kinds[chosen]
            own_rows = np.zeros((rows.shape[0], padded))
            own_rows[:, :size] = rows[:, chosen]
            own_joined = np.zeros((padded, joined.shape[1]))
            own_joined[:size] = joined[chosen]
            lengths, means = np.empty((times.size, padded)), np.empty((means_wanted, padded))
            _motion.play(
                self._native, self.parameters, moved, drive.edge_s, acts, drive.mass_kg, wanted,
                times, *seen, own_kinds, self._elastic, self._pull, self._capacitance,
                self._free_by, own_rows, lengths, means,
            )  # fmt: skip
            return moved, seen, [by @ own_joined for by in (lengths, means, own_rows)]

        workers = min(_CORES, 1 + kinds.size // _COLUMNS_EACH)
        parts = np.array_split(np.arange(kinds.size), workers)
        found = [part(parts[0])] if workers == 1 else in_threads(part, parts, workers)
        state, (length, speed, mean, drift), total = found[0]
        for _, _, more in found[1:]:
            for by, added in zip(total, more, strict=True):
                by += added
        return Response(length, speed, mean, drift, state, *total)
