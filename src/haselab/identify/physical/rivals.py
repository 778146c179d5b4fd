r"""Compare a physical model with laws that have one effect less or more.

At the minimum, a law with one effect more is judged by the size $a$ that this effect would have and
its standard deviation $\sigma$, with all other parameters free: its logarithm of evidence over the
present law is

$\tfrac12 (a/\sigma)^2 - \tfrac12 k \ln N$

for $k$ parameters more and $N$ values (Schwarz's criterion). A law with one effect less is judged
likewise by the size of that effect. A law with another elastic energy has as many parameters; it is
fitted, and half the difference of the sums of squares counts.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab import _motion
from haselab.actuators import (
    ADDED_INERTIA,
    DRIFT_TIMES,
    DRIFTS,
    GRAVITY_M_S2,
    ActuatorLaw,
    with_parameters,
)
from haselab.actuators.threads import in_threads
from haselab.identify.noise import coloured_covariance
from haselab.identify.physical.information import vague_information
from haselab.identify.physical.misfit import Misfit
from haselab.identify.physical.search import SearchResult, refine, search
from haselab.identify.physical.unknowns import INSTRUMENTS, START_HYSTERESIS, Unknowns

__all__ = [
    "DECISIVE",
    "ExtendedLaw",
    "Rival",
    "compare_elastic_laws",
    "find_extended_law",
    "find_simpler_laws",
    "search_with_all_effects",
]

Floats = NDArray[np.float64]
DECISIVE = 5.0  # logarithm of evidence: 150 to 1
_LITTLE = 1e-6  # size of an effect at which its derivative is taken
_LARGEST = 0.5  # size of an effect from which to refine
_TIMES = 9  # relaxation times of a further branch that are tried
_SHORTEST_S, _SHARE_OF_RECORD = 0.03, 0.1  # of them: shortest, and longest over the record
_WIDTHS = (0.005, 0.02, 0.08)  # of a hysteresis that are tried
_DRIFTS = {"stiffness": DRIFTS[:2], "permittivity": DRIFTS[2:]}
_DRIFTING = (0.3, 1.0, 3.0)  # time constants of a drift that are tried, over the record
_FASTEST = 1e-3  # drift from which to refine, 1/s
_SOME_SHARE, _SOME_WEIGHT = 0.01, 2e-3  # of the voltage and the weight: sizes of a little effect
_NAMES = {
    "softening_share": "softening",
    "charge_share": "charge creep",
    "hysteresis_n": "hysteresis",
}


@dataclass(frozen=True)
class Rival:
    """A law that was compared with the one that was chosen.

    Args:
        law: how it differs.
        log_evidence: its logarithm of evidence less that of the chosen law.
    """

    law: str
    log_evidence: float


def compare_elastic_laws(misfit: Misfit, found: SearchResult) -> list[Rival]:
    """Compare laws of another elastic energy, each fitted to the records.

    Args:
        misfit: that was minimised.
        found: its minimum.
    Returns:
        Laws that differ decisively; the logarithm of evidence of better ones is positive.
    """
    rivals = []
    for words, law in found.unknowns.present_law().elastic_rivals().items():
        other = refine(misfit, dataclasses.replace(found.unknowns, law=law))
        if other is None or not other.converged:
            continue
        squares = (found.residuals**2).sum() - (other.residuals**2).sum()
        evidence = 0.5 * float(squares)
        if abs(evidence) > DECISIVE:
            rivals.append(Rival(words, evidence))
    return rivals


@dataclass(frozen=True)
class ExtendedLaw:
    """A law with one effect more that the records prefer.

    Args:
        start: its parameters, from which to refine.
        effect: in words.
        log_evidence: over the law without.
    """

    start: Unknowns
    effect: str
    log_evidence: float


def find_simpler_laws(found: SearchResult, covariance: Floats) -> list[Rival]:
    """Laws without one of the effects that the records show decisively.

    Args:
        found: the minimum.
        covariance: of the values there. Shape `(P, P)`.
    Returns:
        Rejected laws, in the order of the effects.
    """
    unknowns = found.unknowns
    fields = {about.key: about for about in unknowns.law.described()}
    rivals = []
    for k, name in enumerate(unknowns.names):
        about = fields.get(name.partition("[")[0])
        if about is None:
            continue
        size, std = unknowns.values[k], math.sqrt(covariance[k, k])
        if power := about.inverse_exponent:
            effect, std = f"{about.key} (infinite)", power * std / size ** (power + 1)
            size = size**-power
        elif about.name == "branch_share":
            effect = f"the branch {name}"
        elif about.name in _NAMES:
            effect = _NAMES[about.name]
        else:
            continue
        evidence = _log_evidence(size, std, 1 if power else 2, found.residuals.size)
        if evidence > DECISIVE:
            rivals.append(Rival(f"without {effect}", -evidence))
    return rivals


def _log_evidence(size: float, std: float, parameters: int, count: int) -> float:
    if not (std > 0.0 and math.isfinite(std)):
        return -math.inf
    return float(0.5 * (size / std) ** 2 - 0.5 * parameters * math.log(count))


def find_extended_law(misfit: Misfit, found: SearchResult) -> ExtendedLaw | None:
    """The law with one effect more that the records prefer most, if any decisively.

    Args:
        misfit: that was minimised.
        found: its minimum.
    Returns:
        That law; None if there is none.
    """
    best: ExtendedLaw | None = None
    candidates = _candidates(found.unknowns, _duration_s(misfit))
    columns_of = in_threads(
        lambda more: _column(misfit, found, more), candidates, os.cpu_count() or 1
    )
    for more, column in zip(candidates, columns_of, strict=True):
        if column is None or not column.any():
            continue
        columns = np.column_stack([found.jacobian, column])
        columns = columns[:, np.abs(columns).any(axis=0)]
        scale = np.linalg.norm(columns, axis=0)
        step = np.linalg.lstsq(columns / scale, found.residuals, rcond=1e-12)[0]
        rest = found.residuals - (columns / scale) @ step
        covariance = coloured_covariance(
            [columns[part.rows] for part in misfit.segments],
            [rest[part.rows] for part in misfit.segments],
            scale.size,
        )
        size, std = float(step[-1] / scale[-1]), math.sqrt(covariance[-1, -1])
        evidence = _log_evidence(size, std, 2, rest.size)
        possible = size > 0.0 or more.name in DRIFTS
        if possible and evidence > (DECISIVE if best is None else best.log_evidence):
            best = ExtendedLaw(more.sized(size, found.unknowns), more.effect, evidence)
    return best


def _duration_s(misfit: Misfit) -> float:
    return max(float(np.ptp(record.drive.edge_s)) for record in misfit.records)


def search_with_all_effects(
    misfit: Misfit, start: Unknowns, found: SearchResult
) -> tuple[SearchResult, list[Rival]]:
    """Search again with a little of every effect that the law lacks, and keep those that matter.

    Without an effect that there is, the search may leave the law's parameters far away, where no
    rival can be judged.

    Args:
        misfit: to minimise.
        start: first values.
        found: by a search from there, which did not converge.
    Returns:
        The new result with the laws without these effects; the old one if it is no better.
    """
    law, effects = _every_effect(start)
    duration_s = _duration_s(misfit)
    drifts = {name: duration_s if name in DRIFT_TIMES else 0.0 for name in DRIFTS}
    unknowns = start.with_law(law, {**drifts, **start.drifts})
    more = search(misfit, unknowns, found.evaluations)
    if more is None or not more.converged:
        return found, []
    covariance = coloured_covariance(
        [more.jacobian[part.rows] for part in misfit.segments],
        [more.residuals[part.rows] for part in misfit.segments],
        more.left.size,
        prior=vague_information(more.unknowns),
    )
    std = np.sqrt(np.diag(covariance)) * np.abs(more.unknowns.slopes)
    kept_law, kept_drifts = more.unknowns.present_law(), more.unknowns.drifts
    rejected = []
    for name, (field, words) in effects.items():
        k = more.unknowns.names.index(name)
        evidence = _log_evidence(more.unknowns.values[k], std[k], 2, more.residuals.size)
        if evidence > DECISIVE:
            rejected.append(Rival(f"without {words}", -evidence))
        elif field:
            kept_law = dataclasses.replace(kept_law, **{field: 0.0})
        else:
            for other in next(pair for pair in _DRIFTS.values() if name in pair):
                del kept_drifts[other]
    if not rejected:
        return found, []
    kept = refine(misfit, more.unknowns.with_law(kept_law, kept_drifts), more.evaluations)
    return (found, []) if kept is None else (kept, rejected)


def _every_effect(start: Unknowns) -> tuple[ActuatorLaw, dict[str, tuple[str, str]]]:
    """The law with a little of charge creep and hysteresis; all effects by the names of their size.

    Each has the field of the law, empty for a drift, and its words.
    """
    law = start.present_law()
    fields = {about.name: about.key for about in law.described() if about.fitted}
    effects = {}
    for field, size in (
        ("charge_share", _SOME_SHARE),
        ("hysteresis_n", _SOME_WEIGHT * GRAVITY_M_S2 * start.mass_kg),
    ):
        if field in fields and getattr(law, field) == 0.0:
            law = dataclasses.replace(law, **{field: size})
            effects[fields[field]] = field, _NAMES[field]
    for what, (rate, _) in _DRIFTS.items():
        if rate not in start.names:
            effects[rate] = "", f"drift of the {what}"
    return law, effects


@dataclass(frozen=True)
class _Candidate:
    """A law with one effect more, of hardly any size.

    Args:
        law: with it, unless it is a drift.
        drifts: with it, if it is one.
        name: of its size.
        effect: in words.
    """

    law: ActuatorLaw
    drifts: Mapping[str, float]
    name: str
    effect: str

    def sized(self, size: float, present: Unknowns) -> Unknowns:
        """Where to refine with an effect of about that size."""
        law, drifts = self.law, dict(self.drifts)
        if self.name in drifts:
            drifts[self.name] = min(max(size, -_FASTEST), _FASTEST)
        else:
            law = with_parameters(law, {self.name: min(size, _LARGEST)})
        return present.with_law(law, drifts)


def _candidates(unknowns: Unknowns, duration_s: float) -> list[_Candidate]:
    """All effects that the law lacks."""
    law, drifts = unknowns.present_law(), unknowns.drifts
    fields = {about.name: about.key for about in law.described() if about.fitted}
    found = []
    for field in ("softening_share", "charge_share"):
        if field in fields and getattr(law, field) == 0.0:
            more = dataclasses.replace(law, **{field: _LITTLE})
            found.append(_Candidate(more, drifts, fields[field], _NAMES[field]))
    if "hysteresis_n" in fields and law.losses.hysteresis_n == 0.0:
        for width in _WIDTHS:
            little = {"hysteresis_n": _LITTLE, "hysteresis_width": width}
            more = dataclasses.replace(law, **little)
            found.append(_Candidate(more, drifts, fields["hysteresis_n"], _NAMES["hysteresis_n"]))
    if "branch_share" in fields and "branch_relaxation_s" in fields:
        shares, times = law.losses.branch_share, law.losses.branch_relaxation_s
        if len(shares) < _motion.BRANCHES:
            name = f"{fields['branch_share']}[{len(shares)}]"
            longest_s = max(_SHARE_OF_RECORD * duration_s, 2.0 * _SHORTEST_S)
            for time_s in np.geomspace(_SHORTEST_S, longest_s, _TIMES).tolist():
                added = {
                    "branch_share": (*shares, _LITTLE),
                    "branch_relaxation_s": (*times, time_s),
                }
                more = dataclasses.replace(law, **added)
                effect = f"a branch of about {time_s:.2g} s"
                found.append(_Candidate(more, drifts, name, effect))
    for what, (rate, time) in _DRIFTS.items():
        for share in _DRIFTING if rate not in drifts else ():
            slow = {**drifts, rate: _LITTLE, time: share * duration_s}
            found.append(_Candidate(law, slow, rate, f"drift of the {what}"))
    return found


def _column(misfit: Misfit, found: SearchResult, more: _Candidate) -> Floats | None:
    """Derivative of the modelled, over the standard deviations, by the size of an effect."""
    present = found.unknowns
    beside = [*more.drifts, *INSTRUMENTS, START_HYSTERESIS]
    others = [name for name in beside if name in (*present.names, *more.drifts)]
    values = {ADDED_INERTIA: 0.0, **dict.fromkeys(others, 0.0)}
    values |= {name: present.value(name) for name in values if name in present.names}
    values = {more.name: _LITTLE, **values, **more.drifts}
    unknowns = Unknowns(more.law, tuple(values), np.array([*values.values()]), present.mass_kg)
    linear = misfit.linearised(unknowns)
    return None if linear is None else linear[1][:, 0] / unknowns.slopes[0]
