r"""How well parameters would be known after another experiment.

The information of an experiment that was not played follows from its simulated motion at the
present estimate, $J^\top J$ with the derivatives $J$ of its lengths and capacitances over their
standard deviations. It adds to that of the records,

$\Sigma' = \left(\Sigma^{-1} + J^\top J / e\right)^{-1}$

where $e$ is the excess of the records' variance over that with white residuals. It is valid as far
as the motion is linear in the parameters within their present uncertainty.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError
from haselab.identify.physical.information import RELATIVE, covariance_of
from haselab.identify.physical.misfit import SharedErrors, model_record
from haselab.identify.physical.record import MotionRecord
from haselab.identify.physical.unknowns import Unknowns

__all__ = ["Outlook"]

Floats = NDArray[np.float64]
_LEAST = 1e-14  # eigenvalue of a correlation that is positive in spite of rounding


@dataclass(frozen=True)
class Outlook:
    """What is known of a model's parameters, and what another experiment would add.

    Args:
        unknowns: at the present estimate.
        present: square root of the present information, in vague widths. Shape `(M, P)`.
        excess_variance: of the records over that with white residuals.
    """

    unknowns: Unknowns
    present: Floats
    excess_variance: float = 1.0

    @classmethod
    def of(
        cls,
        unknowns: Unknowns,
        covariance: Floats,
        excess_variance: float = 1.0,
    ) -> Outlook:
        """Start from the covariance of the present values.

        Args:
            unknowns: at the present estimate.
            covariance: of the values, finite. Shape `(P, P)`.
            excess_variance: of the records over that with white residuals.
        Raises:
            InputError: The covariance is not finite and positive.
        """
        unit = unknowns.slopes * unknowns.vague_widths
        relative = covariance / np.outer(unit, unit)
        std = np.sqrt(np.diag(relative))
        if not (np.isfinite(relative).all() and (std > 0.0).all()):
            raise InputError(
                "The covariance of the physical model is not finite and positive. Identify the "
                "actuator again."
            )
        size, axes = np.linalg.eigh(relative / np.outer(std, std))
        if size[0] < -1e-6 * size[-1]:
            raise InputError(
                "The covariance of the physical model has a negative eigenvalue. Identify the "
                "actuator again."
            )
        root = axes / np.sqrt(np.maximum(size, _LEAST * size[-1]))
        return cls(unknowns, root.T / std, excess_variance)

    def information(self, record: MotionRecord) -> Floats:
        """Square root of the information of an experiment, in vague widths.

        Args:
            record: when and how well lengths and capacitances would be seen; their values are not
                used.
        Returns:
            Upper triangle. Shape `(P, P)` or fewer rows.
        Raises:
            HaselabError: The actuator has no equilibrium, or leaves the limits of its law.
        """
        found = model_record(self.unknowns, record, strict=True)
        seen = replace(record, length_m=found.length_m)
        shared = SharedErrors.of(seen, record.length_std_m)
        rows = np.vstack(
            [
                shared.whitened(found.length_by / record.length_std_m[:, None]),
                found.capacitance_by / record.capacitance_std_f[:, None],
            ]
        )
        scale = self.unknowns.vague_widths / np.sqrt(self.excess_variance)
        return np.asarray(np.linalg.qr(rows * scale, mode="r"))

    def relative_std(self, added: Sequence[Floats] = ()) -> Floats:
        """Relative standard deviations, now or with further information.

        Args:
            added: square roots of the informations of further experiments.
        Returns:
            Standard deviations of what varies over 2.5 widths: those of the logarithms, of
            latencies over 5 ms, and so on; of an inverse, that of at most the default value.
            Shape `(P,)`.
        """
        covariance = covariance_of([self.present, *added])
        return np.asarray(np.sqrt(np.diag(covariance)) / RELATIVE)
