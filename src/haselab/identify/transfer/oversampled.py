"""Records that were sampled much faster than the output moves, at a rate that suits a search."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfft

from haselab.identify.record import Record

__all__ = ["at_lower_rate"]

Floats = NDArray[np.float64]
_MANY = 10_000  # outputs of all records, from which on a search on fewer is worth the while
_LEAST = 5_000  # outputs that are kept
_FINER = 20.0  # times the highest frequency of the output: least rate
_ABOVE_NOISE = 4.0  # times the noise: power of a frequency that counts
# Share of the power above the highest frequency: of the one resonance of two poles, and of others.
_BELOW, _BELOW_WEAK = 1e-4, 1e-9
_PARTS = 8  # of a record, whose spectra are averaged
_REACH = 16  # outputs that are kept on either side of one, within which the filter acts
_ROLL_OFF = 0.2  # width of the filter's slope, as a share of its half-power frequency
_OF_HOLD = {"zero": 1, "first": 2, "band-limited": 0}  # factors of the spectrum of held values
_REGULAR = 1e-3  # of a sample: deviation of the times


def at_lower_rate(records: Sequence[Record], poles: int) -> list[Record] | None:
    """The same records with fewer inputs and outputs.

    Both are filtered alike, so that the plant is the same. The outputs near both ends are left
    out. The filter keeps white noise white.

    Args:
        records: of one plant.
        poles: of the model to be searched, besides slow ones.
    Returns:
        The records, some of them as they were; None: all of them are.
    """
    count = sum(record.y.size for record in records)
    if count <= _MANY:
        return None
    most = count // _LEAST
    share = _BELOW if poles <= 2 else _BELOW_WEAK
    every = [min(_every(record, share), most) for record in records]
    if max(every) < 2:
        return None
    return [
        _filtered(record, n) if n > 1 else record for record, n in zip(records, every, strict=True)
    ]


def _every(record: Record, share: float) -> int:
    """One of how many outputs is enough; 1 if the record has no regular times."""
    rate_hz = 1.0 / record.output_step_s
    times = record.output_time_s * rate_hz
    held = rate_hz / record.input_rate_hz
    if np.abs(times - np.arange(times.size)).max() > _REGULAR:
        return 1
    if abs(held - round(held)) > 1e-6 or record.y.size > round(held) * record.u.size:
        return 1
    from scipy.signal import welch  # takes half a second to import

    part = record.y.size // _PARTS
    frequency_hz, power = welch(record.y, rate_hz, nperseg=part, detrend="linear")
    noise = float(np.median(power[power.size // 2 :]))
    clear = np.where(power > _ABOVE_NOISE * noise, power, 0.0)
    left = np.cumsum(clear[::-1])[::-1]  # in this and all higher frequencies, without the noise
    moves = (clear > 0.0) & (left > share * left[0])
    highest_hz = float(frequency_hz[np.flatnonzero(moves)[-1]]) if moves.any() else 0.0
    wanted_hz = _FINER * max(highest_hz, float(frequency_hz[1]))
    fewest = record.y.size // (4 * _REACH)
    return max(1, min(int(rate_hz / wanted_hz), fewest))


def _filtered(record: Record, every: int) -> Record:
    """One of `every` outputs of a record, and the input at the same times."""
    from scipy.signal import upfirdn  # takes half a second to import

    rate_hz = 1.0 / record.output_step_s
    held = round(rate_hz / record.input_rate_hz)
    u = np.repeat(record.u, held)[: record.y.size]
    reach = _REACH * every
    before = record.u[0] if record.input_before is None else record.input_before
    ends = {"y": (record.y[0], record.y[-1]), "u": (before, u[-1])}
    kept = {}
    for name, values, power in (("y", record.y, 0), ("u", u, _OF_HOLD[record.hold])):
        first, last = ends[name]
        padded = np.concatenate([np.full(reach, first), values, np.full(reach, last)])
        filtered = upfirdn(_filter(every, power), padded, down=every)
        kept[name] = filtered[2 * _REACH :][: 1 + (values.size - 1) // every]
    # Held values are those of a smooth input half a sample later.
    late_s = 0.5 / rate_hz if record.hold == "zero" else 0.0
    times_s = np.arange(kept["y"].size) * (every / rate_hz) - late_s
    # Straight lines between them are faster to simulate; they damp a tone by 1 - (omega T)^2/12.
    kept["u"][1:-1] -= np.diff(kept["u"], 2) / 12.0
    inner = slice(_REACH, kept["y"].size - _REACH)
    return replace(
        record, u=kept["u"], input_rate_hz=rate_hz / every, y=kept["y"][inner],
        output_time_s=times_s[inner], hold="first", hold_assumed=False,
    )  # fmt: skip


def _filter(every: int, held: int) -> Floats:
    """Impulse response of a low-pass filter whose power at half the new rate is one half.

    Args:
        every: ratio of the rates.
        held: factors sin(x)/x of the spectrum of held values that it contains, too.
    Returns:
        Symmetric about its middle. Shape `(2 * _REACH * every + 1,)`.
    """
    reach = _REACH * every
    size = 8 * reach
    frequency = np.arange(size // 2 + 1) / size  # in samples^-1
    place = (2.0 * every * frequency - (1.0 - _ROLL_OFF)) / (2.0 * _ROLL_OFF)
    response = np.cos(0.5 * math.pi * np.clip(place, 0.0, 1.0)) * np.sinc(frequency) ** held
    impulse = irfft(response, size)
    taps = np.concatenate([impulse[-reach:], impulse[: reach + 1]])
    taps *= np.kaiser(taps.size, 8.0)
    return np.asarray(taps / taps.sum())
