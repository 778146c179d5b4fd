"""From a model to a controller, and what is known of one actuator."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from haselab.base import InputError, check_fields, check_length, checked, generator
from haselab.control import (
    Design,
    DesignSpec,
    LoopSetting,
    Saturation,
    design_controller,
)
from haselab.control.plausible_design import USUAL_STRUCTURE, Structure
from haselab.control.reach import usual_limits
from haselab.controllers import ChosenController, KnownActuator, known_actuator
from haselab.controllers.registry import chosen_controller
from haselab.identify import TransferFit
from haselab.models import Plant, RationalModel, VoltageMap
from haselab.models.actuator.sections import ActuatorTables, missing
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.posterior import PlantPosterior
from haselab.pipelines.design.model_file import read_any_plant
from haselab.runtime.loop import LoopSettings
from haselab.store.actuator_file import ACTUATOR, read_run
from haselab.store.toml import validated

__all__ = ["Actuator", "design"]

_USUAL = LoopSetting()


@checked
def design(
    model: TransferFit | PlantPosterior | Plant | RationalModel,
    spec: DesignSpec | Mapping[str, float | bool] | None = None,
    *,
    controller: Structure = USUAL_STRUCTURE,
    limits: tuple[float, float] | None = None,
    rate_hz: float = _USUAL.rate_hz,
    delay_s: float = _USUAL.measurement_delay_s,
    probability: float | None = None,
    feedthrough: float = 0.0,
    seed: int = 0,
) -> Design:
    """Design a PI or PID controller for a model, with margins that include the loop's delay.

    `haselab design` makes the same design from a file. It takes rate and delay from the file if
    they are in it.

    Args:
        model: a fit, which also gives the share of plausible plants that keep the margins; or a
            plant.
        spec: demands; None: the usual ones.
        controller: "pi" or "pid".
        limits: lowest and highest output of the controller, in the unit of the model's input.
            None: -0.05 to 0.1, for a model from strain to strain.
        rate_hz: updates of the loop a second, in Hz.
        delay_s: age of a measurement when the output computed from it takes effect, in s.
        probability: share of the plausible plants that has to keep the margins; a fit only.
        feedthrough: of the drive to the sensed strain, see `LoopSetting`; -0.98 to 0.98.
        seed: of the search.
    Returns:
        Gains, margins and the predicted step; `shortfalls` names the demands that are not met.
    Raises:
        InputError: an unknown kind, a probability for a plant without covariance, or no limits for
            a model whose gain is not that from strain to strain.
        ResultError: the fit has no result, or a number that is not identifiable.
    Example:
        >>> found = design(Plant(1.0, 32.0, 0.3), {"phase_margin_deg": 60.0})
        >>> found.shortfalls, found.nominal.margins.phase_margin_deg >= 60.0
        ((), True)
    """
    demands = spec if isinstance(spec, DesignSpec) else DesignSpec.from_mapping(spec or {})
    known = model.posterior if isinstance(model, TransferFit) else model
    plant = known.nominal if isinstance(known, PlantPosterior) else known
    range_ = usual_limits(plant) if limits is None else Saturation(*limits)
    loop = LoopSetting(rate_hz, delay_s, range_, feedthrough=feedthrough)
    rng = generator(seed)
    return design_controller(
        known, demands, loop, rng=rng, structure=controller, probability=probability
    )


@dataclass(frozen=True)
class Actuator:
    """What a closed loop needs to know of one actuator.

    Args:
        voltage_map: from strain to drive voltage; None: not known yet.
        strain_map: from capacitance to strain; None: not known yet.
        controller: a design, or a controller of any registered kind; None: not known yet.
        saturation: limits of the controller's output, in strain. None: those of the design, else
            those of the reference study.
        plant: the model, in general rational form if it is not one resonance; None: not known yet.
        physical: what controllers of the physical model use; None: not known yet.
        zero_length_m: length between the fiducials at zero strain, in m; None: not known yet.
    """

    voltage_map: VoltageMap | None = None
    strain_map: StrainMap | None = None
    controller: Design | ChosenController | None = None
    saturation: Saturation | None = None
    plant: Plant | RationalModel | None = None
    physical: KnownActuator | None = None
    zero_length_m: float | None = None

    def __post_init__(self) -> None:
        check_fields(self)
        check_length("zero_length_m", self.zero_length_m)

    @classmethod
    @checked
    def load(cls, path: str | Path) -> Actuator:
        """Read an actuator file, or the folder of a run.

        Args:
            path: actuator.toml, or a folder that holds one.
        Returns:
            What the file knows.
        Raises:
            InputError: no such file, or values that cannot be.
        """
        tables = validated(ActuatorTables, read_run(Path(path)), Path(path))
        drive, sensing, model, section = (
            tables.drive, tables.sensing, tables.model, tables.controller,
        )  # fmt: skip
        chosen = limits = None
        if section is not None and section.is_known:
            chosen = chosen_controller(section.model_dump(), path)
        if section is not None and section.limits is not None:
            limits = Saturation(section.limits.low, section.limits.high)
        return cls(
            None if drive.voltage_map is None else drive.voltage_map.map(),
            None if sensing.strain_map is None else sensing.strain_map.map(),
            chosen,
            limits,
            None if model is None or not model.model_extra else _plant(tables, Path(path)),
            _physical(tables, chosen, path),
            tables.actuator.geometry.zero_length_m,
        )

    def loop(self) -> LoopSettings:
        """The settings of a closed loop.

        Returns:
            Controller, saturation and both maps.
        Raises:
            InputError: one of them is not known yet.
        """
        if self.voltage_map is None:
            raise missing("drive.voltage_map", "haselab identify voltage-map FILE")
        if self.strain_map is None:
            raise missing("sensing.strain_map", "haselab identify capacitance-map FILE")
        if self.controller is None:
            raise missing("controller", "haselab design")
        if isinstance(self.controller, Design):
            limits = self.saturation or self.controller.setting.saturation
            chosen = self.controller.gains.controller()
        else:
            limits, chosen = self.saturation or Saturation(), self.controller
        return LoopSettings(
            chosen, limits, self.voltage_map, self.strain_map, actuator=self.physical
        )


def _plant(tables: ActuatorTables, path: Path) -> Plant | RationalModel:
    """The model of a file in any form; older runs have one resonance in a file of its own."""
    file = path / ACTUATOR if path.is_dir() else path
    return read_any_plant(file) if file.exists() else tables.plant()


def _physical(
    tables: ActuatorTables, chosen: ChosenController | None, path: str | Path
) -> KnownActuator | None:
    """What controllers of the physical model use.

    Raises:
        InputError: the controller of the file needs it, and the file lacks a part of it.
    """
    try:
        return known_actuator(tables, path)
    except InputError:
        if chosen is not None and chosen.kind.needs_actuator:
            raise
        return None
