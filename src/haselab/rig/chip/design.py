"""What a chip is built from: the maps, limits and gains of an actuator file or a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from haselab.base import InputError
from haselab.firmware import ChipSettings, FrontEnd
from haselab.models.actuator import ActuatorTables
from haselab.models.plant import Plant
from haselab.store.actuator_file import read_run
from haselab.store.toml import validated

__all__ = ["ChipDesign", "read_design"]

_HIGHEST_DRIVE_V = 1.9  # of the chip's output, whose converter ends at 2.048 V


@dataclass(frozen=True)
class ChipDesign:
    """A controller for a chip and the actuator that it was designed for.

    Args:
        tables: the actuator file.
        settings: what is compiled in.
        path: of the actuator file or the run, for messages.
    """

    tables: ActuatorTables
    settings: ChipSettings
    path: Path

    @property
    def plant(self) -> Plant:
        """The identified plant.

        Raises:
            InputError: there is none, or one of another kind.
        """
        try:
            return self.tables.plant()
        except InputError as error:
            raise InputError(f"{error} {self.path}") from None

    @property
    def zero_length_m(self) -> float:
        """Length of the actuator at zero strain, in m.

        Raises:
            InputError: the file does not hold it.
        """
        length_m = self.tables.actuator.geometry.zero_length_m
        if length_m is None:
            raise InputError(
                "[actuator.geometry] has no zero_length_m, the length at zero strain in m. Add it, "
                f"or give it with: haselab init NAME --zero-length-m. {self.path}"
            )
        return length_m


def read_design(path: Path, kind: str, front_end: FrontEnd) -> ChipDesign:
    """The settings of a chip from an actuator file or the folder of a run.

    Args:
        path: of the actuator file or the folder; older runs too.
        kind: of the controller, "pi" or "pid".
        front_end: of the chip's board.
    Returns:
        The settings; the gains are those of continuous time, stepped at the chip's rate. The drive
        goes no higher than `[drive] high_v`.
    Raises:
        InputError: something is missing or unusable.
    """
    tables = validated(ActuatorTables, read_run(path), path)
    try:
        return ChipDesign(tables, _settings(tables, kind, front_end), path)
    except InputError as error:
        text = str(error)
        raise InputError(text if str(path) in text else f"{text} {path}") from None


def _settings(tables: ActuatorTables, kind: str, front_end: FrontEnd) -> ChipSettings:
    controller = tables.designed(kind)
    volt, strain = tables.voltage_map(), tables.strain_map()
    if controller.limits is None:
        raise InputError(
            "[controller] has no limits, the range of its output. Design it with haselab design, "
            "or add limits = {low = -0.05, high = 0.1}."
        )
    gains = controller.parameters
    lacking = [name for name in ("kp", "ki") if name not in gains]
    if lacking:
        raise InputError(
            f"[controller.parameters] lacks {', '.join(lacking)}, which a {kind} controller needs. "
            "Design it with haselab design, or add the number."
        )
    high_v = tables.drive.high_v
    return ChipSettings(
        gains["kp"],
        gains["ki"],
        gains.get("kd", 0.0),
        gains.get("derivative_filter_s", 0.0),
        controller.limits.low,
        controller.limits.high,
        (volt.a1_v, volt.b1, volt.a2_v, volt.b2),
        strain.coefficients,
        front_end,
        drive_high_v=_HIGHEST_DRIVE_V if high_v is None else min(_HIGHEST_DRIVE_V, high_v),
    )
