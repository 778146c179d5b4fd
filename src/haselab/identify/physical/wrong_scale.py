r"""Whether lengths of a wrong scale explain the records as well as an effect that the law lacks.

The scale of a camera or of a displacement sensor is stated, and assumed to be nearly right. If it
is wrong, residuals remain that a small hysteresis, drift or further branch may imitate. So before
such an effect is added, the scale and the zero of the lengths are estimated from the records. With
sums of squares $S$, the logarithm of evidence of $k$ effects over the wrong scale is

$\tfrac12 (S_\text{scale} - S_\text{effects}) - (k - 1) \ln N$

since an effect has two parameters, as scale and zero have together.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from haselab.identify.physical.misfit import Misfit
from haselab.identify.physical.residuals import channel_residuals
from haselab.identify.physical.rivals import DECISIVE
from haselab.identify.physical.search import SearchResult, refine
from haselab.identify.physical.unknowns import CAMERA_OFFSET, CAMERA_SCALE

__all__ = ["WrongScale", "find_wrong_scale"]

_WIDE = 0.05  # relative standard deviation of the scale; of the zero, over the longest length


@dataclass(frozen=True)
class WrongScale:
    """A fit in which scale and zero of the lengths are estimated.

    Args:
        misfit: with hardly any knowledge of both.
        found: its minimum.
        energy: sum of the squares that the stated scale leaves beyond it.
        instead_of: effects that explain the records hardly better, in words; empty: none.
    """

    misfit: Misfit
    found: SearchResult
    energy: float
    instead_of: str

    @property
    def status(self) -> str:
        """The model error that it is."""
        scale = self.found.unknowns.value(CAMERA_SCALE)
        than = f" about as well as {self.instead_of}" if self.instead_of else ""
        return (
            f"model error: lengths that are {scale:.4f} times the true ones explain the records"
            f"{than}. Check the scale of the camera or the gain of the displacement sensor; the "
            "intervals are wider for it"
        )


def find_wrong_scale(
    misfit: Misfit,
    without: SearchResult,
    effects: SearchResult | None = None,
    words: tuple[str, ...] = (),
) -> WrongScale | None:
    """Estimate scale and zero of the lengths, and compare with effects that the law lacks.

    Args:
        misfit: that was minimised.
        without: its result without these effects.
        effects: its minimum with them; None: there are none that explain the records.
        words: these effects.
    Returns:
        The fit, if nothing but noise is left, it explains the records decisively better than the
            stated scale, and the effects are not decisively better than it.
    """
    lengths_m = [float(abs(record.length_m).max()) for record in misfit.records
                 if record.length_m.size]  # fmt: skip
    if not lengths_m or not {CAMERA_OFFSET, CAMERA_SCALE} <= set(without.unknowns.names):
        return None
    wide = {CAMERA_OFFSET: _WIDE * max(lengths_m), CAMERA_SCALE: _WIDE}
    free = replace(misfit, known={**misfit.known, **wide}, zero_std_m=misfit.own_zero_std_m)
    found = refine(free, without.unknowns, without.evaluations)
    if found is None or not (found.converged and channel_residuals(free, found).explained):
        return None
    energy, one = _squares(without) - _squares(found), math.log(found.residuals.size)
    if 0.5 * energy - one < DECISIVE:
        return None
    if effects is not None:
        ahead = 0.5 * (_squares(found) - _squares(effects)) - (len(words) - 1) * one
        if ahead > DECISIVE:
            return None
    return WrongScale(free, found, energy, " and ".join(words))


def _squares(result: SearchResult) -> float:
    return float(result.residuals @ result.residuals)
