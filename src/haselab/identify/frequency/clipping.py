"""Detection of clipped outputs by comparison with the prediction of a frequency response."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from haselab.identify.frequency.lines import Pair, hold_spectrum

__all__ = ["clipped_at"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_LEVELS = (0.999, 0.995, 0.99, 0.97, 0.93, 0.88, 0.8, 0.7)  # quantiles where a limit may be
_BETTER = 50.0  # twice the gain of logarithmic likelihood that identifies a limit
_FOLLOWS = 0.3  # slope of the outputs beyond a limit over the prediction; 0 where they are clipped
_EXTREME = 0.999  # of the outputs lie below the limit plus ...
_CLEAR = 4.0  # ... this many standard deviations of the noise
_CONSTANT = 1.5  # largest median deviation from a limit over that of the prediction elsewhere
_EXPLAINED = 0.1  # largest share of the outputs' energy in the residuals
_LEAST_ROWS = 10
_LEAST_VISITS = 2


def clipped_at(
    pairs: Sequence[Pair], rate_hz: float, held: bool, frequency_hz: Floats, response: Complexes
) -> tuple[float, ...]:
    """Limits at which the outputs stay while the prediction continues; empty without any.

    The prediction is the response times the spectrum of the input. Noise and disturbances also move
    an output, but the outputs beyond a quantile then still rise with the
    prediction.

    Args:
        pairs: input and output of each record, without their means.
        rate_hz: sampling rate, in Hz.
        held: whether the inputs were held.
        frequency_hz: rising frequencies of the response, in Hz. Shape `(K,)`.
        response: complex gain. Shape `(K,)`.
    Returns:
        The lower and upper limits that were found, in the unit of the output, minus its mean.
    """
    if frequency_hz.size < 2:
        return ()
    y = np.concatenate([output for _, output in pairs])
    predicted = np.concatenate(
        [_predicted(u, rate_hz, held, frequency_hz, response) for u, _ in pairs]
    )
    driven = np.concatenate([np.maximum.accumulate(u != u[0]) for u, _ in pairs])
    y, predicted = y[driven], predicted[driven]
    limits = [sign * found for sign in (-1.0, 1.0) if (found := _rail(sign * y, sign * predicted))]
    return tuple(limits)


def _predicted(
    u: Floats, rate_hz: float, held: bool, frequency_hz: Floats, response: Complexes
) -> Floats:
    """Output predicted from the input by the lines of the response."""
    spectrum = np.fft.rfft(u)
    at_hz = np.arange(1, spectrum.size) * rate_hz / u.size
    gain = np.interp(at_hz, frequency_hz, response, left=0.0, right=0.0)
    spectrum[0] = 0.0
    spectrum[1:] *= gain * hold_spectrum(at_hz, rate_hz) if held else gain
    return np.asarray(np.fft.irfft(spectrum, u.size))


def _rail(y: Floats, predicted: Floats) -> float | None:
    """The clearest upper limit."""
    best: tuple[float, float] | None = None
    *levels, extreme = np.quantile(y, [*_LEVELS, _EXTREME]).tolist()
    for level in levels:
        beyond = predicted > level
        visits = np.count_nonzero(np.diff(beyond.astype(np.int8), prepend=0) == 1)
        rows = int(beyond.sum())
        if rows < _LEAST_ROWS or visits < _LEAST_VISITS:
            continue
        there, modelled = y[beyond], predicted[beyond]
        rail = float(np.median(there))
        along = modelled - modelled.mean()
        if abs(float(along @ there)) > _FOLLOWS * float(along @ along):
            continue  # a curve, such as the trough of a response to the square of a voltage
        elsewhere = float(np.median(np.abs(y[~beyond] - predicted[~beyond])))
        if float(np.median(np.abs(there - rail))) > _CONSTANT * elsewhere:
            continue
        if extreme - rail > _CLEAR * float(there.std()):
            continue  # an extreme value that is reached often, not a limit
        off = float(((there - modelled) ** 2).sum())
        limited = float(((there - rail) ** 2).sum())
        gain = rows * math.log(off / max(limited, 1e-300))
        rest = float(((y[~beyond] - predicted[~beyond]) ** 2).sum())
        if rest + limited > _EXPLAINED * float(((y - y.mean()) ** 2).sum()):
            continue
        whole = y.size * math.log((rest + off) / max(rest + limited, 1e-300))
        if min(gain, whole) > _BETTER and (best is None or gain > best[0]):
            best = gain, rail
    return None if best is None else best[1]
