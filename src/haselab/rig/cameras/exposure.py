"""A camera's exposure signal, sampled beside the monitors: the times of its frames.

The line is high (or low) for as long as a picture is exposed. Both of its edges are found to the
sample and within it, so that a frame's time is the acquisition's own, whenever the frame arrives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from haselab.base import DeviceError, InputError

__all__ = ["ExposureSignal", "ExposureState", "ExposureTrain", "frame_times_from_exposure"]


@dataclass(frozen=True)
class ExposureSignal:
    """What the line looks like.

    Args:
        low_code: at or below it the line is low.
        high_code: at or above it the line is high; between the two it is what it was.
        shortest_s: a pulse, or a gap, shorter than that is bounce and no edge.
        longest_s: an exposure longer than that is a line that hangs.
        active: which level means light.
    Raises:
        InputError: the two levels are not in this order, or a time is not above zero.
    """

    low_code: float
    high_code: float
    shortest_s: float = 50e-6
    longest_s: float = 1.0
    active: Literal["high", "low"] = "high"

    def __post_init__(self) -> None:
        if not self.low_code < self.high_code:
            raise InputError(
                f"Exposure levels = {self.low_code:g}, {self.high_code:g} codes, allowed is a low "
                "one below the high one. Correct them."
            )
        if not 0.0 < self.shortest_s < self.longest_s < np.inf:
            raise InputError(
                f"Shortest and longest exposure = {self.shortest_s:g}, {self.longest_s:g} s, "
                "allowed is 0 < shortest < longest. Correct them."
            )


@dataclass(frozen=True)
class ExposureState:
    """Between two blocks.

    Args:
        position: samples seen.
        tail: the last ones, from the last on whose level is certain.
        edges: found and not told yet, in samples after the first of all; beginning and end in turn.
    """

    position: int
    tail: NDArray[np.float64]
    edges: tuple[float, ...]


class ExposureTrain:
    """Finds the exposures of a signal that comes in blocks.

    Args:
        signal: what it looks like.
        rate_hz: of the samples.
    """

    def __init__(self, signal: ExposureSignal, rate_hz: float) -> None:
        self._signal = signal
        self._rate_hz = rate_hz
        self._shortest = signal.shortest_s * rate_hz
        self._longest = signal.longest_s * rate_hz

    def init(self) -> ExposureState:
        """The state before the first block."""
        return ExposureState(0, np.empty(0), ())

    def step(
        self, state: ExposureState, codes: NDArray[np.int16]
    ) -> tuple[ExposureState, NDArray[np.float64]]:
        """The exposures that are over for sure: whole ones, with no bounce that may follow.

        Args:
            state: after the block before.
            codes: of the next block, shape `(samples,)`.
        Returns:
            The new state; begin and end of each exposure, in s after the first sample of all,
            shape `(exposures, 2)`.
        Raises:
            DeviceError: the line hangs.
        """
        values = np.concatenate([state.tail, np.asarray(codes, dtype=np.float64)])
        position = state.position + len(codes)
        found, rises, rest = self._crossings(values)
        found += position - values.size
        if not state.edges and found.size and not rises:
            found = found[1:]  # of an exposure whose beginning was not seen
        edges = np.concatenate([state.edges, found])
        self._check_hanging(position, rest.size, edges)
        whole = np.append(edges, np.inf) if edges.size % 2 else edges
        groups = _joined(whole.reshape(-1, 2), self._shortest)
        over = groups[groups[:, 1] < position - 1 - self._shortest]
        if len(over):
            edges = edges[edges > over[-1, 1]]
        told = over[over[:, 1] - over[:, 0] >= self._shortest]
        return ExposureState(position, rest, tuple(edges)), told / self._rate_hz

    def _crossings(
        self, values: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], bool, NDArray[np.float64]]:
        """Where the line crosses its middle, whether the first is a beginning, what is open."""
        signal = self._signal
        above = np.where(values >= signal.high_code, 1, 0)
        level = np.where(values <= signal.low_code, -1, above)
        sure = np.flatnonzero(level)
        if sure.size == 0:
            return np.empty(0), False, values
        turns = np.flatnonzero(np.diff(level[sure]))
        middle = 0.5 * (signal.low_code + signal.high_code)
        at = np.empty(turns.size)
        for k, turn in enumerate(turns):
            piece = values[sure[turn] : sure[turn + 1] + 1] - middle
            last = int(np.flatnonzero(piece * piece[0] > 0.0)[-1])
            at[k] = sure[turn] + last + piece[last] / (piece[last] - piece[last + 1])
        rises = bool(turns.size) and (level[sure[turns[0]]] < 0) == (signal.active == "high")
        return at, rises, values[sure[-1] :]

    def _check_hanging(self, position: int, open_: int, edges: NDArray[np.float64]) -> None:
        exposing = position - edges[-1] if edges.size % 2 else 0.0
        if max(exposing, float(open_)) <= self._longest:
            return
        where = "as if it exposed" if exposing > open_ else "between its two levels"
        raise DeviceError(
            f"The camera's exposure signal stays {where} for {self._signal.longest_s:g} s. Check "
            "its wire and its levels, or take shorter exposures."
        )

    def settled(self, state: ExposureState) -> float:
        """The time, in s after the first sample, before which no exposure is still to be told."""
        first = state.edges[0] if state.edges else state.position - state.tail.size
        return float(first) / self._rate_hz


def _joined(pairs: NDArray[np.float64], shortest: float) -> NDArray[np.float64]:
    """Beginnings and ends with the short gaps closed, shape `(groups, 2)`."""
    if len(pairs) == 0:
        return pairs
    gap = pairs[1:, 0] - pairs[:-1, 1] >= shortest
    first, last = np.concatenate([[True], gap]), np.concatenate([gap, [True]])
    return np.stack([pairs[first, 0], pairs[last, 1]], axis=1)


def frame_times_from_exposure(
    codes: NDArray[np.int16], rate_hz: float, signal: ExposureSignal
) -> NDArray[np.float64]:
    """The middle of each exposure, from the recorded exposure signal.

    Each edge is put where the straight line between the samples about it crosses the middle of
    the two levels: an edge faster than a sample is uncertain by half a sample, a slower one by
    less. Exposures that are cut by the record's ends are left out.

    Args:
        codes: of the exposure channel, shape `(samples,)`.
        rate_hz: of the samples.
        signal: what the line looks like.
    Returns:
        Times in s after the first sample, shape `(exposures,)`.
    Raises:
        DeviceError: the line hangs.
    Example:
        >>> codes = np.zeros(100, np.int16)
        >>> codes[20:31] = codes[60:71] = 1000
        >>> signal = ExposureSignal(low_code=300, high_code=700, shortest_s=2e-3)
        >>> frame_times_from_exposure(codes, 1e3, signal)
        array([0.025, 0.065])
    """
    train = ExposureTrain(signal, rate_hz)
    _, found = train.step(train.init(), np.asarray(codes))
    return np.asarray(found.mean(axis=1), dtype=np.float64)
