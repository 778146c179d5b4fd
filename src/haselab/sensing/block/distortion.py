"""Harmonics of the carrier: of the generator, or of a monitor that saturates."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from haselab.sensing.block.segments import HARMONICS

__all__ = ["find_distortion"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_CLEAR = 4.5  # standard deviations of a harmonic's quadrature
_IN_PHASE = 0.06  # of a harmonic: tolerance for noise and skew of the phase of a saturation


def find_distortion(
    harmonic: Complexes, std: Floats, voltage: Complexes, current: Complexes
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
    Returns:
        Two arrays of shape `(blocks,)`.
    """
    orders = np.array(HARMONICS)
    carriers = np.stack([voltage, current], axis=1)
    size = np.maximum(np.abs(carriers), 1e-300)
    harmonic = harmonic * np.conj(carriers / size)[:, :, np.newaxis] ** orders
    single = _saturates(harmonic, _beyond_load(harmonic, carriers, orders), std)
    seen = (np.abs(harmonic) > _CLEAR * std).any(axis=(1, 2))
    # The same for the mean over the record, since noise hides it in one block.
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
