r"""How far a misstated gain, mass or scale of the camera may have changed the parameters.

Forces follow from the stated voltages and weights, capacitances from the monitors. If the
capacitances are a factor $s$ off from those that the forces need, the monitors, the amplifier's
gain, a mass or the camera's scale is wrong, and the records do not say which. An error $a$ of one
of these changes what the model says by $g\,a$, and so moves the estimates by

$\delta\theta = (J^\top J)^{-1} J^\top g\,a$

where $a$ is the error that alone explains $s$. The largest of these moves counts as one standard
deviation.

The clock of the records has an error $a$ of which only the standard deviation is known beforehand.
It moves the estimates in the same way, and the squares of these moves add to the variances.

Lengths of a wrong scale may also leave residuals that an effect imitates which the law lacks.
Before such an effect is added, the scale and the zero of the lengths are estimated from the
records. With sums of squares $S$, the logarithm of evidence of $k$ effects over the wrong scale is

$\tfrac12 (S_\text{scale} - S_\text{effects}) - (k - 1) \ln N$

since an effect has two parameters, as scale and zero have together.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from haselab.identify.physical.misfit import Misfit
from haselab.identify.physical.record import MotionRecord
from haselab.identify.physical.residuals import channel_residuals
from haselab.identify.physical.rivals import DECISIVE
from haselab.identify.physical.search import SearchResult, refine
from haselab.identify.physical.unknowns import CAMERA_OFFSET, CAMERA_SCALE, SENSING_SCALE

__all__ = [
    "WrongScale",
    "clock_std",
    "find_wrong_scale",
    "misstated_std",
    "scale_error",
    "suspect_scale",
]

Floats = NDArray[np.float64]
_CAREFUL = 0.005  # error of the capacitance that a careful calibration has
_SURE = 2.0  # standard deviations from which an error is one
_LITTLE = 1e-4  # relative change of gain or mass, for the derivative
_MOST = 0.2  # error of a gain, a mass or the camera's scale
_SUSPECTED = 1e-3  # error of the scale that is suspected without visible residuals
_WIDE = 0.05  # relative standard deviation of the scale; of the zero, over the longest length


def scale_error(scale: float, std: float) -> float:
    """Logarithm of the scale of the capacitances, where it is an error; 0 where it is none.

    Args:
        scale: measured over true capacitance.
        std: relative standard deviation of it.
    Example:
        >>> scale_error(1.04, 0.03), round(scale_error(1.04, 0.001), 4)
        (0.0, 0.0392)
    """
    error = math.log(scale)
    return error if abs(error) > max(_CAREFUL, _SURE * std) else 0.0


def misstated_std(misfit: Misfit, found: SearchResult, error: float, prior: Floats) -> Floats:
    """Standard deviations of what varies, for the error that the capacitances show.

    Args:
        misfit: that was minimised.
        found: its minimum.
        error: see `scale_error`.
        prior: information on what varies before the records. Positive, shape `(P,)`.
    Returns:
        Standard deviations. Shape `(P,)`.
    """
    unknowns = found.unknowns
    scale = unknowns.names.index(SENSING_SCALE)
    largest = np.zeros(unknowns.values.size)
    if error == 0.0:
        return largest
    for change in _changes(misfit, found):
        moved = _moved(found, change, prior)
        # a mass of one record may hardly change the scale
        share = min(abs(error), _MOST * abs(moved[scale])) / max(abs(moved[scale]), 1e-300)
        largest = np.maximum(largest, share * np.abs(moved))
    return largest


def clock_std(misfit: Misfit, found: SearchResult, relative: float, prior: Floats) -> Floats:
    """Standard deviations of what varies, for an error of the clock of all records.

    Args:
        misfit: that was minimised.
        found: its minimum.
        relative: standard deviation of the stated over the true times.
        prior: information on what varies before the records. Positive, shape `(P,)`.
    Returns:
        Standard deviations. Shape `(P,)`.
    """
    slower = [_slower(record, 1.0 + _LITTLE) for record in misfit.records]
    residuals = replace(misfit, records=slower).residuals(found.unknowns) if relative else None
    if residuals is None:
        return np.zeros(found.unknowns.values.size)
    return relative * np.abs(_moved(found, (found.residuals - residuals) / _LITTLE, prior))


def _moved(found: SearchResult, change: Floats, prior: Floats) -> Floats:
    """By how much a change of the model's output moves what varies. Shape `(P,)`."""
    columns = np.vstack([found.jacobian, np.diag(np.sqrt(prior))])
    size = np.linalg.norm(columns, axis=0)
    wanted = np.concatenate([change, np.zeros(size.size)])
    return np.asarray(np.linalg.lstsq(columns / size, wanted, rcond=None)[0] / size)


def _slower(record: MotionRecord, factor: float) -> MotionRecord:
    """The record with all times multiplied by a factor."""
    return replace(
        record,
        drive=replace(record.drive, edge_s=factor * record.drive.edge_s),
        length_time_s=factor * record.length_time_s,
        exposure_s=factor * record.exposure_s,
        capacitance_later_s=factor * record.capacitance_later_s,
    )


def _changes(misfit: Misfit, found: SearchResult) -> Iterator[Floats]:
    """Change of the model's output by each error, in standard deviations. Shape `(N,)`."""
    for records in _misstated(misfit.records):
        residuals = replace(misfit, records=records).residuals(found.unknowns)
        if residuals is not None:
            yield (found.residuals - residuals) / _LITTLE
    names = found.unknowns.names
    if CAMERA_SCALE in names:
        # the prior knowledge of the scale would then be wrong
        known = [part.rows for part in misfit.segments if not part.experiment]
        change = found.jacobian[:, names.index(CAMERA_SCALE)].copy()
        change[np.concatenate([np.zeros(0, np.int64), *known])] = 0.0
        yield change


def _misstated(records: Sequence[MotionRecord]) -> Iterator[list[MotionRecord]]:
    """The records with another gain, with other masses, and with another mass in each."""
    more = 1.0 + _LITTLE
    yield [
        replace(record, drive=replace(
            record.drive, voltage_v=more * record.drive.voltage_v,
            ripple_v2=more**2 * record.drive.ripple_v2,
        ))
        for record in records
    ]  # fmt: skip
    heavier = [
        replace(record, drive=replace(
            record.drive, load_n=more * record.drive.load_n, mass_kg=more * record.drive.mass_kg
        ))
        for record in records
    ]  # fmt: skip
    yield heavier
    if len(records) > 1:
        for k in range(len(records)):
            yield [*records[:k], heavier[k], *records[k + 1 :]]


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
    def negligible(self) -> bool:
        """Whether the scale is right."""
        return abs(self.found.unknowns.value(CAMERA_SCALE) - 1.0) < _SUSPECTED

    @property
    def status(self) -> str:
        """The model error that it is."""
        scale = self.found.unknowns.value(CAMERA_SCALE)
        effects = self.instead_of
        than = f"about as well as {effects}" if effects else "better than the stated scale"
        return (
            f"model error: lengths that are {scale:.4f} times the true ones explain the records "
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


def suspect_scale(misfit: Misfit, found: SearchResult) -> bool:
    """Whether the residuals would shrink decisively with another scale of the lengths.

    By the derivatives at the minimum alone, so that it takes no time.

    Args:
        misfit: that was minimised.
        found: its minimum.
    """
    if CAMERA_SCALE not in found.unknowns.names:
        return False
    residuals, columns = found.residuals.copy(), found.jacobian.copy()
    for part in misfit.segments:
        if not part.experiment:
            residuals[part.rows], columns[part.rows] = 0.0, 0.0
    scale = np.linalg.norm(columns, axis=0)
    scale[scale == 0.0] = 1.0
    step = np.linalg.lstsq(columns / scale, residuals, rcond=1e-9)[0]
    gained = _squares(found) - float(np.sum((residuals - columns / scale @ step) ** 2))
    error = float((step / scale)[found.unknowns.names.index(CAMERA_SCALE)])
    return abs(error) > _SUSPECTED and 0.5 * gained - math.log(residuals.size) > DECISIVE


def _squares(result: SearchResult) -> float:
    return float(result.residuals @ result.residuals)
