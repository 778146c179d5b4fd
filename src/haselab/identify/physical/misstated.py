r"""How far a misstated gain, mass or scale of the camera may have changed the parameters.

Forces follow from the stated voltages and weights, capacitances from the monitors. If the
capacitances are a factor $s$ off from those that the forces need, the monitors, the amplifier's
gain, a mass or the camera's scale is wrong, and the records do not say which. An error $a$ of one
of these changes what the model says by $g\,a$, and so moves the estimates by

$\delta\theta = (J^\top J)^{-1} J^\top g\,a$

where $a$ is the error that alone explains $s$. The largest of these moves counts as one standard
deviation.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from haselab.identify.physical.misfit import Misfit
from haselab.identify.physical.record import MotionRecord
from haselab.identify.physical.search import SearchResult
from haselab.identify.physical.unknowns import CAMERA_SCALE, SENSING_SCALE

__all__ = ["misstated_std", "scale_error"]

Floats = NDArray[np.float64]
_CAREFUL = 0.005  # error of the capacitance that a careful calibration has
_SURE = 2.0  # standard deviations from which an error is one
_LITTLE = 1e-4  # relative change of gain or mass, for the derivative
_MOST = 0.2  # error of a gain, a mass or the camera's scale


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
    columns = np.vstack([found.jacobian, np.diag(np.sqrt(prior))])
    size = np.linalg.norm(columns, axis=0)
    for change in _changes(misfit, found):
        wanted = np.concatenate([change, np.zeros(size.size)])
        moved = np.linalg.lstsq(columns / size, wanted, rcond=None)[0] / size
        # a mass of one record may hardly change the scale
        share = min(abs(error), _MOST * abs(moved[scale])) / max(abs(moved[scale]), 1e-300)
        largest = np.maximum(largest, share * np.abs(moved))
    return largest


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
