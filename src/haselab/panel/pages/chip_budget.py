"""Flash, RAM and processor time of a PID on the microcontroller, measured in co-simulation."""

from __future__ import annotations

from dataclasses import asdict, replace

from haselab.base import DeviceError, JsonObject, ResultError
from haselab.panel.files import PanelFiles
from haselab.panel.pages.design import CHIP, gains_of, opened
from haselab.rig.chip import load_board, read_design
from haselab.rig.rig_file import TwinFile, load_rig
from haselab.rig.twin.config import twin_of_reading
from haselab.study.chip.loops import UPDATE_CYCLES, StepPlan, chip_experiment

__all__ = ["chip_budget"]

_BOARD = "atmega2560"
_FLASH_BYTES, _RAM_BYTES = 256 * 1024, 8 * 1024  # of the ATmega2560, data sheet
_CLOSED_S = 1.0  # of the loop at zero strain
_SEED = 1


def chip_budget(files: PanelFiles, values: JsonObject) -> JsonObject:
    """Compile the firmware with the gains of a page, and close its loop on a twin for a second.

    Args:
        files: that the panel was started with; the twin is that of the rig file, else that of the
            reference study.
        values: the gains.
    Returns:
        Use of flash, RAM and processor, each beside what the microcontroller has.
    Raises:
        InputError: Something in the actuator file, the compiler or libsimavr is missing.
        ResultError: The loop is unstable on the microcontroller, or it tripped.
    """
    loop, gains = opened(files), gains_of(values)
    loop.require_pid()
    if not loop.margins(gains, CHIP).stable:
        raise ResultError(
            f"Not measured: with these gains the loop is unstable on the microcontroller, at "
            f"{CHIP.rate_hz:g} Hz with a delay of {1e3 * CHIP.measurement_delay_s:.3g} ms. "
            "Change the gains until it is stable."
        )
    design = read_design(loop.path, None, load_board(_BOARD).front_end)
    settings = replace(design.settings, **asdict(gains))
    file = load_rig(files.rig)
    is_twin = isinstance(file, TwinFile)
    twin = file.configuration(files.rig) if isinstance(file, TwinFile) else twin_of_reading("hz")
    plan = StepPlan(0.0, 0.0, 0.5 * _CLOSED_S, 0.5 * _CLOSED_S, 1.0)  # the strain is not used
    try:
        chip, made = chip_experiment(settings, twin, _SEED, plan)
    except DeviceError as error:
        where = "the twin of the rig file" if is_twin else "the twin of the reference study"
        raise ResultError(
            f"Not measured: the microcontroller stopped its loop on {where}. {error}"
        ) from None
    return {
        "flash_bytes": made.firmware.flash_bytes,
        "flash_bytes_available": _FLASH_BYTES,
        "ram_bytes": made.firmware.static_bytes + chip.stack_bytes,
        "ram_bytes_available": _RAM_BYTES,
        "longest_update_cycles": chip.busy_cycles,
        "cycles_of_an_update": UPDATE_CYCLES,
        "load": chip.load,
        "overruns": chip.overruns,
    }
