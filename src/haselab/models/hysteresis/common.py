"""Common parts of hysteresis models: stepped memory, asymmetric output curve, inverses."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from haselab.base import InputError

__all__ = ["NO_DEAD_ZONES", "DeadZones", "Hysteresis", "HysteresisState"]

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class DeadZones:
    r"""One-sided dead-zone operators, which make a loop asymmetric or saturate it.

    $S(h) = h + \sum_{d_j \ge c} w_j \max(h - d_j, 0) + \sum_{d_j < c} w_j \min(h - d_j, 0)$

    Args:
        thresholds: ascending, in the unit of the output. Shape `(M,)`.
        weights: change of slope beyond each, dimensionless. Shape `(M,)`.
        centre: point where the slope is 1, in the unit of the output.
    Raises:
        InputError: unequal lengths, NaN, thresholds that do not ascend.
    Source: Kuhnen, Eur. J. Control 9 (2003), 407, section 4.
    Example:
        >>> saturating = DeadZones((1.0,), (-0.75,))
        >>> saturating.apply([0.5, 2.0]).tolist(), saturating.invert([1.25]).tolist()
        ([0.5, 1.25], [2.0])
    """

    thresholds: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()
    centre: float = 0.0

    def __post_init__(self) -> None:
        numbers = np.array([*self.thresholds, *self.weights, self.centre])
        if len(self.thresholds) != len(self.weights) or not np.isfinite(numbers).all():
            raise InputError(
                f"The dead zones have {len(self.thresholds)} thresholds and {len(self.weights)} "
                "weights. Give one finite weight for each threshold."
            )
        if not (np.diff(self.thresholds) > 0.0).all():
            raise InputError(
                f"The dead zones have the thresholds {self.thresholds}; they must "
                "ascend. Sort them."
            )

    @property
    def slopes(self) -> Floats:
        """Slope of each straight segment, the lowest first. Shape `(M + 1,)`."""
        upper = np.asarray(self.thresholds) >= self.centre
        weights = np.asarray(self.weights, dtype=np.float64)
        above = 1.0 + np.cumsum(weights[upper])
        below = 1.0 + np.cumsum(weights[~upper][::-1])[::-1]
        return np.concatenate([below, [1.0], above])

    @property
    def invertible(self) -> bool:
        """Whether the curve rises everywhere."""
        return bool((self.slopes > 0.0).all())

    def _corners(self) -> tuple[Floats, Floats]:
        """Thresholds, and the curve's values there."""
        d = np.asarray(self.thresholds, dtype=np.float64)
        columns = self.columns(d)
        return d, d + columns @ np.asarray(self.weights, dtype=np.float64)

    def columns(self, values: Floats) -> Floats:
        """Derivatives of the curve with respect to the weights: the operators themselves.

        Args:
            values: arguments, in the unit of the output. Shape `(N,)`.
        Returns:
            Operators. Shape `(N, M)`.
        """
        d = np.asarray(self.thresholds, dtype=np.float64)
        beyond = np.asarray(values)[:, None] - d
        return np.where(d >= self.centre, np.maximum(beyond, 0.0), np.minimum(beyond, 0.0))

    def slope_at(self, values: Floats) -> Floats:
        """Slope of the curve. Shape of `values`."""
        index = np.searchsorted(np.asarray(self.thresholds), values)
        return np.asarray(self.slopes[index])

    def apply(self, values: ArrayLike) -> Floats:
        """The curve's values. Shape of `values`."""
        h = np.asarray(values, dtype=np.float64)
        if not self.thresholds:
            return h
        return _broken_line(h, *self._corners(), self.slopes)

    def invert(self, values: ArrayLike) -> Floats:
        """Invert `apply`; a curve that does not rise is refused.

        Args:
            values: in the unit of the output. Shape `(...)`.
        Returns:
            Arguments. Shape `(...)`.
        Raises:
            InputError: the curve does not rise everywhere.
        """
        y = np.asarray(values, dtype=np.float64)
        if not self.invertible:
            raise InputError(
                f"The dead zones have the slopes {self.slopes.tolist()}; an inverse needs slopes "
                "above 0. Fit again with fewer dead zones, or over a smaller range."
            )
        if not self.thresholds:
            return y
        d, s = self._corners()
        return _broken_line(y, s, d, 1.0 / self.slopes)


def _broken_line(x: Floats, corners: Floats, values: Floats, slopes: Floats) -> Floats:
    index = np.searchsorted(corners, x)
    near = np.maximum(index - 1, 0)
    return np.asarray(values[near] + slopes[index] * (x - corners[near]))


NO_DEAD_ZONES = DeadZones()


@dataclass(frozen=True)
class HysteresisState:
    """State of a hysteresis model between two blocks.

    Args:
        memory: the model's memory states, with the last input at the end. Shape `(S,)`.
        rate_hz: sampling rate, in Hz.
    """

    memory: Floats
    rate_hz: float


class Hysteresis(ABC):
    """A hysteresis model: `y = S(offset + memory and input)`, stepped, with its inverse."""

    offset: float
    dead_zones: DeadZones

    @abstractmethod
    def init(self, rate_hz: float = 1.0, input_before: float = 0.0) -> HysteresisState:
        """Initial state of a model at rest at `input_before`, without a past.

        Args:
            rate_hz: sampling rate, in Hz; used only by a rate-dependent model.
            input_before: input before the record.
        Returns:
            State, for both `step` and `inverse_step`.
        """

    @abstractmethod
    def obstacle(self, rate_hz: float = 1.0) -> str:
        """Why there is no inverse at this rate, and what to do; empty if there is one."""

    @abstractmethod
    def _run(self, memory: Floats, rate_hz: float, u: Floats, y: Floats) -> None:
        """Output without offset and dead zones; `memory` is changed in place."""

    @abstractmethod
    def _solve(self, memory: Floats, rate_hz: float, y: Floats, u: Floats) -> None:
        """Input from output without offset and dead zones; `memory` is changed in place."""

    def step(self, state: HysteresisState, u: ArrayLike) -> tuple[HysteresisState, Floats]:
        """Simulate one block of inputs.

        Args:
            state: from `init` or the previous block.
            u: inputs. Shape `(B,)`.
        Returns:
            State after the block, and outputs of shape `(B,)`.
        Raises:
            InputError: an input that is not a finite vector.
        """
        inputs, memory = _block("u", u), state.memory.copy()
        out = np.empty_like(inputs)
        self._run(memory, state.rate_hz, inputs, out)
        return HysteresisState(memory, state.rate_hz), self.dead_zones.apply(out + self.offset)

    def inverse_step(self, state: HysteresisState, y: ArrayLike) -> tuple[HysteresisState, Floats]:
        """Compute the inputs for one block of desired outputs.

        Args:
            state: from `init` or the previous block.
            y: desired outputs. Shape `(B,)`.
        Returns:
            State after the block, and inputs of shape `(B,)`.
        Raises:
            InputError: an output that is not a finite vector, or a model without an inverse.
        """
        outputs, memory = _block("y", y), state.memory.copy()
        reason = self.obstacle(state.rate_hz)
        if reason:
            raise InputError(reason)
        inputs = np.empty_like(outputs)
        bare = np.ascontiguousarray(self.dead_zones.invert(outputs) - self.offset)
        self._solve(memory, state.rate_hz, bare, inputs)
        return HysteresisState(memory, state.rate_hz), inputs

    def simulate(self, u: ArrayLike, rate_hz: float = 1.0, input_before: float = 0.0) -> Floats:
        """Simulate a whole record from `init`. Arguments and errors as in `init` and `step`."""
        return self.step(self.init(rate_hz, input_before), u)[1]

    def invert(self, y: ArrayLike, rate_hz: float = 1.0, input_before: float = 0.0) -> Floats:
        """Compute the inputs for a whole record of desired outputs, from `init`."""
        return self.inverse_step(self.init(rate_hz, input_before), y)[1]


def _block(name: str, values: ArrayLike) -> Floats:
    block = np.ascontiguousarray(values, dtype=np.float64)
    if block.ndim != 1 or not np.isfinite(block).all():
        raise InputError(
            f"{name} has shape {block.shape} or contains NaN; it must be a finite vector. "
            "Give one number for each sample."
        )
    return block
