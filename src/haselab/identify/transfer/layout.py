"""Structure of a transfer function, and the order of its parameters in the search."""

from __future__ import annotations

import cmath
import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, check_fields

__all__ = ["Layout", "Section", "TransferStructure", "layout_of"]

Floats = NDArray[np.float64]
_MAX_POLES = 6


@dataclass(frozen=True)
class TransferStructure:
    r"""Structure of the model $[B(s)/A(s) + \sum_i c_i/(\tau_i s + 1)]\, e^{-s T_d}$.

    Args:
        poles: poles of the fast part, 1 to 6; two form a resonance.
        zeros: zeros of the fast part, at most as many as poles. With as many, the output follows a
            jump of the input at once, as an acceleration does.
        delay: "auto" to estimate it, or a known delay in s. With feed-through, "auto" means no
            delay.
        slow_modes: slow branches in parallel to the fast part.
        offset: whether each record has its own constant offset.
        initial_state: whether each record has its own initial state.
        fixed: known parameters by name: `natural_frequency_rad_s`, `damping_ratio`,
            `slow_time_constant_s`, `gain`, `slow_gain`; with several of a kind, `..._2` in front
            of the unit.
    Raises:
        InputError: a number of poles, zeros or branches out of range.
    """

    poles: int = 2
    zeros: int = 0
    delay: str | float = "auto"
    slow_modes: int = 0
    offset: bool = True
    initial_state: bool = True
    fixed: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_fields(self)
        if not 1 <= self.poles <= _MAX_POLES:
            raise InputError(
                f"poles = {self.poles}; it must be 1 to {_MAX_POLES}. Two form one resonance."
            )
        if not 0 <= self.zeros <= self.poles:
            raise InputError(
                f"zeros = {self.zeros}; it must be 0 to {self.poles}, at most as many as poles. "
                "Lower the zeros or add a pole."
            )
        if not 0 <= self.slow_modes <= 3:
            raise InputError(f"slow_modes = {self.slow_modes}; it must be 0 to 3.")
        known_delay = isinstance(self.delay, (int, float)) and 0.0 <= self.delay < math.inf
        if self.delay != "auto" and not known_delay:
            raise InputError(
                f"delay = {self.delay}; it must be auto or a finite number of seconds, 0 or above. "
                "Give auto to estimate it."
            )


@dataclass(frozen=True)
class Section:
    """A group of poles with a common denominator.

    Args:
        pairs: positions of `(log natural frequency, log damping ratio)` in the searched parameters.
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

    def poles(self, numbers: Floats) -> list[complex]:
        """Poles for given parameters of the layout, in rad/s."""
        values = []
        for at_omega, at_zeta in self.pairs:
            omega, zeta = math.exp(numbers[at_omega]), math.exp(numbers[at_zeta])
            root = cmath.sqrt(zeta * zeta - 1.0)
            values += [omega * (-zeta + root), omega * (-zeta - root)]
        return values + [complex(-math.exp(-numbers[at])) for at in self.reals]


@dataclass(frozen=True)
class Layout:
    """Positions of the searched parameters and factors of a structure.

    Args:
        structure: what is fitted.
        names: searched parameters, in order; the delay is last.
        template: their fixed values, else NaN. Shape `(L,)`.
        sections: fast part first, then the slow branches.
        factor_names: factors common to all records, in order.
        factor_template: their fixed values, else NaN. Shape `(S,)`.
    """

    structure: TransferStructure
    names: tuple[str, ...]
    template: Floats
    sections: tuple[Section, ...]
    factor_names: tuple[str, ...]
    factor_template: Floats

    @property
    def free(self) -> NDArray[np.intp]:
        """Positions of the parameters that are not fixed."""
        return np.flatnonzero(np.isnan(self.template))

    def ordered(self, search: Floats) -> Floats:
        """Searched parameters with the resonances in order of their frequency, if none is fixed."""
        pairs = self.sections[0].pairs
        numbers = self.full(search)
        if len(pairs) < 2 or not np.isnan(self.template[: 2 * len(pairs)]).all():
            return search
        by_frequency = sorted(pairs, key=lambda pair: float(numbers[pair[0]]))
        values = [numbers[at] for pair in by_frequency for at in pair]
        numbers[: len(values)] = values
        return np.asarray(numbers[self.free])

    def full(self, search: Floats) -> Floats:
        """All parameters, including the fixed ones."""
        numbers = self.template.copy()
        numbers[self.free] = search
        return numbers


def _numbered(stem: str, unit: str, index: int) -> str:
    return f"{stem}{'' if index == 0 else f'_{index + 1}'}{unit}"


def layout_of(structure: TransferStructure) -> Layout:
    """Layout of a structure; an unknown name in `fixed` is an `InputError`."""
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
    elif structure.zeros == structure.poles:
        fixed["delay_s"] = 0.0  # an immediate jump has no derivative with respect to the delay
    unknown = sorted(set(fixed) - set(names) - set(factors))
    if unknown:
        raise InputError(
            f"fixed names {', '.join(unknown)}; the names must be among "
            f"{', '.join([*names, *factors])}."
        )
    template = np.array([_inner(name, fixed.get(name)) for name in names])
    factor_template = np.array([fixed.get(name, math.nan) for name in factors])
    return Layout(
        structure, tuple(names), template, tuple(sections), tuple(factors), factor_template
    )


def _inner(name: str, value: float | None) -> float:
    """Fixed value as the search uses it: the logarithm, except for the delay; NaN when free."""
    if value is None:
        return math.nan
    if name == "delay_s":
        return float(value)
    if not value > 0.0:
        raise InputError(f"fixed {name} = {value:g}; it must be above 0.")
    return math.log(value)
