"""Which of some rival models do records support."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from haselab.base import Estimate, InputError, JsonObject
from haselab.identify.noise import autoregression, fit_percent, whiteness_p
from haselab.identify.record import Record

__all__ = [
    "Explanation",
    "Hypothesis",
    "NoiseShape",
    "Rival",
    "Verdict",
    "compare",
    "noise_shape",
]

Floats = NDArray[np.float64]
_SPECTRUM_LINES = 4096
_FEWEST = 4.0  # independent samples; with as many, the odds ask for a tenfold misfit already


@dataclass(frozen=True)
class Explanation:
    """What a hypothesis makes of the records.

    Args:
        status: "ok", or why there is no result.
        parameters: fitted numbers.
        modelled: fitted output of each record. Shape `(M_r,)` each.
        residuals: measured minus fitted. Shape `(M_r,)` each.
        estimates: fitted numbers by name.
        model: the fitted model for a file, with a key for its kind; empty where it has no form.
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
        """A word for tables."""

    @property
    def says(self) -> str:
        """The statement, a sentence's end."""

    def explain(self, records: Sequence[Record], near: Explanation | None = None) -> Explanation:
        """The best fit; `near` is a rival's fit, one more place to start from."""


@dataclass(frozen=True)
class Rival:
    """One hypothesis beside the others.

    Args:
        name: of the hypothesis.
        says: what it states.
        status: "ok", or why its fit has no result.
        parameters: fitted numbers.
        fit_percent: NRMSE fit.
        misfit: root mean square of the residuals over that of the output about its means.
        log_likelihood: with as many independent samples as the noise model allows; NaN without one.
        bic: against that of the best hypothesis.
        probability: with equal chances before, from `bic`.
        lead: how far the best one is ahead, in standard deviations of what noise could decide; NaN
            for the best one.
        excluded: whether the records speak against it.
        estimates: fitted numbers by name.
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
        """Keys of the answer."""
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
class Verdict:
    """What the records say about rival hypotheses.

    Args:
        status: "ok", or why there is no result.
        verdict: "supports NAME", "cannot tell", or "none explains the data".
        supported: name of the supported hypothesis, "" without one.
        rivals: hypotheses, the best first.
        effective_samples: independent samples of the residuals' noise model.
        systematic: part of the output's swing that the best hypothesis leaves and that is not
            white.
        risk: of a wrong verdict that was allowed.
        notes: why, a sentence each.
    """

    status: str
    verdict: str
    supported: str
    rivals: tuple[Rival, ...]
    effective_samples: float
    systematic: float
    risk: float
    notes: tuple[str, ...]

    @property
    def succeeded(self) -> bool:
        """Whether there is a verdict; "cannot tell" is one."""
        return self.status == "ok"

    def answer(self) -> JsonObject:
        """The keys of the public contract."""
        return {
            "verdict": self.verdict,
            "supported": self.supported,
            "rivals": [rival.to_dict() for rival in self.rivals],
            "effective_samples": self.effective_samples,
            "systematic": self.systematic,
            "risk": self.risk,
            "status": self.status,
            "notes": list(self.notes),
        }


@dataclass(frozen=True)
class NoiseShape:
    """Colour of residuals, from the spectrum of their autoregressive model.

    Args:
        samples: white samples whose variance would be known as well.
        strongest: spectrum at its highest over its mean.
        white: innovation's over total variance.
    """

    samples: float
    strongest: float
    white: float


def noise_shape(residuals: Sequence[Floats]) -> NoiseShape:
    r"""How many independent samples coloured residuals are worth, and how strong they get.

    $n = N\,\bar S^2 / \overline{S^2}$, with the spectrum $S$ of an autoregressive model

    Args:
        residuals: one array a record, in order of time. Shape `(M_r,)`.
    Returns:
        The shape; white residuals give as many samples as there are, 1 and 1.
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


def compare(
    hypotheses: Sequence[Hypothesis],
    records: Sequence[Record],
    *,
    risk: float = 0.01,
    unexplained: float = 0.3,
) -> Verdict:
    r"""Fit each hypothesis to the records and say which one they support.

    A rival with as many numbers as the best is excluded when three things hold: its odds from
    $\mathrm{BIC} = n \ln(\lVert e\rVert^2/N) + k \ln n$ are below the risk ($n$ independent
    samples of the residuals' noise model, the same for all); its lead
    $(\lVert e_B\rVert^2 - \lVert e_A\rVert^2) / 2\sigma\lVert\hat y_A - \hat y_B\rVert$, a normal
    deviate were the truth half-way between both models and the noise everywhere as strong as at its
    strongest frequency, passes that risk; and its extra misfit is
    larger than what the best one leaves unexplained itself, else a shortcoming that all share could
    have decided. A rival with more numbers that fits better but not enough to be the best needs the
    first of these alone.

    Args:
        hypotheses: two or more.
        records: experiments that all hypotheses have to explain together.
        risk: allowed for a wrong verdict, 0 to 0.5.
        unexplained: coloured part of the output's swing above which a hypothesis explains nothing.
    Returns:
        The verdict; `status` says "ok" or why there is none.
    Raises:
        InputError: fewer than two hypotheses, a rate out of range, records that cannot be fitted.
    Source: Schwarz, Ann. Stat. 6 (1978), 461; Cox, J. R. Stat. Soc. B 24 (1962), 406, for rivals
        that do not contain each other.
    """
    _check(hypotheses, risk, unexplained)
    explained = [hypothesis.explain(records) for hypothesis in hypotheses]
    first = min(explained, key=lambda e: e.cost)
    if math.isfinite(first.cost):
        # A rival must not lose only because its search went astray.
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
    rivals = [
        evidence.rival(h.name, h.says, e)
        for h, e in zip(hypotheses, explained, strict=True)
    ]  # fmt: skip
    return _judged(sorted(rivals, key=lambda rival: rival.bic), evidence, unexplained)


def _check(hypotheses: Sequence[Hypothesis], risk: float, unexplained: float) -> None:
    if len(hypotheses) < 2:
        raise InputError(
            f"{len(hypotheses)} hypotheses; allowed are two or more. Give a rival to compare with."
        )
    if not 0.0 < risk < 0.5:
        raise InputError(f"risk = {risk:g}; allowed is above 0 and below 0.5. Correct it.")
    if not 0.0 < unexplained <= 1.0:
        raise InputError(
            f"unexplained = {unexplained:g}; allowed is above 0 and up to 1. Correct it."
        )


def _no_result(reason: str, risk: float) -> Verdict:
    status = f"no result: {reason}"
    return Verdict(status, "cannot tell", "", (), math.nan, math.nan, risk, ())


class _Evidence:
    """Likelihoods of all explanations under one noise model."""

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
        """How far the best one is ahead, in deviations at which noise alone would decide."""
        if e is self._best or e.status != "ok":
            return math.nan
        pairs = zip(e.modelled, self._best.modelled, strict=True)
        apart = sum(float(((theirs - ours) ** 2).sum()) for theirs, ours in pairs)
        noise = self._best.cost / self._count * self._strongest  # at its strongest frequency
        std = 2.0 * math.sqrt(apart * noise)
        return (e.cost - self._best.cost) / std if std > 0.0 else 0.0

    def rival(self, name: str, says: str, e: Explanation) -> Rival:
        """One line of the table."""
        if e.status != "ok":
            nan = math.nan
            return Rival(name, says, e.status, 0, nan, nan, nan, math.inf, 0.0, nan, False, {}, {})
        bic = self._bic(e) - self._lowest
        lead = self._lead(e)
        extra = e.cost - self._best.cost
        odds = math.exp(-0.5 * bic)
        excluded = e is not self._best and odds < self.risk
        if e.parameters <= self._best.parameters:
            far = lead > float(-ndtri(self.risk))
            excluded = excluded and far and extra >= self.systematic_cost
        return Rival(
            name, says, e.status, e.parameters, fit_percent(self._measured, e.modelled),
            math.sqrt(e.cost / self._spread), self._log_likelihood(e), bic, odds / self._weight,
            lead, excluded, e.estimates, e.model,
        )  # fmt: skip


def _judged(rivals: Sequence[Rival], evidence: _Evidence, unexplained: float) -> Verdict:
    best, others = rivals[0], rivals[1:]
    left = [rival for rival in others if not rival.excluded]
    percent = 100.0 * evidence.systematic
    notes = [
        f"{best.name} explains best: it leaves {100.0 * best.misfit:.2g} % of the output's swing, "
        + ", ".join(f"{r.name} {100.0 * r.misfit:.2g} %" for r in others)
        + "."
    ]
    notes += [f"{r.name} has no fit and is not excluded: {r.status}" for r in others
              if r.status != "ok"]  # fmt: skip
    if best.misfit > 1.0 - unexplained:
        notes.append("The output hardly follows the drive. Check the columns and the sensor.")
    supported = ""
    if evidence.systematic > unexplained and evidence.whiteness_p < evidence.risk:
        verdict = "none explains the data"
        notes.append(
            f"Even the best one leaves a coloured {percent:.2g} % of the output's swing; allowed "
            f"is {100.0 * unexplained:.2g} %. Check the columns, or think of another hypothesis."
        )
    elif evidence.samples < _FEWEST:
        verdict = "cannot tell"
        notes.append(
            f"The residuals are worth {evidence.samples:.2g} independent samples; "
            f"{_FEWEST:g} are needed. Record longer."
        )
    elif left:
        verdict = "cannot tell"
        names = ", ".join(rival.name for rival in left)
        notes.append(
            f"Not excluded: {names}. The best one itself leaves a coloured {percent:.2g} %, and an "
            "advantage within that may come from what all of them leave out. Ask "
            "`haselab plan-experiment` for an experiment that separates them."
        )
    else:
        supported = best.name
        verdict = f"supports {best.name}"
        notes.append(
            f"The records say: {best.says}. The others are excluded at a risk of {evidence.risk:g}."
        )
    return Verdict(
        "ok", verdict, supported, tuple(rivals), evidence.samples, evidence.systematic,
        evidence.risk, tuple(notes),
    )  # fmt: skip
