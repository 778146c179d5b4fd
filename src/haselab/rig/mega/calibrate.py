"""What a chip reads of a reference capacitor."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from haselab.base import DeviceError
from haselab.firmware.messages import KeepAlive, Status
from haselab.rig.mega.simulator import CoSim
from haselab.rig.twin.bench import TwinBench
from haselab.rig.twin.config import TwinConfig

__all__ = ["REFERENCE", "chip_correction"]

REFERENCE = (500e-12, 5e3)  # capacitor and resistor in the actuator's place, in F and ohm
_READINGS, _APART_S = 10, 0.1


def chip_correction(program: Path, elf: Path, config: TwinConfig, seed: int) -> float:
    """What a reference capacitor reads, turned over: `FrontEnd.correction`.

    Args:
        program: of the co-simulation.
        elf: a firmware without a correction.
        config: of the twin.
        seed: of its noise.
    Returns:
        Capacitance of the reference over the one that the chip tells.
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
        told = [m.capacitance_f for m in chip.messages[known:] if isinstance(m, Status)]
    if not told or min(told) <= 0.0:
        raise DeviceError(
            f"The chip saw no capacitor of {REFERENCE[0]:g} F in {told.count(0.0)} of {len(told)} "
            "readings; needed is one in each. Check the front end's numbers."
        )
    return REFERENCE[0] / float(np.mean(told))
