"""Which structure of a transfer function the records support, nonlinear ones included."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, JsonObject, checked
from haselab.identify.fit import several
from haselab.identify.model_choice import APART
from haselab.identify.noise import autoregression
from haselab.identify.nonlinear.nonlinear_fit import NonlinearFit
from haselab.identify.record import Record
from haselab.identify.transfer.fit import TransferFit, fit_transfer
from haselab.identify.transfer.layout import TransferStructure
from haselab.identify.transfer.nonlinear import (
    beats_linear,
    linear_candidates,
    nonlinear_candidates,
)
from haselab.models.filters import lfilter

__all__ = ["Candidate", "TransferChoice", "choose_transfer"]

Floats = NDArray[np.float64]
_VARIED = ("poles", "zeros", "delay", "slow_modes")
_NONLINEAR = "nonlinear"
_MOST_POLES = 6
_MOST_SLOW = 2
_MOST_ROUNDS = 8
_WHITE = 1e-3


@dataclass(frozen=True)
class Candidate:
    """One structure, fitted.

    Args:
        fit: its fit.
        bic: Bayesian information criterion, with the noise model of the best fit for all.
    """

    fit: TransferFit
    bic: float


@dataclass(frozen=True)
class TransferChoice:
    """The structure that the records support, and all other candidates.

    Args:
        candidates: all that were fitted, the lowest criterion first.
        notes: remarks for the user, one sentence each.
    """

    candidates: tuple[Candidate, ...]
    notes: tuple[str, ...]

    @property
    def fit(self) -> TransferFit:
        """The chosen fit."""
        return self.candidates[0].fit

    @property
    def status(self) -> str:
        """ "ok", or why there is no result."""
        return self.fit.status

    @property
    def succeeded(self) -> bool:
        """Whether the fit has a usable result."""
        return self.fit.succeeded

    def answer(self) -> JsonObject:
        """The result under its public JSON keys, and the candidates with their criterion."""
        lowest = self.candidates[0].bic
        return {
            **self.fit.answer(),
            "notes": [*self.fit.notes, *self.notes],
            "structure": _described(self.fit),
            "candidates": [
                {**_described(c.fit), "bic": c.bic - lowest, "fit_percent": c.fit.fit_percent}
                for c in self.candidates
            ],
        }


def _structure_dict(structure: TransferStructure) -> dict[str, Any]:
    return {name: getattr(structure, name) for name in _VARIED}


def _described(fit: TransferFit) -> dict[str, Any]:
    kind = fit.kind if isinstance(fit, NonlinearFit) else None
    return {**_structure_dict(fit.structure), _NONLINEAR: kind}


@checked
def choose_transfer(
    records: Record | Sequence[Record],
    start: TransferStructure | None = None,
    varied: Sequence[str] = _VARIED,
) -> TransferChoice:
    r"""Fit structures from simple to rich and keep the one with the lowest BIC.

    $\mathrm{BIC} = N \ln(\lVert A(q)\,e\rVert^2/N) + k \ln N$, with $A(q)$ the noise model of
    the fit with the smallest residuals, the same for all. From `start` on, one number is changed at
    a time, or a resonance added, as long as that lowers the criterion.

    Args:
        records: experiments, or one.
        start: first structure; its fields that are not varied are kept. Default: one resonance
            with a delay.
        varied: which of these may change: `poles`, `zeros`, `delay` (estimated or zero),
            `slow_modes`, and `nonlinear` (a curve of the input or the output, a cubic spring).
    Returns:
        The chosen fit and all other candidates.
    Raises:
        InputError: as of `fit_transfer`; an unknown name in `varied`.
    Source: Schwarz, Ann. Stat. 6 (1978), 461.
    Example:
        >>> from haselab.models import Plant, SlowMode
        >>> rng = np.random.default_rng(7)
        >>> u, time_s = rng.normal(size=1000), np.arange(4000) / 400.0
        >>> plant = Plant(0.5, 5.11, 0.09, 0.012, (SlowMode(0.2, 2.0),))
        >>> y = plant.simulate(u, 100.0, time_s) + 0.002 * rng.normal(size=4000)
        >>> choice = choose_transfer(Record(u, 100.0, y, time_s), varied=["slow_modes"])
        >>> choice.fit.structure.slow_modes
        1
    """
    allowed = (*_VARIED, _NONLINEAR)
    unknown = sorted(set(varied) - set(allowed))
    if unknown:
        raise InputError(
            f"varied names {', '.join(unknown)}; they must be among {', '.join(allowed)}."
        )
    records = several(records)
    first = start or TransferStructure()
    search = _Search(records, first)
    at = first
    for _ in range(_MOST_ROUNDS):
        search.try_all(_neighbours(at, varied))
        ranked = search.ranked()
        if _key(ranked[0].fit.structure) == _key(at):
            break
        at = ranked[0].fit.structure
    notes = _hidden_creep(ranked) if "slow_modes" in varied else ()
    if _NONLINEAR in varied:
        ranked, said = _with_nonlinear(records, ranked, first)
        notes += said
    return TransferChoice(tuple(ranked), notes)


class _Search:
    """Fits of structures to the same records.

    Whether a fault of the records, such as a drifting clock, explains the residuals takes most of
    the time of a fit. It is asked only while no structure leaves white residuals, and of the best
    fit.

    Args:
        records: experiments.
        first: the first structure, which has to be possible.
    """

    def __init__(self, records: Sequence[Record], first: TransferStructure) -> None:
        self._records = records
        fit = fit_transfer(records, first, applied=True)
        self._plain = {_key(fit.structure): fit}
        self._diagnosed: dict[tuple[object, ...], TransferFit] = {}

    def try_all(self, structures: Iterable[TransferStructure]) -> None:
        """Fit those that have not been tried."""
        for structure in structures:
            if _key(structure) not in self._plain:
                fit = _fit_or_not(self._records, structure, applied=True)
                self._plain[_key(structure)] = fit

    def ranked(self) -> list[Candidate]:
        """All candidates, the best one with its diagnosis."""
        if not any(map(_explains, self._plain.values())):
            for key in self._plain:
                self._diagnose(key)
        while True:
            found = _ranked([self._diagnosed.get(key, fit) for key, fit in self._plain.items()])
            key = _key(found[0].fit.structure)
            if key in self._diagnosed or _explains(found[0].fit):
                return found
            self._diagnose(key)

    def _diagnose(self, key: tuple[object, ...]) -> None:
        if key not in self._diagnosed:
            structure = self._plain[key].structure
            self._diagnosed[key] = _fit_or_not(self._records, structure, applied=False)


def _explains(fit: TransferFit) -> bool:
    """Whether nothing is left in the residuals that a fault of the records could explain."""
    return fit.succeeded and fit.residual_whiteness_p >= _WHITE


def _with_nonlinear(
    records: Sequence[Record], linear: Sequence[Candidate], start: TransferStructure
) -> tuple[list[Candidate], tuple[str, ...]]:
    """All candidates, a nonlinear one first if it beats the linear ones, and notes."""
    chosen = linear[0].fit
    structures = [chosen.structure]
    if _key(start) != _key(chosen.structure):
        structures.append(start)
    fits: list[TransferFit] = [c.fit for c in linear]
    known = {_key(fit.structure) for fit in fits}
    richer = [fit for fit in linear_candidates(chosen) if _key(fit.structure) not in known]
    nonlinear = nonlinear_candidates(records, structures, chosen)
    everything = _ranked([*fits, *richer, *nonlinear])
    criterion = {id(c.fit): c.bic for c in everything}
    linear_ones = [c for c in everything if not isinstance(c.fit, NonlinearFit)]
    best = linear_ones[0] if linear_ones[0].fit.residuals else None
    for candidate in everything:
        fit = candidate.fit
        if not chosen.succeeded and fit.residual_whiteness_p < _WHITE:
            continue  # keep causes found by the linear fit, such as a clipped input
        if isinstance(fit, NonlinearFit) and beats_linear(
            fit, candidate.bic, best.fit if best else None, best.bic if best else math.inf
        ):
            return [candidate, *(c for c in everything if c is not candidate)], (
                f"A nonlinear model is supported: {fit.equation}.",
            )
    first = Candidate(chosen, criterion[id(chosen)])
    notes: tuple[str, ...] = ()
    if best is not None and best.bic < first.bic - APART and best.fit is not chosen:
        notes = (
            f"No nonlinear model is supported. A linear one with {_words(best.fit.structure)} "
            "explains the records better; try --choose all.",
        )
    return [first, *(c for c in everything if c.fit is not chosen)], notes


def _words(structure: TransferStructure) -> str:
    parts = [f"{structure.poles} poles", f"{structure.zeros} zeros"]
    return ", ".join([*parts, f"{structure.slow_modes} slow branches"])


def _fit_or_not(
    records: Sequence[Record], structure: TransferStructure, *, applied: bool
) -> TransferFit:
    """The fit; with too few samples for the structure, a fit without a result."""
    try:
        return fit_transfer(records, structure, applied=applied)
    except InputError as error:
        return TransferFit(status=f"no result: {error}", structure=structure)


def _key(structure: TransferStructure) -> tuple[object, ...]:
    return tuple(_structure_dict(structure).values())


def _neighbours(at: TransferStructure, varied: Sequence[str]) -> Iterator[TransferStructure]:
    """Structures that differ by one step."""
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
        yield replace(at, poles=at.poles + 2, zeros=at.zeros + 2)  # one more resonance


def _ranked(fits: Sequence[TransferFit]) -> list[Candidate]:
    """Candidates by their criterion; those without a result last."""
    good = [fit for fit in fits if fit.succeeded]
    if not good:
        return [Candidate(fit, math.inf) for fit in fits]
    # Excluded outputs (spikes, clipping) differ between fits, so each energy is normalised by its
    # count.
    closest = min(good, key=lambda fit: _energy(fit, np.ones(1)) / _count(fit))
    polynomial = autoregression(closest.residuals)[0]
    count = max(_count(fit) for fit in good)

    def bic(fit: TransferFit) -> float:
        if not fit.succeeded:
            return math.inf
        spread = max(_energy(fit, polynomial), 1e-300) / _count(fit)
        return count * math.log(spread) + fit.parameter_count * math.log(count)

    return sorted((Candidate(fit, bic(fit)) for fit in fits), key=lambda c: c.bic)


def _count(fit: TransferFit) -> int:
    return sum(e.size for e in fit.residuals)


def _energy(fit: TransferFit, polynomial: Floats) -> float:
    """Sum of the squared residuals, whitened."""
    whitened = (lfilter(polynomial, [1.0], e) for e in fit.residuals)
    return sum(float(e @ e) for e in whitened)


def _hidden_creep(ranked: Sequence[Candidate]) -> tuple[str, ...]:
    """A note where a slow branch may be present but is not identifiable."""
    chosen = ranked[0].fit
    larger = (c.fit for c in ranked if c.fit.structure.slow_modes > chosen.structure.slow_modes)
    richer = next(larger, None)
    if chosen.structure.slow_modes or richer is None:
        return ()
    if richer.succeeded and math.isfinite(richer.parameters["slow_time_constant_s"].std):
        return ()
    return (
        "Creep is not identifiable from these records: a slow branch may or may not be present. "
        "Add a step that lasts several times as long as the creep.",
    )
