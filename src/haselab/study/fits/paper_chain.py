"""Compare the paper's sensing chain with the lock-in (rows S6 to S9)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import Estimate, JsonObject, ResultError
from haselab.models.actuator.strain_map import StrainMap
from haselab.sensing import Sensed, relative_capacitance
from haselab.study.tables import Sensing

__all__ = ["Chain", "PrintedChain", "compare_chain", "read_chain"]

_LEAST_BLOCKS = 16

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Chain:
    """Values of the paper's sensing chain for each block; NaN where it has none.

    Args:
        capacitance_f: shape `(B,)`.
        relative_capacitance: eqs. 2 and 3, shape `(B,)`.
        phase_rad: between the monitors, shape `(B,)`.
        v_pp_v: peak-to-peak voltage of the sensing component after the low-pass, shape `(B,)`.
    """

    capacitance_f: Floats
    relative_capacitance: Floats
    phase_rad: Floats
    v_pp_v: Floats

    def rows(self) -> Floats:
        """All columns, shape `(B, 4)`."""
        columns = (self.capacitance_f, self.relative_capacitance, self.phase_rad, self.v_pp_v)
        return np.stack(columns, axis=1)

    @classmethod
    def of(cls, rows: Floats) -> Chain:
        """Inverse of `rows`."""
        return cls(*rows.T)

    def taken(self, blocks: NDArray[np.bool_]) -> Chain:
        """Select some of the blocks."""
        return Chain.of(self.rows()[blocks])


@dataclass(frozen=True)
class PrintedChain:
    """Results of the comparison.

    Args:
        strain_map: eq. 5 fitted to the chain's own capacitances, for loops that use it.
        quantities: results by id.
        notes: by id, remarks for the reader.
        figures: section of analysis.json.
    """

    strain_map: StrainMap
    quantities: dict[str, Estimate]
    notes: dict[str, str]
    figures: JsonObject


def read_chain(sensed: Sensed, sensing: Sensing, volt_per_code: float) -> Chain:
    """Collect the values of blocks that the paper's chain has sensed."""
    good = sensed.valid
    relative = relative_capacitance(
        np.where(good, sensed.v_pp, 1.0) * volt_per_code,
        np.where(good, sensed.i_pp, 1.0) * volt_per_code,
        np.where(good, sensed.phase_rad, 1.0),
        frequency_hz=sensing.carrier_hz,
        reactance_scale=sensing.reactance_scale,
        capacitance_scale=sensing.capacitance_scale,
    )
    columns = (sensed.capacitance_f, relative, sensed.phase_rad, sensed.v_pp * volt_per_code)
    return Chain(*(np.where(good, column, np.nan) for column in columns))


def compare_chain(
    printed: Chain,
    lockin: Chain,
    strain: Floats,
    drive_v: Floats,
    time_s: Floats,
    periods: float,
    fitted_periods: float,
) -> PrintedChain:
    """Compare the paper's chain with the lock-in over the fitted cycles of the triangle.

    Args:
        printed: values of the paper's chain.
        lockin: values of the lock-in for the same blocks.
        strain: measured by the camera at these blocks, shape `(B,)`.
        drive_v: of these blocks, shape `(B,)`.
        time_s: of these blocks, shape `(B,)`.
        periods: of the carrier in a block.
        fitted_periods: of these, how many the lock-in fits.
    Returns:
        Results S6 to S8, data for figure 13.
    Raises:
        ResultError: fewer than 16 blocks have both values.
    """
    both = np.isfinite(printed.capacitance_f) & np.isfinite(lockin.capacitance_f)
    if both.sum() < _LEAST_BLOCKS:
        raise ResultError(
            f"The paper's sensing chain has a capacitance in only {int(both.sum())} blocks of the "
            f"triangle, but {_LEAST_BLOCKS} are needed. Check whether the carrier was lost."
        )
    ratio = printed.capacitance_f[both] / lockin.capacitance_f[both]
    turned = np.abs(printed.phase_rad[both]) - np.abs(lockin.phase_rad[both])
    rises = np.gradient(drive_v)[both] > 0.0
    slope, offset = np.polyfit(printed.capacitance_f[both], strain[both], 1)

    def scattered(values: Floats, unit: str) -> Estimate:
        std = float(values.std(ddof=1)) / np.sqrt(values.size)
        return Estimate.normal(float(values.mean()), std, unit)

    return PrintedChain(
        strain_map=StrainMap(float(slope), float(offset)),
        quantities={
            "S6.carrier_gain": scattered(printed.v_pp_v[both] / lockin.v_pp_v[both], ""),
            "S7.periods": Estimate.normal(periods, 0.0, ""),
            "S8.phase": scattered(turned, "rad"),
            "S8.difference_rising": scattered(ratio[rises] - 1.0, ""),
            "S8.difference_falling": scattered(ratio[~rises] - 1.0, ""),
        },
        notes={
            "S7.periods": f"the lock-in fits {fitted_periods:.3g} of them",
            "S8.difference_rising": "averaging over periods does not remove the ramp and the steps "
            "of the drive",
        },
        figures={
            "chain": {
                "time_s": time_s - time_s[0],
                "lockin_f": lockin.capacitance_f,
                "printed_f": printed.capacitance_f,
            }
        },
    )
