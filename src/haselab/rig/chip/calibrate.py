"""Calibrate the simulated microcontroller with a reference capacitor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from haselab.base import DeviceError
from haselab.firmware import ChipSettings
from haselab.firmware.messages import KeepAlive, Status
from haselab.rig.chip.build import Firmware, build_cosim, build_firmware
from haselab.rig.chip.simulator import CoSim
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import TwinBench

__all__ = ["REFERENCE", "Calibrated", "calibrated_firmware", "chip_correction"]

REFERENCE = (500e-12, 5e3)  # capacitor and resistor in place of the actuator, in F and ohm
_READINGS, _APART_S = 10, 0.1


@dataclass(frozen=True)
class Calibrated:
    """A calibrated microcontroller for co-simulation.

    Args:
        program: the co-simulation.
        firmware: firmware with the correction.
        settings: settings compiled into it.
        correction: capacitance of the reference over the value reported without correction.
    """

    program: Path
    firmware: Firmware
    settings: ChipSettings
    correction: float


def calibrated_firmware(
    settings: ChipSettings, config: TwinConfig, seed: int, folder: Path
) -> Calibrated:
    """Build the firmware, measure a reference capacitor, and build again with the correction.

    Args:
        settings: of the microcontroller.
        config: of the twin.
        seed: of its noise.
        folder: for the programs.
    Returns:
        Programs and settings.
    Raises:
        InputError: A compiler or libsimavr is missing.
        DeviceError: The microcontroller measured no capacitor.
    """
    program = build_cosim(folder)
    plain = build_firmware(settings, folder)
    share = chip_correction(program, plain.elf, config, seed, _reference_f(settings))
    front_end = replace(settings.front_end, correction=settings.front_end.correction * share)
    settings = replace(settings, front_end=front_end)
    return Calibrated(program, build_firmware(settings, folder), settings, share)


def _reference_f(settings: ChipSettings) -> float:
    """Capacitance of the reference: the usual one, or the middle of the valid range."""
    low_f, high_f = settings.capacitance_range_f
    return REFERENCE[0] if low_f < REFERENCE[0] < high_f else 0.5 * (low_f + high_f)


def chip_correction(
    program: Path, elf: Path, config: TwinConfig, seed: int, reference_f: float = REFERENCE[0]
) -> float:
    """Measure `FrontEnd.correction` with a reference capacitor.

    Args:
        program: the co-simulation.
        elf: firmware without a correction.
        config: of the twin.
        seed: of its noise.
        reference_f: capacitance of the reference, within the range of the firmware's strain map.
    Returns:
        Capacitance of the reference over the reported value.
    Raises:
        DeviceError: The microcontroller refused a command, or measured no capacitor.
    """
    with CoSim(program, elf, TwinBench(config, seed)) as chip:
        chip.run(0.02)
        chip.command(f"connect {reference_f} {REFERENCE[1]}")
        chip.arm()
        known = len(chip.messages)
        for _ in range(_READINGS):
            chip.execute(KeepAlive(), _APART_S)
        reported = [m.capacitance_f for m in chip.messages[known:] if isinstance(m, Status)]
    if not reported or min(reported) <= 0.0:
        raise DeviceError(
            f"The microcontroller measured no capacitance in {reported.count(0.0)} of "
            f"{len(reported)} readings of {reference_f:.3g} F. Check the values of [front_end]."
        )
    return reference_f / float(np.mean(reported))
