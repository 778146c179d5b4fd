"""Judge whether the errors of a prediction are as large as its 95 % band states."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base.estimate import Z95
from haselab.identify.model_choice import effective_count

__all__ = ["BandCheck"]

Floats = NDArray[np.float64]
_INSIDE, _BY_CHANCE = 0.95, 1e-4  # share of the samples inside; probability of fewer by chance
_NEARLY = 0.85  # share inside that is noticed even if chance explains it
_LARGE = 2.0  # standard deviations of the band, from which the rms error is a model error
_FAR = 3.5  # standard deviations of an error of the parameters that all samples share
_NOISIER = 1.1  # noise over that of the fit, which is noticed
_CONSTANT = 0.5  # share of the mean square error


@dataclass(frozen=True)
class BandCheck:
    r"""Errors of a prediction over the standard deviation that its band states.

    A share $\rho$ of the variance of the band is the uncertainty of the parameters, whose error
    may be the same in all samples; the rest is noise. The errors $z$ are too large for the band if
    $\overline{z^2} - w^2 > (1-\rho)\,2^2 + \rho\,3.5^2$, where $w$ is the white part of their rms.
    For noise of which only 8 samples are independent, $\overline{z^2} > 2^2$ has a probability of
    1e-4.

    Args:
        errors: measured minus predicted, over the standard deviation. Shape `(M_r,)` each.
        mean_error: mean of measured minus predicted, in the unit of the output.
        noise_share: share of the variance of the band that is noise.
    """

    errors: tuple[Floats, ...]
    mean_error: float
    noise_share: float

    @classmethod
    def of(cls, errors: Sequence[Floats], half_band: Floats, noise_std: float) -> BandCheck:
        """Compare errors with a band.

        Args:
            errors: measured minus predicted, of each record. Shape `(M_r,)` each.
            half_band: half the width of the band, of all records. Shape `(M,)`.
            noise_std: standard deviation of the noise that the band contains.
        """
        std = np.maximum(half_band / Z95, np.finfo(np.float64).tiny)
        ends = np.cumsum([e.size for e in errors])[:-1]
        relative = (e / s for e, s in zip(errors, np.split(std, ends), strict=True))
        share = float(np.mean(np.minimum(noise_std / std, 1.0) ** 2))
        return cls(tuple(relative), float(np.mean(np.concatenate(list(errors)))), share)

    @property
    def inside(self) -> float:
        """Share of the samples inside the band."""
        return float(np.mean(np.abs(np.concatenate(self.errors)) <= Z95))

    @property
    def rms(self) -> float:
        """Root mean square error, in standard deviations of the band."""
        return float(np.sqrt(np.mean(np.concatenate(self.errors) ** 2)))

    @property
    def noise_rms(self) -> float:
        """The part of `rms` that is white noise, from second differences."""
        second = [np.diff(e, 2) for e in self.errors if e.size > 2]
        found = float(np.sqrt(np.mean(np.concatenate(second) ** 2) / 6.0)) if second else 0.0
        return min(found, self.rms)

    @property
    def error(self) -> str:
        """Why the band does not describe the record; empty if it may."""
        most = math.sqrt(self.noise_share * _LARGE**2 + (1.0 - self.noise_share) * _FAR**2)
        left = math.sqrt(self.rms**2 - self.noise_rms**2)
        if left <= most:
            return ""
        return (
            f"model error: the rms error is {self.rms:.3g} times the standard deviation that the "
            f"95 % band states, and only {100.0 * self.inside:.4g} % of the samples are inside. "
            "The model does not describe this record: check that actuator, operating point, units "
            "and sensors are those of the fit, or fit a model to such records too"
        )

    @property
    def note(self) -> str:
        """Sentences if clearly fewer samples than stated are inside the band; else empty."""
        from scipy.stats import binom  # slow to import

        # The correlation of the errors themselves would be that of the noise, which hides an error
        # that all samples share.
        inside = [(np.abs(e) <= Z95).astype(np.float64) for e in self.errors]
        independent = round(effective_count([part - self.inside for part in inside]))
        percent = f"{100.0 * self.inside:.4g}"
        few = f"Only {percent} % of the samples are inside the band of 95 %."
        if self.inside * independent >= binom.ppf(_BY_CHANCE, independent, _INSIDE):
            if self.inside > _NEARLY:
                return ""
            return (
                f"{few} The errors change so slowly that about {independent} of them are "
                "independent, so this may be chance. Compare with a longer record."
            )
        mean = float(np.mean(np.concatenate(self.errors)))
        if mean**2 > _CONSTANT * self.rms**2 or mean**2 > _CONSTANT * (self.rms**2 - 1.0) > 0.0:
            place = "above" if self.mean_error > 0.0 else "below"
            cause = (
                f"The measured output is on average {abs(self.mean_error):.3g} {place} the "
                "predicted one. The zero of the sensor may have moved"
            )
        elif self.noise_rms > _NOISIER and self.rms**2 - self.noise_rms**2 < 1.0:
            cause = f"The noise is {self.noise_rms:.3g} times that in the record of the fit"
        else:
            cause = (
                "The model does not describe this record within its uncertainty, or slow "
                "disturbances are larger than in the record of the fit"
            )
        return f"{few} {cause}."
