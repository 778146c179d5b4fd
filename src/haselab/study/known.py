"""Values of an actuator file, for a study that does not find them itself."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Mapping

from pydantic import ValidationError

from haselab.base import InputError
from haselab.controllers import CONTROLLERS, KnownActuator, known_actuator
from haselab.models.actuator import ActuatorTables
from haselab.models.maps import allow_start
from haselab.study.definition import Study
from haselab.study.fits.maps import Maps, require_open_steps
from haselab.study.fits.resolution import ZERO_PX
from haselab.study.own_controller import own_controller
from haselab.study.tables import Control, OperatingPoint

__all__ = ["known_values", "with_actuator_tables"]

_SAME_STRAIN = 1e-9  # the limits of a design are this reach, as decimal numbers


def known_values(tables: ActuatorTables) -> dict[type, object]:
    """Values that experiments may request by type, if the study itself does not find them.

    Args:
        tables: of the actuator file.
    Returns:
        The maps, if the file has both of them and the length at zero strain; the physical model,
        if the file has all that a controller needs of it.
    """
    length_m, drive = tables.actuator.geometry.zero_length_m, tables.drive
    found: dict[type, object] = {}
    with contextlib.suppress(InputError):  # of a model that no controller of the study may need
        if (actuator := known_actuator(tables)) is not None:
            found[KnownActuator] = actuator
    if length_m is None or tables.sensing.strain_map is None or drive.voltage_map is None:
        return found
    maps = Maps(length_m, tables.voltage_map(), tables.strain_map(), {}, {}, {}, ZERO_PX)
    return found | {Maps: maps}


def with_actuator_tables(study: Study, tables: ActuatorTables) -> Study:
    """Complete a study with the voltage of zero strain and the controller of an actuator file.

    Args:
        study: as in its file; its own settings are kept.
        tables: of the actuator file.
    Returns:
        The study; with `[steps]` and without `[control]`, its `custom_trials` use the controller
        of the actuator file, within its limits.
    Raises:
        InputError: the controller's kind is not registered, does not accept its parameters, or has
            no limits; or the drive or the controller does not reach the step.
    """
    changes: dict[str, object] = {}
    open_point = study.operating_point.baseline_v is None and not study.has("triangle")
    if open_point and tables.drive.voltage_map is not None:
        baseline_v = _baseline_v(tables)
        changes["operating_point"] = OperatingPoint(baseline_v=baseline_v)
    held = tables.controller
    if study.has("steps") and not study.has("control") and held is not None and held.is_known:
        if held.limits is None:
            raise InputError(
                "[controller] has no limits, the range of its output. Design it with haselab "
                "design, or add limits = {low = -0.05, high = 0.1}."
            )
        chosen = CONTROLLERS.find(held.kind).choose(_given(held.parameters, held.kind))
        low, high = held.limits.low, held.limits.high
        try:
            changes["control"] = Control(
                kind=held.kind,
                parameters=dict(chosen.values),
                saturation_low=low,
                saturation_high=high,
            )
        except ValidationError as error:
            reasons = "; ".join(str(one["msg"]) for one in error.errors())
            raise InputError(
                f"[controller] has limits of {low:g} to {high:g}, and a study cannot use them: "
                f"{reasons}. Give other --limits to 'haselab design'."
            ) from None
    complete = study.model_copy(update=changes)
    if study.has("steps") and not study.has("triangle") and tables.drive.voltage_map is not None:
        _require_steps(complete, tables)
    return complete


def _require_steps(study: Study, tables: ActuatorTables) -> None:
    """Refuse a step beyond the reach of the voltage map in open loop, or of the controller.

    A controller that puts out a voltage reaches what the physical model says, not the map.

    Raises:
        InputError: the drive or the controller does not reach it.
    """
    to_volt, step, own = tables.voltage_map(), study.steps.step, own_controller(study)
    low_v, high_v = tables.drive_ends_v()
    ends_v = -math.inf if low_v is None else low_v, math.inf if high_v is None else high_v
    closed, low, high = "", -math.inf, math.inf
    if own is not None and own.kind.output == "voltage":
        actuator = known_actuator(tables)
        physical = (-math.inf, math.inf) if actuator is None else actuator.reachable()
        low = max(study.control.saturation_low, physical[0] - _SAME_STRAIN)
        high = min(study.control.saturation_high, physical[1] + _SAME_STRAIN)
        closed = (
            f"The controller {own.kind.name!r} puts out a voltage and reaches {low:.3g} to "
            f"{high:.3g} by the physical model: play it alone with open_trials = 0."
        )
    if study.steps.open_trials:
        require_open_steps(to_volt, step, *ends_v, closed if low <= step <= high else "")
    elif not closed:
        require_open_steps(to_volt, step, *ends_v)
    if not low <= step <= high:
        assert own is not None
        raise InputError(
            f"step = {step:g} in [steps] is a strain that the controller {own.kind.name!r} does "
            f"not reach. Choose a step between {low:.4g} and {high:.4g}."
        )


def _baseline_v(tables: ActuatorTables) -> float:
    """Voltage of zero strain, or the end of the drive if zero strain is just outside."""
    to_volt, (low_v, high_v) = tables.voltage_map(), tables.drive_ends_v()
    voltage_v = float(to_volt.voltage_v(0.0))
    reach = to_volt.reach(
        (to_volt.strain_low, to_volt.strain_high),
        -math.inf if low_v is None else low_v,
        math.inf if high_v is None else high_v,
    )
    if reach is None or reach[0] <= 0.0 <= reach[1] or not allow_start(reach):
        return voltage_v
    return float(to_volt.voltage_v(min(reach, key=abs)))


def _given(parameters: Mapping[str, float], kind: str) -> dict[str, object]:
    """Parameters of a controller; a designed PI states the gains of a PID, some of them 0."""
    absent = ("kd", "derivative_filter_s") if kind == "pi" else ()
    return {name: value for name, value in parameters.items() if name not in absent or value}
