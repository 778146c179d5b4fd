"""Ready-made hypotheses: unit of a printed frequency, kind of creep, one mode or two."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from haselab.base import InputError
from haselab.identify.model_comparison.comparison import Explanation, Hypothesis
from haselab.identify.model_comparison.voltage_plant import VoltageStructure, fit_voltage_plant
from haselab.identify.record import Record
from haselab.identify.transfer.fit import TransferStructure, fit_transfer
from haselab.models.voltage_plant import VoltagePlant

__all__ = [
    "QUESTIONS",
    "TransferHypothesis",
    "VoltageHypothesis",
    "creep_hypotheses",
    "hypotheses_of",
    "linear_mode_hypotheses",
    "mode_hypotheses",
    "reading_hypotheses",
]

QUESTIONS = ("reading", "creep", "modes")
_PRINTED = 5.1  # natural frequency of the reference study, printed with an ambiguous unit
_SPREAD = 1.5  # the study's own values, 5.1 to 6.6 by its eq. 7, differ by a factor of 1.3


@dataclass(frozen=True)
class VoltageHypothesis:
    """A hypothesis in terms of the voltage plant.

    Args:
        name: short name for tables.
        says: the statement.
        structures: structures that fulfil the statement; the best fit is used.
    """

    name: str
    says: str
    structures: tuple[VoltageStructure, ...]

    def explain(self, records: Sequence[Record], near: Explanation | None = None) -> Explanation:
        """See `haselab.identify.model_comparison.comparison.Hypothesis`."""
        start: list[VoltagePlant] = []
        if near is not None and "voltage_plant" in near.model:
            start.append(VoltagePlant.from_dict(near.model["voltage_plant"]))
        fits = [fit_voltage_plant(records, structure, start) for structure in self.structures]
        usable = [fit for fit in fits if fit.succeeded]
        if not usable:
            return Explanation(fits[0].status, 0, (), (), {}, {})
        fit = min(usable, key=lambda f: sum(float(e @ e) for e in f.residuals))
        model = {"voltage_plant": fit.plant.to_dict()} if fit.plant else {}
        return Explanation(
            fit.status, fit.parameter_count, fit.modelled, fit.residuals, fit.parameters, model
        )


@dataclass(frozen=True)
class TransferHypothesis:
    """A hypothesis in terms of a transfer function.

    Args:
        name: short name for tables.
        says: the statement.
        structure: what is fitted.
    """

    name: str
    says: str
    structure: TransferStructure

    def explain(self, records: Sequence[Record], near: Explanation | None = None) -> Explanation:
        """See `haselab.identify.model_comparison.comparison.Hypothesis`; the fit needs no start."""
        del near
        fit = fit_transfer(records, self.structure)
        if not (fit.succeeded or fit.ambiguous):
            return Explanation(fit.status, 0, (), (), {}, {})
        s = self.structure
        own = s.offset + (s.poles + s.slow_modes if s.initial_state else 0)
        free = sum(estimate.std > 0.0 for estimate in fit.parameters.values())
        open_to = {
            name for minimum in fit.other_minima if minimum.possible for name in minimum.differs
        }
        estimates = {name: e for name, e in fit.parameters.items() if name not in open_to}
        # Ambiguous minima are accepted here: they explain the records equally well.
        parameters = free + own * len(records)
        return Explanation("ok", parameters, fit.modelled, fit.residuals, estimates, {})


def reading_hypotheses(
    printed: float = _PRINTED,
    *,
    spread: float = _SPREAD,
    powers: int = 2,
    slew_v_s: float = math.inf,
) -> tuple[Hypothesis, ...]:
    """Hypotheses about a frequency printed with an ambiguous unit: rad/s, Hz or neither.

    Args:
        printed: the printed value.
        spread: factor on either side that still counts as the printed value, 1 to 2.5.
        powers: number of terms of the static curve.
        slew_v_s: fastest change of the drive, in V/s.
    Returns:
        Hypotheses `rad`, `hz` and `neither`, all with the same free parameters.
    Raises:
        InputError: a spread at which the hypotheses overlap.
    Example:
        >>> [hypothesis.name for hypothesis in reading_hypotheses()]
        ['rad', 'hz', 'neither']
    """
    if not (printed > 0.0 and 1.0 < spread < math.sqrt(2.0 * math.pi)):
        raise InputError(
            f"printed = {printed:g}, spread = {spread:g}; printed must be above 0 and spread 1 to "
            "2.5, so that rad/s and Hz do not overlap."
        )

    def within(low: float | None, high: float | None) -> VoltageStructure:
        return VoltageStructure(
            powers=powers, lowest_rad_s=low, highest_rad_s=high, slew_v_s=slew_v_s
        )

    rad, hz = printed, 2.0 * math.pi * printed
    return (
        VoltageHypothesis(
            "rad",
            f"the natural frequency is near {rad:.3g} rad/s",
            (within(rad / spread, rad * spread),),
        ),
        VoltageHypothesis(
            "hz",
            f"the natural frequency is near {printed:.3g} Hz, {hz:.3g} rad/s",
            (within(hz / spread, hz * spread),),
        ),
        VoltageHypothesis(
            "neither",
            f"the natural frequency is near neither {rad:.3g} nor {hz:.3g} rad/s",
            (
                within(0.1 * rad, rad / spread),
                within(rad * spread, hz / spread),
                within(hz * spread, 5.0 * hz),
            ),
        ),
    )


def creep_hypotheses(*, powers: int = 2, slew_v_s: float = math.inf) -> tuple[Hypothesis, ...]:
    """Hypotheses about creep: of the shell, or of the charge in oil and silicone.

    Args:
        powers: of the static curve.
        slew_v_s: fastest change of the drive, in V/s.
    Returns:
        Hypotheses `mechanical` and `electrical`, with the same free parameters.
    Example:
        >>> [hypothesis.name for hypothesis in creep_hypotheses()]
        ['mechanical', 'electrical']
    """
    says = {
        "mechanical": "creep follows the force, independent of the polarity",
        "electrical": "creep follows the voltage with its sign",
    }
    return tuple(
        VoltageHypothesis(
            name, text, (VoltageStructure(name, powers=powers, slew_v_s=slew_v_s),)
        )
        for name, text in says.items()
    )  # fmt: skip


def mode_hypotheses(
    creep: str = "mechanical", *, powers: int = 2, slew_v_s: float = math.inf
) -> tuple[Hypothesis, ...]:
    """Hypotheses of one or two resonances, with the drive voltage as input.

    Args:
        creep: "mechanical" or "electrical".
        powers: of the static curve.
        slew_v_s: fastest change of the drive, in V/s.
    Returns:
        Hypotheses `one` and `two`.
    """
    return tuple(
        VoltageHypothesis(
            name,
            text,
            (VoltageStructure(creep, powers=powers, two_modes=two, slew_v_s=slew_v_s),),
        )
        for name, text, two in (
            ("one", "one resonance is enough", False),
            ("two", "there are two resonances", True),
        )
    )


def linear_mode_hypotheses(slow_modes: int = 0) -> tuple[Hypothesis, ...]:
    """Hypotheses of one or two resonances, for a linear output.

    Args:
        slow_modes: slow branches in parallel to them.
    Returns:
        Hypotheses `one` and `two`.
    """
    return (
        TransferHypothesis(
            "one", "one resonance is enough", TransferStructure(poles=2, slow_modes=slow_modes)
        ),
        TransferHypothesis(
            "two",
            "there are two resonances",
            TransferStructure(poles=4, zeros=2, slow_modes=slow_modes),
        ),
    )


def hypotheses_of(question: str, *, slew_v_s: float = math.inf) -> tuple[Hypothesis, ...]:
    """The hypotheses of a question in `QUESTIONS`.

    Args:
        question: "reading", "creep" or "modes".
        slew_v_s: fastest change of the drive, in V/s.
    Returns:
        Two or three hypotheses.
    Raises:
        InputError: an unknown question.
    """
    if question == "reading":
        return reading_hypotheses(slew_v_s=slew_v_s)
    if question == "creep":
        return creep_hypotheses(slew_v_s=slew_v_s)
    if question == "modes":
        return mode_hypotheses(slew_v_s=slew_v_s)
    raise InputError(f"question = {question}; it must be one of {', '.join(QUESTIONS)}.")
