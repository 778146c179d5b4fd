"""Starting points for a transfer function, found from the records alone."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import rfft

from haselab.identify.record import Record
from haselab.identify.transfer.layout import Layout
from haselab.identify.transfer.spectra import Lines, lines_of, rational_poles

__all__ = [
    "SHARES",
    "coarse_grid",
    "delay_grid",
    "delay_margin_s",
    "delayed_starts",
    "richer_start",
    "search_bounds",
    "starting_points",
    "thinned",
]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
SHARES = (0.99, 0.9)  # of the output's energy: the bands that are tried
_A_PERIOD = 8  # delays of the grid per period of the output's motion
_REACH = 0.5  # of the record: the longest delay that is tried
_MOST_DELAYS = 400
_FEW_LINES = 160  # spectral lines when many delays are tried


def thinned(records: Sequence[Record], most: int) -> list[Record]:
    """The same records with every k-th output only, at most `most` outputs in all."""
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
    """How far below zero a delay is searched, so that an interval around zero is not truncated."""
    step_s = min(r.output_step_s for r in records)
    return 4.0 * max(step_s, min(1.0 / r.input_rate_hz for r in records))


def search_bounds(layout: Layout, records: Sequence[Record]) -> tuple[Floats, Floats]:
    """Bounds of the searched parameters within which the records can identify them."""
    span_s = max(record.duration_s for record in records)
    step_s = min(r.output_step_s for r in records)
    low, high = [], []
    for at in layout.free:
        name = layout.names[at]
        if name == "delay_s":
            pair = (-delay_margin_s(records), _REACH * span_s)
        elif name.startswith("natural_frequency"):
            # Above half the output's rate a ringing is aliased to a lower frequency.
            pair = (math.log(0.1 / span_s), math.log(math.pi / step_s))
        elif name.startswith("damping_ratio"):
            pair = (math.log(1e-5), math.log(100.0))
        else:
            pair = (math.log(0.1 * step_s), math.log(100.0 * span_s))
        low.append(pair[0])
        high.append(pair[1])
    return np.array(low), np.array(high)


def starting_points(layout: Layout, records: Sequence[Record]) -> Iterator[Floats]:
    """Starting values of the searched parameters, the most likely first.

    Sanathanan-Koerner iterations on the spectra, with polynomials for the transients, for several
    delays and bands; then a coarse grid.

    Args:
        layout: order of the parameters.
        records: experiments.
    Source: Sanathanan and Koerner, IEEE Trans. Autom. Control 8 (1963), 56; transients after
        Pintelon and Schoukens, System Identification (2012), chapter 6.
    """
    free = layout.free
    bands: dict[float, list[Lines]] = {}
    for order, zeros, taus in _orders(layout, records):
        for delay_s in _delays(layout, records):
            for share in SHARES:
                if share not in bands:
                    bands[share] = [lines_of(r, share) for r in records]
                at = np.array([delay_s])
                ((poles,),) = rational_poles(bands[share], order, zeros, at, refined=False)
                for numbers in _arranged(layout, poles, taus, delay_s):
                    yield numbers[free]


def delay_grid(layout: Layout, records: Sequence[Record]) -> Floats:
    """Delays spaced closely enough that a search from the nearest one finds the right minimum.

    A search in the delay converges within a quarter period of the motion with most of the output's
    energy; the grid has eight points a period.
    """
    known = layout.template[-1]
    if not math.isnan(known):
        return np.array([known])
    span_s = max(record.duration_s for record in records)
    step_s = span_s
    for record in records:
        y = record.y - record.y.mean()
        times_s = record.output_time_s
        energy = np.abs(rfft(y)[1:]) ** 2
        tail = energy[energy.size // 2 :]
        energy = np.maximum(energy - np.median(tail) / math.log(2.0), 0.0)  # of white noise
        lines = np.arange(1, energy.size + 1) / float(times_s[-1] - times_s[0])
        mean_hz = math.sqrt(float((energy @ lines**2) / (energy.sum() + 1e-300)))
        step_s = min(step_s, 1.0 / (_A_PERIOD * max(mean_hz, 1.0 / span_s)))
    count = min(int(_REACH * span_s / step_s) + 2, _MOST_DELAYS)
    return np.linspace(0.0, _REACH * span_s, count)


def delayed_starts(
    layout: Layout, records: Sequence[Record], delays_s: Floats, share: float
) -> Iterator[Floats]:
    """Starting values at each of many delays, from the band that contains a share of the energy."""
    lines = [lines_of(r, share, _FEW_LINES) for r in records]
    for order, zeros, taus in _orders(layout, records):
        for found in rational_poles(lines, order, zeros, delays_s, refined=True):
            for delay_s, poles in zip(delays_s.tolist(), found, strict=True):
                for numbers in _arranged(layout, poles, taus, delay_s):
                    yield numbers[layout.free]


def _orders(
    layout: Layout, records: Sequence[Record]
) -> Iterator[tuple[int, int, list[tuple[float, ...]]]]:
    """Poles and zeros of the rational functions that are tried, and slow time constants."""
    structure = layout.structure
    taus = _time_constants(records, structure.slow_modes)
    for order in sorted({structure.poles, structure.poles + structure.slow_modes}, reverse=True):
        yield order, structure.zeros if order == structure.poles else order - 1, taus


def richer_start(
    layout: Layout, simpler: Layout, search: Floats, records: Sequence[Record]
) -> Iterator[Floats]:
    """The parameters of a fit with fewer fast poles, extended by fast poles.

    Such a start is as good as that fit, so more poles never fit worse.

    Args:
        layout: order of the parameters.
        simpler: layout of that fit, with fewer poles and otherwise identical.
        search: its searched parameters.
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
    """Starting values on a grid of frequency and damping, if the spectra are misleading."""
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


def _arranged(
    layout: Layout, poles: Complexes, taus: Sequence[tuple[float, ...]], delay_s: float
) -> Iterator[Floats]:
    """Poles in the order of the layout; slow branches from the slowest poles or from `taus`."""
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
