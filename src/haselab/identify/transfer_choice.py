"""Which structure of a transfer function the records support: order, zeros, delay, slow modes."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.identify.noise import autoregression
from haselab.identify.record import Record
from haselab.identify.transfer import TransferFit, fit_transfer
from haselab.identify.transfer_layout import TransferStructure
from haselab.models.filters import lfilter

__all__ = ["Candidate", "TransferChoice", "choose_transfer"]

Floats = NDArray[np.float64]
_VARIED = ("poles", "zeros", "delay", "slow_modes")
_MOST_POLES = 6
_MOST_SLOW = 2
_MOST_ROUNDS = 8


@dataclass(frozen=True)
class Candidate:
    """One structure, fitted.

    Args:
        fit: its fit.
        bic: Bayesian information criterion, the noise model of the best fit taken for all.
    """

    fit: TransferFit
    bic: float


@dataclass(frozen=True)
class TransferChoice:
    """The structure that the records support, and its rivals.

    Args:
        candidates: all that were fitted, the lowest criterion first.
        notes: what the reader of the numbers should know, a sentence each.
    """

    candidates: tuple[Candidate, ...]
    notes: tuple[str, ...]

    @property
    def fit(self) -> TransferFit:
        """The chosen fit."""
        return self.candidates[0].fit

    @property
    def status(self) -> str:
        """The word ok, or why there is no result."""
        return self.fit.status

    @property
    def succeeded(self) -> bool:
        """Whether the numbers may be used."""
        return self.fit.succeeded

    def answer(self) -> dict[str, Any]:
        """The keys of the public contract, and the candidates with their criterion."""
        lowest = self.candidates[0].bic
        return {
            **self.fit.answer(),
            "notes": [*self.fit.notes, *self.notes],
            "structure": _told(self.fit.structure),
            "candidates": [
                {**_told(c.fit.structure), "bic": c.bic - lowest, "fit_percent": c.fit.fit_percent}
                for c in self.candidates
            ],
        }


def _told(structure: TransferStructure) -> dict[str, Any]:
    return {name: getattr(structure, name) for name in _VARIED}


def choose_transfer(
    records: Sequence[Record],
    start: TransferStructure | None = None,
    varied: Sequence[str] = _VARIED,
) -> TransferChoice:
    r"""Fit structures from simple to rich and keep the one with the lowest BIC.

    $\mathrm{BIC} = N \ln(\lVert A(q)\,e\rVert^2/N) + k \ln N$, with $A(q)$ the noise model of
    the fit with the smallest residuals, the same for all. From `start` on, one number is changed at
    a time, or a resonance added, as long as that lowers the criterion.

    Args:
        records: experiments.
        start: where the search begins, and what is kept of what does not vary. One resonance with a
            delay when not given.
        varied: what may change, of `poles`, `zeros`, `delay` (estimated or zero), `slow_modes`.
    Returns:
        The chosen fit and all others.
    Raises:
        InputError: as of `fit_transfer`; an unknown name in `varied`.
    Source: Schwarz, Ann. Stat. 6 (1978), 461.
    Example:
        >>> from haselab.models import Plant, SlowMode
        >>> rng = np.random.default_rng(7)
        >>> u, time_s = rng.normal(size=1000), np.arange(4000) / 400.0
        >>> plant = Plant(0.5, 5.11, 0.09, 0.012, (SlowMode(0.2, 2.0),))
        >>> y = plant.simulate(u, 100.0, time_s) + 0.002 * rng.normal(size=4000)
        >>> choice = choose_transfer([Record(u, 100.0, y, time_s)], varied=["slow_modes"])
        >>> choice.fit.structure.slow_modes
        1
    """
    unknown = sorted(set(varied) - set(_VARIED))
    if unknown:
        raise InputError(
            f"varied names {', '.join(unknown)}; allowed are {', '.join(_VARIED)}. Correct it."
        )
    fits = [fit_transfer(records, start)]
    tried = {_key(fits[0].structure)}
    ranked = _ranked(fits)
    for _ in range(_MOST_ROUNDS):
        best = ranked[0].fit
        for structure in _neighbours(best.structure, varied):
            if _key(structure) not in tried:
                tried.add(_key(structure))
                fits.append(_fit_or_not(records, structure))
        ranked = _ranked(fits)
        if ranked[0].fit is best:
            break
    notes = _hidden_creep(ranked) if "slow_modes" in varied else ()
    return TransferChoice(tuple(ranked), notes)


def _fit_or_not(records: Sequence[Record], structure: TransferStructure) -> TransferFit:
    """The fit; a structure for which there are too few samples has no result."""
    try:
        return fit_transfer(records, structure)
    except InputError as error:
        return TransferFit(f"no result: {error}", structure)


def _key(structure: TransferStructure) -> tuple[object, ...]:
    return tuple(_told(structure).values())


def _neighbours(at: TransferStructure, varied: Sequence[str]) -> Iterator[TransferStructure]:
    """Structures one step away."""
    if "slow_modes" in varied:
        if at.slow_modes < _MOST_SLOW:
            yield replace(at, slow_modes=at.slow_modes + 1)
        if at.slow_modes > 0:
            yield replace(at, slow_modes=at.slow_modes - 1)
    if "delay" in varied:
        yield replace(at, delay=0.0 if at.delay == "auto" else "auto")
    if "zeros" in varied:
        if at.zeros + 1 < at.poles:
            yield replace(at, zeros=at.zeros + 1)
        if at.zeros > 0:
            yield replace(at, zeros=at.zeros - 1)
    if "poles" in varied:
        if at.poles < _MOST_POLES:
            yield replace(at, poles=at.poles + 1)
        if at.poles > 1:
            yield replace(at, poles=at.poles - 1, zeros=min(at.zeros, at.poles - 2))
    if "poles" in varied and "zeros" in varied and at.poles + 2 <= _MOST_POLES:
        yield replace(at, poles=at.poles + 2, zeros=at.zeros + 2)  # one resonance more


def _ranked(fits: Sequence[TransferFit]) -> list[Candidate]:
    """Candidates by their criterion; those without a result last."""
    good = [fit for fit in fits if fit.succeeded]
    if not good:
        return [Candidate(fit, math.inf) for fit in fits]
    closest = min(good, key=lambda fit: _energy(fit, np.ones(1)))
    polynomial = autoregression(closest.residuals)[0]
    count = sum(e.size for e in closest.residuals)

    def bic(fit: TransferFit) -> float:
        if not fit.succeeded:
            return math.inf
        spread = max(_energy(fit, polynomial), 1e-300) / count
        return count * math.log(spread) + fit.parameters * math.log(count)

    return sorted((Candidate(fit, bic(fit)) for fit in fits), key=lambda c: c.bic)


def _energy(fit: TransferFit, polynomial: Floats) -> float:
    """Sum of the squared residuals, whitened."""
    whitened = (lfilter(polynomial, [1.0], e) for e in fit.residuals)
    return sum(float(e @ e) for e in whitened)


def _hidden_creep(ranked: Sequence[Candidate]) -> tuple[str, ...]:
    """A sentence where a slow branch could hide, or is there but not told."""
    chosen = ranked[0].fit
    rivals = (c.fit for c in ranked if c.fit.structure.slow_modes > chosen.structure.slow_modes)
    richer = next(rivals, None)
    if chosen.structure.slow_modes or richer is None:
        return ()
    if richer.succeeded and math.isfinite(richer.estimates["slow_time_constant_s"].std):
        return ()
    return (
        "Creep is not identifiable from these records: a slow branch may be there or not. Add a "
        "step that lasts several times as long as the creep.",
    )
