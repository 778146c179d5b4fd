"""Basis functions of a transfer function: responses of its poles to a held input, exact in time."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.identify.projection import Basis
from haselab.identify.record import Record
from haselab.models import HeldInput, PoleResponse

__all__ = ["Layout", "Section", "TransferStructure", "layout_of"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_CRITICAL_BAND = 1e-6
_MAX_POLES = 6


@dataclass(frozen=True)
class TransferStructure:
    r"""What is fitted: $[B(s)/A(s) + \sum_i c_i/(\tau_i s + 1)]\, e^{-s T_d}$ with nuisances.

    Args:
        poles: poles of the fast part, 1 to 6; two make a resonance.
        zeros: zeros of the fast part, fewer than the poles.
        delay: "auto" to estimate it, or a known delay in s.
        slow_modes: slow branches beside the fast part.
        offset: whether each record has its own constant.
        initial_state: whether each record starts in its own state.
        fixed: known numbers by name: `natural_frequency_rad_s`, `damping_ratio`,
            `slow_time_constant_s`, `gain`, `slow_gain`; with several of a kind, `..._2` in front
            of the unit.
    Raises:
        InputError: a number of poles, zeros or branches that makes no sense.
    """

    poles: int = 2
    zeros: int = 0
    delay: str | float = "auto"
    slow_modes: int = 0
    offset: bool = True
    initial_state: bool = True
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not 1 <= self.poles <= _MAX_POLES:
            raise InputError(
                f"poles = {self.poles}; allowed is 1 to {_MAX_POLES}. Two make one resonance."
            )
        if not 0 <= self.zeros < self.poles:
            raise InputError(
                f"zeros = {self.zeros}; allowed is 0 to {self.poles - 1}, fewer than the poles. "
                "Lower the zeros or add a pole."
            )
        if not 0 <= self.slow_modes <= 3:
            raise InputError(f"slow_modes = {self.slow_modes}; allowed is 0 to 3. Lower it.")
        known_delay = isinstance(self.delay, (int, float)) and 0.0 <= self.delay < math.inf
        if self.delay != "auto" and not known_delay:
            raise InputError(
                f"delay = {self.delay}; allowed is auto or a finite number of seconds, 0 or above. "
                "Give auto to estimate it."
            )


@dataclass(frozen=True)
class Section:
    """A group of poles with a common denominator.

    Args:
        pairs: positions of `(log natural frequency, log damping ratio)` in the searched numbers.
        reals: positions of `log time constant`.
        zeros: zeros of the section.
    """

    pairs: tuple[tuple[int, int], ...]
    reals: tuple[int, ...]
    zeros: int

    @property
    def order(self) -> int:
        """Number of poles."""
        return 2 * len(self.pairs) + len(self.reals)

    def poles(self, numbers: Floats) -> tuple[Complexes, Complexes, NDArray[np.int_]]:
        """Poles, their derivatives `(order, L)`, and how often each response counts (0, 1, 2)."""
        values: list[complex] = []
        slopes: list[Complexes] = []
        counts: list[int] = []
        for at_omega, at_zeta in self.pairs:
            omega, zeta = math.exp(numbers[at_omega]), math.exp(numbers[at_zeta])
            spread = zeta * zeta - 1.0
            if abs(spread) < 2.0 * _CRITICAL_BAND:
                spread = 2.0 * _CRITICAL_BAND
            root = cmath.sqrt(spread)
            for sign in (1.0, -1.0):
                slope = np.zeros(numbers.size, dtype=np.complex128)
                value = omega * (-zeta + sign * root)
                slope[at_omega] = value
                slope[at_zeta] = omega * zeta * (-1.0 + sign * zeta / root)
                values.append(value)
                slopes.append(slope)
            counts.extend((1, 1) if spread > 0.0 else (2, 0))
        for at_tau in self.reals:
            slope = np.zeros(numbers.size, dtype=np.complex128)
            rate = math.exp(-numbers[at_tau])
            slope[at_tau] = rate
            values.append(complex(-rate))
            slopes.append(slope)
            counts.append(1)
        return np.array(values), np.array(slopes), np.array(counts)


def _weights(poles: Complexes, power: int, size: float) -> tuple[Complexes, Complexes]:
    r"""Residues of $a_0^{size} s^{power}/A(s)$ and their derivatives by the poles `(n, n)`."""
    gap = poles[:, None] - poles[None, :]
    np.fill_diagonal(gap, 1.0)
    weight = np.prod(-poles) ** size * poles**power / gap.prod(axis=1)
    inverse = 1.0 / gap
    np.fill_diagonal(inverse, 0.0)
    logarithmic = inverse + size / poles[None, :]
    logarithmic = logarithmic + np.diag(power / poles - inverse.sum(axis=1))
    return weight, weight[:, None] * logarithmic


@dataclass(frozen=True)
class Layout:
    """Where each searched number and each factor of a structure sits.

    Args:
        structure: what is fitted.
        names: searched numbers, in order; the delay is last.
        template: their values where fixed, else NaN. Shape `(L,)`.
        sections: fast part first, then the slow branches.
        factor_names: common factors, in order.
        factor_template: their values where fixed, else NaN. Shape `(S,)`.
    """

    structure: TransferStructure
    names: tuple[str, ...]
    template: Floats
    sections: tuple[Section, ...]
    factor_names: tuple[str, ...]
    factor_template: Floats

    @property
    def free(self) -> NDArray[np.intp]:
        """Positions of the numbers that are searched."""
        return np.flatnonzero(np.isnan(self.template))

    def full(self, search: Floats) -> Floats:
        """All numbers, the fixed ones included."""
        numbers = self.template.copy()
        numbers[self.free] = search
        return numbers

    def basis(self, search: Floats, record: Record) -> Basis:
        """Basis functions of one record at searched numbers (logarithms; the delay in s)."""
        numbers, time_s = self.full(search), record.output_time_s
        before = record.input_before or 0.0
        held = HeldInput(record.u - before, record.input_rate_hz)
        shared, own = _Columns(numbers.size), _Columns(numbers.size)
        for section in self.sections:
            poles, slopes, counts = section.poles(numbers)
            forced = [
                held.response(p, time_s - numbers[-1]) if c else None
                for p, c in zip(poles, counts, strict=True)
            ]
            for power in range(section.zeros + 1):
                weights = _weights(poles, power, 1.0 - power / section.order)
                value, slope = _combine(weights, slopes, counts, forced)
                shared.add(value + (before if power == 0 else 0.0), slope)
            if self.structure.initial_state:
                free = [_free_decay(p, time_s) if c else None
                        for p, c in zip(poles, counts, strict=True)]  # fmt: skip
                for power in range(section.order):
                    size = (section.order - 1 - power) / section.order
                    own.add(*_combine(_weights(poles, power, size), slopes, counts, free))
        if self.structure.offset:
            own.add(np.ones(time_s.size), np.zeros((numbers.size, time_s.size)))
        return self._assemble(record, shared, own)

    def _assemble(self, record: Record, shared: _Columns, own: _Columns) -> Basis:
        values, slopes = shared.arrays(record.y.size)
        own_values, own_slopes = own.arrays(record.y.size)
        slopes, own_slopes = slopes[self.free], own_slopes[self.free]
        open_factor = np.isnan(self.factor_template)
        given = np.where(open_factor, 0.0, self.factor_template)
        return Basis(
            record.y,
            values[:, open_factor],
            own_values,
            np.concatenate([slopes[:, :, open_factor], own_slopes], axis=2),
            values @ given,
            slopes @ given,
        )


class _Columns:
    """Collects functions of time and their derivatives."""

    def __init__(self, numbers: int) -> None:
        self._numbers = numbers
        self._values: list[Floats] = []
        self._slopes: list[Floats] = []

    def add(self, value: Floats, slope: Floats) -> None:
        """One function `(M,)` with its derivatives `(L, M)`; the delay is the last number."""
        self._values.append(value)
        self._slopes.append(slope)

    def arrays(self, size: int) -> tuple[Floats, Floats]:
        """Functions `(M, n)` and derivatives `(L, M, n)`."""
        if not self._values:
            return np.zeros((size, 0)), np.zeros((self._numbers, size, 0))
        return np.stack(self._values, axis=1), np.stack(self._slopes, axis=2)


def _free_decay(pole: complex, time_s: Floats) -> PoleResponse:
    state = np.exp(pole * time_s)
    return PoleResponse(state, time_s * state, np.zeros_like(state))


def _combine(
    weights: tuple[Complexes, Complexes],
    slopes: Complexes,
    counts: NDArray[np.int_],
    responses: Sequence[PoleResponse | None],
) -> tuple[Floats, Floats]:
    """Weighted sum of pole responses and its derivatives by all numbers, the delay last."""
    weight, weight_by_pole = weights
    weight_slope = weight_by_pole @ slopes
    size = next(r.state.size for r in responses if r is not None)
    total, slope = np.zeros(size), np.zeros((slopes.shape[1], size))
    for i, response in enumerate(responses):
        if response is None:
            continue
        total += counts[i] * (weight[i] * response.state).real
        for j in np.flatnonzero(np.abs(weight_slope[i]) + np.abs(slopes[i])):
            inner = weight_slope[i, j] * response.state
            inner += (weight[i] * slopes[i, j]) * response.by_pole
            slope[j] += counts[i] * inner.real
        slope[-1] -= counts[i] * (weight[i] * response.by_time).real
    return total, slope


def _numbered(stem: str, unit: str, index: int) -> str:
    return f"{stem}{'' if index == 0 else f'_{index + 1}'}{unit}"


def layout_of(structure: TransferStructure) -> Layout:
    """Order of the numbers of a structure; an unknown name in `fixed` is an `InputError`."""
    names: list[str] = []
    pairs, reals = [], []
    for i in range(structure.poles // 2):
        pairs.append((len(names), len(names) + 1))
        names += [_numbered("natural_frequency", "_rad_s", i), _numbered("damping_ratio", "", i)]
    if structure.poles % 2:
        reals.append(len(names))
        names.append("time_constant_s")
    sections = [Section(tuple(pairs), tuple(reals), structure.zeros)]
    for i in range(structure.slow_modes):
        sections.append(Section((), (len(names),), 0))
        names.append(_numbered("slow_time_constant", "_s", i))
    names.append("delay_s")
    factors = ["gain"] + [f"numerator_{i}" for i in range(1, structure.zeros + 1)]
    factors += [_numbered("slow_gain", "", i) for i in range(structure.slow_modes)]
    fixed = dict(structure.fixed)
    if structure.delay != "auto":
        fixed["delay_s"] = float(structure.delay)
    unknown = sorted(set(fixed) - set(names) - set(factors))
    if unknown:
        raise InputError(
            f"fixed names {', '.join(unknown)}; allowed are {', '.join([*names, *factors])}. "
            "Correct the name."
        )
    template = np.array([_inner(name, fixed.get(name)) for name in names])
    factor_template = np.array([fixed.get(name, math.nan) for name in factors])
    return Layout(
        structure, tuple(names), template, tuple(sections), tuple(factors), factor_template
    )


def _inner(name: str, value: float | None) -> float:
    """Searched form of a fixed number: the logarithm, except for the delay; NaN when free."""
    if value is None:
        return math.nan
    if name == "delay_s":
        return float(value)
    if not value > 0.0:
        raise InputError(f"fixed {name} = {value:g}; allowed is above 0. Correct the number.")
    return math.log(value)
