"""Read the settings of a microcontroller from an actuator file or a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from haselab.base import InputError
from haselab.controllers import ControllerSetting, known_actuator
from haselab.controllers.chip.loop import chip_setting
from haselab.firmware import (
    HIGHEST_DRIVE_V,
    MOTION_RISE_V_PER_S,
    ChipSettings,
    ControllerStep,
    FrontEnd,
)
from haselab.models.actuator import ActuatorTables
from haselab.models.actuator.sections import ControllerSection
from haselab.models.maps import VoltageMap, allow_start, require_start
from haselab.models.plant import Plant
from haselab.rig.chip.own_step import controller_step
from haselab.store.actuator_file import read_run
from haselab.store.toml import validated

__all__ = ["ChipDesign", "ModuleLimits", "read_design", "strains_within"]

_NO_GAINS = {"kp": 0.0, "ki": 0.0}


@dataclass(frozen=True)
class ModuleLimits:
    """What a high-voltage module reaches, where it is less than the microcontroller.

    Args:
        drive_high_v: highest drive; None: that of the output.
        rise_v_per_s: fastest change of the drive; None: that of the firmware.
    """

    drive_high_v: float | None = None
    rise_v_per_s: float | None = None


_ANY_MODULE = ModuleLimits()


@dataclass(frozen=True)
class ChipDesign:
    """A controller for a microcontroller and the actuator for which it was designed.

    Args:
        tables: the actuator file.
        settings: settings to compile in.
        path: of the actuator file or the run, for messages.
        limits: of the controller's output, as designed. Those of the settings are narrower if the
            microcontroller's output does not reach them.
    """

    tables: ActuatorTables
    settings: ChipSettings
    path: Path
    limits: tuple[float, float]

    @property
    def plant(self) -> Plant:
        """The identified plant.

        Raises:
            InputError: There is none, or it has another form.
        """
        try:
            return self.tables.plant()
        except InputError as error:
            raise InputError(f"{error} {self.path}") from None

    @property
    def zero_length_m(self) -> float:
        """Length of the actuator at zero strain, in m.

        Raises:
            InputError: The file does not contain it.
        """
        length_m = self.tables.actuator.geometry.zero_length_m
        if length_m is None:
            raise InputError(
                "[actuator.geometry] has no zero_length_m, the length at zero strain in m. Add it, "
                f"or give it with: haselab init NAME --zero-length-m. {self.path}"
            )
        return length_m


def read_design(
    path: Path,
    kind: str | None,
    front_end: FrontEnd,
    source: Path | None = None,
    module: ModuleLimits = _ANY_MODULE,
) -> ChipDesign:
    """Read the settings of a microcontroller from an actuator file or the folder of a run.

    Args:
        path: of the actuator file or the folder, also of older runs.
        kind: of a controller in the file; None: the one of [controller], or with a
            source that of its name.
        front_end: of the board.
        source: C file compiled in place of the PID; None: the C step of the kind. PI and PID need
            none.
        module: limits of the high-voltage module, for a C step that is written for them.
    Returns:
        The settings, with continuous-time gains that are stepped at the microcontroller's rate. The
        drive is limited by `[drive] high_v`, the highest field and the microcontroller's output,
        and the controller's output to the strains that this drive reaches.
    Raises:
        InputError: Something is missing or not valid, or the kind has no C step.
    """
    tables = validated(ActuatorTables, read_run(path), path)
    try:
        settings, limits = _settings(tables, kind, front_end, source, module)
        return ChipDesign(tables, settings, path, limits)
    except InputError as error:
        text = str(error)
        raise InputError(text if str(path) in text else f"{text} {path}") from None


def _settings(
    tables: ActuatorTables,
    kind: str | None,
    front_end: FrontEnd,
    source: Path | None,
    module: ModuleLimits,
) -> tuple[ChipSettings, tuple[float, float]]:
    """Settings, and the limits of the controller as designed."""
    low_v, high_v = tables.drive_ends_v()
    most_v = [
        value for value in (HIGHEST_DRIVE_V, high_v, module.drive_high_v) if value is not None
    ]
    rise_v_per_s = module.rise_v_per_s or MOTION_RISE_V_PER_S

    def setting() -> ControllerSetting | None:
        known = known_actuator(tables)
        return None if known is None else chip_setting(known, min(most_v), rise_v_per_s)

    controller, step = _controller(tables, kind, source, setting)
    volt, strain = tables.voltage_map(), tables.strain_map()
    limits = controller.limits
    if limits is None and tables.controller is not None:
        limits = tables.controller.limits
    if limits is None:
        raise InputError(
            "[controller] has no limits of its output. Design it with haselab design, or add "
            "limits = {low = -0.05, high = 0.1}."
        )
    require_start((limits.low, limits.high))
    if step is None:
        _check_units(tables)
    gains = _NO_GAINS if step is not None else _gains(controller)
    high_v = HIGHEST_DRIVE_V if high_v is None else min(HIGHEST_DRIVE_V, high_v)
    designed = (limits.low, limits.high)
    settings = ChipSettings(
        gains["kp"],
        gains["ki"],
        gains.get("kd", 0.0),
        gains.get("derivative_filter_s", 0.0),
        *strains_within(designed, volt, high_v, max(low_v or 0.0, 0.0)),
        (volt.a1_v, volt.b1, volt.a2_v, volt.b2),
        strain.coefficients,
        front_end,
        drive_high_v=high_v,
        own=step,
        usable_f=None if strain.range_f is None else strain.usable_f,
    )
    if step is not None and step.in_volts:
        settings = replace(settings, rise_v_per_s=rise_v_per_s)
    return settings, designed


def _check_units(tables: ActuatorTables) -> None:
    """Refuse gains for a model that is not from strain to strain, as the maps are."""
    stated = {} if tables.model is None else tables.model.model_extra or {}
    for key, end in (("input_unit", "input"), ("output_unit", "output")):
        unit = stated.get(key)
        if unit not in (None, "", "1"):
            raise InputError(
                f"The {end} of [model] is in {unit}, but the maps of this file are for a loop from "
                "strain to strain. Identify the model again with the strain as output and with "
                "--through-voltage-map, and design the controller again."
            )


def strains_within(
    limits: tuple[float, float], to_volt: VoltageMap, high_v: float, low_v: float = 0.0
) -> tuple[float, float]:
    """Narrow the limits of a controller's output to what a microcontroller's output reaches.

    Args:
        limits: lowest and highest strain.
        to_volt: strain to drive voltage.
        high_v: highest drive, in V.
        low_v: lowest drive, in V.
    Returns:
        The narrower limits; unchanged if these would exclude zero strain, which `ChipSettings`
        refuses.
    """
    found = to_volt.reach(limits, low_v, high_v)
    return limits if found is None or not allow_start(found) else found


def _controller(
    tables: ActuatorTables,
    kind: str | None,
    source: Path | None,
    setting: Callable[[], ControllerSetting | None],
) -> tuple[ControllerSection, ControllerStep | None]:
    """Find the controller of a kind, and its C step; None for the firmware's PID."""
    if source is not None and kind is None:
        held = tables.controller or ControllerSection()
        controller = held.all_kinds.get(source.stem, ControllerSection(kind=source.stem))
    else:
        controller = tables.designed(kind)
    if source is None and controller.kind in ("pi", "pid"):
        return controller, None
    return controller, controller_step(controller, source, setting)


def _gains(controller: ControllerSection) -> Mapping[str, float]:
    lacking = [name for name in ("kp", "ki") if name not in controller.parameters]
    if lacking:
        raise InputError(
            f"[controller.parameters] lacks {', '.join(lacking)}, which a {controller.kind} "
            "controller needs. Design it with haselab design, or add the number."
        )
    return controller.parameters
