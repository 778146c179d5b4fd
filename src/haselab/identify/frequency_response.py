"""Empirical frequency response with the leakage of transients removed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.signal import csd, welch

from haselab.base import InputError
from haselab.identify.record import finite_vector

__all__ = ["FrequencyResponse", "estimate_frequency_response"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_METHODS = ("rational", "polynomial", "welch")
_HALF_WINDOW = {"rational": 16, "polynomial": 6}
_EXCITED = 5e-2
_REWEIGHTINGS = 3
_FLOOR = 1e-2


@dataclass(frozen=True)
class FrequencyResponse:
    """Frequency response on the lines that the input excites.

    Args:
        frequency_hz: frequencies, in Hz. Shape `(K,)`.
        response: complex gain. Shape `(K,)`.
        coherence: share of the output power that follows the input, 0 to 1. Shape `(K,)`.
        std: standard deviation of the complex gain (real and imaginary part together). `(K,)`.
        notes: what the reader should know.
    """

    frequency_hz: Floats
    response: Complexes
    coherence: Floats
    std: Floats
    notes: tuple[str, ...]

    @property
    def magnitude_std(self) -> Floats:
        """Standard deviation of the magnitude. Shape `(K,)`."""
        return np.asarray(self.std / np.sqrt(2.0))

    @property
    def phase_std_rad(self) -> Floats:
        """Standard deviation of the phase, in rad; at most that of a uniform phase. `(K,)`."""
        ratio = self.magnitude_std / np.maximum(np.abs(self.response), 1e-300)
        return np.asarray(np.minimum(ratio, np.pi / np.sqrt(3.0)))

    def answer(self) -> dict[str, Any]:
        """The keys of the public contract; the phase runs on without jumps."""
        return {
            "frequency_hz": self.frequency_hz,
            "magnitude": np.abs(self.response),
            "phase_rad": np.unwrap(np.angle(self.response)),
            "coherence": self.coherence,
            "magnitude_std": self.magnitude_std,
            "phase_std_rad": self.phase_std_rad,
            "notes": list(self.notes),
        }


def estimate_frequency_response(
    u: object, y: object, rate_hz: float, *, method: str = "rational", held: bool = True
) -> FrequencyResponse:
    r"""Frequency response from one record.

    Around each line the response and the leakage are smooth functions of frequency:
    $Y(k+r) = G(r)\,U(k+r) + T(r)$. `rational` gives both a common local denominator of second
    order, which a lightly damped resonance needs; `polynomial` is of second order without it.
    `welch` is H1 of averaged, windowed segments, for long noise records.

    Args:
        u: input. Shape `(N,)`.
        y: output at the same moments. Shape `(N,)`.
        rate_hz: samples a second, in Hz.
        method: "rational", "polynomial" or "welch".
        held: whether `u` was held between its updates; its hold is then taken out.
    Returns:
        Response on the lines where the input has 5 % or more of its largest spectrum.
    Raises:
        InputError: unequal lengths, too few samples, an input without change, unknown method.
    Source: Pintelon and Schoukens, System Identification (2012), chapter 7; the local rational
        form: McKelvey and Guerin, SYSID 2012.
    Example:
        >>> u = np.random.default_rng(1).normal(size=2000)
        >>> response = estimate_frequency_response(u, 3.0 * u, 100.0, held=False)
        >>> bool(np.allclose(response.response, 3.0))
        True
    """
    source, output = finite_vector("u", u, 64), finite_vector("y", y, 64)
    if source.size != output.size:
        raise InputError(
            f"u has {source.size} values and y {output.size}; allowed are equal lengths. "
            "Give both at the same moments."
        )
    if not rate_hz > 0.0:
        raise InputError(f"rate_hz = {rate_hz:g} Hz; allowed is above 0 Hz. Give the rate.")
    if np.ptp(source) == 0.0:
        raise InputError(
            f"The input is {source[0]:g} throughout, so it excites nothing; allowed is one that "
            "changes. Name the right column, or record a chirp."
        )
    if method not in _METHODS:
        raise InputError(f"method = {method}; allowed are {', '.join(_METHODS)}. Choose one.")
    source, output = source - source.mean(), output - output.mean()
    if method == "welch":
        return _welch(source, output, rate_hz, held)
    return _local(source, output, rate_hz, method, held)


def _hold(frequency_hz: Floats, rate_hz: float) -> Complexes:
    """Spectrum of a held input over that of its samples."""
    turn = 2j * np.pi * frequency_hz / rate_hz
    return np.asarray(-np.expm1(-turn) / turn)


def _local(u: Floats, y: Floats, rate_hz: float, method: str, held: bool) -> FrequencyResponse:
    lines = np.arange(1, (u.size - 1) // 2)
    half = min(_HALF_WINDOW[method], lines.size // 2 - 1)
    frequency_hz = lines * rate_hz / u.size
    u_hat, y_hat = np.fft.rfft(u)[lines], np.fft.rfft(y)[lines]
    if held:
        u_hat = u_hat * _hold(frequency_hz, rate_hz)
    excited = np.flatnonzero(np.abs(u_hat) >= _EXCITED * np.abs(u_hat).max())
    # The neighbours of a low line include negative frequencies, the conjugates; zero is left out,
    # for the offset sits there. At the upper end the window is shifted inwards.
    both = np.concatenate([-lines[:half][::-1], lines])
    u_hat = np.concatenate([u_hat[:half][::-1].conj(), u_hat])
    y_hat = np.concatenate([y_hat[:half][::-1].conj(), y_hat])
    start = np.clip(excited, 0, both.size - 2 * half - 1)
    window = start[:, None] + np.arange(2 * half + 1)[None, :]
    r = (both[window] - lines[excited][:, None]) / half
    us, ys = u_hat[window], y_hat[window]
    factors, inverse, misfit = _windows(r, us, ys, rational=method == "rational")
    spare = r.shape[1] - factors.shape[1]
    variance = (np.abs(misfit) ** 2).sum(axis=1) / spare
    response = factors[:, 0]
    spread = (np.abs(inverse[:, 0, :]) ** 2).sum(axis=1)
    power = np.abs(response) ** 2 * (np.abs(us) ** 2).mean(axis=1)
    coherence = power / np.maximum(power + variance, 1e-300)
    return FrequencyResponse(
        frequency_hz[excited], response, coherence, np.sqrt(variance * spread), ()
    )


def _windows(
    r: Floats, us: Complexes, ys: Complexes, *, rational: bool
) -> tuple[Complexes, Complexes, Complexes]:
    """Local models of all lines at once: factors, root of their covariance, misfits."""
    powers = r[:, :, None] ** np.arange(3)
    blocks = [powers * us[:, :, None], powers.astype(np.complex128)]
    if rational:
        blocks.append(-powers[:, :, 1:] * ys[:, :, None])
    plain = np.concatenate(blocks, axis=2)
    weight = np.ones(r.shape)
    for _ in range(_REWEIGHTINGS if rational else 1):
        matrix, target = plain * weight[:, :, None], ys * weight
        size = np.sqrt((np.abs(matrix) ** 2).sum(axis=1, keepdims=True)) + 1e-300
        matrix = matrix / size
        q, triangle = np.linalg.qr(matrix)
        diagonal = np.abs(np.diagonal(triangle, axis1=1, axis2=2))
        triangle[(diagonal < 1e-12).any(axis=1)] += 1e-12 * np.eye(matrix.shape[2])
        inverse = np.linalg.inv(triangle)
        scaled = inverse @ (q.conj().transpose(0, 2, 1) @ target[:, :, None])
        misfit = target - (matrix @ scaled)[:, :, 0]
        inverse, factors = inverse / size.transpose(0, 2, 1), scaled[:, :, 0] / size[:, 0]
        if rational:
            # Weighted by its own denominator, the misfit is that of the output itself.
            bottom = np.abs(1.0 + (powers[:, :, 1:] @ factors[:, 6:, None])[:, :, 0])
            weight = 1.0 / np.maximum(bottom, _FLOOR * bottom.max(axis=1, keepdims=True))
            weight = weight / weight[np.arange(r.shape[0]), np.abs(r).argmin(axis=1)][:, None]
    return factors, inverse, misfit


def _welch(u: Floats, y: Floats, rate_hz: float, held: bool) -> FrequencyResponse:
    size = max(64, u.size // 8)
    frequency_hz, input_power = welch(u, rate_hz, nperseg=size)
    _, cross = csd(u, y, rate_hz, nperseg=size)
    _, output_power = welch(y, rate_hz, nperseg=size)
    response = cross / np.maximum(input_power, 1e-300)
    both = np.maximum(input_power * output_power, 1e-300)
    coherence = np.clip(np.abs(cross) ** 2 / both, 1e-12, 1.0)
    averages, sharing = _averages(u, size)
    std = np.abs(response) * np.sqrt((1.0 - coherence) / (coherence * averages))
    kept = (input_power >= _EXCITED**2 * input_power.max()) & (frequency_hz > 0.0)
    if held:
        response[kept] = response[kept] / _hold(frequency_hz[kept], rate_hz)
    notes: tuple[str, ...] = ()
    if sharing < 0.3 * averages:
        notes = (
            "The input is a single sweep: each frequency is excited in one segment only, and "
            "averaged segments are wrong for it. Use the method rational, or fit a transfer "
            "function.",
        )
    return FrequencyResponse(frequency_hz[kept], response[kept], coherence[kept], std[kept], notes)


def _averages(u: Floats, size: int) -> tuple[float, float]:
    """Number of independent segments, and of those that share a typical excited line."""
    starts = range(0, u.size - size + 1, max(1, size // 2))
    window = np.hanning(size)
    power = np.array([np.abs(np.fft.rfft(u[k : k + size] * window)) ** 2 for k in starts])
    total = power.sum(axis=0)
    loud = total >= _EXCITED * total.max()
    sharing = total[loud] ** 2 / (power[:, loud] ** 2).sum(axis=0)
    # Half-overlapping Hann segments count as 0.95 of twice the disjoint ones, about 1.9 N/size.
    return max(1.0, 0.95 * len(starts)), float(np.median(sharing))
