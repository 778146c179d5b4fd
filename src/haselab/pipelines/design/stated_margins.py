"""Check what [controller], [model] and [drive] state against the rest of their file."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

from haselab.base import InputError
from haselab.control import DesignSpec, LoopSetting, Saturation
from haselab.control.feedthrough import with_feedthrough
from haselab.control.plants.general_loops import loop_variants
from haselab.control.stability.margins import loop_margins
from haselab.models.actuator import ControllerSection
from haselab.pipelines.design.feedback import feedback_of
from haselab.pipelines.design.model_file import loop_of, read_any_plant, read_origin, read_tables
from haselab.store.actuator_file import ACTUATOR

__all__ = ["controller_doubt", "delay_doubt", "drive_doubt", "model_doubt"]

_SAME = 1e-6  # relative difference of a map's coefficients, and of delays
_STABLE = "stable"
_FAR = 100.0  # high_v over the voltages of the map: mV, or V behind the amplifier, typed as V
_WORST = "worst_"  # prefix of a margin over the plants that the design covers
# What is said of each margin, and its absolute and relative tolerance: above the rounding of
# numbers typed by hand, below what matters to a loop.
_STATED = {
    "phase_margin_deg": ("a phase margin of {:.3g} deg", 1.0, 0.0),
    "gain_margin_db": ("a gain margin of {:.3g} dB", 0.5, 0.0),
    "delay_margin_s": ("a delay margin of {:.3g} s", 0.0, 0.05),
    "peak_sensitivity": ("a peak sensitivity of {:.3g}", 0.0, 0.05),
    "crossover_rad_s": ("a crossover at {:.3g} rad/s", 0.0, 0.05),
    "worst_phase_margin_deg": ("a worst phase margin of {:.3g} deg", 1.0, 0.0),
    "worst_gain_margin_db": ("a worst gain margin of {:.3g} dB", 0.5, 0.0),
}


def controller_doubt(path: Path, kind: str | None = None) -> str:
    """Why the margins that a controller states are not those of `[model]` in the same file.

    They are computed again, at the rate and the delay in the controller's own `loop`. They differ
    if the model or the gains changed after the design, or were typed by hand.

    Args:
        path: an actuator file, or the folder of a run.
        kind: kind or name of the controller; None: that of `[controller]`.
    Returns:
        What is wrong and what to do; empty if the margins are right, or if none are stated.
    """
    section = read_tables(path).controller
    held = section if kind is None or section is None else section.all_kinds.get(kind)
    file = path / ACTUATOR if path.is_dir() else path
    if held is None or not held.margins or not file.exists():  # an older run states no margins
        return ""
    try:
        found = _margins(held, file, _loop_of(held, file))
    except InputError as error:
        return f"The margins of [controller] cannot be verified. {error}"
    wrong = [key for key in _STATED if not _agree(key, held.margins, found)]
    if not wrong:
        return ""
    return (
        f"[controller] states {_text(wrong, held.margins)}, but with [model] of the same file the "
        f"{held.name or held.kind} {_found(wrong, found)}. Design it again with: "
        f"{_design(held, file)}"
    )


def delay_doubt(path: Path, kind: str | None = None) -> str:
    """Why a controller was designed for another delay of the loop than `[model]` states.

    A delay belongs to its rate: at another rate, as on a microcontroller, the controller has its
    own.

    Args:
        path: an actuator file, or the folder of a run.
        kind: kind or name of the controller; None: that of `[controller]`.
    Returns:
        What is wrong and what to do; empty if the delays or the margins are the same.
    """
    tables = read_tables(path)
    section = tables.controller
    held = section if kind is None or section is None else section.all_kinds.get(kind)
    file = path / ACTUATOR if path.is_dir() else path
    if held is None or held.loop is None or not file.exists():
        return ""
    if tables.model is None or tables.model.loop_delay_s is None:
        return ""  # the design alone states a delay
    rate_hz, delay_s = loop_of(file, None, None)
    own_hz, own_s = _loop_of(held, file)
    if rate_hz != own_hz or math.isclose(delay_s, own_s, rel_tol=_SAME):
        return ""
    try:
        designed, found = (_margins(held, file, (rate_hz, delay)) for delay in (own_s, delay_s))
    except InputError:
        return ""  # the margins cannot be computed, which controller_doubt says
    if all(_agree(key, designed, found) for key in _STATED):
        return ""
    margin = ["phase_margin_deg"]
    return (
        f"The {held.name or held.kind} was designed for a loop delay of {own_s:g} s, but [model] "
        f"states loop_delay_s = {delay_s:g}, with which it {_found(margin, found)} instead of "
        f"{_text(margin, designed)}. Correct loop_delay_s, or design it again with: "
        f"{_design(held, file)}"
    )


def _design(held: ControllerSection, file: Path) -> str:
    return f"haselab design {file}" + ("" if held.kind == "pid" else f" --controller {held.kind}")


def _loop_of(held: ControllerSection, file: Path) -> tuple[float, float]:
    """Rate and delay that a controller was designed for."""
    loop = held.loop
    return loop_of(
        file,
        None if loop is None else loop.rate_hz,
        None if loop is None else loop.measurement_delay_s,
    )


def _margins(held: ControllerSection, file: Path, loop: tuple[float, float]) -> dict[str, float]:
    """Margins with the model of the file; the worst ones where the section has its demands."""
    rate_hz, delay_s = loop
    feedback, plant = feedback_of(held, rate_hz), read_any_plant(file)
    limits = Saturation() if held.limits is None else Saturation(held.limits.low, held.limits.high)
    setting = with_feedthrough(LoopSetting(rate_hz, delay_s, limits), read_tables(file))
    found = loop_margins(plant, feedback, setting)
    known = {key: getattr(found, key) for key in _STATED if not key.startswith(_WORST)}
    known[_STABLE] = float(found.stable)
    stated = [key for key in _STATED if key.startswith(_WORST) and key in held.margins]
    if not (stated and held.demands):
        return known
    spread = DesignSpec.from_mapping(held.demands).frequency_spread
    every = [
        loop_margins(one, feedback, loop) for one, loop in loop_variants(plant, setting, spread)
    ]
    return known | {
        key: min(getattr(one, key.removeprefix(_WORST)) for one in every) for key in stated
    }


def _agree(key: str, stated: Mapping[str, float], found: Mapping[str, float]) -> bool:
    """Whether two margins are the same; one that is not known agrees with any."""
    if key not in stated or key not in found:
        return True
    _, absolute, relative = _STATED[key]
    one, other = stated[key], found[key]
    return math.isclose(one, other, abs_tol=absolute, rel_tol=relative) or (
        math.isnan(one) and math.isnan(other)
    )


def _found(keys: Sequence[str], values: Mapping[str, float]) -> str:
    """What the loop has; of an unstable loop, only the margins that are numbers."""
    if values[_STABLE]:
        return f"has {_text(keys, values)}"
    finite = [key for key in keys if math.isfinite(values[key])]
    return f"is unstable, with {_text(finite, values)}" if finite else "is unstable"


def _text(keys: Sequence[str], values: Mapping[str, float]) -> str:
    return " and ".join(_said(_STATED[key][0], values[key]) for key in keys)


def _said(text: str, value: float) -> str:
    """A margin in words: "a phase margin of 60 deg", or "no finite phase margin"."""
    if math.isfinite(value):
        return text.format(value)
    return re.sub(r"^a (.+?) (?:of|at) .*", r"no finite \1", text)


def drive_doubt(path: Path) -> str:
    """Why `high_v` of `[drive]` is not in the unit of the voltage map.

    Args:
        path: an actuator file, or the folder of a run.
    Returns:
        What is wrong and what to do; empty if both may be in the same unit, or if one is missing.
    """
    tables = read_tables(path)
    high_v, table = tables.drive.high_v, tables.drive.voltage_map
    if high_v is None or table is None:
        return ""
    ends = [table.strain_low, table.strain_high]
    most_v = float(table.map().voltage_v(ends).max())
    if not high_v > _FAR * most_v > 0.0:
        return ""
    file = path / ACTUATOR if path.is_dir() else path
    return (
        f"high_v in [drive] is {high_v:g} V, but [drive.voltage_map] gives at most {most_v:.3g} V "
        f"from a strain of {ends[0]:g} to {ends[1]:g}. State high_v in V before the amplifier, as "
        f"the map: {file}"
    )


def model_doubt(path: Path) -> str:
    """Why `[model]` does not describe the loop with the voltage map of its file.

    Args:
        path: an actuator file, or the folder of a run.
    Returns:
        What is wrong and what to do; empty if the model was identified through this map, or if
        the file does not say through which one.
    """
    tables = read_tables(path)
    file, table = path / ACTUATOR if path.is_dir() else path, tables.drive.voltage_map
    if table is None or tables.model is None or not tables.model.model_extra or not file.exists():
        return ""
    used, now = read_origin(file).through_voltage_map, table.coefficients
    if not used or all(math.isclose(a, b, rel_tol=_SAME) for a, b in zip(used, now, strict=True)):
        return ""
    return (
        "[model] was identified through another [drive.voltage_map] than the one in the file. "
        "Identify it again with: haselab identify transfer FILE --through-voltage-map --actuator "
        f"{file}"
    )
