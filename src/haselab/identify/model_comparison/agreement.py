"""Test whether independent estimates of one quantity agree."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import chdtrc, ndtri

from haselab.base import Estimate, InputError, JsonObject, checked
from haselab.base.estimate import Z95

__all__ = ["Agreement", "compare_estimates"]


@dataclass(frozen=True)
class Agreement:
    """Result of a test whether independent estimates of one quantity agree.

    Args:
        status: "ok", or why there is no result.
        verdict: "compare_estimates", "disagree: NAMES", or "cannot tell".
        mean: weighted mean, widened by the Birge ratio where that exceeds 1.
        birge_ratio: root of chi-square over its degrees of freedom; about 1 for correct intervals.
        chi_square_p: probability of a scatter as large or larger.
        pairs: difference over its standard deviation, by the names of both.
        notes: reasons, one sentence each.
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
        """Whether the test has a result; "cannot tell" counts as one."""
        return self.status == "ok"

    def answer(self) -> JsonObject:
        """The result under its public JSON keys."""
        return {
            "verdict": self.verdict,
            "mean": self.mean,
            "birge_ratio": self.birge_ratio,
            "chi_square_p": self.chi_square_p,
            "pairs": [{"names": list(names), "z": z} for names, z in self.pairs.items()],
            "status": self.status,
            "notes": list(self.notes),
        }


@checked
def compare_estimates(
    estimates: Mapping[str, Estimate], *, risk: float = 0.01, matters: float = 0.2
) -> Agreement:
    r"""Test whether independent estimates of one quantity agree.

    $\chi^2 = \sum_i (x_i - \bar x)^2/\sigma_i^2$ on $n - 1$ degrees of freedom; a pair disagrees
    when its difference exceeds the limit for the risk, which all pairs share.

    Args:
        estimates: by the name of the experiment, two or more, of one unit.
        risk: probability of calling agreeing estimates contradictory, 0 to 0.5.
        matters: relevant relative difference; "agree" needs two 95 % intervals that are
            narrower than this on either side.
    Returns:
        The result; `status` says "ok" or why there is none.
    Raises:
        InputError: fewer than two estimates, different units, a risk out of range.
    Source: Birge, Phys. Rev. 40 (1932), 207; Bonferroni's bound for the pairs.
    Example:
        >>> chirp = Estimate.normal(5.11, 0.02, "rad/s")
        >>> compare_estimates({"chirp": chirp, "decay": Estimate.normal(6.4, 0.1, "rad/s")}).verdict
        'disagree: chirp and decay'
        >>> compare_estimates({"chirp": chirp, "decay": Estimate.normal(4.0, 2.0, "rad/s")}).verdict
        'cannot tell'
    """
    finite, notes = _finite(estimates, risk, matters)
    if len(finite) < 2:
        nothing = Estimate(math.nan, math.inf, (-math.inf, math.inf), "")
        mean = next(iter(finite.values()), nothing)
        notes.append("Fewer than two estimates have a finite interval; nothing to compare.")
        return Agreement("ok", "cannot tell", mean, math.nan, math.nan, {}, tuple(notes))
    mean, birge, p = _together(list(finite.values()))
    pairs = {
        (a, b): (finite[a].value - finite[b].value) / math.hypot(finite[a].std, finite[b].std)
        for a, b in combinations(finite, 2)
    }
    far = float(-ndtri(0.5 * risk / len(pairs)))
    apart = [names for names, z in pairs.items() if abs(z) > far]
    narrow = [name for name, e in finite.items() if Z95 * e.std <= matters * abs(mean.value)]
    if apart or p < risk:
        verdict = "disagree: " + ("; ".join(f"{a} and {b}" for a, b in apart) or ", ".join(finite))
        notes.append(
            f"The scatter is {birge:.2g} times what the intervals imply (p = {p:.2g}): an interval "
            "is too narrow, or the experiments did not measure the same thing."
        )
    elif len(narrow) < 2:
        verdict = "cannot tell"
        notes.append(
            f"Fewer than two intervals are narrower than {100.0 * matters:g} % on either side, so "
            "a relevant difference may go unnoticed. Measure again with more excitation."
        )
    else:
        verdict = "agree"
        notes.append(f"The scatter is {birge:.2g} times what the intervals imply (p = {p:.2g}).")
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


def _finite(
    estimates: Mapping[str, Estimate], risk: float, matters: float
) -> tuple[dict[str, Estimate], list[str]]:
    """Estimates with a finite interval, and a note for each of the others."""
    if len(estimates) < 2:
        raise InputError(
            f"{len(estimates)} estimate(s); at least two are required. Add another experiment."
        )
    units = {e.unit for e in estimates.values()}
    if len(units) > 1:
        raise InputError(
            f"The estimates have units {sorted(units)}; they must have one unit. Convert them "
            "first."
        )
    if not (0.0 < risk < 0.5 and matters > 0.0):
        raise InputError(
            f"risk = {risk:g}, matters = {matters:g}; risk must be 0 to 0.5 and matters above 0."
        )
    finite = {n: e for n, e in estimates.items() if math.isfinite(e.value) and 0 < e.std < math.inf}
    notes = [
        f"{name} is left out: its interval is not finite or has no width."
        for name in estimates
        if name not in finite
    ]
    return finite, notes
