"""Row S28: the study's step on a miniature bench, scaled to the voltage of its supply."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np

from haselab.base import InputError, ResultError
from haselab.control import DesignSpec, LoopSetting, PidGains, Saturation, design_pid
from haselab.control.feedthrough import with_feedthrough
from haselab.firmware import RATE_HZ
from haselab.models.actuator import ActuatorTables, StrainMap
from haselab.models.actuator.tables import strain_map_section, voltage_map_section
from haselab.models.maps import VoltageMap
from haselab.models.plant import Plant
from haselab.rig.chip import SupplyModel

__all__ = ["RELAY_AGE_S", "MiniatureDesign", "design_miniature", "relay_setting"]

# Shares of the supply's highest voltage at zero strain and at the end of the step. The study has
# 0.5 and 0.73 of 10 kV; 0.5 here would put zero strain at the lower end of the voltage map.
_BASELINE, _TOP = 0.6, 0.78
_ROUND = 500.0  # a step is a multiple of 0.002
_SLEW_SHARE = 0.4  # of the supply's slew rate that the chip requests at most
_SEED = 20181002  # of the design's search
_SPEC = DesignSpec(rise_time_s=2.0, overshoot=0.07, phase_margin_deg=50.0, frequency_spread=0.25)
# Age of the chip's strain when the computer has its output code: half of the samples (7.5 slots of
# 125 us), 45 bytes at 500,000 baud, half an update until the computer reads it. The computer takes
# the mean of all updates since its last command, which adds to the age.
RELAY_AGE_S = 7.5 * 125e-6 + 45 * 10 / 500e3 + 0.5e-3


@dataclass(frozen=True)
class MiniatureDesign:
    """Maps, gains and step of the miniature bench.

    Args:
        plant: of the study.
        voltage_map: corrected strain to drive voltage, about the new zero strain.
        strain_map: capacitance to strain, about the new zero strain.
        zero_length_m: length at the new zero strain.
        gains: of the PID.
        setting: rate, delay and saturation of its loop.
        highest_v: highest voltage of the supply.
        drive_high_v: the drive for that voltage.
        rise_v_per_s: fastest change of the drive that the chip requests.
        step: of the strain.
        zero_strain: strain of the study that is zero strain on this bench.
        baseline_v: high voltage at zero strain, from the model.
        top_v: the same at the end of the step.
    """

    plant: Plant
    voltage_map: VoltageMap
    strain_map: StrainMap
    zero_length_m: float
    gains: PidGains
    setting: LoopSetting
    highest_v: float
    drive_high_v: float
    rise_v_per_s: float
    step: float
    zero_strain: float
    baseline_v: float
    top_v: float

    @property
    def sections(self) -> Mapping[str, Mapping[str, object]]:
        """Content of actuator.toml."""
        limits = self.setting.saturation
        return {
            "actuator": {"name": "miniature bench"},
            "actuator.geometry": {"zero_length_m": self.zero_length_m},
            "sensing.strain_map": strain_map_section(self.strain_map),
            "drive.voltage_map": voltage_map_section(self.voltage_map),
            "model": self.plant.to_dict(),
            "controller": {
                "kind": "pid",
                "parameters": asdict(self.gains),
                "limits": {"low": limits.low, "high": limits.high},
                "loop": {
                    "rate_hz": self.setting.rate_hz,
                    "measurement_delay_s": self.setting.measurement_delay_s,
                },
            },
        }


def relay_setting(supply: SupplyModel, saturation: Saturation | None = None) -> LoopSetting:
    """Rate and delay of a loop whose output is sent to the supply over a serial line.

    The time constant of the supply is treated as a delay.

    Args:
        supply: its limits.
        saturation: of the corrected strain.
    """
    return LoopSetting(
        rate_hz=1.0 / supply.every_s,
        measurement_delay_s=RELAY_AGE_S + 0.5 * (supply.every_s - 1.0 / RATE_HZ) + supply.delay_s,
        saturation=saturation or Saturation(),
    )


def design_miniature(tables: ActuatorTables, supply: SupplyModel, gain: float) -> MiniatureDesign:
    """Scale the study's step to the supply, and design a PID for the loop with its delay.

    The voltage for a lasting strain follows from the plant with its slow branch: with creep, the
    strain exceeds that of the voltage map. Both maps are shifted to the strain at the baseline,
    which becomes the new zero.

    Args:
        tables: the study's actuator file.
        supply: its limits.
        gain: high voltage per volt of drive.
    Returns:
        Maps, gains and step.
    Raises:
        InputError: a map, the model or the length at zero strain is missing.
        ResultError: the supply is too weak for a step, or no PID is stable.
    """
    to_volt, plant = tables.voltage_map(), tables.plant()
    length_m = tables.actuator.geometry.zero_length_m
    if length_m is None:
        raise InputError("[actuator.geometry] has no zero_length_m. Add the length in m.")
    reach_v = supply.highest_v / gain
    lowest, baseline, top, highest = (
        float(to_volt.strain(share * reach_v)) for share in (0.01, _BASELINE, _TOP, 0.99)
    )
    zero = plant.static_gain * baseline
    step = math.floor(_ROUND * _moved(plant.static_gain * top, zero)) / _ROUND
    if not lowest < zero < highest or step <= 0.0:
        raise ResultError(
            f"With a supply of {supply.highest_v:g} V, zero strain is at {zero:.3g} and the "
            f"voltage map covers {lowest:.3g} to {highest:.3g} around it, which leaves no room for "
            "a step. Use a supply with a higher voltage."
        )
    setting = relay_setting(supply, Saturation(_moved(lowest, zero), _moved(highest, zero)))
    setting = with_feedthrough(setting, tables)
    found = design_pid(plant, replace(_SPEC, step=step), setting, rng=np.random.default_rng(_SEED))
    end = (zero + (1.0 + zero) * step) / plant.static_gain
    return MiniatureDesign(
        plant=plant,
        voltage_map=_rebased(to_volt, zero),
        strain_map=tables.strain_map().rebased(zero),
        zero_length_m=length_m * (1.0 + zero),
        gains=found.gains,
        setting=setting,
        highest_v=supply.highest_v,
        drive_high_v=reach_v,
        rise_v_per_s=_SLEW_SHARE * supply.slew_v_per_s / gain,
        step=step,
        zero_strain=zero,
        baseline_v=_BASELINE * supply.highest_v,
        top_v=gain * float(to_volt.voltage_v(end)),
    )


def _moved(strain: float, zero: float) -> float:
    """Convert a strain to another zero length, that at the strain `zero`."""
    return (1.0 + strain) / (1.0 + zero) - 1.0


def _rebased(to_volt: VoltageMap, zero: float) -> VoltageMap:
    """Shift a map to another zero: strain = zero + (1 + zero) new strain."""
    scale = 1.0 + zero
    return VoltageMap(
        to_volt.a1_v * math.exp(to_volt.b1 * zero),
        to_volt.b1 * scale,
        to_volt.a2_v * math.exp(to_volt.b2 * zero),
        to_volt.b2 * scale,
        _moved(to_volt.strain_low, zero),
        _moved(to_volt.strain_high, zero),
    )
