"""Free response after a drop, fitted as in the paper and with a creep term: row S19."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from haselab.base import Estimate, JsonObject, ResultError
from haselab.control import over_trials
from haselab.identify.free.response import FreeResponseFit, FreeTrial, fit_free_response
from haselab.models.filters import find_peaks
from haselab.study.fits.observe import Observation
from haselab.study.fits.resolution import with_resolution
from haselab.study.fits.trials import normal_equivalent

__all__ = ["Envelope", "Free", "PrintedFit", "fit_free", "fit_printed"]

_FEWEST = 16  # frames of a motion
_WITH_CREEP = 3  # parameters that are searched: decay, frequency, and time constant of the creep
_ONE_TRIAL = (
    "one trial: the interval only includes how the decay changes if the last peak is left out, not "
    "the scatter between trials"
)
_TWO_PEAKS = (
    "one trial with two peaks, which determine an exponential exactly, so there is no interval. "
    "Play more trials"
)
_NO_SCATTER = (
    "one trial: no interval, because it would be the scatter between trials. Play more trials"
)
_EQ_6 = ("S19.eq6_omega_d", "S19.eq6_decay", "S19.eq6_rms")
_LEAST_PEAKS = 2  # of one sign, through which an envelope is drawn
_LEAST_PEAK = 0.03  # of the amplitude: smaller peaks are below the residuals of eq. 6

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Envelope:
    """Exponential envelope of the peaks of one sign; the paper calls it hull curve.

    Args:
        decay: in 1/s.
        moved: change of the decay without the last peak, in 1/s; NaN with only two peaks.
        amplitude_m: at the first sample, in m, positive for either sign.
        peak_s: times of the peaks from the first sample, shape `(P,)`.
        peak_m: their distances from rest, in m, positive for either sign, shape `(P,)`.
    """

    decay: float
    moved: float
    amplitude_m: float
    peak_s: Floats
    peak_m: Floats

    def at(self, time_s: Floats) -> Floats:
        """The curve from the first to the last peak, in m; NaN elsewhere."""
        curve_m = self.amplitude_m * np.exp(-self.decay * time_s)
        fitted = (time_s >= self.peak_s[0] - 1e-9) & (time_s <= self.peak_s[-1] + 1e-9)
        return np.where(fitted, curve_m, np.nan)


@dataclass(frozen=True)
class PrintedFit:
    """Least-squares fit of eq. 6 to one trial, and the envelopes of its peaks.

    Args:
        omega_d: damped frequency, in rad/s.
        decay: decay rate, in 1/s.
        amplitude_m: at the first sample, in m.
        rest_m: length around which it oscillates, in m.
        envelopes: of the positive and the negative peaks; None if fewer than two peaks exceed the
            residuals.
        modelled_m: eq. 6 at the trial's times, shape `(N,)`.
        rms_m: rms residual, in m.
    """

    omega_d: float
    decay: float
    amplitude_m: float
    rest_m: float
    envelopes: tuple[Envelope | None, Envelope | None]
    modelled_m: Floats
    rms_m: float

    @property
    def omega_0(self) -> float:
        """Natural frequency by eq. 7, in rad/s."""
        return math.hypot(self.omega_d, self.decay)


@dataclass(frozen=True)
class Free:
    """Results of the free-response trials.

    Args:
        quantities: results by id.
        notes: by id, remarks for the reader.
        figures: section of analysis.json.
        fit: of all trials.
    """

    quantities: dict[str, Estimate]
    notes: dict[str, str]
    figures: JsonObject
    fit: FreeResponseFit


def fit_printed(trial: FreeTrial, omega_d: float, decay: float) -> PrintedFit:
    """Fit eq. 6 as printed, without a creep term, to one trial.

    Args:
        trial: displacement after the drop.
        omega_d: start of the search, in rad/s.
        decay: start of the search, in 1/s.
    Returns:
        The fit.
    Raises:
        ResultError: the search fails.
    Source: reference study, eq. 6 and fig. 5.
    """
    t = trial.time_s - trial.time_s[0]

    def modelled(search: Floats) -> Floats:
        swing = search[1] * np.cos(search[0] * t) + search[2] * np.sin(search[0] * t)
        return np.asarray(np.exp(-search[3] * t) * swing + search[4])

    rest_m = float(np.median(trial.x[-trial.x.size // 4 :]))
    start = np.array([omega_d, trial.x[0] - rest_m, 0.0, decay, rest_m])
    scale = np.array([omega_d, np.ptp(trial.x), np.ptp(trial.x), decay, np.ptp(trial.x)])
    found = least_squares(lambda search: modelled(search) - trial.x, start, x_scale=scale)
    omega, cosine, sine, rate, rest_m = (float(value) for value in found.x)
    if not found.success or rate <= 0.0:
        raise ResultError(f"Eq. 6 as printed does not fit (decay {rate:.3g} 1/s). Record longer.")
    amplitude_m = math.hypot(cosine, sine)
    swings = t <= -math.log(_LEAST_PEAK) / rate  # later peaks are creep and noise
    positive, negative = (
        _envelope(t[swings], sign * (trial.x - rest_m)[swings], amplitude_m, abs(omega))
        for sign in (1.0, -1.0)
    )
    rms_m = float(np.sqrt(np.mean(found.fun**2)))
    return PrintedFit(
        abs(omega), rate, amplitude_m, rest_m, (positive, negative), modelled(found.x), rms_m
    )


def _envelope(time_s: Floats, moved_m: Floats, amplitude_m: float, omega: float) -> Envelope | None:
    """Fit an exponential to the peaks of one sign: a straight line through their logarithms.

    The amplitude of eq. 6 is not used: with the decay of the peaks it misses them.
    """

    apart = max(1, round(0.7 * 2.0 * math.pi / omega / float(np.median(np.diff(time_s)))))
    peaks, _ = find_peaks(moved_m, height=_LEAST_PEAK * amplitude_m, distance=apart)
    if peaks.size < _LEAST_PEAKS:
        return None
    at_s, logarithm = time_s[peaks], np.log(moved_m[peaks])
    slope, intercept = (float(value) for value in np.polyfit(at_s, logarithm, 1))
    moved = math.nan  # two peaks determine an exponential, and nothing is left over
    if peaks.size > _LEAST_PEAKS:
        moved = abs(slope - float(np.polyfit(at_s[:-1], logarithm[:-1], 1)[0]))
    return Envelope(-slope, moved, math.exp(intercept), at_s, moved_m[peaks])


def fit_free(trials: Sequence[Observation], near: Free | None = None) -> Free:
    """Fit eqs. 6 and 7 and both envelopes, as printed and with a creep term.

    Eq. 6 has no creep term. With an actuator that creeps it leaves large residuals, and creep makes
    the two envelopes differ. Both fits are therefore reported. If the motion has no creep that can
    be fitted, there is none in either.

    Args:
        trials: one observation per trial.
        near: results of almost the same observations, where the search starts.
    Returns:
        Results S19, data for figure 5.
    Raises:
        ResultError: the motion is not a decaying oscillation, or hardly seen.
    Source: reference study, row S19.
    """
    records = [_trial(seen).moving() for seen in trials]
    fit = fit_free_response(records, creep=True, near=None if near is None else near.fit)
    if not fit.succeeded:
        fit = fit_free_response(records, creep=False)
    if not fit.succeeded:
        raise ResultError(fit.status)
    envelopes = {
        "S19.decay_1": fit.envelope_positive_decay_per_s,
        "S19.decay_2": fit.envelope_negative_decay_per_s,
    }
    e = fit.parameters
    printed = [
        fit_printed(record, e["damped_frequency_rad_s"].value, e["decay_rate_per_s"].value)
        for record in records
    ]
    left_m = np.concatenate(
        [record.x - part for record, part in zip(records, fit.modelled, strict=True)]
    )
    return Free(
        fit=fit,
        quantities={
            "S19.omega_d": e["damped_frequency_rad_s"],
            **{name: decay for name, decay in envelopes.items() if decay is not None},
            "S19.omega_0": e["natural_frequency_rad_s"],
            "S19.eq6_omega_d": _repeated(np.array([p.omega_d for p in printed]), "rad/s"),
            "S19.eq6_decay": _repeated(np.array([p.decay for p in printed]), "1/s"),
            **_envelope_decays(printed),
            "S19.eq6_omega_0": _repeated(np.array([p.omega_0 for p in printed]), "rad/s"),
            "S19.eq6_rms": _repeated(np.array([p.rms_m for p in printed]), "m"),
        },
        notes={
            **(_notes_of_one(printed[0]) if len(printed) == 1 else {}),
            "S19.omega_0": f"{_model(fit)}; the rms residual is "
            f"{1e3 * float(np.sqrt(np.mean(left_m**2))):.2g} mm",
            "S19.eq6_omega_0": "decaying oscillation without a creep term"
            + _missing(printed)
            + (f"; {_NO_SCATTER}" if len(printed) == 1 else ""),
        },
        figures={"free_response": _figure(trials, records, fit, printed)},
    )


def _repeated(values: Floats, unit: str) -> Estimate:
    """Mean of the trials; Student's interval accounts for their small number."""
    return normal_equivalent(over_trials(values, unit))


def _envelope_decays(printed: Sequence[PrintedFit]) -> dict[str, Estimate]:
    """Decays of the envelopes that all trials have."""
    found = {}
    for k in (0, 1):
        drawn = [envelope for p in printed if (envelope := p.envelopes[k]) is not None]
        if len(drawn) == len(printed):
            rates, moves = np.array([(one.decay, one.moved) for one in drawn]).T
            scattered, known = _repeated(rates, "1/s"), moves[np.isfinite(moves)]
            found[f"S19.eq6_decay_{k + 1}"] = (
                with_resolution(scattered, float(known.mean())) if known.size else scattered
            )
    return found


def _notes_of_one(fit: PrintedFit) -> dict[str, str]:
    """What the intervals of a single trial lack, by id."""
    notes = dict.fromkeys(_EQ_6, _NO_SCATTER)
    for k, envelope in enumerate(fit.envelopes):
        if envelope is not None:
            notes[f"S19.eq6_decay_{k + 1}"] = (
                _TWO_PEAKS if math.isnan(envelope.moved) else _ONE_TRIAL
            )
    return notes


def _missing(printed: Sequence[PrintedFit]) -> str:
    """Note about envelopes that cannot be fitted; empty if both can."""
    gone = [
        name
        for k, name in enumerate(("positive", "negative"))
        if any(p.envelopes[k] is None for p in printed)
    ]
    return f"; too few {' and '.join(gone)} peaks exceed creep and noise" if gone else ""


def _trial(seen: Observation) -> FreeTrial:
    after = seen.frame_time_s >= seen.drop_s
    if (count := int(after.sum())) < _FEWEST:
        raise ResultError(
            f"{seen.name}: {count} frames after the drop show all marks, and {_FEWEST} are needed; "
            "the tracker has lost one"
        )
    return FreeTrial(seen.length_m[after], seen.frame_time_s[after] - seen.drop_s)


def _model(fit: FreeResponseFit) -> str:
    """The fitted motion in words."""
    if fit.search.size == _WITH_CREEP:
        return (
            "decaying oscillation with exponential creep; the creep is "
            f"{1e3 * _creep_m(fit):.2g} mm over the record"
        )
    return " ".join(["decaying oscillation without creep.", *fit.notes]).rstrip(".")


def _creep_m(fit: FreeResponseFit) -> float:
    """Creep of the mean of the trials during the recording."""
    moved = []
    for k, modelled in enumerate(fit.modelled):
        alone = fit.trials[k] if fit.trials else fit
        e = {name: estimate.value for name, estimate in alone.parameters.items()}
        time_s = fit.time_s[k] - fit.time_s[k][0]
        swing_m = e["amplitude"] * np.exp(-e["decay_rate_per_s"] * time_s)
        slow_m = modelled - swing_m * np.cos(e["damped_frequency_rad_s"] * time_s - e["phase_rad"])
        moved.append(slow_m[-1] - slow_m[0])
    return float(np.mean(moved))


def _figure(
    trials: Sequence[Observation],
    records: Sequence[FreeTrial],
    fit: FreeResponseFit,
    printed: Sequence[PrintedFit],
) -> dict[str, Any]:
    """Measured displacement, relative to the final value of eq. 6 as printed."""
    drawn = []
    for k, (seen, record) in enumerate(zip(trials, records, strict=True)):
        thin = slice(None, None, max(1, record.time_s.size // 1200))
        time_s, eq_6 = record.time_s[thin], printed[k]
        spread_m = np.interp(time_s, seen.frame_time_s - seen.drop_s, seen.spread_m)
        start_s = float(record.time_s[0])
        curves: dict[str, Any] = {}
        for name, sign, envelope in zip(
            ("positive", "negative"), (1.0, -1.0), eq_6.envelopes, strict=True
        ):
            if envelope is not None:
                curves[f"envelope_{name}_m"] = sign * envelope.at(time_s - start_s)
                curves[f"peaks_{name}"] = {
                    "time_s": envelope.peak_s + start_s, "m": sign * envelope.peak_m,
                }  # fmt: skip
        drawn.append(
            {
                **curves,
                "time_s": time_s,
                "displacement_m": record.x[thin] - eq_6.rest_m,
                "displacement_std_m": spread_m,
                "printed_m": eq_6.modelled_m[thin] - eq_6.rest_m,
                "creeping_m": fit.modelled[k][thin] - eq_6.rest_m,
            }
        )
    shortest = min(len(d["time_s"]) for d in drawn)
    mean_m = np.mean([d["displacement_m"][:shortest] for d in drawn], axis=0)
    return {"trials": drawn, "mean_m": mean_m, "time_s": drawn[0]["time_s"][:shortest]}
