"""What acted on an actuator without interruption, and what was seen of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from haselab.actuators import Drive
from haselab.base import InputError
from haselab.identify.training_output import grid_step

__all__ = ["MotionRecord", "repeats"]

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
_VOLTAGE_ERROR = 0.01  # of a carefully calibrated monitor and amplifier together
_REPEATED = 0.05  # share of values that are equal to the one before, above which these share errors


@dataclass(frozen=True)
class MotionRecord:
    """One uninterrupted record of an actuator; at its first edge the actuator rests.

    Args:
        name: for messages.
        drive: what acted, from the first edge to the last.
        length_time_s: rising. Shape `(F,)`.
        length_m: seen by the camera. Shape `(F,)`.
        length_std_m: standard deviation of each. Shape `(F,)`.
        window: intervals of the drive in which capacitances were sensed. Shape `(W,)`.
        window_of: index of the capacitance to which each of them belongs. Shape `(W,)`.
        capacitance_f: mean over its intervals. Shape `(C,)`.
        capacitance_std_f: standard deviation of each. Shape `(C,)`.
        experiments: names of the experiments that the record consists of.
        length_experiment: index of the experiment of each length. Shape `(F,)`.
        capacitance_experiment: the same of each capacitance. Shape `(C,)`.
        exposure_s: of the frames, whose times are the middle of it; 0 if it is not known.
        pixel_m: size of a pixel at the actuator, over which the tracker's errors are similar; 0:
            the errors of all lengths are independent.
        capacitance_later_s: by how much later than the middle of its intervals each capacitance
            was sensed, for all of them or for each. Shape `()` or `(C,)`.
        block: of each capacitance within its experiment, shape `(C,)`; empty if it is not known.
        window_weight: of a second of each interval in its capacitance, shape `(W,)`; empty: all
            weigh the same.
        voltage_ratio: voltage by the monitor over drive times gain; NaN if it was not measured.
        std_estimated: whether the standard deviations are estimates from the values themselves,
            and say nothing of those that another record states.
    Raises:
        InputError: Shapes do not fit together, a value is not finite, or a standard deviation is
            not positive.
    """

    name: str
    drive: Drive
    length_time_s: Floats
    length_m: Floats
    length_std_m: Floats
    window: Integers
    window_of: Integers
    capacitance_f: Floats
    capacitance_std_f: Floats
    experiments: tuple[str, ...]
    length_experiment: Integers
    capacitance_experiment: Integers
    exposure_s: float = 0.0
    pixel_m: float = 0.0
    capacitance_later_s: Floats | float = 0.0
    block: Integers = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    window_weight: Floats = field(default_factory=lambda: np.zeros(0))
    voltage_ratio: float = math.nan
    std_estimated: bool = False

    @cached_property
    def sensed(self) -> NDArray[np.bool_]:
        """The intervals of the drive in which a capacitance was sensed. Shape `(N,)`."""
        found = np.zeros(self.drive.voltage_v.size, dtype=np.bool_)
        found[self.window] = True
        return found

    @property
    def voltage_remark(self) -> str:
        """A warning if the monitor contradicts the stated voltage; empty otherwise."""
        if not abs(self.voltage_ratio - 1.0) > _VOLTAGE_ERROR:
            return ""
        return (
            f"{self.name}: the voltage by the monitor is {self.voltage_ratio:.4g} times drive "
            "times gain. Check the gain of the amplifier and the scale of its voltage monitor."
        )

    @property
    def repeated_remarks(self) -> list[str]:
        """What coarse steps or held values do to the lengths and capacitances."""
        found = []
        for what, values, unit in (
            ("lengths", self.length_m, "m"), ("capacitances", self.capacitance_f, "F")
        ):  # fmt: skip
            if repeats(values):
                share, step = float(np.mean(np.diff(values) == 0.0)), grid_step(values)
                steps = f", and all are in steps of {step:.3g} {unit}" if step > 0.0 else ""
                found.append(
                    f"{self.name}: {100.0 * share:.0f} % of the {what} are equal to the one "
                    f"before{steps}: neighbouring values have the same error"
                )
        return found

    @cached_property
    def _shares(self) -> csr_array:
        """Share of each sensed interval in each capacitance. Shape `(C, S)`."""
        weight = np.diff(self.drive.edge_s)[self.window]
        if self.window_weight.size:
            weight = weight * self.window_weight
        share = weight / np.bincount(self.window_of, weight)[self.window_of]
        place = np.cumsum(self.sensed) - 1
        shape = self.capacitance_f.size, int(np.count_nonzero(self.sensed))
        return csr_array((share, (self.window_of, place[self.window])), shape=shape)

    def over_windows(self, values: Floats) -> Floats:
        """Weighted means over the intervals in which each capacitance was sensed.

        Args:
            values: means over each interval of `sensed`. Shape `(S,)` or `(S, P)`.
        Returns:
            One per capacitance. Shape `(C,)` or `(C, P)`.
        """
        return np.asarray(self._shares @ values)

    def __post_init__(self) -> None:
        frames = (self.length_m, self.length_std_m, self.length_experiment)
        blocks = (self.capacitance_f, self.capacitance_std_f, self.capacitance_experiment)
        if any(part.size != self.length_time_s.size for part in frames) or any(
            part.size != self.capacitance_f.size for part in blocks
        ):
            raise InputError(
                f"{self.name}: lengths and capacitances each need one time, standard deviation "
                "and experiment per value."
            )
        if self.window.size != self.window_of.size or not np.array_equal(
            np.unique(self.window_of), np.arange(self.capacitance_f.size)
        ):
            raise InputError(
                f"{self.name}: each capacitance needs at least one interval in which it was sensed."
            )
        if self.length_m.size + self.capacitance_f.size == 0:
            raise InputError(
                f"{self.name} has neither lengths nor capacitances. Record at least one of them."
            )
        for what, values, std in (
            ("length", self.length_m, self.length_std_m),
            ("capacitance", self.capacitance_f, self.capacitance_std_f),
        ):
            if not np.isfinite(values).all():
                raise InputError(f"{self.name}: a {what} is not finite. Leave such values out.")
            if not (std > 0.0).all():
                raise InputError(
                    f"{self.name}: the standard deviation of a {what} is "
                    f"{float(std.min()):g}. It must be above 0."
                )


def repeats(values: Floats) -> bool:
    """Whether so many values are equal to the one before that their errors are not independent.

    Args:
        values: measured. Shape `(N,)`.
    Returns:
        True if the steps of a converter are larger than the noise, or if values were held.
    Example:
        >>> repeats(np.array([0.0, 0.0, 1.0, 1.0])), repeats(np.arange(4.0))
        (True, False)
    """
    return values.size > 1 and float(np.mean(np.diff(values) == 0.0)) > _REPEATED
