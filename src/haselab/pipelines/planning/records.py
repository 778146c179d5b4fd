"""What the actuator file keeps of the records of a physical model."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from haselab.identify.physical import ActuatorFit, MotionRecord
from haselab.models.actuator.sections import PhysicalRecords

__all__ = ["summary_of"]


def summary_of(
    fit: ActuatorFit, records: Sequence[MotionRecord], gain_v_per_v: float
) -> PhysicalRecords:
    """Summarise records, so that the information of a further experiment can be computed.

    Args:
        fit: of the records.
        records: that were fitted.
        gain_v_per_v: of the amplifier.
    Returns:
        `[model.physical.records]`.
    """
    drives = [record.drive for record in records]
    first = records[0]
    names = dict.fromkeys(name for record in records for name in record.experiments)
    ripple_v2 = [part[part > 0.0] for part in (drive.ripple_v2 for drive in drives)]
    ripple = np.concatenate(ripple_v2)
    lengths_m = np.concatenate([record.length_m for record in records])
    return PhysicalRecords(
        experiments=tuple(names),
        duration_s=sum(float(np.ptp(drive.edge_s)) for drive in drives),
        gain_v_per_v=gain_v_per_v,
        highest_drive_v=max(float(np.abs(d.voltage_v).max()) for d in drives) / gain_v_per_v,
        heaviest_kg=max(float(drive.mass_kg.max()) for drive in drives),
        carrier_v=math.sqrt(2.0 * float(np.median(ripple))) if ripple.size else 0.0,
        length_std_m=_known(fit.length_noise_m),
        capacitance_std_f=_known(fit.capacitance_noise_f),
        exposure_s=first.exposure_s,
        pixel_m=first.pixel_m,
        lengths_m=(float(lengths_m.min()), float(lengths_m.max())) if lengths_m.size else None,
        excess_variance=fit.excess_variance,
    )


def _known(std: float) -> float | None:
    return std if std > 0.0 and math.isfinite(std) else None
