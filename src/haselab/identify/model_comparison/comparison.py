"""Comparison of candidate models: which one do the records support."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from haselab.base import Estimate, InputError, JsonObject, checked
from haselab.identify.fit import several
from haselab.identify.noise import autoregression, fit_percent, whiteness_p
from haselab.identify.record import Record

__all__ = [
    "CandidateModel",
    "Explanation",
    "Hypothesis",
    "ModelComparison",
    "NoiseShape",
    "compare",
    "noise_shape",
]

Floats = NDArray[np.float64]
_SPECTRUM_LINES = 4096
_FEWEST = 4.0  # independent samples; with so few the odds already require a tenfold misfit


@dataclass(frozen=True)
class Explanation:
    """Best fit of a hypothesis to the records.

    Args:
        status: "ok", or why there is no result.
        parameters: fitted parameters.
        modelled: fitted output of each record. Shape `(M_r,)` each.
        residuals: measured minus fitted. Shape `(M_r,)` each.
        estimates: fitted parameters by name.
        model: the fitted model for a file, with a key for its kind; empty if it cannot be saved.
    """

    status: str
    parameters: int
    modelled: tuple[Floats, ...]
    residuals: tuple[Floats, ...]
    estimates: Mapping[str, Estimate]
    model: Mapping[str, Any]

    @property
    def cost(self) -> float:
        """Sum of the squared residuals."""
        return sum(float(e @ e) for e in self.residuals) if self.residuals else math.inf


class Hypothesis(Protocol):
    """A statement about the actuator that can be fitted to records."""

    @property
    def name(self) -> str:
        """Short name for tables."""

    @property
    def says(self) -> str:
        """The statement, as the end of a sentence."""

    def explain(self, records: Sequence[Record], near: Explanation | None = None) -> Explanation:
        """The best fit; `near` is the fit of another hypothesis, as an additional start."""


@dataclass(frozen=True)
class CandidateModel:
    """One hypothesis in a comparison.

    Args:
        name: of the hypothesis.
        says: its statement.
        status: "ok", or why its fit has no result.
        parameters: fitted parameters.
        fit_percent: NRMSE fit.
        misfit: root mean square of the residuals over that of the output about its means.
        log_likelihood: with the effective number of independent samples; NaN without a fit.
        bic: relative to that of the best hypothesis.
        probability: from `bic`, with equal prior probabilities.
        lead: how far the best one is ahead, in standard deviations of the noise; NaN
            for the best one.
        excluded: whether the records exclude it.
        estimates: fitted parameters by name.
        model: the fitted model for a file.
    """

    name: str
    says: str
    status: str
    parameters: int
    fit_percent: float
    misfit: float
    log_likelihood: float
    bic: float
    probability: float
    lead: float
    excluded: bool
    estimates: Mapping[str, Estimate]
    model: Mapping[str, Any]

    def to_dict(self) -> JsonObject:
        """The result as a dictionary for JSON."""
        return {
            "name": self.name,
            "says": self.says,
            "status": self.status,
            "parameters": self.parameters,
            "fit_percent": self.fit_percent,
            "misfit": self.misfit,
            "log_likelihood": self.log_likelihood,
            "bic": self.bic,
            "probability": self.probability,
            "lead": self.lead,
            "excluded": self.excluded,
            "estimates": dict(self.estimates),
            "model": dict(self.model),
        }


@dataclass(frozen=True)
class ModelComparison:
    """Result of a comparison of hypotheses.

    Args:
        status: "ok", or why there is no result.
        verdict: "supports NAME", "cannot tell", or "none explains the data".
        supported: name of the supported hypothesis, "" if none.
        candidates: hypotheses, the best first.
        effective_samples: independent samples of the residuals' noise model.
        systematic: coloured part of the output's variation that the best hypothesis does not
            explain.
        risk: accepted probability of a wrong decision.
        notes: reasons, one sentence each.
    """

    status: str
    verdict: str
    supported: str
    candidates: tuple[CandidateModel, ...]
    effective_samples: float
    systematic: float
    risk: float
    notes: tuple[str, ...]

    @property
    def succeeded(self) -> bool:
        """Whether the comparison has a result; "cannot tell" counts as one."""
        return self.status == "ok"

    def answer(self) -> JsonObject:
        """The result under its public JSON keys."""
        return {
            "verdict": self.verdict,
            "supported": self.supported,
            "candidates": [candidate.to_dict() for candidate in self.candidates],
            "effective_samples": self.effective_samples,
            "systematic": self.systematic,
            "risk": self.risk,
            "status": self.status,
            "notes": list(self.notes),
        }


@dataclass(frozen=True)
class NoiseShape:
    """Shape of the residuals' spectrum, from an autoregressive model.

    Args:
        samples: number of white samples whose variance would be known equally well.
        strongest: maximum of the spectrum over its mean.
        white: variance of the innovation over the total variance.
    """

    samples: float
    strongest: float
    white: float


def noise_shape(residuals: Sequence[Floats]) -> NoiseShape:
    r"""Effective number of samples of coloured residuals, and the peak of their spectrum.

    $n = N\,\bar S^2 / \overline{S^2}$, with the spectrum $S$ of an autoregressive model

    Args:
        residuals: one array per record, in order of time. Shape `(M_r,)`.
    Returns:
        The shape; for white residuals: all samples, 1 and 1.
    Source: Bartlett, J. R. Stat. Soc. Suppl. 8 (1946), 27, for the variance of a variance.
    Example:
        >>> white = np.random.default_rng(1).normal(size=1000)
        >>> noise_shape([white])
        NoiseShape(samples=1000.0, strongest=1.0, white=1.0)
        >>> coloured = noise_shape([np.convolve(white, np.ones(10), "same")])
        >>> 100 < coloured.samples < 300, coloured.white < 0.2
        (True, True)
    """
    count = sum(e.size for e in residuals)
    polynomial, variance = autoregression(residuals)
    total = sum(float(e @ e) for e in residuals) / count
    if polynomial.size == 1 or total <= 0.0:
        return NoiseShape(float(count), 1.0, 1.0)
    spectrum = 1.0 / np.abs(np.fft.rfft(polynomial, 2 * _SPECTRUM_LINES)) ** 2
    mean = float(spectrum.mean())
    samples = count * mean**2 / float((spectrum**2).mean())
    return NoiseShape(samples, float(spectrum.max()) / mean, min(variance / total, 1.0))


@checked
def compare(
    hypotheses: Sequence[Hypothesis],
    records: Record | Sequence[Record],
    *,
    risk: float = 0.01,
    unexplained: float = 0.3,
) -> ModelComparison:
    r"""Fit each hypothesis to the records and determine which one they support.

    A hypothesis with as many parameters as the best is excluded when three conditions hold: its
    odds from $\mathrm{BIC} = n \ln(\lVert e\rVert^2/N) + k \ln n$ are below the risk ($n$
    independent samples of the residuals' noise model, the same for all); its lead
    $(\lVert e_B\rVert^2 - \lVert e_A\rVert^2) / 2\sigma\lVert\hat y_A - \hat y_B\rVert$, a normal
    deviate if the truth were half-way between both models and the noise were as strong as at its
    strongest frequency everywhere, exceeds the limit for that risk; and its extra misfit is
    larger than the unexplained part of the best one, since otherwise a deficiency common to all
    could decide. For a hypothesis with more parameters that fits better, but not well enough to be
    the best, the first condition is sufficient.

    Args:
        hypotheses: two or more.
        records: experiments that each hypothesis has to explain jointly.
        risk: accepted probability of a wrong decision, 0 to 0.5.
        unexplained: coloured part of the output's variation above which a hypothesis is useless.
    Returns:
        The result; `status` says "ok" or why there is none.
    Raises:
        InputError: fewer than two hypotheses, a risk out of range, records that cannot be fitted.
    Source: Schwarz, Ann. Stat. 6 (1978), 461; Cox, J. R. Stat. Soc. B 24 (1962), 406, for models
        that are not nested.
    """
    _check(hypotheses, risk, unexplained)
    records = several(records)
    explained = [hypothesis.explain(records) for hypothesis in hypotheses]
    first = min(explained, key=lambda e: e.cost)
    if math.isfinite(first.cost):
        # A hypothesis must not lose only because its search ended in a local minimum.
        explained = [
            e if e is first else min((h.explain(records, first), e), key=lambda other: other.cost)
            for h, e in zip(hypotheses, explained, strict=True)
        ]
    usable = [k for k, e in enumerate(explained) if e.status == "ok"]
    if len(usable) < 2:
        reasons = {h.name: e.status for h, e in zip(hypotheses, explained, strict=True)}
        return _no_result(f"fewer than two hypotheses could be fitted: {reasons}", risk)
    leader = min(usable, key=lambda k: explained[k].cost)
    evidence = _Evidence(records, explained, noise_shape(explained[leader].residuals), risk)
    candidates = [
        evidence.candidate(h.name, h.says, e)
        for h, e in zip(hypotheses, explained, strict=True)
    ]  # fmt: skip
    return _judged(sorted(candidates, key=lambda candidate: candidate.bic), evidence, unexplained)


def _check(hypotheses: Sequence[Hypothesis], risk: float, unexplained: float) -> None:
    if len(hypotheses) < 2:
        raise InputError(f"{len(hypotheses)} hypotheses; at least two are required.")
    if not 0.0 < risk < 0.5:
        raise InputError(f"risk = {risk:g}; it must be above 0 and below 0.5.")
    if not 0.0 < unexplained <= 1.0:
        raise InputError(f"unexplained = {unexplained:g}; it must be above 0 and up to 1.")


def _no_result(reason: str, risk: float) -> ModelComparison:
    status = f"no result: {reason}"
    return ModelComparison(status, "cannot tell", "", (), math.nan, math.nan, risk, ())


class _Evidence:
    """Likelihoods of all fits under one noise model."""

    def __init__(
        self,
        records: Sequence[Record],
        explained: Sequence[Explanation],
        noise: NoiseShape,
        risk: float,
    ) -> None:
        self.risk, self.samples, self._strongest = risk, noise.samples, noise.strongest
        self._measured = [record.y for record in records]
        self._count = sum(y.size for y in self._measured)
        self._spread = sum(float(((y - y.mean()) ** 2).sum()) for y in self._measured)
        self._floor = 1e-24 * self._spread
        bics = [self._bic(e) for e in explained]
        self._best = explained[int(np.argmin(bics))]
        self._lowest = min(bics)
        self._weight = sum(math.exp(-0.5 * (bic - self._lowest)) for bic in bics)
        self.systematic_cost = self._best.cost * (1.0 - noise.white)
        self.systematic = math.sqrt(self.systematic_cost / self._spread)
        self.whiteness_p = whiteness_p(self._best.residuals)

    def _log_likelihood(self, e: Explanation) -> float:
        return -0.5 * self.samples * math.log((e.cost + self._floor) / self._spread)

    def _bic(self, e: Explanation) -> float:
        if e.status != "ok":
            return math.inf
        return e.parameters * math.log(max(self.samples, 2.0)) - 2.0 * self._log_likelihood(e)

    def _lead(self, e: Explanation) -> float:
        """Lead of the best hypothesis, in standard deviations of the noise."""
        if e is self._best or e.status != "ok":
            return math.nan
        pairs = zip(e.modelled, self._best.modelled, strict=True)
        apart = sum(float(((theirs - ours) ** 2).sum()) for theirs, ours in pairs)
        noise = self._best.cost / self._count * self._strongest  # at its strongest frequency
        std = 2.0 * math.sqrt(apart * noise)
        return (e.cost - self._best.cost) / std if std > 0.0 else 0.0

    def candidate(self, name: str, says: str, e: Explanation) -> CandidateModel:
        """The row of one hypothesis in the comparison."""
        if e.status != "ok":
            nan = math.nan
            return CandidateModel(
                name, says, e.status, 0, nan, nan, nan, math.inf, 0.0, nan, False, {}, {}
            )
        bic = self._bic(e) - self._lowest
        lead = self._lead(e)
        extra = e.cost - self._best.cost
        odds = math.exp(-0.5 * bic)
        excluded = e is not self._best and odds < self.risk
        if e.parameters <= self._best.parameters:
            far = lead > float(-ndtri(self.risk))
            excluded = excluded and far and extra >= self.systematic_cost
        return CandidateModel(
            name, says, e.status, e.parameters, fit_percent(self._measured, e.modelled),
            math.sqrt(e.cost / self._spread), self._log_likelihood(e), bic, odds / self._weight,
            lead, excluded, e.estimates, e.model,
        )  # fmt: skip


def _judged(
    candidates: Sequence[CandidateModel], evidence: _Evidence, unexplained: float
) -> ModelComparison:
    best, others = candidates[0], candidates[1:]
    left = [candidate for candidate in others if not candidate.excluded]
    percent = 100.0 * evidence.systematic
    notes = [
        f"{best.name} explains best: it leaves {100.0 * best.misfit:.2g} % of the output's "
        "variation, " + ", ".join(f"{r.name} {100.0 * r.misfit:.2g} %" for r in others) + "."
    ]
    notes += [f"{r.name} has no fit and is not excluded: {r.status}" for r in others
              if r.status != "ok"]  # fmt: skip
    if best.misfit > 1.0 - unexplained:
        notes.append("The output hardly depends on the drive. Check the columns and the sensor.")
    supported = ""
    if evidence.systematic > unexplained and evidence.whiteness_p < evidence.risk:
        verdict = "none explains the data"
        notes.append(
            f"Even the best hypothesis leaves a coloured {percent:.2g} % of the output's "
            f"variation; the limit is {100.0 * unexplained:.2g} %. Check the columns, or add "
            "another hypothesis."
        )
    elif evidence.samples < _FEWEST:
        verdict = "cannot tell"
        notes.append(
            f"The residuals are equivalent to {evidence.samples:.2g} independent samples; "
            f"at least {_FEWEST:g} are required. Record longer."
        )
    elif left:
        verdict = "cannot tell"
        names = ", ".join(candidate.name for candidate in left)
        notes.append(
            f"Not excluded: {names}. The best one leaves a coloured {percent:.2g} %, and an "
            "advantage below that may be caused by effects that all of them neglect. Use "
            "`haselab plan-experiment` to find an experiment that separates them."
        )
    else:
        supported = best.name
        verdict = f"supports {best.name}"
        notes.append(
            f"Supported: {best.says}. The others are excluded at a risk of {evidence.risk:g}."
        )
    return ModelComparison(
        "ok", verdict, supported, tuple(candidates), evidence.samples, evidence.systematic,
        evidence.risk, tuple(notes),
    )  # fmt: skip
