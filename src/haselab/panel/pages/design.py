"""The Design page: margins, frequency response and step of the identified model, and writing."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from haselab import __version__
from haselab.base import HaselabError, InputError, JsonObject, ResultError
from haselab.control import (
    Design,
    LinearController,
    LoopSetting,
    PidGains,
    design_controller,
    loop_response,
)
from haselab.control.feedthrough import with_feedthrough
from haselab.control.plants.general import AnyPlant, PlantScale
from haselab.control.plausible_design import evaluate_controller
from haselab.control.predicted_step import predicted_step
from haselab.control.reach import default_step
from haselab.control.stability.margins import Margins, frequency_grid, loop_margins
from haselab.firmware.settings import RATE_HZ, UPDATE_DELAY_S
from haselab.models.actuator import ControllerSection
from haselab.panel.files import PanelFiles
from haselab.panel.pages.values import number
from haselab.pipelines.design.answer import margins_answer, plausible_sentence
from haselab.pipelines.design.feedback import feedback_of
from haselab.pipelines.design.model_file import (
    loop_of,
    read_any_plant,
    read_origin,
    read_posterior,
    read_tables,
)
from haselab.pipelines.design.sections import (
    CONTROLLER_KEYS,
    controller_section,
    demands_of,
    limits_of,
    other_controllers,
)
from haselab.pipelines.design.stated_margins import controller_doubt, model_doubt
from haselab.store.actuator_file import ACTUATOR, Provenance, hashed, write_section

__all__ = ["CHIP", "DESIGN_REQUESTS", "DesignedLoop", "gains_of", "opened"]

CHIP = LoopSetting(float(RATE_HZ), UPDATE_DELAY_S)

Floats = NDArray[np.float64]
_POINTS = 300  # of a frequency response, besides those near the resonance
_SLOWEST = 0.03  # lowest frequency shown, relative to the slowest pole
_SHOWN_CROSSOVERS = 20.0  # length of the step, in periods of the crossover divided by 2 pi
_LONGEST_S = 30.0
_SETTLED = 0.02  # relative to the step
_MOST_SAMPLES = 4000
_LEAST, _MOST = 1e-12, 1e12  # gains
_NO_FILE = (
    "The panel was started with --rig, but without an actuator file. Start it with --actuator "
    "ACTUATOR.toml. A study with [triangle], [chirp] and [steps] writes such a file, "
    "actuator.toml, into the folder of its recording. For a file from example records, run: "
    "haselab example actuator --out example"
)
_NO_UNCERTAINTY = "no uncertainty: [model] has no covariance"


@dataclass(frozen=True)
class DesignedLoop:
    """The model of an actuator file, and the loop that its controller closes.

    Args:
        path: of the file.
        sha256: of its contents.
        plant: the model.
        setting: rate, delay and limits; default limits if they are not known.
        held: the controller; None: the file has none.
        no_limits: why the limits are not known; empty: they are.
    """

    path: Path
    sha256: str
    plant: AnyPlant
    setting: LoopSetting
    held: ControllerSection | None
    no_limits: str = ""

    @property
    def is_pid(self) -> bool:
        """Whether the gains can be changed: of a PI or PID, or of none yet."""
        return self.held is None or self.held.kind in ("pi", "pid")

    def feedback(self) -> PidGains | LinearController:
        """The controller as linear feedback; without a controller gains of 0."""
        if self.held is None:
            return PidGains(0.0, 0.0)
        return feedback_of(self.held, self.setting.rate_hz)

    def margins(
        self, gains: PidGains | LinearController, setting: LoopSetting | None = None
    ) -> Margins:
        """Margins of the loop, as `haselab margins` computes them."""
        return loop_margins(self.plant, gains, setting or self.setting)

    def require_limits(self) -> None:
        """Refuse a loop whose limits are not known."""
        if self.no_limits:
            raise InputError(self.no_limits)

    def require_pid(self) -> None:
        """Refuse to change the gains of a controller that has none."""
        if self.held is not None and not self.is_pid:
            raise InputError(
                f"The controller of the file has kind = {self.held.kind!r}, but this page changes "
                f"only the gains of a PI or PID. Edit its parameters in the file: {self.path}"
            )


def opened(files: PanelFiles) -> DesignedLoop:
    """Read the model and the controller of the panel's actuator file.

    Args:
        files: that the panel was started with.
    Returns:
        The loop, of the file as it is now.
    Raises:
        InputError: There is no file, it has no model, or a value in it is not valid.
    """
    if files.actuator is None:
        raise InputError(_NO_FILE)
    path = files.actuator / ACTUATOR if files.actuator.is_dir() else files.actuator
    tables, (sha256, *_) = read_tables(path), [*hashed([path]).values(), ""]
    plant, section = read_any_plant(path), tables.controller
    held = None if section is None or not section.all_kinds else tables.designed()
    loop = None if held is None else held.loop
    usual = (None, None) if loop is None else (loop.rate_hz, loop.measurement_delay_s)
    setting = LoopSetting(*loop_of(path, None, None, usual))
    try:
        setting = replace(setting, saturation=limits_of(path, None))
    except HaselabError as error:
        setting = with_feedthrough(setting, tables)
        return DesignedLoop(path, sha256, plant, setting, held, str(error))
    return DesignedLoop(path, sha256, plant, with_feedthrough(setting, tables), held)


def gains_of(values: JsonObject) -> PidGains:
    """Read the gains that a page has sent.

    Args:
        values: kp, ki, kd and derivative_filter_s.
    Returns:
        The gains.
    Raises:
        InputError: One is missing, is not a number of 0 or more, or is extreme.
    """
    gains = PidGains(*(number(values, field.name) for field in fields(PidGains)))
    for name, value in asdict(gains).items():
        if value and not _LEAST <= value <= _MOST:  # beyond, products of gains overflow
            raise InputError(f"{name} is {value:g}, but it must be 0, or {_LEAST:g} to {_MOST:g}.")
    return gains


def _overview(files: PanelFiles, values: JsonObject) -> JsonObject:
    """What the page shows first: the controller of the file, and what its gains may be."""
    if files.actuator is None:
        return {"none": _NO_FILE}
    loop = opened(files)
    held, gains, origin = loop.held, loop.feedback(), read_origin(loop.path)
    warnings = [model_doubt(loop.path), loop.no_limits]
    warnings.append(controller_doubt(loop.path) if held is not None else "")
    answer: JsonObject = {
        "file": str(loop.path),
        "sha256": loop.sha256,
        "kind": None if held is None else held.name or held.kind,
        "is_pid": loop.is_pid,
        "loop": {
            "rate_hz": loop.setting.rate_hz,
            "delay_s": loop.setting.measurement_delay_s,
        },
        "output": origin.output,
        "unit": "" if origin.output_unit == "1" else origin.output_unit,
        "warnings": [text for text in warnings if text],
    }
    if isinstance(gains, PidGains):
        return answer | {"gains": asdict(gains), "ranges": _ranges(loop, gains)}
    return answer | {"found": _response(loop, gains, loop.margins(gains))}


def _ranges(loop: DesignedLoop, gains: PidGains) -> JsonObject:
    """Highest value of each slider: far beyond the gains that a design would try."""
    scale, period_s = PlantScale.of(loop.plant), 1.0 / loop.setting.rate_hz
    gain = abs(scale.gain) or 1.0
    highest = PidGains(
        10.0 / gain,
        5.0 * scale.fast_rad_s / gain,
        10.0 / (gain * scale.fast_rad_s),
        2.0 * max(3.0 / scale.fast_rad_s, 2.0 * period_s),
    )
    present = asdict(gains)
    return {name: max(most, 2.0 * present[name]) for name, most in asdict(highest).items()}


def _evaluate(files: PanelFiles, values: JsonObject) -> JsonObject:
    """Margins, frequency response and step with the gains of the page."""
    loop = opened(files)
    loop.require_pid()
    gains = gains_of(values)
    found = loop.margins(gains)
    at_chip = replace(CHIP, feedthrough=loop.setting.feedthrough)
    chip = margins_answer(loop.margins(gains, at_chip), CHIP)
    step = None if loop.no_limits else _step(loop, gains, found)
    return _response(loop, gains, found) | {"gains": asdict(gains), "chip": chip, "step": step}


def _response(loop: DesignedLoop, gains: PidGains | LinearController, found: Margins) -> JsonObject:
    """Margins, and the frequency responses of the open loop and of the plant."""
    setting, plant = loop.setting, loop.plant
    omega = frequency_grid(plant, PidGains(1.0, 0.0), setting.rate_hz, _POINTS)
    poles = np.abs(np.asarray(plant.poles, dtype=complex))
    slowest = poles[poles > 0.0].min() if (poles > 0.0).any() else omega[-1]
    omega = omega[omega >= _SLOWEST * slowest]
    delay_s = plant.delay_s + setting.measurement_delay_s
    with np.errstate(divide="ignore", invalid="ignore"):  # a pole may be on the axis
        open_loop = loop_response(
            plant, gains, omega, loop_delay_s=setting.measurement_delay_s, rate_hz=setting.rate_hz,
            feedthrough=setting.feedthrough,
        )  # fmt: skip
        alone = np.asarray(plant.frequency_response(omega))
    return {
        "sha256": loop.sha256,
        "margins": margins_answer(found, setting),
        "bode": {
            "frequency_hz": omega / (2.0 * math.pi),
            "loop": _decibels_and_degrees(open_loop, omega, delay_s),
            "plant": _decibels_and_degrees(alone, omega, plant.delay_s),
        },
    }


def _decibels_and_degrees(
    response: NDArray[np.complex128], omega_rad_s: Floats, delay_s: float
) -> JsonObject:
    """Magnitude and phase; the phase of the delay is added after unwrapping that of the rest."""
    late = omega_rad_s * delay_s
    with np.errstate(divide="ignore", invalid="ignore"):
        rest = np.angle(response * np.exp(1j * late))
        magnitude_db = 20.0 * np.log10(np.abs(response))
    known = np.isfinite(rest)
    phase = np.full(rest.shape, math.nan)
    phase[known] = np.unwrap(rest[known]) - late[known]
    return {"magnitude_db": magnitude_db, "phase_deg": np.degrees(phase)}


def _step(loop: DesignedLoop, gains: PidGains, found: Margins) -> JsonObject:
    """Step of the closed loop, saturation included, over a time of 1, 2 or 5 times 10^n s.

    The time is long enough for several oscillations, and for a stable loop to settle.
    """
    setting, crossover_rad_s = loop.setting, found.crossover_rad_s
    longest_s = min(_LONGEST_S, _MOST_SAMPLES / setting.rate_hz)
    size = demands_of(loop.path).step or default_step(loop.plant, setting.saturation)
    step = predicted_step(loop.plant, gains, setting, size, longest_s)
    wanted_s = _SHOWN_CROSSOVERS / crossover_rad_s if crossover_rad_s > 0.0 else _LONGEST_S
    if found.stable:
        moving = np.abs(step.measured - step.measured[-1]) > _SETTLED * abs(size)
        wanted_s = max(wanted_s, 1.5 * float(step.time_s[moving].max(initial=0.0)))
    decade = 10.0 ** math.floor(math.log10(wanted_s))
    round_s = next(k * decade for k in (1.0, 2.0, 5.0, 10.0) if k * decade >= wanted_s * 0.999)
    seen = step.time_s < min(round_s, longest_s)
    return {"time_s": step.time_s[seen], "reference": step.reference[seen],
            "measured": step.measured[seen], "controller": step.u[seen]}  # fmt: skip


def _design(loop: DesignedLoop, gains: PidGains) -> Design:
    """The gains with what they achieve, as `haselab design` reports it."""
    loop.require_pid()
    loop.require_limits()
    if not (gains.kp or gains.ki):
        raise InputError(
            "kp and ki are both 0, so the controller does not follow the reference. Set at "
            "least one above 0."
        )
    posterior = read_posterior(loop.path)
    return evaluate_controller(
        posterior or loop.plant,
        gains,
        demands_of(loop.path),
        loop.setting,
        rng=np.random.default_rng(0),
        nominal=loop.plant,
    )


def _demands(files: PanelFiles, values: JsonObject) -> JsonObject:
    """Unmet demands, and the plausible plants that keep the margins: takes about a second."""
    return _reported(_design(opened(files), gains_of(values)))


def _reported(design: Design) -> JsonObject:
    plausible = design.plausible
    return {
        "gains": asdict(design.gains),
        "shortfalls": list(design.shortfalls),
        "plausible": _NO_UNCERTAINTY if plausible is None else plausible_sentence(plausible),
    }


def _search(files: PanelFiles, values: JsonObject) -> JsonObject:
    """The gains of `haselab design` for the demands of the file: takes some seconds."""
    loop = opened(files)
    loop.require_pid()
    loop.require_limits()
    is_pi = loop.held is not None and loop.held.kind == "pi"
    return _reported(
        design_controller(
            read_posterior(loop.path) or loop.plant,
            demands_of(loop.path),
            loop.setting,
            rng=np.random.default_rng(0),
            structure="pi" if is_pi else "pid",
            nominal=loop.plant,
        )
    )


def _write(files: PanelFiles, values: JsonObject) -> JsonObject:
    """Write the gains to [controller] of the actuator file, if the loop is stable."""
    loop, gains = opened(files), gains_of(values)
    if values.get("sha256") != loop.sha256:
        raise InputError(
            "Not written: the actuator file has changed since this page read it. Read it again, "
            f"check its gains and margins, and write again. {loop.path}"
        )
    if not loop.margins(gains).stable:
        raise ResultError(
            "Not written: with these gains the loop is unstable at "
            f"{loop.setting.rate_hz:g} Hz with a delay of {loop.setting.measurement_delay_s:g} s. "
            "Change the gains until it is stable."
        )
    design, held = _design(loop, gains), loop.held
    kind = "pi" if held is not None and held.kind == "pi" and not gains.kd else "pid"
    section = controller_section(design, kind)
    name = "" if held is None else held.name
    section["name"] = name or None
    section["alternatives"] = other_controllers(loop.path, name or kind) or None
    command = f"haselab panel --actuator {shlex.quote(str(files.actuator))} # page Design"
    inputs = {loop.path.name: loop.sha256}
    origin = Provenance(command, inputs, datetime.now(UTC), __version__)
    write_section(loop.path, "controller", section, origin, CONTROLLER_KEYS, loop.sha256)
    return {"written": str(loop.path), "sha256": next(iter(hashed([loop.path]).values()))}


DESIGN_REQUESTS: dict[str, Callable[[PanelFiles, JsonObject], JsonObject]] = {
    "design": _overview,
    "design-loop": _evaluate,
    "design-demands": _demands,
    "design-search": _search,
    "design-write": _write,
}
"""By name, see `REQUESTS`."""
