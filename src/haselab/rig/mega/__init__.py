"""The ATmega2560: its firmware built from a checkout, and run in co-simulation with the twin."""

from haselab.rig.mega.build import Firmware, build_cosim, build_firmware, checkout, find_tool
from haselab.rig.mega.simulator import CoSim, Output, Track

__all__ = [
    "CoSim",
    "Firmware",
    "Output",
    "Track",
    "build_cosim",
    "build_firmware",
    "checkout",
    "find_tool",
]
