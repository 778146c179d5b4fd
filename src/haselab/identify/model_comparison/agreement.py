"""Do independent estimates of one quantity agree."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import chdtrc, ndtri

from haselab.base import Estimate, InputError, JsonObject
from haselab.base.estimate import Z95

__all__ = ["Agreement", "agree"]


@dataclass(frozen=True)
class Agreement:
    """Whether independent estimates of one quantity agree.

    Args:
        status: "ok", or why there is no result.
        verdict: "agree", "disagree: NAMES", or "cannot tell".
        mean: weighted mean, widened by the Birge ratio where that exceeds 1.
        birge_ratio: root of chi-square over its degrees of freedom; about 1 for honest intervals.
        chi_square_p: probability of a scatter as large or larger.
        pairs: difference over its standard deviation, by the names of both.
        notes: why, a sentence each.
    """

    status: str
    verdict: str
    mean: Estimate
    birge_ratio: float
    chi_square_p: float
    pairs: Mapping[tuple[str, str], float]
    notes: tuple[str, ...]

    @property
    def succeeded(self) -> bool:
        """Whether there is a verdict; "cannot tell" is one."""
        return self.status == "ok"

    def answer(self) -> JsonObject:
        """The keys of the public contract."""
        return {
            "verdict": self.verdict,
            "mean": self.mean,
            "birge_ratio": self.birge_ratio,
            "chi_square_p": self.chi_square_p,
            "pairs": [{"names": list(names), "z": z} for names, z in self.pairs.items()],
            "status": self.status,
            "notes": list(self.notes),
        }


def agree(
    estimates: Mapping[str, Estimate], *, risk: float = 0.01, matters: float = 0.2
) -> Agreement:
    r"""Whether independent estimates of one quantity agree.

    $\chi^2 = \sum_i (x_i - \bar x)^2/\sigma_i^2$ on $n - 1$ degrees of freedom; a pair disagrees
    when its difference is too large for the risk shared among all pairs.

    Args:
        estimates: by the name of the experiment, two or more, of one unit.
        risk: allowed for calling agreeing estimates contradictory, 0 to 0.5.
        matters: relative difference that would matter; "agree" needs two 95 % intervals that are
            narrower than this either side.
    Returns:
        The verdict; `status` says "ok" or why there is none.
    Raises:
        InputError: fewer than two estimates, different units, a rate out of range.
    Source: Birge, Phys. Rev. 40 (1932), 207; Bonferroni's bound for the pairs.
    Example:
        >>> chirp = Estimate.normal(5.11, 0.02, "rad/s")
        >>> agree({"chirp": chirp, "decay": Estimate.normal(6.4, 0.1, "rad/s")}).verdict
        'disagree: chirp and decay'
        >>> agree({"chirp": chirp, "decay": Estimate.normal(4.0, 2.0, "rad/s")}).verdict
        'cannot tell'
    """
    told, notes = _told(estimates, risk, matters)
    if len(told) < 2:
        nothing = Estimate(math.nan, math.inf, (-math.inf, math.inf), "")
        mean = next(iter(told.values()), nothing)
        notes.append("Fewer than two estimates tell the quantity; there is nothing to compare.")
        return Agreement("ok", "cannot tell", mean, math.nan, math.nan, {}, tuple(notes))
    mean, birge, p = _together(list(told.values()))
    pairs = {
        (a, b): (told[a].value - told[b].value) / math.hypot(told[a].std, told[b].std)
        for a, b in combinations(told, 2)
    }
    far = float(-ndtri(0.5 * risk / len(pairs)))
    apart = [names for names, z in pairs.items() if abs(z) > far]
    narrow = [name for name, e in told.items() if Z95 * e.std <= matters * abs(mean.value)]
    if apart or p < risk:
        verdict = "disagree: " + ("; ".join(f"{a} and {b}" for a, b in apart) or ", ".join(told))
        notes.append(
            f"The scatter is {birge:.2g} times what the intervals claim (p = {p:.2g}): an interval "
            "is too narrow, or the experiments did not measure the same thing."
        )
    elif len(narrow) < 2:
        verdict = "cannot tell"
        notes.append(
            f"Fewer than two intervals are narrower than {100.0 * matters:g} % either side, so a "
            "difference that matters could hide in them. Measure again with more excitation."
        )
    else:
        verdict = "agree"
        notes.append(f"The scatter is {birge:.2g} times what the intervals claim (p = {p:.2g}).")
    return Agreement("ok", verdict, mean, birge, p, pairs, tuple(notes))


def _together(estimates: Sequence[Estimate]) -> tuple[Estimate, float, float]:
    """Weighted mean, Birge ratio, probability of the scatter."""
    value = np.array([e.value for e in estimates])
    weight = np.array([e.std for e in estimates]) ** -2.0
    mean = float((weight * value).sum() / weight.sum())
    chi_square = float((weight * (value - mean) ** 2).sum())
    birge = math.sqrt(chi_square / (value.size - 1))
    p = float(chdtrc(value.size - 1, chi_square))
    std = max(birge, 1.0) / math.sqrt(weight.sum())
    return Estimate.normal(mean, std, estimates[0].unit), birge, p


def _told(
    estimates: Mapping[str, Estimate], risk: float, matters: float
) -> tuple[dict[str, Estimate], list[str]]:
    """Estimates that tell something, and a note for each of the others."""
    if len(estimates) < 2:
        raise InputError(
            f"{len(estimates)} estimate(s); allowed are two or more. Give another experiment."
        )
    units = {e.unit for e in estimates.values()}
    if len(units) > 1:
        raise InputError(
            f"The estimates have units {sorted(units)}; allowed is one unit. Convert them first."
        )
    if not (0.0 < risk < 0.5 and matters > 0.0):
        raise InputError(
            f"risk = {risk:g}, matters = {matters:g}; allowed are 0 to 0.5 and above "
            "0. Correct them."
        )
    told = {n: e for n, e in estimates.items() if math.isfinite(e.value) and 0 < e.std < math.inf}
    notes = [
        f"{name} is left out: its interval is not finite or has no width."
        for name in estimates
        if name not in told
    ]
    return told, notes
