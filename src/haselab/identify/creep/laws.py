"""Creep laws to fit: searched parameters, responses to the input, and derivatives."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.models.creep import (
    Creep,
    FractionalCreep,
    LogarithmicCreep,
    PowerCreep,
    PronyCreep,
    superpose,
)
from haselab.models.held_input import HeldInput

__all__ = ["CreepLaw", "FractionalLaw", "LogarithmicLaw", "PowerLaw", "PronyLaw", "Span"]

Floats = NDArray[np.float64]
_ORDERS = (0.02, 1.0)
_DIFFERENCE = 1e-5
_LONGEST = 30.0  # record lengths
_SHORTEST = 0.3  # samples


@dataclass(frozen=True)
class Span:
    """The input of a record at its own sampling rate.

    Args:
        inputs: held input, from 0 before the record. Shape `(N,)`.
        rate_hz: sampling rate, in Hz.
    """

    inputs: Floats
    rate_hz: float

    @property
    def duration_s(self) -> float:
        """Length, in s."""
        return self.inputs.size / self.rate_hz

    @property
    def log_times(self) -> tuple[float, float]:
        """Logarithms of the shortest and the longest time constant in s of the search."""
        return math.log(_SHORTEST / self.rate_hz), math.log(_LONGEST * self.duration_s)


class CreepLaw(ABC):
    """A law: `y = offset + instant u + gains x columns`."""

    kind: str

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the searched parameters, then of the gains."""

    @abstractmethod
    def bounds(self, span: Span) -> tuple[Floats, Floats]:
        """Lowest and highest searched parameters; time constants by their logarithm."""

    @abstractmethod
    def starts(self, span: Span) -> list[Floats]:
        """Starting values of the searched parameters."""

    @abstractmethod
    def columns(self, search: Floats, span: Span) -> tuple[Floats, Floats]:
        """Responses to the input at gains of 1, shape `(N, C)`, and derivatives, `(L, N, C)`."""

    @abstractmethod
    def model(self, search: Floats, instant: float, gains: Floats) -> Creep:
        """The model with these parameters."""


@dataclass(frozen=True)
class PronyLaw(CreepLaw):
    """Prony series; the logarithms of its time constants are searched.

    Args:
        count: number of branches; 0 means no creep.
    """

    count: int
    kind = "prony"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the searched parameters, then of the gains."""
        numbers = range(1, self.count + 1)
        taus = (f"time_constant_{k}_s" for k in numbers)
        return (*taus, *(f"gain_{k}" for k in numbers))

    def bounds(self, span: Span) -> tuple[Floats, Floats]:
        """The same range for each."""
        low, high = span.log_times
        return np.full(self.count, low), np.full(self.count, high)

    def starts(self, span: Span) -> list[Floats]:
        """Combinations of time constants from a grid over the record."""
        low, high = math.log(2.0 / span.rate_hz), math.log(span.duration_s)
        if self.count == 0:
            return [np.zeros(0)]
        if self.count == 1:
            return [np.array([value]) for value in np.linspace(low, high, 8)]
        inner = np.linspace(low, high, self.count + 2)
        step = inner[1] - inner[0]
        return [inner[1:-1] + shift * step for shift in (-0.7, -0.35, 0.0, 0.35, 0.7)]

    def columns(self, search: Floats, span: Span) -> tuple[Floats, Floats]:
        """Exact for the held input."""
        size = span.inputs.size
        held, time_s = HeldInput(span.inputs, span.rate_hz), np.arange(size) / span.rate_hz
        columns, slopes = np.empty((size, self.count)), np.zeros((self.count, size, self.count))
        for k, log_tau in enumerate(search):
            pole = -math.exp(-log_tau)
            response = held.response(complex(pole), time_s)
            columns[:, k] = (-pole * response.state).real
            slopes[k, :, k] = (pole * (response.state + pole * response.by_pole)).real
        return columns, slopes

    def model(self, search: Floats, instant: float, gains: Floats) -> Creep:
        """The model with these parameters."""
        return PronyCreep(instant, tuple(gains.tolist()), tuple(np.exp(search).tolist()))


class _Differenced(CreepLaw):
    """A law with numerical derivatives."""

    @abstractmethod
    def _column(self, search: Floats, span: Span) -> Floats:
        """Response to the input at a gain of 1. Shape `(N,)`."""

    def columns(self, search: Floats, span: Span) -> tuple[Floats, Floats]:
        """Response and its derivatives by central differences inside the bounds."""
        low, high = self.bounds(span)
        slopes = np.empty((search.size, span.inputs.size, 1))
        for k in range(search.size):
            ends = []
            for step in (-_DIFFERENCE, _DIFFERENCE):
                moved = search.copy()
                moved[k] = min(max(moved[k] + step, low[k]), high[k])
                ends.append((moved[k], self._column(moved, span)))
            slopes[k, :, 0] = (ends[1][1] - ends[0][1]) / (ends[1][0] - ends[0][0])
        return self._column(search, span)[:, None], slopes


@dataclass(frozen=True)
class PowerLaw(_Differenced):
    """A spring-pot; its order is searched."""

    kind = "fractional"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the searched parameters, then of the gain."""
        return ("order", "gain_1")

    def bounds(self, span: Span) -> tuple[Floats, Floats]:
        """Orders up to 1."""
        return np.array(_ORDERS[:1]), np.array(_ORDERS[1:])

    def starts(self, span: Span) -> list[Floats]:
        """Orders over the range."""
        return [np.array([order]) for order in (0.1, 0.3, 0.6)]

    def _column(self, search: Floats, span: Span) -> Floats:
        time_s = np.arange(span.inputs.size) / span.rate_hz
        answer = PowerCreep(0.0, 1.0, float(search[0])).compliance(time_s)
        return superpose(span.inputs, answer)

    def model(self, search: Floats, instant: float, gains: Floats) -> Creep:
        """The model with these parameters."""
        return PowerCreep(instant, float(gains[0]), float(search[0]))


@dataclass(frozen=True)
class FractionalLaw(_Differenced):
    """A fractional Kelvin-Voigt branch; order and logarithm of the time constant are searched."""

    kind = "fractional"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the searched parameters, then of the gain."""
        return ("order", "time_constant_1_s", "gain_1")

    def bounds(self, span: Span) -> tuple[Floats, Floats]:
        """Orders up to 1, time constants as of a Prony branch."""
        low, high = span.log_times
        return np.array([_ORDERS[0], low]), np.array([_ORDERS[1], high])

    def starts(self, span: Span) -> list[Floats]:
        """A grid of both."""
        low, high = math.log(4.0 / span.rate_hz), math.log(span.duration_s)
        taus = np.linspace(low, high, 5)
        return [np.array([order, tau]) for order in (0.4, 0.8) for tau in taus]

    def _column(self, search: Floats, span: Span) -> Floats:
        time_s = np.arange(span.inputs.size) / span.rate_hz
        creep = FractionalCreep(0.0, 1.0, float(search[0]), math.exp(search[1]))
        return superpose(span.inputs, creep.compliance(time_s))

    def model(self, search: Floats, instant: float, gains: Floats) -> Creep:
        """The model with these parameters."""
        return FractionalCreep(instant, float(gains[0]), float(search[0]), math.exp(search[1]))


@dataclass(frozen=True)
class LogarithmicLaw(_Differenced):
    """Logarithmic creep; the logarithm of its time constant is searched."""

    kind = "logarithmic"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the searched parameter, then of the gain."""
        return ("time_constant_1_s", "gain_1")

    def bounds(self, span: Span) -> tuple[Floats, Floats]:
        """Time constants as of a Prony branch."""
        low, high = span.log_times
        return np.array([low]), np.array([high])

    def starts(self, span: Span) -> list[Floats]:
        """A grid over the record."""
        low, high = math.log(0.5 / span.rate_hz), math.log(span.duration_s)
        return [np.array([value]) for value in np.linspace(low, high, 8)]

    def _column(self, search: Floats, span: Span) -> Floats:
        time_s = np.arange(span.inputs.size) / span.rate_hz
        creep = LogarithmicCreep(0.0, 1.0, math.exp(search[0]))
        return superpose(span.inputs, creep.compliance(time_s))

    def model(self, search: Floats, instant: float, gains: Floats) -> Creep:
        """The model with these parameters."""
        return LogarithmicCreep(instant, float(gains[0]), math.exp(search[0]))
