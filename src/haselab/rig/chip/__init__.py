"""The microcontroller: build its firmware, use it as a rig, and simulate it with the twin."""

from haselab.rig.chip.boards import Board, board_names, load_board, source_folder
from haselab.rig.chip.build import Firmware, build_cosim, build_firmware, find_tool
from haselab.rig.chip.calibrate import (
    REFERENCE,
    Calibrated,
    calibrated_firmware,
    chip_correction,
)
from haselab.rig.chip.chip_bench import ChipBench
from haselab.rig.chip.design import ChipDesign, ModuleLimits, read_design
from haselab.rig.chip.opening import (
    ChipFile,
    ConnectedChip,
    key_of_port,
    opened_chip,
)
from haselab.rig.chip.serial_link import SerialChip
from haselab.rig.chip.simulator import CoSim, Output, Track
from haselab.rig.chip.supplied import SuppliedCoSim, SupplyModel, SupplyOutput

__all__ = [
    "REFERENCE",
    "Board",
    "Calibrated",
    "ChipBench",
    "ChipDesign",
    "ChipFile",
    "CoSim",
    "ConnectedChip",
    "Firmware",
    "ModuleLimits",
    "Output",
    "SerialChip",
    "SuppliedCoSim",
    "SupplyModel",
    "SupplyOutput",
    "Track",
    "board_names",
    "build_cosim",
    "build_firmware",
    "calibrated_firmware",
    "chip_correction",
    "find_tool",
    "key_of_port",
    "load_board",
    "opened_chip",
    "read_design",
    "source_folder",
]
