"""Starting points for a transfer function, found from the records alone."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from haselab.identify.record import Record
from haselab.identify.transfer_layout import Layout

__all__ = [
    "coarse_grid",
    "delay_margin_s",
    "richer_start",
    "search_bounds",
    "starting_points",
    "thinned",
]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_REFINEMENTS = 4
_MAX_LINES = 400


@dataclass(frozen=True)
class _Spectrum:
    """Spectra of one record on the lines of its own length."""

    s: Complexes
    u: Complexes
    y: Complexes


def thinned(records: Sequence[Record], most: int) -> list[Record]:
    """The same records with every k-th output only, `most` outputs or fewer in all."""
    total = sum(record.y.size for record in records)
    stride = max(1, math.ceil(total / most))
    kept = []
    for r in records:
        step = max(1, min(stride, r.y.size // 8))
        picked = slice(0, None, step)
        if np.ptp(r.y[picked]) == 0.0:
            picked = slice(None)
        kept.append(replace(r, y=r.y[picked], output_time_s=r.output_time_s[picked]))
    return kept


def delay_margin_s(records: Sequence[Record]) -> float:
    """How far below zero a delay is searched, so that an interval around zero stays honest."""
    step_s = min(r.output_step_s for r in records)
    return 4.0 * max(step_s, min(1.0 / r.input_rate_hz for r in records))


def search_bounds(layout: Layout, records: Sequence[Record]) -> tuple[Floats, Floats]:
    """Lowest and highest searched numbers that the records could tell apart."""
    span_s = max(record.duration_s for record in records)
    step_s = min(r.output_step_s for r in records)
    low, high = [], []
    for at in layout.free:
        name = layout.names[at]
        if name == "delay_s":
            pair = (-delay_margin_s(records), 0.5 * span_s)
        elif name.startswith("natural_frequency"):
            # Above half the output's rate a ringing cannot be told from a slower one.
            pair = (math.log(0.1 / span_s), math.log(math.pi / step_s))
        elif name.startswith("damping_ratio"):
            pair = (math.log(1e-5), math.log(100.0))
        else:
            pair = (math.log(0.1 * step_s), math.log(100.0 * span_s))
        low.append(pair[0])
        high.append(pair[1])
    return np.array(low), np.array(high)


def starting_points(layout: Layout, records: Sequence[Record]) -> Iterator[Floats]:
    """Starting values of the searched numbers, the more likely ones first.

    Sanathanan-Koerner iterations on the spectra, with polynomials for the transients, for some
    delays and bands; then a coarse grid.

    Args:
        layout: order of the numbers.
        records: experiments.
    Source: Sanathanan and Koerner, IEEE Trans. Autom. Control 8 (1963), 56; transients after
        Pintelon and Schoukens, System Identification (2012), chapter 6.
    """
    structure, free = layout.structure, layout.free
    orders = {structure.poles, structure.poles + structure.slow_modes}
    taus = _time_constants(records, structure.slow_modes)
    for order in sorted(orders, reverse=True):
        zeros = structure.zeros if order == structure.poles else order - 1
        for delay_s in _delays(layout, records):
            for share in (0.99, 0.9):
                spectra = [_spectrum(r, delay_s, share) for r in records]
                poles = _rational_poles(spectra, order, zeros)
                for numbers in _arranged(layout, poles, taus, delay_s):
                    yield numbers[free]


def richer_start(
    layout: Layout, simpler: Layout, search: Floats, records: Sequence[Record]
) -> Iterator[Floats]:
    """The numbers of a fit with fewer fast poles, and fast poles beside them.

    Such a start is no worse than that fit, so that more poles never fit worse.

    Args:
        layout: order of the numbers.
        simpler: that of the fit, with fewer poles and all else alike.
        search: its searched numbers.
        records: experiments.
    """
    numbers = simpler.full(search)
    poles = simpler.sections[0].poles(numbers)
    step_s = min(record.output_step_s for record in records)
    missing = layout.structure.poles - len(poles)
    fast = [-5.0 / step_s * 1.2**k for k in range(missing)]
    taus = tuple(np.exp(numbers[section.reals[0]]) for section in simpler.sections[1:])
    for found in _arranged(layout, np.array([*poles, *fast]), [taus], float(numbers[-1])):
        yield found[layout.free]


def coarse_grid(layout: Layout, records: Sequence[Record]) -> Iterator[Floats]:
    """Starting values on a grid of frequency and damping, for records that the spectra mislead."""
    span_s = max(record.duration_s for record in records)
    step_s = min(r.output_step_s for r in records)
    taus = _time_constants(records, layout.structure.slow_modes)[:1]
    for omega in np.geomspace(2.0 / span_s, 0.5 / step_s, 20):
        for zeta in (0.05, 0.3, 1.0):
            pair = omega * np.roots([1.0, 2.0 * zeta + 1e-3, 1.0])
            poles = np.concatenate([pair * 2.0**k for k in range(3)])[: layout.structure.poles]
            for numbers in _arranged(layout, poles.astype(np.complex128), taus, 0.0):
                yield numbers[layout.free]


def _delays(layout: Layout, records: Sequence[Record]) -> list[float]:
    known = layout.template[-1]
    if not math.isnan(known):
        return [float(known)]
    step_s = max(r.output_step_s for r in records)
    unit_s = max(step_s, max(1.0 / r.input_rate_hz for r in records))
    return [0.0, 2.0 * unit_s, 5.0 * unit_s]


def _time_constants(records: Sequence[Record], count: int) -> list[tuple[float, ...]]:
    span_s = max(record.duration_s for record in records)
    if count == 0:
        return [()]
    ladder = [span_s * factor for factor in (0.1, 0.3, 1.0)]
    return [tuple(tau * 5.0**k for k in range(count)) for tau in ladder]


def _spectrum(record: Record, delay_s: float, share: float) -> _Spectrum:
    """Finite Fourier transforms of a record up to the band that holds `share` of the energy."""
    times_s = record.output_time_s
    step_s = float(times_s[-1] - times_s[0]) / (times_s.size - 1)
    grid_s = times_s[0] + step_s * np.arange(times_s.size)
    even = float(np.abs(grid_s - times_s).max()) < 1e-3 * step_s
    y = record.y if even else np.interp(grid_s, times_s, record.y)
    index = np.floor((grid_s + 0.5 * step_s - delay_s) * record.input_rate_hz).astype(np.intp)
    held = record.u[np.clip(index, 0, record.u.size - 1)]
    held[index < 0] = record.input_before or 0.0
    span_s = step_s * y.size
    u_hat, y_hat = rfft(held)[1:], rfft(y)[1:]
    energy = np.cumsum(y_hat.real**2 + y_hat.imag**2)
    reach = np.cumsum(u_hat.real**2 + u_hat.imag**2)
    inside = int(np.searchsorted(energy, share * energy[-1])) + 1
    excited = int(np.searchsorted(reach, share * reach[-1]))
    lines = min(max(12, 3 * inside, excited), u_hat.size, _MAX_LINES)
    s = 2j * np.pi * np.arange(1, lines + 1) / span_s
    return _Spectrum(s, u_hat[:lines] * np.exp(-0.5 * s * step_s), y_hat[:lines])


def _rational_poles(spectra: Sequence[_Spectrum], order: int, zeros: int) -> Complexes:
    """Poles of the rational function that the spectra suggest, made stable."""
    scale = max(float(np.abs(sp.s[-1])) for sp in spectra) / 3.0
    blocks, targets, all_powers = [], [], []
    for i, sp in enumerate(spectra):
        powers = (sp.s / scale)[:, None] ** np.arange(order + 1)
        block = np.zeros((sp.s.size, order + zeros + 1 + order * len(spectra)), np.complex128)
        block[:, :order] = -powers[:, :order] * sp.y[:, None]
        block[:, order : order + zeros + 1] = powers[:, : zeros + 1] * sp.u[:, None]
        first = order + zeros + 1 + order * i
        block[:, first : first + order] = powers[:, :order] * np.abs(sp.y).max()
        blocks.append(block)
        targets.append(powers[:, order] * sp.y)
        all_powers.append(powers)
    rows, lines = np.vstack(blocks), np.vstack(all_powers)
    matrix = np.vstack([rows.real, rows.imag])
    shown = np.concatenate(targets)
    target = np.concatenate([shown.real, shown.imag])
    size = np.sqrt(np.einsum("ij,ij->j", matrix, matrix)) + 1e-300
    matrix /= size
    ridge = 1e-12 * np.eye(matrix.shape[1])
    bottom = 1.0 + np.abs(lines[:, 1]) ** 2  # of a denominator with all roots at -1
    square = bottom**order
    for _ in range(_REFINEMENTS):
        weighted = matrix.T / np.concatenate([square, square])
        gram = weighted @ matrix
        level = gram[0, 0] or np.trace(gram) or 1.0
        factors = np.linalg.solve(gram + level * ridge, weighted @ target) / size
        denominator = np.concatenate([factors[:order], [1.0]])
        # The size of the denominator is that of its roots mirrored to the left, so stable or not
        # does not matter here.
        shown = lines @ denominator
        square = np.maximum(shown.real**2 + shown.imag**2, 1e-18)
    roots = np.roots(denominator[::-1])
    stable = -np.abs(roots.real) - 1e-4 * np.abs(roots) - 1e-9 + 1j * roots.imag
    return np.asarray(stable * scale, dtype=np.complex128)


def _arranged(
    layout: Layout, poles: Complexes, taus: Sequence[tuple[float, ...]], delay_s: float
) -> Iterator[Floats]:
    """Poles put to their places in the layout; slow branches from the slowest or from `taus`."""
    structure = layout.structure
    upper = sorted((p for p in poles if p.imag > 1e-9 * abs(p)), key=abs)
    reals = sorted((p.real for p in poles if abs(p.imag) <= 1e-9 * abs(p)), key=abs)
    choices: list[tuple[tuple[float, ...], list[float]]] = []
    if poles.size > structure.poles:
        count = structure.slow_modes
        if len(reals) < count:
            return
        choices = [(tuple(-1.0 / r for r in reals[:count]), reals[count:])]
    else:
        choices = [(tau, reals) for tau in taus]
    for slow, fast in choices:
        numbers = []
        pairs = [(abs(p), -p.real / abs(p)) for p in upper]
        rest = list(fast)
        while len(pairs) < structure.poles // 2 and len(rest) >= 2:
            a, b = rest.pop(0), rest.pop(0)
            pairs.append((math.sqrt(a * b), -(a + b) / (2.0 * math.sqrt(a * b))))
        if len(pairs) != structure.poles // 2 or len(rest) != structure.poles % 2:
            continue
        for omega, zeta in pairs:
            numbers += [math.log(omega), math.log(max(zeta, 1e-3))]
        numbers += [math.log(-1.0 / r) for r in rest] + [math.log(tau) for tau in slow]
        yield np.array([*numbers, delay_s])
