"""What a chip reads of a reference capacitor."""

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

REFERENCE = (500e-12, 5e3)  # capacitor and resistor in the actuator's place, in F and ohm
_READINGS, _APART_S = 10, 0.1


@dataclass(frozen=True)
class Calibrated:
    """A chip ready for co-simulation.

    Args:
        program: the co-simulation.
        firmware: with the correction.
        settings: that it holds.
        correction: capacitance of the reference over the one that was reported without it.
    """

    program: Path
    firmware: Firmware
    settings: ChipSettings
    correction: float


def calibrated_firmware(
    settings: ChipSettings, config: TwinConfig, seed: int, folder: Path
) -> Calibrated:
    """Build, read a reference capacitor, and build again with what it reported.

    Args:
        settings: of the chip.
        config: of the twin.
        seed: of its noise.
        folder: where programs go.
    Returns:
        Programs and settings.
    Raises:
        InputError: a compiler or libsimavr is missing.
        DeviceError: the chip saw no capacitor.
    """
    program = build_cosim(folder)
    plain = build_firmware(settings, folder)
    share = chip_correction(program, plain.elf, config, seed)
    front_end = replace(settings.front_end, correction=settings.front_end.correction * share)
    settings = replace(settings, front_end=front_end)
    return Calibrated(program, build_firmware(settings, folder), settings, share)


def chip_correction(program: Path, elf: Path, config: TwinConfig, seed: int) -> float:
    """What a reference capacitor reads, turned over: `FrontEnd.correction`.

    Args:
        program: of the co-simulation.
        elf: a firmware without a correction.
        config: of the twin.
        seed: of its noise.
    Returns:
        Capacitance of the reference over the one that the chip reports.
    Raises:
        DeviceError: the chip refused a command, or saw no capacitor.
    """
    with CoSim(program, elf, TwinBench(config, seed)) as chip:
        chip.run(0.02)
        chip.command(f"connect {REFERENCE[0]} {REFERENCE[1]}")
        chip.arm()
        known = len(chip.messages)
        for _ in range(_READINGS):
            chip.tell(KeepAlive(), _APART_S)
        reported = [m.capacitance_f for m in chip.messages[known:] if isinstance(m, Status)]
    if not reported or min(reported) <= 0.0:
        raise DeviceError(
            f"The chip saw no capacitor of {REFERENCE[0]:g} F in {reported.count(0.0)} of "
            f"{len(reported)} readings; every one has to show it. Check the front end's numbers."
        )
    return REFERENCE[0] / float(np.mean(reported))
