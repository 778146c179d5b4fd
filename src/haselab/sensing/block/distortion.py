"""Detect a monitor that saturates, by harmonics of the carrier or by many equal readings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.sensing.block.segments import HARMONICS

__all__ = ["at_a_rail", "find_distortion"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_CLEAR = 4.5  # standard deviations of a harmonic's quadrature
_RUN = 3  # equal readings in a row that count as clipped
_FEWEST = 6  # readings of a block in such runs
_PILED = 3.0  # ratio to the readings just below; a sine in coarse steps has at most 1.2
_JUST_INSIDE = (2.5, 0.02)  # steps, and share of the range
_IN_PHASE = 0.06  # of a harmonic: tolerance for noise and skew of the phase of a saturation


def find_distortion(
    harmonic: Complexes,
    std: Floats,
    voltage: Complexes,
    current: Complexes,
    apart: NDArray[np.bool_],
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Find blocks in which a monitor saturates, and blocks with harmonics of the carrier.

    A static curve creates harmonics whose phases are n times that of the sine,
    or opposite to that; for a flat top the third harmonic lowers the peaks.
    Harmonics of the generator pass through the actuator: those of the current follow from those of
    the voltage by the impedance at the carrier. They cause no error of C.

    Args:
        harmonic: phasors of the harmonics, `(blocks, 2, harmonics)`.
        std: standard deviation of one quadrature.
        voltage: phasor of the carrier, `(blocks,)`.
        current: the same for the current.
        apart: blocks to leave out of the mean, such as those at a rail, `(blocks,)`.
    Returns:
        Two arrays of shape `(blocks,)`.
    """
    orders = np.array(HARMONICS)
    carriers = np.stack([voltage, current], axis=1)
    size = np.maximum(np.abs(carriers), 1e-300)
    harmonic = harmonic * np.conj(carriers / size)[:, :, np.newaxis] ** orders
    single = _saturates(harmonic, _beyond_load(harmonic, carriers, orders), std)
    seen = (np.abs(harmonic) > _CLEAR * std).any(axis=(1, 2))
    if apart.all():
        return single, np.asarray(seen)
    # The same for the mean over the record, since noise hides it in one block.
    kept = ~(apart | single)
    if not kept.any():
        kept = ~apart
    harmonic, std, size = harmonic[kept], std[kept], size[kept]
    voltage, current = voltage[kept], current[kept]
    typical = np.median(size, axis=0)
    weight = (size[:, :, np.newaxis] / np.maximum(std, 1e-12 * size[:, :, np.newaxis])) ** 2
    total = np.maximum(weight.sum(axis=0), 1e-300)
    mean = (harmonic / size[:, :, np.newaxis] * weight).sum(axis=0) / total
    mean = (mean * typical[:, np.newaxis])[np.newaxis]
    quotient = np.median((current / voltage).real) + 1j * np.median((current / voltage).imag)
    pair = np.array([[typical[0], typical[0] * quotient]])
    whole = _saturates(
        mean,
        _beyond_load(mean, pair, orders),
        (typical[:, np.newaxis] / np.sqrt(total))[np.newaxis],
    )
    return single | bool(whole[0]), np.asarray(seen)


def _beyond_load(harmonic: Complexes, carriers: Complexes, orders: NDArray[np.int_]) -> Complexes:
    """Harmonics of the current minus those caused by the voltage's harmonics."""
    z = carriers[:, 0] / carriers[:, 1]
    at = z.real[:, np.newaxis] + 1j * z.imag[:, np.newaxis] / orders
    # Rotate each channel by n times the phase of its own carrier.
    lead = carriers[:, 1] / carriers[:, 0]
    lead = (lead / np.abs(lead))[:, np.newaxis] ** orders
    return np.asarray(harmonic[:, 1] - harmonic[:, 0] / at / lead)


def _saturates(harmonic: Complexes, excess: Complexes, std: Floats) -> NDArray[np.bool_]:
    """Blocks whose harmonics are those of a saturation, on either channel."""
    third = HARMONICS.index(3)
    limit = _CLEAR * std
    size = np.abs(harmonic)
    clear = size > limit
    aligned = (~clear | (np.abs(harmonic.imag) < np.maximum(limit, _IN_PHASE * size))).all(axis=2)
    down = clear[:, :, third] & (harmonic[:, :, third].real < 0.0)
    # A third harmonic on both monitors that agrees with the load is the generator's.
    load = size[:, 1, third] / np.maximum(size[:, 0, third], 1e-300)
    error = np.hypot(std[:, 0, third] * load, std[:, 1, third])
    tolerance = np.maximum(_CLEAR * error, _IN_PHASE * size[:, 1, third])
    linear = clear[:, :, third].all(axis=1) & (np.abs(excess[:, third]) < tolerance)
    return np.asarray((aligned & down).any(axis=1) & ~linear)


def at_a_rail(cut: Floats, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Find blocks in which many readings equal the largest or smallest one, as at a rail.

    Harmonics do not show a rail that the drive reaches within a block, because it clips most of
    some carrier periods and nothing of others.

    Args:
        cut: readings `(blocks, 2, segments, length)`.
        used: segments that count, `(blocks, segments)`.
    Returns:
        Shape `(blocks,)`.
    Example:
        >>> angle = 2 * np.pi * np.arange(1000) / 50
        >>> wave = np.cos(angle) + 0.01 * np.random.default_rng(1).normal(size=1000)
        >>> cut = np.stack([np.minimum(wave, 0.9), wave]).reshape(1, 2, 20, 50)
        >>> at_a_rail(np.concatenate([cut, cut[:, [1, 1]]]), np.ones((2, 20), dtype=bool)).tolist()
        [True, False]
    """
    flat = cut.reshape(len(cut), 2, -1)
    every = np.repeat(used, cut.shape[3], axis=1)[:, np.newaxis]
    piled = np.zeros(len(cut), dtype=np.bool_)
    for sign, ends in ((1.0, flat.max(axis=2)), (-1.0, flat.min(axis=2))):
        # Most blocks have too few such readings, in runs or not, and need no closer look.
        equal = np.count_nonzero(flat == ends[:, :, np.newaxis], axis=2)
        some = np.flatnonzero((equal >= _FEWEST).any(axis=1))
        piled[some] |= _piled_at_top(sign * flat[some], every[some])
    return piled


def _piled_at_top(values: Floats, every: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether many readings equal the largest one of a block in runs, and few lie just below it."""
    below = values.max(axis=2, keepdims=True) - values
    top = below == 0.0
    inside = np.where(top, np.inf, below)
    step = inside.min(axis=2, keepdims=True)
    width = np.maximum(_JUST_INSIDE[0] * step, _JUST_INSIDE[1] * below.max(2, keepdims=True))
    ends = [top[..., k : top.shape[2] - _RUN + 1 + k] for k in range(_RUN)]
    runs = np.logical_and.reduce(ends)
    inner = np.zeros_like(top)
    for k in range(_RUN):
        inner[..., k : top.shape[2] - _RUN + 1 + k] |= runs
    many = (inner & every).sum(axis=2)
    near = ((inside <= width) & every).sum(axis=2)
    return np.asarray(((many >= _FEWEST) & (many > _PILED * near)).any(axis=1))
