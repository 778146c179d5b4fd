"""Blocks that the plain model does not explain: find a model, or the reason for refusal."""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from haselab.sensing.block.distortion import at_a_rail, find_distortion
from haselab.sensing.block.drive import UNEXPLAINED, DriveLibrary
from haselab.sensing.block.dropouts import Breaks, find_breaks
from haselab.sensing.block.ratio import Ratio, ratio_of_segments
from haselab.sensing.block.segments import Projected, Segments
from haselab.sensing.block.tones import Lines, converter_step, find_lines, hum_text, rounding_error
from haselab.sensing.sensed import LockinConfig

__all__ = ["DISTURBED", "Explained", "coarse_text", "explain"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

_UPDATE, _CARRIER_OFF, DISTURBED = 16, 64, 128
_LOUD = 2.0  # variance of a segment over that of the others, from which spikes are searched for
_SPIKE = 6.0  # standard deviations of a reading that counts as a spike
_MOST_SPIKES = 8  # of a block, one per segment
_MANY_OUT = 3  # segments left out by the drive's model
_DROP = 0.2  # of the ratio: the tail of a step changes it less
_MOST_OFF = 0.002  # of the carrier's frequency: largest deviation
_LEAKS = 0.0003  # of it: above, the carrier leaks into its harmonics
_HARMONIC = 4.5  # standard deviations of a harmonic's quadrature
_DRIVEN = ("degree", "step", "transient")  # texts of a drive that may include hum
_FAST = "fast drive, as of a step or ringing"
_DEGREE_OF_LINES = 8  # of the polynomial that is fitted together with the tones


@dataclass(frozen=True)
class Explained:
    """Results of blocks processed by the slower models; arrays of shape `(blocks,)`.

    Args:
        voltage: mean phasor of the carrier.
        current: the same, so that the ratio of both is the estimate.
        voltage_std: of one quadrature.
        current_std: the same.
        omega_rad_s: true carrier frequency.
        middle_s: mean time of the counted samples, from the block's first one.
        reason: 0, or bits of `REASONS`.
        texts: model of an explained block, otherwise a description of the disturbance.
    """

    voltage: Complexes
    current: Complexes
    voltage_std: Floats
    current_std: Floats
    omega_rad_s: Floats
    middle_s: Floats
    reason: NDArray[np.uint8]
    texts: list[str]


@lru_cache(maxsize=8)
def _tools(config: LockinConfig) -> tuple[Segments, DriveLibrary]:
    segments = Segments(config)
    return segments, DriveLibrary(segments, expected=config.search_updates)


def _tools_of_a_call(config: LockinConfig) -> tuple[Segments, DriveLibrary]:
    """Tools for one call: tables are shared, state is not, so that calls may run concurrently."""
    segments, library = _tools(config)
    return segments, copy(library)


def _on_one_side(config: LockinConfig) -> LockinConfig:
    """Blank also the shorter side of a known update: no model of a drive continues across it."""
    (low, high), n = config.blank, config.block_samples
    if not 0 < low < high < n:
        return config
    return replace(config, blank=(0, high) if n - high >= low else (low, n))


def explain(readings: NDArray[Any], config: LockinConfig) -> Explained | None:
    """Find models for blocks that the plain model does not explain.

    Args:
        readings: those blocks, `(blocks, block_samples, 2)`, in the order of the record.
        config: configuration of the lock-in.
    Returns:
        The results; None where a block has too few periods for other models.
    """
    config = _on_one_side(config)
    segments, library = _tools_of_a_call(config)
    if not segments.enough or segments.counts.sum() < 4:
        return None
    lines = find_lines(readings, config)
    cut = segments.cut(readings)
    found = _fit(segments, library, cut)
    stuck = found.stuck  # found before tones are subtracted, which would hide it
    dearer = np.ones(len(readings))
    with_lines = np.zeros(len(readings), dtype=bool)
    if lines.hz:
        open_ = _open(found, segments, lines)
        some = cut if open_.size == len(cut) else cut[open_]
        clean, factor = _without_lines(some, segments, config, lines.hz)
        if open_.size:
            other = _fit(segments, library, clean)
            taken = _better(found.only(open_), other, segments, len(lines.hz))
            with_lines[open_[taken]] = True
            dearer[with_lines] = factor
            found = _merged(found, other, open_, taken)
    breaks = find_breaks(found.phasors, found.used, stuck, found.variance, segments)
    # A drive model fitted to a disturbance hides a dropout, and so does a long part left out.
    hidden = found.fast | ((~found.used & segments.counts).sum(axis=1) > _MANY_OUT)
    if hidden.any():
        alone = segments.phasors_alone(segments.project(cut[hidden]))
        every = np.broadcast_to(segments.counts, (len(alone), segments.count))
        again = find_breaks(
            alone, every, stuck[hidden], found.variance[hidden], segments, smallest=_DROP
        )
        breaks = breaks.with_blocks(np.flatnonzero(hidden), again)
    ratio = ratio_of_segments(
        found.phasors, breaks.used, found.extra, found.variance, segments, breaks.refused
    )
    relative = dearer * ratio.relative_std
    texts = list(found.texts)
    rail = at_a_rail(cut, breaks.used)
    judged = (found, ratio, breaks)
    reason = _judge(readings, config, segments, lines, with_lines, judged, rail, texts)
    if not config.search_updates:
        reason[found.stepped & (reason == 0)] |= _UPDATE
    return Explained(
        ratio.voltage,
        ratio.current,
        np.abs(ratio.voltage) * relative / np.sqrt(2.0),
        np.abs(ratio.current) * relative / np.sqrt(2.0),
        np.where(np.abs(ratio.turn) < 0.5 * segments.turn, ratio.turn, 0.0) * config.rate_hz,
        ratio.middle_samples / config.rate_hz,
        reason,
        texts,
    )


@dataclass(frozen=True)
class _Found:
    """Blocks minus their drive; arrays with one row per block."""

    phasors: Complexes
    used: NDArray[np.bool_]
    extra: Floats
    variance: Floats
    harmonic: Complexes
    harmonic_std: Floats
    score: Floats
    spikes: NDArray[np.intp]
    texts: NDArray[np.object_]
    stepped: NDArray[np.bool_]
    stuck: NDArray[np.bool_]
    fast: NDArray[np.bool_]
    over: Floats

    def only(self, blocks: NDArray[np.intp]) -> _Found:
        """The selected blocks."""
        return _Found(*(getattr(self, one.name)[blocks] for one in fields(self)))


def _fit(segments: Segments, library: DriveLibrary, cut: Floats) -> _Found:
    """Fit the drive of each block, and subtract it from the carrier and its harmonics."""
    projected, spikes = _without_spikes(segments, cut, segments.project(cut))
    mean, std = projected.harmonics(np.broadcast_to(segments.counts, (len(cut), segments.count)))
    clear = np.abs(mean) > _HARMONIC * std
    harmonics = bool(clear.any(axis=(1, 2)).mean() > 0.02)
    calm, stuck = projected.calm_variance(segments.counts)
    carrier, slow = projected.carrier, projected.slow
    drive = library.choose(slow, calm, harmonics=harmonics)
    phasors = segments.phasors(carrier - drive.carrier.reshape(carrier.shape))
    changing = _changes(phasors, drive.used, calm * segments.quadrature)
    if changing.any():  # a growing carrier looks like a drive, which biases the carrier
        put = segments.growth(phasors, drive.used)
        own = changing[:, np.newaxis, np.newaxis, np.newaxis]
        carrier = carrier - np.where(own, put[0], 0.0)
        slow = slow - np.where(own, put[1], 0.0)
        projected = replace(projected, harmonic=projected.harmonic - np.where(own, put[2], 0.0))
        again = library.choose(slow[changing], calm[changing], harmonics=harmonics)
        drive = drive.with_blocks(np.flatnonzero(changing), again)
        phasors = segments.phasors(carrier - drive.carrier.reshape(carrier.shape))
    mean, std = projected.harmonics(drive.used)
    return _Found(
        phasors,
        drive.used,
        drive.extra,
        projected.variance(drive.used),
        mean - drive.harmonic,
        std,
        drive.score,
        spikes,
        np.array(drive.texts, dtype=object),
        drive.stepped,
        stuck,
        drive.fast,
        drive.over,
    )


def _changes(phasors: Complexes, used: NDArray[np.bool_], variance: Floats) -> NDArray[np.bool_]:
    """Blocks whose carrier changes smoothly between segments, far beyond the noise."""
    used = used[:, np.newaxis]
    both = used[..., 1:] & used[..., :-1]
    mean = (phasors * used).sum(axis=2) / used.sum(axis=2)
    about = phasors - mean[:, :, np.newaxis]
    scatter = (np.abs(about) ** 2 * used).sum(axis=2) / used.sum(axis=2)
    jumps = (np.abs(np.diff(phasors, axis=2)) ** 2 * both).sum(axis=2) / both.sum(axis=2)
    return np.asarray(((scatter > 6.0 * variance) & (jumps < scatter)).any(axis=1))


def _better(found: _Found, other: _Found, segments: Segments, lines: int) -> NDArray[np.bool_]:
    """Blocks that fit better without the lines, with a penalty for parameters."""
    freedom = float(segments.counts.sum() * segments.length)
    least = np.minimum(found.variance, other.variance)

    def misfit(one: _Found) -> Floats:
        share = one.variance / np.maximum(least, 1e-300)
        used = one.used[:, np.newaxis]
        count = used.sum(axis=2)
        mean = (one.phasors * used).sum(axis=2) / count
        about = (np.abs(one.phasors - mean[:, :, np.newaxis]) ** 2 * used).sum(axis=2)
        about = about / np.maximum(least * segments.quadrature, 1e-300) + 2.0 * (
            segments.count - count
        )
        with np.errstate(over="ignore"):  # without noise, one of the fits may be exact
            misfits = about + freedom * (share - 1.0)
            return np.asarray(one.score * share.mean(axis=1) + misfits.sum(axis=1))

    cost = 4.0 * lines * np.log(freedom)
    return np.asarray(misfit(other) + cost < misfit(found), dtype=np.bool_)


def _open(found: _Found, segments: Segments, lines: Lines) -> NDArray[np.intp]:
    """Blocks that tones may explain better; all blocks if a tone is too fast for a drive."""
    if max(lines.hz) > 0.5 * segments.rate_hz / segments.length:
        return np.arange(len(found.score))
    used = found.used[:, np.newaxis]
    count = used.sum(axis=2)
    mean = (found.phasors * used).sum(axis=2) / count
    about = (np.abs(found.phasors - mean[:, :, np.newaxis]) ** 2 * used).sum(axis=2)
    noise = 2.0 * count * segments.quadrature * found.variance
    even = (about < (1.0 + UNEXPLAINED / np.sqrt(count)) * noise).all(axis=1)
    return np.flatnonzero(~even | (found.over > UNEXPLAINED) | found.fast)


def _merged(
    found: _Found, other: _Found, blocks: NDArray[np.intp], taken: NDArray[np.bool_]
) -> _Found:
    """The results with blocks `blocks[taken]` replaced; `other` has the rows of `blocks`."""
    changed = {}
    for one in fields(_Found):
        values = getattr(found, one.name).copy()
        values[blocks[taken]] = getattr(other, one.name)[taken]
        changed[one.name] = values
    return _Found(**changed)


# ---- what is subtracted from the readings
# ---------------------------------------------------------


def _without_lines(
    cut: Floats, segments: Segments, config: LockinConfig, lines_hz: tuple[float, ...]
) -> tuple[Floats, float]:
    """Readings minus tones of known frequency, and the factor by which that increases the error."""
    if not lines_hz:
        return cut, 1.0
    time = np.arange(segments.samples)
    angles = 2.0 * np.pi * np.outer(time, np.array(lines_hz) / config.rate_hz)
    tones = np.concatenate([np.cos(angles), np.sin(angles)], axis=1)
    at = 2.0 * (time + 0.5) / segments.samples - 1.0
    carrier = np.stack([np.cos(segments.turn * time), np.sin(segments.turn * time)], axis=1)
    degree = min(_DEGREE_OF_LINES, segments.count - 1)
    beside = np.concatenate([carrier, np.polynomial.legendre.legvander(at, degree)], axis=1)
    kept = np.repeat(segments.counts, segments.length)[:, np.newaxis]
    plain, _ = np.linalg.qr(beside * kept)
    free = tones * kept - plain @ (plain.T @ (tones * kept))
    u, s, vt = np.linalg.svd(free, full_matrices=False)
    keep = s > 1e-4 * s[0]
    flat = cut.reshape(-1, segments.samples)
    taken = (flat @ u[:, keep]) @ ((vt[keep].T / s[keep]).T @ tones.T)
    own = np.linalg.qr(np.concatenate([beside[:, 2:], tones], axis=1) * kept)[0]
    left = carrier * kept - own @ (own.T @ (carrier * kept))
    dearer = float(np.sqrt(0.5 * kept.sum() / (0.5 * (left**2).sum())))
    return (flat - taken).reshape(cut.shape), max(dearer, 1.0)


def _without_spikes(
    segments: Segments, cut: Floats, projected: Projected
) -> tuple[Projected, NDArray[np.intp]]:
    """Replace isolated outliers by a fit to the rest of their segment."""
    spikes = np.zeros(len(cut), dtype=np.intp)
    limit = _LOUD * np.median(projected.rest, axis=2, keepdims=True)
    places = np.nonzero(projected.rest > np.maximum(limit, 1e-300))
    if not places[0].size:
        return projected, spikes
    block, channel, segment = places
    some = cut[places]
    rest, leverage = segments.rest(some)
    size = np.abs(rest) * np.sqrt(1.0 - leverage)
    # Only the largest of a segment, since it disturbs the residuals of its neighbours.
    rows, worst = np.arange(len(some)), size.argmax(axis=1)
    std = np.sqrt(projected.calm_variance(segments.counts)[0])[block, channel]
    far = size[rows, worst] > _SPIKE * np.maximum(std, 1e-300)
    some[rows[far], worst[far]] -= rest[rows[far], worst[far]]
    other = segments.project(some, segment)
    loud = np.bincount(block[other.rest >= limit[block, channel, 0]], minlength=len(cut)) > 0
    counts = np.bincount(block[far], minlength=len(cut))
    few = ~loud & (counts <= _MOST_SPIKES)  # a longer disturbance is not a spike
    spikes[few] = counts[few]
    kept = few[block]
    if not kept.any():
        return projected, spikes
    other = Projected(*(getattr(other, one.name)[kept] for one in fields(other)))
    return projected.with_segments((block[kept], channel[kept], segment[kept]), other), spikes


# ---- texts and reasons ----------------------------------------------------------------------


def _judge(
    readings: NDArray[Any],
    config: LockinConfig,
    segments: Segments,
    lines: Lines,
    with_lines: NDArray[np.bool_],
    judged: tuple[_Found, Ratio, Breaks],
    rail: NDArray[np.bool_],
    texts: list[str],
) -> NDArray[np.uint8]:
    """Determine the reason of each block, and complete the texts."""
    found, ratio, breaks = judged
    reason = np.zeros(len(texts), dtype=np.uint8)
    flat, harmonic = find_distortion(
        found.harmonic, found.harmonic_std, ratio.voltage, ratio.current, rail
    )
    coarse, step = _coarse(readings, found.variance, ratio)
    far = np.abs(ratio.turn) > _MOST_OFF * segments.turn
    off = far & ratio.turns
    unexplained = ratio.unexplained | (far & ~ratio.turns)
    nearly_off = np.abs(ratio.turn) > _LEAKS * segments.turn
    words = _Words(hum_text(lines), ", ".join(f"{hz:.5g} Hz" for hz in lines.hz[:3]))
    seen = zip(
        texts, (with_lines | unexplained).tolist(), ratio.modulated.tolist(), harmonic.tolist(),
        found.spikes.tolist(), ratio.left_out.tolist(), breaks.texts, ratio.coloured.tolist(),
        strict=True,
    )  # fmt: skip
    texts[:] = [words.of(one) for one in seen]
    wrong = breaks.refused | coarse | off | (flat & nearly_off) | flat | rail | unexplained
    for k in np.flatnonzero(wrong).tolist():
        reason[k] = DISTURBED
        if breaks.refused[k]:
            texts[k] = breaks.texts[k]
        elif coarse[k]:
            texts[k] = coarse_text(step)
        elif off[k] or (flat[k] and nearly_off[k]):  # its leakage looks like harmonics
            reason[k] = _CARRIER_OFF
            texts[k] = f"by {ratio.turn[k] / (2 * np.pi) * config.rate_hz:.3g} Hz"
        elif flat[k] or rail[k]:
            texts[k] = "flat top: a monitor saturates"
        else:
            near_hz = config.carrier_hz + ratio.strongest[k] * config.rate_hz
            fast = _FAST if found.fast[k] else ""
            parts = (fast, texts[k], f"most of it near {near_hz:.4g} Hz")
            texts[k] = f"disturbance near the carrier: {'; '.join(part for part in parts if part)}"
    return reason


class _Words:
    """Cached descriptions of blocks; most blocks of a record have the same.

    Args:
        hum: text for the hum.
        tones: text with the frequencies.
    """

    def __init__(self, hum: str, tones: str) -> None:
        self._hum, self._tones = hum, tones
        self._known: dict[tuple[Any, ...], str] = {}

    def of(self, seen: tuple[Any, ...]) -> str:
        """Text for `seen`: drive, tones, modulated, harmonics, spikes, out, breaks, coloured."""
        if seen not in self._known:
            drive, tones, modulated, harmonics, spikes, left_out, breaks, coloured = seen
            parts = (
                drive,
                self._hum if any(word in drive for word in _DRIVEN) else "",
                f"tone at {self._tones}" if self._tones and tones else "",
                "modulated carrier" if modulated else "",
                "harmonics of the carrier" if harmonics else "",
                f"{spikes} spike(s) left out" if spikes else "",
                f"{left_out} segment(s) with a transient left out" if left_out else "",
                breaks,
                "noise that is not white" if coloured else "",
            )
            self._known[seen] = "; ".join(part for part in parts if part)
        return self._known[seen]


def coarse_text(step: Floats) -> str:
    """Text for a block refused for too coarse a converter, from the steps in V or codes."""
    return f"step of the converter ({step.max():.2g} V) larger than the noise"


def _coarse(
    readings: NDArray[Any], variance: Floats, ratio: Ratio
) -> tuple[NDArray[np.bool_], Floats]:
    """Blocks in which the converter's rounding error exceeds the stated standard deviation."""
    step = converter_step(readings)
    sizes = np.abs(np.stack([ratio.voltage, ratio.current]))
    error = np.hypot(*rounding_error(sizes, np.sqrt(variance.T), step))
    return error > ratio.relative_std, step
