"""Residuals of a joint fit: what the model leaves beyond the noise, and what that says of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.identify.noise import whiteness_p
from haselab.identify.physical.misfit import CAPACITANCE, LENGTH, Misfit, Segment, least_explained
from haselab.identify.physical.model_error import excess_energy
from haselab.identify.physical.record import MotionRecord
from haselab.identify.physical.rivals import Rival
from haselab.identify.physical.search import SearchResult

__all__ = [
    "ChannelResiduals",
    "channel_of",
    "channel_residuals",
    "noise_of",
    "notes_of",
    "rms_of",
    "status_of",
    "typical_of",
    "worst_of",
]

Floats = NDArray[np.float64]
_SLIGHT, _GROSS = 1.05, 10.0  # rms over noise: of a model error, and of a contradiction
_SCALE = 0.2  # largest error of the capacitance that a calibration can have
_LEAST_SHARE = 0.75  # of the variance of each channel that a model must explain
_WHITE = 1e-3  # probability of the residuals under white noise
_COLOURED = 1e-5  # the same, from which a note says it
_ENOUGH = 20  # values of an experiment, for an rms of its own


def channel_of(segments: Sequence[Segment], channel: str, residuals: Floats) -> list[Floats]:
    """Residuals of one channel, experiment by experiment."""
    return [residuals[part.rows] for part in segments if part.channel == channel]


def rms_of(parts: Sequence[Floats]) -> float:
    """Root mean square of all values; 1 where there are none."""
    return math.sqrt(float(np.mean(np.concatenate(parts) ** 2))) if parts else 1.0


def worst_of(parts: Sequence[Floats]) -> float:
    """Largest rms of an experiment with enough values."""
    return max((rms_of([part]) for part in parts if part.size >= _ENOUGH), default=math.nan)


def noise_of(parts: Sequence[Floats]) -> float:
    """Noise by the differences of neighbours, which a slow misfit does not change."""
    steps = [np.diff(part) for part in parts if part.size > 1]
    return rms_of(steps) / math.sqrt(2.0) if steps else math.nan


def typical_of(parts: Sequence[Floats]) -> float:
    """Typical standard deviation of a channel; NaN where it has no values."""
    joined = np.concatenate(list(parts))
    return float(np.median(joined)) if joined.size else math.nan


@dataclass(frozen=True)
class ChannelResiduals:
    """Residuals of both channels, experiment by experiment."""

    lengths: list[Floats]
    capacitances: list[Floats]
    share: float  # of the variance of the channel that is explained least

    @property
    def whiteness_p(self) -> float:
        """Of the less probable channel."""
        return min(whiteness_p(self.lengths), whiteness_p(self.capacitances))

    @property
    def excess_energy(self) -> float:
        """Sum of the squares beyond the noise."""
        both = (self.lengths, self.capacitances)
        return excess_energy([(parts, noise_of(parts)) for parts in both if parts])

    @property
    def excess(self) -> tuple[float, str]:
        """Largest rms of a channel over its noise, and its name."""
        both = {"lengths": self.lengths, "capacitances": self.capacitances}
        found = {
            name: float(np.nan_to_num(rms_of(part) / noise_of(part))) for name, part in both.items()
        }
        largest = max(found, key=lambda name: found[name])
        return found[largest], largest

    @property
    def explained(self) -> bool:
        """Whether the law leaves nothing but noise."""
        return not (self.excess[0] > _SLIGHT and self.whiteness_p < _WHITE)

    @property
    def misses_a_signal(self) -> bool:
        """Whether the law leaves much of the variance of a channel, and not only noise."""
        return not self.explained and self.share < _LEAST_SHARE

    @property
    def contradicts(self) -> bool:
        """Whether the records contradict the law, so that there is no result."""
        return self.excess[0] > _GROSS or self.misses_a_signal


def channel_residuals(misfit: Misfit, found: SearchResult) -> ChannelResiduals:
    """Residuals of a search."""
    return ChannelResiduals(
        channel_of(misfit.segments, LENGTH, found.residuals),
        channel_of(misfit.segments, CAPACITANCE, found.residuals),
        least_explained(misfit, found.residuals),
    )


def status_of(
    seen: ChannelResiduals,
    scale: float,
    preferred: Sequence[Rival],
    *,
    converged: bool,
) -> tuple[str, bool]:
    """ "ok", a model error, or why there is no result; and whether there is one.

    Args:
        seen: residuals.
        scale: measured over true capacitance.
        preferred: laws that the records prefer to the chosen one.
        converged: whether the search did.
    """
    ratio, largest = seen.excess
    if ratio > _GROSS:
        return (
            f"the records contradict the model: its {largest} are off by {ratio:.3g} times the "
            "noise. Check the mass, the units, that each table begins at rest under its first "
            "voltage and that all records are of one actuator, or start nearer, by "
            "[actuator.parameters]"
        ), False
    if seen.misses_a_signal:
        return (
            f"the records contradict the model: it explains only {100.0 * max(seen.share, 0.0):.0f}"
            " % of the variance of a signal. Check the mass, the amplifier's gain, the units, that "
            "each table begins at rest under its first voltage and that all records are of one "
            "actuator, or start nearer, by [actuator.parameters]"
        ), False
    if not converged:
        return (
            "the search did not converge. Check that each table begins at rest under its first "
            "voltage, or start nearer, by [actuator.parameters]"
        ), False
    if abs(scale - 1.0) > _SCALE:
        return (
            f"the records contradict each other: the capacitances are {scale:.3g} times those that "
            "the forces need. Check the mass, the amplifier's gain and the calibration, or start "
            "nearer, by [actuator.parameters]"
        ), False
    if not seen.explained:
        return (
            f"model error: the {largest} are off by {ratio:.3g} times the noise, and the "
            "intervals are wider for it"
        ), True
    if preferred:
        return (
            f"model error: {preferred[0].law} explains the records better (logarithm of evidence "
            f"{preferred[0].log_evidence:.3g}), so the values of the elastic force may be wrong"
        ), True
    return "ok", True


def notes_of(
    error: float, seen: ChannelResiduals, records: Sequence[MotionRecord]
) -> tuple[str, ...]:
    """Notes on what may be misstated, according to capacitances, monitors and residuals.

    Args:
        error: see `scale_error`.
        seen: residuals.
        records: that were fitted.
    """
    notes = [record.voltage_remark for record in records if record.voltage_remark]
    if error != 0.0:
        notes.append(
            f"The capacitances are {math.exp(error):.4g} times those that the forces need. If they "
            "are well calibrated, the amplifier's gain, a mass or the camera's scale is wrong, and "
            "so are permittivity and stiffness. Their intervals allow for it."
        )
    coarse = [remark for record in records for remark in record.repeated_remarks]
    notes += [f"{remark}. The intervals allow for it." for remark in coarse]
    if seen.explained and not coarse:
        notes += [
            f"The residuals of the {what} are not white (p = {p:.2g}), although they are hardly "
            "larger than the noise: the noise is coloured, or the model has a small error. The "
            "intervals allow for coloured noise only."
            for what, p in (
                ("lengths", whiteness_p(seen.lengths)),
                ("capacitances", whiteness_p(seen.capacitances)),
            )
            if p < _COLOURED
        ]
    if not any(record.capacitance_f.size for record in records):
        notes.append(
            "Without capacitances, the fit cannot detect a wrong gain, mass or scale of the "
            "lengths, and the intervals do not include such errors. For example, an error of 1 % "
            "of the gain changes the permittivity by 2 %, and a mass of one record that is stated "
            "3 to 10 % too high moved the shear modulus of a stack by 50 to 250 times its interval."
        )
    if not any(record.length_m.size for record in records):
        notes.append(
            "Without lengths, the fit cannot detect a wrong gain or mass, nor a wrong unit of the "
            "times if no vibration is seen, and the intervals do not include such errors. For "
            "example, a mass of a stack that was stated 2 times too low halved its shear modulus; "
            "times that were stated 2 times too long doubled its relaxation times and damping."
        )
    return tuple(notes)
