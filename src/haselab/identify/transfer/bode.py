"""Bode diagram of a fitted transfer function, over the frequency response of its records."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.base.chart import Curve, Panel, gain_label
from haselab.identify.frequency.response import estimate_frequency_response
from haselab.identify.record import Record
from haselab.models.posterior import PlantPosterior
from haselab.models.rational import RationalModel

__all__ = ["bode_panels"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
_POINTS, _DRAWS, _SEED = 300, 200, 1
_DRIVEN = 0.99  # share of the input's power
_ABOVE_POLES = 10.0
_LONG = 20000  # samples of the records, from which segments are averaged, which takes less time


def bode_panels(
    model: RationalModel,
    posterior: PlantPosterior | None,
    records: Sequence[Record],
    names: tuple[str, str] | None = None,
) -> tuple[Panel, Panel]:
    """Magnitude and phase of a model, with its band of 95 % and the records' frequency response.

    Args:
        model: the fitted model.
        posterior: with the covariance of its parameters; None: no band is drawn.
        records: of input and output of the model. Their frequency response is drawn if it can be
            estimated: input and output have the same times, and the input varies enough; else the
            legend says that it is missing.
        names: of the axes of input and output, for the unit of the magnitude.
    Returns:
        The panel of the magnitude and that of the phase.
    """
    duration_s = max(record.u.size / record.input_rate_hz for record in records)
    highest_hz = max(_highest_hz(model, records), 2.0 / duration_s)
    frequency_hz = np.geomspace(1.0 / duration_s, highest_hz, _POINTS)
    response = model.frequency_response(2.0 * np.pi * frequency_hz)
    size_std, turn_std = _deviations(posterior, frequency_hz, response)
    phase = np.unwrap(np.angle(response))
    size = gain_label("Magnitude", *(names or ("", "")))
    sizes, phases, measured = [], [], _measured(records)
    if measured is not None:
        shown = measured[0] <= highest_hz
        hz, lines = measured[0][shown], measured[1][shown]
        near = np.interp(hz, frequency_hz, phase)
        turns = np.degrees(near + np.angle(lines * np.exp(-1j * near)))
        sizes.append(Curve(hz, np.abs(lines), "measured", "points"))
        phases.append(Curve(hz, turns, "", "points"))
    label = "model" if size_std is None else "model, 95 %"
    if measured is None:
        label += " (no measured points: the records do not give a frequency response)"
    sizes.append(Curve(frequency_hz, np.abs(response), label, std=size_std))
    phases.append(Curve(frequency_hz, np.degrees(phase), std=turn_std))
    return (
        Panel("Frequency (Hz)", size, sizes, log_x=True, log_y=True),
        Panel("Frequency (Hz)", "Phase (°)", phases, log_x=True),
    )


def _highest_hz(model: RationalModel, records: Sequence[Record]) -> float:
    """Upper end of the axis: where the input has power, and well above the fastest pole.

    Half the rate of a record may be far above both, and would leave the points in a corner.
    """
    driven_hz = 0.0
    for record in records:
        power = np.abs(np.fft.rfft((record.u - record.u.mean()) * np.hanning(record.u.size))) ** 2
        sums = np.cumsum(power)
        at = int(np.searchsorted(sums, _DRIVEN * sums[-1]))
        driven_hz = max(driven_hz, at * record.input_rate_hz / record.u.size)
    fastest_hz = float(np.abs(model.poles).max(initial=0.0)) / (2.0 * np.pi)
    nyquist_hz = 0.5 * max(record.input_rate_hz for record in records)
    return min(nyquist_hz, max(2.0 * driven_hz, _ABOVE_POLES * fastest_hz))


def _deviations(
    posterior: PlantPosterior | None, frequency_hz: Floats, response: Complexes
) -> tuple[Floats | None, Floats | None]:
    """Standard deviations of the magnitude and of the phase, in degrees; None: not known."""
    if posterior is None:
        return None, None
    plants = posterior.draw(_DRAWS, np.random.default_rng(_SEED))
    drawn = np.array([plant.frequency_response(2.0 * np.pi * frequency_hz) for plant in plants])
    return np.abs(drawn).std(axis=0), np.degrees(np.angle(drawn / response).std(axis=0))


def _measured(records: Sequence[Record]) -> tuple[Floats, Complexes] | None:
    """Frequencies in Hz and response of the records; None where it cannot be estimated."""
    long = sum(record.y.size for record in records) > _LONG
    try:
        found = estimate_frequency_response(records, method="h1" if long else "polynomial")
    except InputError:
        return None
    used = (found.frequency_hz > 0.0) & np.isfinite(found.response)
    if not found.succeeded or not used.any():
        return None
    return found.frequency_hz[used], found.response[used]
