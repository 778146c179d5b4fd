"""Expected values of a closed loop: strain and capacitance range, static strain."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from haselab.models.maps import VoltageMap
from haselab.rig import RigDescription

__all__ = ["LoopModel", "capacitance_range", "loop_model"]

_GRID = 501
_SLOW = 0.25  # 1 - cos(w T) of actuators to which jump_share applies: 11.5 Hz with 10 ms
_MOST_QUICK = 10.0 / 3.0  # a broken sensor must still be found: half of the range by default
_REAL = 1e-9  # relative imaginary part of a root that is a rounding error


@dataclass(frozen=True)
class LoopModel:
    """Nominal values that a loop's signals are compared with.

    Args:
        block_s: length of a block.
        strain_low: lower end of the strain range of the voltage map.
        strain_high: upper end of it.
        map_drive_v: drive voltages in rising order. Shape `(N,)`.
        map_strain: static strain at each. Shape `(N,)`.
        drive_reach_v: largest drive voltage in magnitude.
        gain: of the amplifier.
        carrier_v: peak of the sensing signal at the amplifier's input.
        code_per_v: codes of the voltage monitor per volt of drive.
        level: samples of a block whose mean is the level of the output: settled, and whole periods
            of the carrier.
        queued: number of queued outputs.
        capacitance_map: coefficients of the strain map, see `capacitance_range`; None if the
            strain does not come from the capacitance.
        capacitance_f: a capacitance in the range of the map; 0: unknown.
        alternates: whether the sign of the drive alternates on purpose.
        resonance_rad_s: highest natural frequency of the actuator; 0: unknown.
        slack_f: capacitance at 0 V of an actuator whose pouches are slack there; 0: it has none.
        follows_drive: whether the sensed strain also follows a change of the drive at once, because
            the capacitance of the actuator depends on the voltage.
    """

    block_s: float
    strain_low: float
    strain_high: float
    map_drive_v: NDArray[np.float64]
    map_strain: NDArray[np.float64]
    drive_reach_v: float
    gain: float
    carrier_v: float
    code_per_v: float
    level: slice
    queued: int
    capacitance_map: tuple[float, float, float, float] | None
    capacitance_f: float
    alternates: bool = False
    resonance_rad_s: float = 0.0
    slack_f: float = 0.0
    follows_drive: bool = False

    @property
    def range(self) -> float:
        """Width of the strain range."""
        return self.strain_high - self.strain_low

    @property
    def quickness(self) -> float:
        """How much more than a slow actuator's the rate of strain may change from block to block.

        It is for motion without a change of the drive; `rate_change` adds what the drive explains.
        """
        return min(max(0.5 * self.rate_change(1.0) / _SLOW, 1.0), _MOST_QUICK)

    def rate_change(self, step: float, blocks: int = 1) -> float:
        """Largest change of the rate of strain, per block, after a step of the drive.

        Without damping, the second difference is $2 x (1 - \\cos\\omega T)$ at most. A controller
        that puts out a voltage steps farther than its reference.

        Args:
            step: x, of the static strain.
            blocks: between two measured strains.
        Returns:
            The change; 0 if the resonance is not known.
        """
        turned = min(self.resonance_rad_s * self.block_s * blocks, math.pi)
        return 2.0 * step * (1.0 - math.cos(turned)) / blocks


def loop_model(
    rig: RigDescription,
    voltage_map: VoltageMap,
    saturation: tuple[float, float],
    carrier: tuple[float, float],
    settle_s: float,
    capacitance_map: tuple[float, float, float, float] | None,
    capacitance_f: float = 0.0,
    alternates: bool = False,
    resonance_rad_s: float = 0.0,
    slack_f: float = 0.0,
    follows_drive: bool = False,
) -> LoopModel:
    """Build the model of a loop on a rig.

    Args:
        rig: nominal values.
        voltage_map: static strain to drive.
        saturation: lowest and highest strain that the loop passes to the map.
        carrier: frequency in Hz and peak at the amplifier's input in V.
        settle_s: settling time of the output.
        capacitance_map: see `LoopModel`.
        capacitance_f: see `LoopModel`.
        alternates: see `LoopModel`.
        resonance_rad_s: see `LoopModel`.
        slack_f: see `LoopModel`.
        follows_drive: see `LoopModel`.
    """
    low, high = min(saturation[0], 0.0), max(saturation[1], 0.0)
    strain = np.linspace(low, high, _GRID)
    drive_v = voltage_map.voltage_v(strain)
    order = np.argsort(drive_v, kind="stable")
    settled = rig.switch_in_block + math.ceil(settle_s * rig.rate_hz)
    period = rig.rate_hz / carrier[0]
    counted = round(max(rig.block_samples - settled, 0) // period * period)
    return LoopModel(
        block_s=rig.block_s,
        strain_low=min(voltage_map.strain_low, low),
        strain_high=max(voltage_map.strain_high, high),
        map_drive_v=drive_v[order],
        map_strain=strain[order],
        drive_reach_v=max(abs(rig.drive_limits.low), abs(rig.drive_limits.high)),
        gain=rig.amplifier_gain,
        carrier_v=abs(carrier[1]),
        code_per_v=rig.amplifier_gain * rig.v_monitor_v_per_v / rig.volt_per_code,
        level=slice(rig.block_samples - counted, rig.block_samples),
        queued=rig.queued_blocks,
        capacitance_map=capacitance_map,
        capacitance_f=capacitance_f,
        alternates=alternates,
        resonance_rad_s=resonance_rad_s,
        slack_f=slack_f,
        follows_drive=follows_drive,
    )


def capacitance_range(
    strain_map: tuple[float, float, float, float],
    strain_low: float,
    strain_high: float,
    about_f: float = 0.0,
) -> tuple[float, float]:
    """Capacitances of a strain range, in F, on one branch of the map.

    Args:
        strain_map: slope (1/F), offset, curvature (1/F^2) and cubic factor (1/F^3).
        strain_low: lower end.
        strain_high: upper end.
        about_f: a capacitance on the branch, as in the range of the map.
    Returns:
        Lowest and highest; if the branch does not reach an end, 0 or its turning point.
    """
    factors = np.array(strain_map)[[3, 2, 0, 1]] * [1e-27, 1e-18, 1e-9, 1.0]  # falling powers, nF
    about, slopes = 1e9 * about_f, np.polyder(factors)
    turns = _positive(slopes)
    low = max((turn for turn in turns if turn < about), default=0.0)
    high = min((turn for turn in turns if turn > about), default=math.inf)
    rises = float(np.polyval(slopes, about)) > 0.0
    ends = []
    for strain in (strain_low, strain_high):
        reached = [
            root for root in _positive(factors - [0.0, 0.0, 0.0, strain]) if low <= root <= high
        ]
        above = strain > float(np.polyval(factors, about))
        ends.append(min(reached, default=high if above == rises else low))
    return 1e-9 * min(ends), 1e-9 * max(ends)


def _positive(factors: NDArray[np.float64]) -> list[float]:
    """Real roots above 0 of a polynomial."""
    roots = np.roots(factors)
    return [float(r.real) for r in roots if abs(r.imag) <= _REAL * abs(r) and r.real > 0.0]
