"""Sample a law on a grid, which the compiled motion interpolates."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from haselab.actuators.law import ActuatorLaw, LawValues
from haselab.base import InputError, LimitError

__all__ = ["LawTable", "at_all_voltages", "law_table", "solved_voltages"]

Floats = NDArray[np.float64]
LENGTHS = 1024  # MOTION_LENGTHS of native/motion/motion.h
VOLTAGES = 129  # MOTION_VOLTAGES
# of them, at which a law is evaluated: the others lie between two of these
_SOLVED = np.append(np.arange(8), np.arange(8, VOLTAGES, 2))
_SAME = 1e-9  # relative difference below which the voltage has no effect
_INTERPOLATED = 1e-6  # largest error between two lengths, of the largest value
_WITH_VOLTAGE = 5e-5  # the same where the voltage has an effect on the capacitance
_BETWEEN_VOLTAGES = 5e-4  # the same between two voltages; long pouches at 20 kV reach 2.7e-4
_EVERY = 8  # length is checked between the voltages
_ROWS = 16  # voltages on, lengths are checked
_FEW = 3  # of the voltages between two, one is checked
_MIDDLE = np.array([-1.0, 9.0, 9.0, -1.0]) / 16.0  # of a cubic through four knots
_AROUND = 8  # solved voltages that a voltage between two of them is interpolated from


@dataclass(frozen=True)
class LawTable:
    """A law on a grid of lengths and voltages.

    Args:
        low_m: first length.
        step_m: distance of two lengths.
        step_v: distance of two voltages, the first of which is 0.
        elastic_n: softened elastic force. Shape `(L,)`.
        gap_m: thickness of the dielectric. Shape `(L,)`.
        capacitance_f: differential. Shape `(V, L)`; V is 1 where the voltage has no effect.
        pull_n_v2: electric force over the voltage squared. Shape `(V, L)`.
        values: of which it was made, at `solved_voltages`.
    """

    low_m: float
    step_m: float
    step_v: float
    elastic_n: Floats
    gap_m: Floats
    capacitance_f: Floats
    pull_n_v2: Floats
    values: LawValues = field(repr=False)

    @property
    def high_m(self) -> float:
        """Last length."""
        return self.low_m + self.step_m * (self.elastic_n.size - 1)

    def arrays(self) -> tuple[float, float, float, Floats, Floats, Floats, Floats]:
        """All values, in the order that the compiled code takes them."""
        return (
            self.low_m,
            self.step_m,
            self.step_v,
            self.elastic_n,
            self.gap_m,
            self.capacitance_f,
            self.pull_n_v2,
        )


def solved_voltages(highest_v: float) -> Floats:
    """Voltages at which a law is evaluated for a table. Shape `(S,)`."""
    return np.linspace(0.0, highest_v, VOLTAGES)[_SOLVED]


def at_all_voltages(solved: Floats) -> Floats:
    """Interpolate values at `solved_voltages` by polynomials of degree 7.

    Args:
        solved: Shape `(S, L)`.
    Returns:
        At all voltages of a table. Shape `(V, L)`.
    """
    return np.asarray(_refinement() @ solved)


@cache
def _refinement() -> csr_array:
    """Lagrange's weights of the solved voltages. Shape `(V, S)`."""
    found = np.zeros((VOLTAGES, _SOLVED.size))
    for k in range(VOLTAGES):
        first = int(np.clip(k - _AROUND + k % 2, 0, VOLTAGES + 1 - 2 * _AROUND))
        around = np.arange(first, first + 2 * _AROUND, 2) if k not in _SOLVED else np.array([k])
        for at in around:
            others = around[around != at]
            found[k, at == _SOLVED] = np.prod((k - others) / (at - others))
    return csr_array(found)


def law_table(law: ActuatorLaw, highest_v: float) -> LawTable:
    """Sample a law over all its lengths, up to a voltage.

    Args:
        law: to sample.
        highest_v: largest voltage that the actuator can get.
    Returns:
        The table.
    Raises:
        LimitError: The law is valid at no length.
        InputError: The law gives a value that is not finite, a capacitance or gap of 0 or less, or
            is not smooth enough to interpolate.
    Example:
        >>> from haselab.actuators import DeaStack
        >>> law_table(DeaStack(), 1e4).pull_n_v2.shape
        (1, 1024)
    """
    limits = law.length_limits_m
    if not limits.low < limits.high:
        raise LimitError(
            f"length_limits_m of the {law.kind} are {limits.low:g} and {limits.high:g} m, but the "
            "lower limit must come first. Change its parameters."
        )
    lengths_m, step_m = np.linspace(limits.low, limits.high, LENGTHS, retstep=True)
    with np.errstate(all="ignore"):  # the values are checked below
        values = law.on_grid(lengths_m, solved_voltages(highest_v))
        gap_m = law.gap_m(lengths_m)
        constant = all(
            np.abs(v - v[0]).max() <= _SAME * np.abs(v[0]).max()
            for v in (values.capacitance_f, values.pull_n_v2)
        )
    capacitance_f, pull_n_v2 = (
        solved[:1] if constant else at_all_voltages(solved)
        for solved in (values.capacitance_f, values.pull_n_v2)
    )  # fmt: skip
    table = LawTable(
        low_m=float(lengths_m[0]),
        step_m=float(step_m),
        step_v=highest_v / (VOLTAGES - 1),
        elastic_n=np.ascontiguousarray(values.elastic_n),
        gap_m=np.ascontiguousarray(gap_m),
        capacitance_f=np.ascontiguousarray(capacitance_f),
        pull_n_v2=np.ascontiguousarray(pull_n_v2),
        values=values,
    )
    _check_values(law, table)
    _check_lengths(law, table, lengths_m)
    if not constant:
        _check_voltages(law, table, lengths_m)
    return table


def _check_values(law: ActuatorLaw, table: LawTable) -> None:
    for name in ("elastic_n", "gap_m", "capacitance_f", "pull_n_v2"):
        values = getattr(table, name)
        if not np.isfinite(values).all():
            raise InputError(
                f"The law {law.kind} gives a value that is not finite ({name}) within its length "
                "limits. Fix the law, or narrow length_limits_m."
            )
        if name in ("gap_m", "capacitance_f") and not (values > 0.0).all():
            raise InputError(
                f"The law {law.kind} gives {name} = {values.min():g} within its length limits. It "
                "must be above 0. Fix the law, or narrow length_limits_m."
            )


def _check_lengths(law: ActuatorLaw, table: LawTable, lengths_m: Floats) -> None:
    """Compare the cubic interpolation with the law, midway between the lengths."""
    middles_m = 0.5 * (lengths_m[1:-2] + lengths_m[2:-1])
    rows = np.arange(table.capacitance_f.shape[0], dtype=np.float64)
    voltages_v = table.step_v * rows[::-_ROWS]
    exact = law.on_grid(middles_m, voltages_v)
    single = voltages_v.size == 1
    squares, limit = (1.0, _INTERPOLATED) if single else (voltages_v[:, None] ** 2, _WITH_VOLTAGE)
    for name, knots, wanted, most in (
        ("elastic force", table.elastic_n, exact.elastic_n, _INTERPOLATED),
        ("gap", table.gap_m, law.gap_m(middles_m), _INTERPOLATED),
        ("capacitance", table.capacitance_f[::-_ROWS], exact.capacitance_f, limit),
        ("electric force", squares * table.pull_n_v2[::-_ROWS], squares * exact.pull_n_v2, limit),
    ):
        found = np.lib.stride_tricks.sliding_window_view(knots, 4, axis=-1) @ _MIDDLE
        _require(law, name, f"{LENGTHS} lengths", found, wanted, knots, most)


def _check_voltages(law: ActuatorLaw, table: LawTable, lengths_m: Floats) -> None:
    """Compare the cubic interpolation with the law, midway between the voltages."""
    voltages_v = table.step_v * np.arange(VOLTAGES, dtype=np.float64)
    middles_v = 0.5 * (voltages_v[1:-2] + voltages_v[2:-1])[::_FEW]
    exact = law.on_grid(lengths_m[::_EVERY], middles_v)
    between, squares = middles_v[:, None] ** 2, voltages_v[:, None] ** 2
    for name, knots, wanted, largest in (
        ("capacitance", table.capacitance_f, exact.capacitance_f, table.capacitance_f),
        ("electric force", table.pull_n_v2, between * exact.pull_n_v2, squares * table.pull_n_v2),
    ):
        found = (
            np.lib.stride_tricks.sliding_window_view(knots[:, ::_EVERY], 4, axis=0)[::_FEW]
            @ _MIDDLE
        )
        found = found * between if name == "electric force" else found
        _require(law, name, f"{VOLTAGES} voltages", found, wanted, largest, _BETWEEN_VOLTAGES)


def _require(
    law: ActuatorLaw,
    name: str,
    grid: str,
    found: Floats,
    exact: Floats,
    knots: Floats,
    limit: float,
) -> None:
    error = float(np.abs(found - exact).max() / np.abs(knots).max())
    if not error < limit:
        raise InputError(
            f"The {name} of the law {law.kind} is not smooth: interpolation between {grid} has a "
            f"relative error of {error:.2g}, and at most {limit:g} is accepted. Remove steps and "
            "kinks from the law, or narrow length_limits_m."
        )
