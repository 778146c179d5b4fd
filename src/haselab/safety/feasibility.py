"""Check whether a bench can play a study before it is energised."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.base import InputError, LimitError
from haselab.rig import RigDescription

__all__ = ["Check", "Drive", "Feasibility", "Rating", "check_feasibility"]


@dataclass(frozen=True)
class Rating:
    """What amplifier and actuator withstand.

    Args:
        current_limit_a: of the amplifier.
        slew_v_per_s: of its output.
        bandwidth_hz: small-signal, -3 dB.
        capacitance_f: of actuator and cable at the largest strain of the study.
        thickness_m: of the dielectric there.
        breakdown_v_per_m: breakdown field of the dielectric.
        field_margin: fraction of that field that may be used.
        stretch_high: largest stretch (length over free length) that the actuator withstands.
        stretch: largest stretch that the study is expected to reach; NaN: unknown.
        settle_s: longest time that an update may take to settle, within its block.
    Raises:
        InputError: A number is not above 0.
    """

    current_limit_a: float
    slew_v_per_s: float
    bandwidth_hz: float
    capacitance_f: float
    thickness_m: float
    breakdown_v_per_m: float
    field_margin: float = 0.9
    stretch_high: float = math.inf
    stretch: float = math.nan
    settle_s: float = 5e-3

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0.0 and name != "stretch":
                raise InputError(
                    f"rating.{name} is {value:g}, but it must be above 0. Change it in the rig "
                    "file."
                )


@dataclass(frozen=True)
class Drive:
    """One experiment's drive voltage, at the amplifier's input.

    Args:
        name: of the experiment.
        values_v: one value per block, in V. Shape `(N,)`.
        highest_hz: highest frequency in it; 0 for steps and holds.
        carrier_v: peak of the sensing signal during it, in V; None: that of the study.
    """

    name: str
    values_v: NDArray[np.float64]
    highest_hz: float = 0.0
    carrier_v: float | None = None


@dataclass(frozen=True)
class Check:
    """One number compared with its limit.

    Args:
        name: of the quantity.
        where: experiment in which it is worst.
        requested: the number.
        allowed: its limit; `requested` must not exceed it.
        unit: of both.
        advice: what to do if it does.
        lower: the limit is the lowest allowed number; `requested` must not be below it.
    """

    name: str
    where: str
    requested: float
    allowed: float
    unit: str
    advice: str
    lower: bool = False

    @property
    def ok(self) -> bool:
        """Whether the number is within its limit; an unknown number (NaN) passes."""
        return not self.excess > 0.0

    @property
    def excess(self) -> float:
        """How far the number is beyond its limit; negative if it is within."""
        return (self.allowed - self.requested) if self.lower else self.requested - self.allowed

    @property
    def fault(self) -> str:
        """The number and its limit, for a number that is beyond it."""
        limit = f"limit {self.allowed:.4g} {self.unit}".strip()
        if math.isinf(self.requested):
            return f"{self.name} is infinite in {self.where} ({limit})"
        value = f"{self.name} is {self.requested:.4g} {self.unit}".strip()
        return f"{value} in {self.where} ({limit})"


@dataclass(frozen=True)
class Feasibility:
    """All checks of a study on a bench.

    Args:
        checks: in the order of the docs.
    """

    checks: tuple[Check, ...]

    @property
    def ok(self) -> bool:
        """Whether the bench can do all of it."""
        return all(check.ok for check in self.checks)

    def require(self) -> None:
        """Refuse a study that the bench cannot do.

        Raises:
            LimitError: A number is too high; the message lists each one and what to do about it.
        """
        bad = [check for check in self.checks if not check.ok]
        if bad:
            reported = " ".join(f"{k}) {c.fault}. {c.advice}" for k, c in enumerate(bad, start=1))
            listed = reported if len(bad) > 1 else reported.removeprefix("1) ")
            raise LimitError(f"Not feasible on this bench: {listed}")


def _largest(drives: Sequence[Drive], measure: list[float]) -> tuple[float, str]:
    k = int(np.argmax(measure))
    return measure[k], drives[k].name


def check_feasibility(
    rig: RigDescription,
    rating: Rating,
    drives: Sequence[Drive],
    carrier_hz: float,
    carrier_v: float,
) -> Feasibility:
    r"""Compare a study's drives with what a bench can do.

    Peak current $2\pi f C V + C\,\Delta V/\Delta t$: the carrier's, and the charge of the largest
    update spread over its block. An update itself is a step; the amplifier makes it as fast as its
    current and slew allow, so what counts there is the time it takes,
    $C\,\Delta V/(I - 2\pi f C V)$ or $\Delta V/\mathrm{slew}$, the longer one, and three time
    constants of its bandwidth.

    Args:
        rig: nominal values of the bench.
        rating: what amplifier and actuator withstand.
        drives: one per experiment; each begins at 0 V.
        carrier_hz: frequency of the sensing signal.
        carrier_v: its peak at the amplifier's input, in V.
    Returns:
        All checks; `Feasibility.require` raises if one of them fails.
    Raises:
        InputError: There is no drive.
    Example:
        >>> from haselab.rig.twin.twin_bench import describe
        >>> from haselab.rig.twin.config import TwinConfig
        >>> rig = describe(TwinConfig())
        >>> rating = Rating(12e-3, 350e6, 6e3, 3.3e-9, 314e-6, 40e6)
        >>> ramp = Drive("ramp", np.linspace(0.0, 2.0, 201))
        >>> check_feasibility(rig, rating, [ramp], 2000.0, 0.02).ok
        True
        >>> found = check_feasibility(rig, rating, [ramp], 2000.0, 0.2)
        >>> [check.name for check in found.checks if not check.ok]
        ['peak current', 'time of an update']
    """
    if not drives:
        raise InputError("There is no drive to check. Name at least one experiment.")
    gain, farad = rig.amplifier_gain, rating.capacitance_f
    jumps = [float(np.abs(np.diff(d.values_v, prepend=0.0)).max()) * gain for d in drives]
    peaks = [float(np.abs(d.values_v).max()) * gain for d in drives]
    jump_v, jumps_in = _largest(drives, jumps)
    peak_v, peaks_in = _largest(drives, peaks)
    signal_hz, signal_in = _largest(drives, [d.highest_hz for d in drives])
    ripple_v = carrier_v * gain
    ripple_a = 2.0 * math.pi * carrier_hz * farad * ripple_v
    left_a = max(rating.current_limit_a - ripple_a, 0.0)
    charge_s = farad * jump_v / left_a if left_a > 0.0 else math.inf
    rise_s = max(charge_s, jump_v / rating.slew_v_per_s)
    rise_s += 3.0 / (2.0 * math.pi * rating.bandwidth_hz)
    limits = rig.drive_limits
    highest_v, highest_in = _largest(drives, [float(d.values_v.max()) for d in drives])
    lowest_v, lowest_in = _largest(drives, [-float(d.values_v.min()) for d in drives])
    current_a = ripple_a + farad * jump_v / rig.block_s
    slew_v_s = 2.0 * math.pi * carrier_hz * ripple_v
    field_v_m = (peak_v + ripple_v) / rating.thickness_m
    field_limit = rating.field_margin * rating.breakdown_v_per_m / 1e6
    lower = "Lower the voltage"
    endless = "" if left_a > 0.0 else "The carrier alone needs all of the amplifier's current. "
    return Feasibility((
        Check("highest drive voltage", highest_in, highest_v, limits.high, "V",
              f"{lower}, or raise the limit in {limits.high_source}."),
        Check("lowest drive voltage", lowest_in, -lowest_v, limits.low, "V",
              f"Raise the voltage, or lower the limit in {limits.low_source}.", lower=True),
        Check("peak current", jumps_in, 1e3 * current_a, 1e3 * rating.current_limit_a, "mA",
              "Lower the carrier or the steps, or use a stronger amplifier."),
        Check("time of an update", jumps_in, 1e3 * rise_s, 1e3 * rating.settle_s, "ms",
              f"{endless}Lower the carrier or the steps, or ramp them."),
        Check("slew of the carrier", "every experiment", slew_v_s / 1e6,
              rating.slew_v_per_s / 1e6, "V/us", "Lower the carrier's frequency or amplitude."),
        Check("carrier frequency", "every experiment", carrier_hz, rating.bandwidth_hz, "Hz",
              "Lower the carrier's frequency, or use a faster amplifier."),
        Check("signal frequency", signal_in, signal_hz, 0.5 / rig.block_s, "Hz",
              "Lower the signal's frequency, or shorten the block."),
        Check("field", peaks_in, field_v_m / 1e6, field_limit, "MV/m",
              f"{lower} or the hung mass of {rig.mass_kg:g} kg."),
        Check("stretch", peaks_in, rating.stretch, rating.stretch_high, "",
              f"{lower} or the hung mass of {rig.mass_kg:g} kg."),
    ))  # fmt: skip
