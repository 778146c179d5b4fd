"""Local models of a spectrum: response and leakage are smooth around each line, noise is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, csr_array

from haselab.identify.frequency.lines import EXCITED, Lines
from haselab.identify.frequency.local_choice import Centres, centres
from haselab.identify.frequency.local_fit import LocalProblem

__all__ = ["Spectrum", "harmonic_leakage", "local_response"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_HALF_WINDOW = {"rational": 16, "polynomial": 6}
_ORDER = 2
# A line is left out when its variance is 1,000 times that of the plain ratio: the input there is
# itself leakage, which is indistinguishable from that of the output.
_BLIND = 1e3
_MOST_MIXED = 10_000
# A window that contains only part of a resonance determines its denominator so badly that the
# linearised std is too small. Wider windows are used where their misfit is no larger, and their
# std then includes the difference between both values.
_WIDER = 3.0
_NO_NOISIER = 1.3


@dataclass(frozen=True)
class Spectrum:
    """Spectra of one record at the lines above zero and below half the rate.

    Args:
        frequency_hz: frequencies, in Hz, multiples of the first. Shape `(M,)`.
        u: spectrum of the input. Shape `(M,)`.
        y: spectrum of the output. Shape `(M,)`.
    """

    frequency_hz: Floats
    u: Complexes
    y: Complexes


@dataclass(frozen=True)
class _Windows:
    """Lines around each requested line, the records one after another.

    Args:
        place: distance from the requested line, in half windows. Shape `(K, R)`.
        u: spectrum of the input. Shape `(K, R)`.
        y: spectrum of the output. Shape `(K, R)`.
        record: index of the record of each row. Shape `(R,)`.
        line: index of the line of each row, over all records. Shape `(K, R)`.
        mirrored: whether the row is a negative frequency, the conjugate of its line. `(K, R)`.
    """

    place: Floats
    u: Complexes
    y: Complexes
    record: NDArray[np.intp]
    line: NDArray[np.intp]
    mirrored: NDArray[np.bool_]


def local_response(spectra: Sequence[Spectrum], method: str) -> Lines:
    r"""Least squares of $Y(k+r) = [N(r)\,U(k+r) + T(r)]/D(r)$ about each line.

    The lines are those of the longest record.

    N, T and D are of second order, with a separate T for each record. `polynomial` has $D = 1$.
    `rational` uses the window's own denominator; if that is not significant, that of
    the neighbouring resonance, or none.

    Args:
        spectra: one per record, all of one system.
        method: "rational" or "polynomial".
    Returns:
        The lines where the input has 5 % or more of its largest spectrum and is distinguishable
        from leakage.
    Source: Pintelon and Schoukens, System Identification (2012), chapter 7; McKelvey and Guerin,
        SYSID 2012, for the rational form.
    """
    longest = max(spectra, key=lambda spectrum: spectrum.u.size)
    step_hz = float(longest.frequency_hz[0])
    most = longest.u.size // 2 - 1
    half_hz = min(_HALF_WINDOW[method], most) * step_hz
    energy = _energy(spectra, longest.frequency_hz)
    wanted_hz = longest.frequency_hz[energy >= EXCITED**2 * energy.max()]

    def about(half_hz: float) -> Centres:
        return centres(
            lambda some_hz: _problem(_windows(spectra, some_hz, half_hz)), wanted_hz, half_hz,
            rational=method == "rational",
        )  # fmt: skip

    found = about(half_hz)
    if method == "rational":
        wider_hz = min(_WIDER * half_hz, most * step_hz)
        wider = about(wider_hz)
        if (_near(wanted_hz, wider_hz, wider.noise / _NO_NOISIER)
                <= _near(wanted_hz, wider_hz, found.noise)).all():  # fmt: skip
            apart = np.abs(wider.value - found.value) ** 2 / np.maximum(found.variance, 1e-300)
            unsure = np.sqrt(np.maximum(1.0, _near(wanted_hz, half_hz, apart)))
            found, half_hz = wider.widened(unsure), wider_hz
    rows = sum(2 * _half(spectrum, half_hz) + 1 for spectrum in spectra)
    power = np.abs(found.value) ** 2 * found.energy / rows
    coherence = power / np.maximum(power + found.noise, 1e-300)
    kept = found.spread * found.energy <= _BLIND
    std = np.sqrt(found.variance[kept])
    unknown = np.full(std.size, np.nan)
    mixing = _mixing(spectra, wanted_hz, half_hz, found)
    mixing = None if mixing is None else mixing[np.tile(kept, 2)]
    return Lines(
        wanted_hz[kept], found.value[kept], coherence[kept], std, unknown, mixing=mixing
    )  # fmt: skip


def _near(at_hz: Floats, reach_hz: float, values: Floats) -> Floats:
    """Mean of the values within `reach_hz` of each frequency. Shape `(K,)`."""
    start, stop = (np.searchsorted(at_hz, at_hz + side) for side in (-reach_hz, reach_hz))
    stop = np.maximum(stop, start + 1)
    total = np.concatenate([[0.0], np.cumsum(values)])
    return np.asarray((total[stop] - total[start]) / (stop - start))


def _energy(spectra: Sequence[Spectrum], frequency_hz: Floats) -> Floats:
    """Energy of the input on the nearest line of each record, summed."""
    total = np.zeros(frequency_hz.size)
    for spectrum in spectra:
        nearest = np.rint(frequency_hz / spectrum.frequency_hz[0]).astype(np.intp) - 1
        inside = (nearest >= 0) & (nearest < spectrum.u.size)
        total[inside] += np.abs(spectrum.u[nearest[inside]]) ** 2
    return total


def _half(spectrum: Spectrum, half_hz: float) -> int:
    """Number of lines of a record on each side of a requested one."""
    wide = round(half_hz / float(spectrum.frequency_hz[0]))
    return min(max(_ORDER, wide), spectrum.u.size // 2 - 1)


def _windows(spectra: Sequence[Spectrum], wanted_hz: Floats, half_hz: float) -> _Windows:
    """The neighbours of a low line include negative frequencies, the conjugates; zero is left out,
    because it contains the offset. At the upper end the window is shifted inwards.
    """
    places, us, ys, owners, lines, mirrors = [], [], [], [], [], []
    before = 0
    for owner, spectrum in enumerate(spectra):
        step_hz = float(spectrum.frequency_hz[0])
        half = _half(spectrum, half_hz)
        below = slice(half - 1, None, -1)
        both_hz = np.concatenate([-spectrum.frequency_hz[below], spectrum.frequency_hz])
        nearest = np.rint(wanted_hz / step_hz).astype(np.intp) - 1
        start = np.clip(nearest, 0, both_hz.size - 2 * half - 1)
        window = start[:, None] + np.arange(2 * half + 1)[None, :]
        places.append((both_hz[window] - wanted_hz[:, None]) / half_hz)
        us.append(np.concatenate([spectrum.u[below].conj(), spectrum.u])[window])
        ys.append(np.concatenate([spectrum.y[below].conj(), spectrum.y])[window])
        owners.append(np.full(window.shape[1], owner))
        mirrors.append(window < half)
        lines.append(before + np.where(window < half, half - 1 - window, window - half))
        before += spectrum.u.size
    return _Windows(
        np.hstack(places), np.hstack(us), np.hstack(ys), np.concatenate(owners),
        np.hstack(lines), np.hstack(mirrors),
    )  # fmt: skip


def _mixing(
    spectra: Sequence[Spectrum], wanted_hz: Floats, half_hz: float, found: Centres
) -> csr_array | None:
    """Contribution of each line's noise to the values; None for more than 10,000 values."""
    count = wanted_hz.size
    if count > _MOST_MIXED:
        return None
    windows = _windows(spectra, wanted_hz, half_hz)
    # The misfit of one window is a noisy weight; the noise level is smooth over another window on
    # each side.
    near = np.abs(wanted_hz[:, None] - wanted_hz[None, :]) <= half_hz
    std = np.sqrt(0.5 * (near @ found.noise) / near.sum(axis=1))
    weights = np.hstack([
        found.by_row * std[:, None], found.by_lender * std[found.lender, None],
    ])  # fmt: skip
    line = np.hstack([windows.line, windows.line[found.lender]]).ravel()
    mirrored = np.hstack([windows.mirrored, windows.mirrored[found.lender]]).ravel()
    at = np.repeat(np.arange(count), weights.shape[1])
    shape = (count, sum(spectrum.u.size for spectrum in spectra))
    direct, conjugate = (
        csr_array((weights.ravel() * chosen, (at, line)), shape=shape)
        for chosen in (~mirrored, mirrored)
    )
    plus, minus = direct + conjugate, direct - conjugate
    return csr_array(block_array([[plus.real, -minus.imag], [plus.imag, minus.real]]))


def _problem(windows: _Windows) -> LocalProblem:
    powers = windows.place[:, :, None] ** np.arange(_ORDER + 1)
    own = windows.record[:, None] == np.arange(int(windows.record[-1]) + 1)
    columns = [powers * windows.u[:, :, None]]
    columns += [powers * own[None, :, k, None] for k in range(own.shape[1])]
    slopes = powers[:, :, 1:].astype(np.complex128)
    return LocalProblem(np.concatenate(columns, axis=2), slopes, windows.y)


def harmonic_leakage(
    u: Complexes, y: Complexes, response: Complexes, harmonics: NDArray[np.intp], periods: int
) -> Centres:
    r"""Leakage $T(k)/D(k)$ of the output at the harmonics, from the lines between them.

    A periodic input has no energy there, so the output consists of transient and noise. An input
    that was measured contains noise; the part of the output caused by it is subtracted.

    Args:
        u: whole discrete Fourier transform of the input, over all periods. Shape `(N,)`.
        y: the same of the output. Shape `(N,)`.
        response: first estimate at the harmonics. Shape `(K,)`.
        harmonics: harmonic numbers, rising. Shape `(K,)`.
        periods: periods in the record, 2 or more.
    Returns:
        Leakage, its variance, and the variance of the noise on a line.
    Source: Pintelon and Schoukens, System Identification (2012), section 7.3.
    """
    reach = np.arange(1, 4 * _HALF_WINDOW["rational"])
    beside = reach[reach % periods != 0][: _HALF_WINDOW["rational"]]
    offsets = np.concatenate([-beside[::-1], beside])
    half = float(beside[-1])
    # The spectrum of a sampled record is periodic.
    lines = (periods * harmonics[:, None] + offsets[None, :]) % y.size
    rest = y[lines] - response[:, None] * u[lines]
    powers = (offsets / half)[:, None] ** np.arange(_ORDER + 1)

    def windows(some: Floats) -> LocalProblem:
        at = np.searchsorted(harmonics, np.rint(some / periods).astype(np.intp))
        linear = np.broadcast_to(powers, (some.size, *powers.shape)).astype(np.complex128)
        return LocalProblem(linear, linear[:, :, 1:], rest[at])

    return centres(windows, periods * harmonics.astype(np.float64), half, rational=True)
