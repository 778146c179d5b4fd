"""Empirical frequency response: local models, averaged segments, whole periods."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from haselab.base import InputError, JsonObject, checked
from haselab.base.chart import Chart, Curve, Panel, gain_label
from haselab.identify.fit import several
from haselab.identify.frequency.charts import BodeChart, NicholsChart, NyquistChart
from haselab.identify.frequency.clipping import clipped_at
from haselab.identify.frequency.fit import ResponseFit, fit_response
from haselab.identify.frequency.lines import Lines, Pair, hold_spectrum
from haselab.identify.frequency.local_models import Spectrum, local_response
from haselab.identify.frequency.periodic import periodic_response
from haselab.identify.frequency.welch import averaged_response
from haselab.identify.record import Record
from haselab.identify.sampled.record import single_driven_record
from haselab.identify.transfer.layout import TransferStructure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["RESPONSE_METHODS", "FrequencyResponse", "estimate_frequency_response"]

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
RESPONSE_METHODS = ("rational", "polynomial", "h1", "h2", "hv", "periodic")
_LEAST = 64
_FAR, _LEAST_STEPS = 10.0, 10  # a gap, in usual distances of lines; to know what is usual


@dataclass(frozen=True, repr=False)
class FrequencyResponse:
    """Frequency response at the lines that the input excites.

    Args:
        frequency_hz: frequencies, in Hz. Shape `(K,)`.
        response: complex gain. Shape `(K,)`.
        coherence: share of the output power that follows the input, 0 to 1. Shape `(K,)`.
        std: standard deviation of the complex gain (real and imaginary part together). `(K,)`.
        distortion_std: the same of nonlinear distortion in one realisation of a periodic drive;
            NaN where not known. Shape `(K,)`.
        notes: remarks for the user.
        mixing: correlation of the errors of the lines: real parts first, then imaginary parts,
            they are this matrix times independent variables of unit variance. None where not
            known: for averaged segments, periods, and more than 10,000 lines. Shape `(2K, M)`.
        status: "ok", or why there is no result.
    """

    frequency_hz: Floats
    response: Complexes
    coherence: Floats
    std: Floats
    distortion_std: Floats
    notes: tuple[str, ...]
    mixing: csr_array | None = None
    status: str = "ok"

    def __repr__(self) -> str:
        """What `print` shows: status, band, largest gain and lowest coherence."""
        lines = self.frequency_hz.size
        if not lines:
            return f"{type(self).__name__}: {self.status}, no lines"
        gain = np.abs(self.response)
        peak = int(np.argmax(gain))
        low_hz, high_hz = float(self.frequency_hz.min()), float(self.frequency_hz.max())
        return (
            f"{type(self).__name__}: {self.status}, {lines} lines from {low_hz:.4g} to "
            f"{high_hz:.4g} Hz, largest gain {gain[peak]:.4g} at {self.frequency_hz[peak]:.4g} Hz, "
            f"coherence {float(self.coherence.min()):.3g} or more"
        )

    @property
    def succeeded(self) -> bool:
        """Whether the fit has a usable result."""
        return self.status == "ok"

    @property
    def magnitude_std(self) -> Floats:
        """Standard deviation of the magnitude. Shape `(K,)`."""
        return np.asarray(self.std / np.sqrt(2.0))

    @property
    def phase_std_rad(self) -> Floats:
        """Standard deviation of the phase, in rad; at most that of a uniform one. `(K,)`."""
        ratio = self.magnitude_std / np.maximum(np.abs(self.response), 1e-300)
        return np.asarray(np.minimum(ratio, np.pi / np.sqrt(3.0)))

    def bode(self) -> BodeChart:
        """Magnitude and phase with 95 % intervals."""
        return BodeChart.of(self.frequency_hz, self.response, self.std)

    def nyquist(self) -> NyquistChart:
        """Real and imaginary part with the radius of the 95 % circle."""
        return NyquistChart.of(self.frequency_hz, self.response, self.std)

    def nichols(self) -> NicholsChart:
        """Magnitude in dB over phase in degrees, with 95 % intervals."""
        return NicholsChart.of(self.frequency_hz, self.response, self.std)

    @property
    def bands(self) -> tuple[slice, ...]:
        """Lines of each band that the input excites, between gaps without lines.

        A gap is above an octave, and far wider than usual between two lines: in Hz, and in octaves.
        """
        hz = self.frequency_hz
        first = int(np.count_nonzero(hz <= 0.0))
        steps, octaves = np.diff(hz[first:]), np.diff(np.log2(hz[first:]))
        if steps.size < _LEAST_STEPS:
            return (slice(0, hz.size),)
        wide = (octaves > 1.0) & (steps > _FAR * np.median(steps))
        wide &= octaves > _FAR * np.median(octaves)
        ends = [0, *(first + 1 + np.flatnonzero(wide)), hz.size]
        return tuple(slice(int(a), int(b)) for a, b in itertools.pairwise(ends))

    @property
    def bands_text(self) -> str:
        """Lowest and highest frequency of each band, in Hz."""
        parts = [self.frequency_hz[band] for band in self.bands]
        return ", ".join(
            f"{part[0]:.4g} to {part[-1]:.4g}" if part.size > 1 else f"{part[0]:.4g}"
            for part in parts
        )

    def _with_gaps(self, values: Floats) -> Floats:
        """Values of the lines with NaN between two bands, which breaks a curve there."""
        starts = [band.start for band in self.bands[1:]]
        return np.insert(np.asarray(values, dtype=float), starts, math.nan)

    def chart(self, fitted: Complexes | None = None, names: tuple[str, str] | None = None) -> Chart:
        """Magnitude, phase and coherence over the frequency as data of a figure.

        Args:
            fitted: response of a model at the same frequencies. Shape `(K,)`.
            names: of the axes of input and output, for the unit of the magnitude.
        Returns:
            The chart; without the line at 0 Hz, which a logarithmic axis does not have.
        """
        axis = "Frequency (Hz)"
        starts = [band.start for band in self.bands[1:]]
        # Between two bands, an abscissa without a value.
        all_hz = np.insert(self.frequency_hz, starts, self.frequency_hz[starts])
        used = all_hz > 0.0
        hz = all_hz[used]

        def drawn(values: Floats) -> Floats:
            return self._with_gaps(values)[used]

        def degrees(response: Complexes) -> Floats:
            return drawn(np.degrees(np.unwrap(np.angle(response))))

        size = drawn(np.abs(self.response))
        sizes = [Curve(hz, size, "estimate, 95 %", std=drawn(self.magnitude_std))]
        std_deg = drawn(np.degrees(self.phase_std_rad))
        phases = [Curve(hz, degrees(self.response), std=std_deg)]
        if fitted is not None:
            sizes.append(Curve(hz, drawn(np.abs(fitted)), "fit"))
            phases.append(Curve(hz, degrees(fitted)))
        magnitude = gain_label("Magnitude", *(names or ("", "")))
        return Chart("Frequency response" if fitted is None else "Frequency response and fit", (
            Panel(axis, magnitude, sizes, log_x=True, log_y=True),
            Panel(axis, "Phase (°)", phases, log_x=True),
            Panel(axis, "Coherence", (Curve(hz, drawn(self.coherence)),), log_x=True,
                  y_limits=(0.0, 1.05)),
        ))  # fmt: skip

    def plot(self) -> Figure:
        """Draw the Bode diagram with bands of 95 %, and the coherence.

        Returns:
            A matplotlib figure: a notebook shows it, and `savefig` writes it.
        """
        return self.chart().plot()

    def fit(self, structure: TransferStructure | None = None) -> ResponseFit:
        """Fit a transfer function to the lines, weighted by their covariance."""
        return fit_response(
            self.frequency_hz, self.response, self.std, structure, mixing=self.mixing
        )  # fmt: skip

    def answer(self) -> JsonObject:
        """The result under its public JSON keys; the phase is unwrapped."""
        return {
            "status": self.status,
            "frequency_hz": self.frequency_hz,
            "magnitude": np.abs(self.response),
            "phase_rad": np.unwrap(np.angle(self.response)),
            "coherence": self.coherence,
            "std": self.std,
            "magnitude_std": self.magnitude_std,
            "phase_std_rad": self.phase_std_rad,
            "distortion_std": self.distortion_std,
            "notes": list(self.notes),
        }


@checked
def estimate_frequency_response(
    records: Record | Sequence[Record],
    *,
    method: str = "rational",
    period_s: float | None = None,
    segment_s: float | None = None,
) -> FrequencyResponse:
    r"""Estimate a frequency response from one record, or from several of one system.

    An input with the hold "zero" was held between its updates, and the hold is corrected for; one
    with the hold "band-limited" was measured.

    `rational` and `polynomial` remove the leakage of transients: around each line response and
    leakage are smooth, $Y(k+r) = G(r)\,U(k+r) + T(r)$; `rational` gives both a common local
    denominator, which a lightly damped resonance needs. `h1`, `h2`, `hv` average windowed
    segments, for long noise records with noise on the output, the input, both alike. `periodic`
    averages whole periods.

    Args:
        records: input and output at the same moments (`Record.sampled`), all at one rate.
        method: one of `RESPONSE_METHODS`.
        period_s: period of the drive, in s; for `periodic`, and for it alone.
        segment_s: length of a segment, in s; for `h1`, `h2`, `hv` alone.
    Returns:
        Response on the lines where the input has 5 % or more of its largest spectrum.
    Raises:
        InputError: times that are not those of the input, several rates, too few samples, a
            constant input, straight lines between the inputs, an unknown method, an option of
            another method.
    Source: Pintelon and Schoukens, System Identification (2012), chapters 2 and 7; Bendat and
        Piersol, Random Data (2010), chapters 6 and 9.
    Example:
        >>> u = np.random.default_rng(1).normal(size=2000)
        >>> record = Record.sampled(u, 3.0 * u, 100.0, hold="band-limited")
        >>> response = estimate_frequency_response(record)
        >>> bool(np.allclose(response.response, 3.0))
        True
    """
    _check_method(method, period_s, segment_s)
    found = [single_driven_record(record) for record in several(records)]
    rate_hz, held = _rate_hz(found), _is_held(found)
    pairs = [(each.u - each.u.mean(), each.y - each.y.mean()) for each in found]
    if method == "periodic" and period_s is not None:
        lines = periodic_response(pairs, rate_hz, period_s, held)
    elif method in ("h1", "h2", "hv"):
        lines = averaged_response(pairs, rate_hz, method, held, segment_s)
    else:
        lines = local_response([_spectrum(pair, rate_hz, held) for pair in pairs], method)
    limits = clipped_at(pairs, rate_hz, held, lines.frequency_hz, lines.response)
    return _result(lines, _status(limits, [each.y for each in found]))


def _status(limits: Sequence[float], outputs: Sequence[Floats]) -> str:
    if not limits:
        return "ok"
    middle = float(np.mean([output.mean() for output in outputs]))
    shown = " and ".join(f"{middle + limit:.4g}" for limit in limits)
    return (
        f"no result: the output stays at {shown} where the response predicts a change, "
        "so it is clipped or saturated; reduce the amplitude or increase the range of the sensor"
    )


def _check_method(method: str, period_s: float | None, segment_s: float | None) -> None:
    if method not in RESPONSE_METHODS:
        raise InputError(f"method = {method}; it must be one of {', '.join(RESPONSE_METHODS)}.")
    if (period_s is not None) != (method == "periodic"):
        raise InputError(
            f"period_s = {period_s} with the method {method}; the method periodic requires a "
            "period and the other methods take none."
        )
    if segment_s is not None and method not in ("h1", "h2", "hv"):
        raise InputError(
            f"segment_s = {segment_s} with the method {method}; only h1, h2 and hv "
            "take a segment length. Leave it out."
        )


def _rate_hz(records: Sequence[Record]) -> float:
    """The one sampling rate of all records."""
    rates_hz = [record.input_rate_hz for record in records]
    if max(rates_hz) - min(rates_hz) > 1e-6 * rates_hz[0]:
        raise InputError(
            f"The records have rates of {min(rates_hz):g} to {max(rates_hz):g} Hz, but one "
            "estimate needs one rate. Resample them, or estimate each alone."
        )
    for record in records:
        if record.u.size < _LEAST:
            raise InputError(
                f"A record has {record.u.size} samples; it must have {_LEAST} or more. Record "
                "longer."
            )
    return rates_hz[0]


def _is_held(records: Sequence[Record]) -> bool:
    """Whether the inputs were held between their updates."""
    holds = {record.hold for record in records}
    if len(holds) > 1 or "first" in holds:
        raise InputError(
            f"The records have the hold {' and '.join(sorted(holds))}; it must be zero for all, "
            "or band-limited for all."
        )
    return "zero" in holds


def _spectrum(pair: Pair, rate_hz: float, held: bool) -> Spectrum:
    size = pair[0].size
    lines = np.arange(1, (size - 1) // 2)
    frequency_hz = lines * rate_hz / size
    u, y = (np.fft.rfft(x)[lines] for x in pair)
    return Spectrum(frequency_hz, u * hold_spectrum(frequency_hz, rate_hz) if held else u, y)


def _result(lines: Lines, status: str) -> FrequencyResponse:
    found = FrequencyResponse(
        lines.frequency_hz, lines.response, lines.coherence, lines.std, lines.distortion_std,
        lines.notes, lines.mixing, status,
    )  # fmt: skip
    if len(found.bands) == 1:
        return found
    note = (
        f"The input excites separate bands: {found.bands_text} Hz. Between them the response is "
        "not known."
    )
    return replace(found, notes=(*found.notes, note))
