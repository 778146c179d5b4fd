"""The registry of instruments: built-in drivers, and those of other packages.

Another package lists its drivers in its own `pyproject.toml`:

    [project.entry-points."haselab.instruments"]
    mysupply = "mypackage.driver:MySupply"

A rig file then chooses it by `kind = "mysupply"`. All programs that load a rig file (a run, a
guardian process, `rig safe`, `doctor`) find its drivers here. A driver that does not load, or that
other processes cannot shut down, is refused while the file is read, before anything is energised.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, cast

from pydantic import GetCoreSchemaHandler
from pydantic_core import PydanticCustomError, core_schema

from haselab.base import DeviceError, HaselabError, described
from haselab.base.exits import no_exit
from haselab.base.registry import Registry
from haselab.rig.instruments.instrument import (
    CameraInstrument,
    DaqInstrument,
    GeneratorInstrument,
    Instrument,
    SupplyInstrument,
)
from haselab.rig.instruments.sections import (
    CameraConfig,
    DaqConfig,
    GeneratorConfig,
    InstrumentConfig,
    SupplyConfig,
)

__all__ = [
    "DEFAULT_KINDS",
    "INSTRUMENTS",
    "ByKind",
    "camera_of",
    "config_class",
    "daq_of",
    "generator_of",
    "instrument_of",
    "reported_faults",
    "supply_of",
]

DEFAULT_KINDS = {"daq": "nidaq", "generator": "keysight33500", "supply": "petapicovoltron"}
_ROLES: dict[str, tuple[type[Instrument[Any]], type[InstrumentConfig]]] = {
    "daq": (DaqInstrument, DaqConfig),
    "generator": (GeneratorInstrument, GeneratorConfig),
    "supply": (SupplyInstrument, SupplyConfig),
    "camera": (CameraInstrument, CameraConfig),
}


@functools.cache
def _instance(driver: type[Instrument[Any]]) -> Instrument[Any]:
    return driver()


def _fault_of(found: Any, kind: str) -> str:
    """Return what is wrong with the class of an entry point, or an empty text."""
    names = ", ".join(base.__name__ for base, _ in _ROLES.values())
    if not (inspect.isclass(found) and issubclass(found, Instrument)):
        return f"it is not a class derived from one of {names}"
    role = next((each for each in _ROLES.values() if issubclass(found, each[0])), None)
    if role is None:
        return f"it is not derived from any of {names}"
    missing = sorted(getattr(found, "__abstractmethods__", ()))
    if missing:
        return f"it has no {', '.join(missing)}"
    if getattr(found, "kind", None) != kind:
        own = getattr(found, "kind", None)
        return f"its entry point is named {kind!r}, but its attribute kind is {own!r}"
    config = getattr(found, "config", None)
    if not (inspect.isclass(config) and issubclass(config, role[1])):
        return f"its attribute config is not derived from {role[1].__name__}"
    _instance(found)
    return ""


INSTRUMENTS: Registry[type[Instrument[Any]]] = Registry(
    "instrument",
    "haselab.instruments",
    {
        "nidaq": "haselab.rig.instruments.nidaq.instrument:NidaqInstrument",
        "keysight33500": "haselab.rig.instruments.keysight33500.instrument:KeysightInstrument",
        "petapicovoltron": (
            "haselab.rig.instruments.petapicovoltron.instrument:PetaPicoVoltronInstrument"
        ),
        "aravis": "haselab.rig.cameras.aravis.instrument:AravisInstrument",
        "v4l2": "haselab.rig.cameras.v4l2:V4l2Instrument",
        "folder": "haselab.rig.cameras.folder:FolderInstrument",
        "twin": "haselab.rig.cameras.twin_source:TwinCameraInstrument",
    },
    _fault_of,
    DeviceError,
)


@contextlib.contextmanager
def reported_faults(config: InstrumentConfig) -> Iterator[None]:
    """Turn any exception of a driver into an error of one line.

    Args:
        config: section of the instrument whose driver is called.
    Raises:
        DeviceError: The driver raised an exception that is not one of haselab's.
    """
    try:
        with no_exit():
            yield
    except HaselabError:
        raise
    except Exception as error:
        raise DeviceError(
            f"The driver of instrument {config.kind!r} failed ({described(error)}). "
            "Check the instrument; if it works, report the fault to the authors of the driver."
        ) from error


def _find(section: str, kind: str) -> Instrument[Any]:
    found = INSTRUMENTS.find(kind)
    if found.section != section:
        raise DeviceError(
            f"The instrument {kind!r} is for section {found.section}, not {section}. Use one of "
            f"{', '.join(_kinds_of(section))}."
        )
    return _instance(found)


def instrument_of(section: str, config: InstrumentConfig) -> Instrument[Any]:
    """The instrument of a section of a rig file.

    Args:
        section: daq, generator, supply or camera.
        config: the section.
    Raises:
        DeviceError: It cannot be used.
    """
    return _find(section, config.kind)


def daq_of(config: DaqConfig) -> DaqInstrument[Any]:
    """The instrument of a section `daq`."""
    return cast(DaqInstrument[Any], _find("daq", config.kind))


def generator_of(config: GeneratorConfig) -> GeneratorInstrument[Any]:
    """The instrument of a section `generator`."""
    return cast(GeneratorInstrument[Any], _find("generator", config.kind))


def supply_of(config: SupplyConfig) -> SupplyInstrument[Any]:
    """The instrument of a section `supply`."""
    return cast(SupplyInstrument[Any], _find("supply", config.kind))


def camera_of(config: CameraConfig) -> CameraInstrument[Any]:
    """The instrument of a section `camera`."""
    return cast(CameraInstrument[Any], _find("camera", config.kind))


def config_class(section: str, data: Any) -> type[InstrumentConfig] | None:
    """Find the model of a section's table; None if its `kind` is missing or unknown.

    Args:
        section: daq, generator, supply or camera.
        data: the table as it was read.
    Raises:
        DeviceError: The driver cannot be used.
    """
    kind = data.get("kind", DEFAULT_KINDS.get(section)) if isinstance(data, dict) else None
    found = INSTRUMENTS.find(kind) if kind in INSTRUMENTS.packages() else None
    return None if found is None or found.section != section else found.config


@dataclass(frozen=True)
class ByKind:
    """Annotation of a pydantic field: the table's key `kind` chooses the model of the table.

    Args:
        section: daq, generator, supply or camera.
    """

    section: str

    def model_of(self, data: Any) -> type[InstrumentConfig] | None:
        """See `config_class`."""
        return config_class(self.section, data)

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        return core_schema.no_info_before_validator_function(
            functools.partial(_validated, self.section), handler(source)
        )


def _validated(section: str, data: Any) -> Any:
    """Validate a table by the model of its instrument; return anything else unchanged."""
    if not isinstance(data, dict):
        return data
    model = config_class(section, data)
    if model is None:
        kinds = ", ".join(repr(each) for each in _kinds_of(section))
        kind = data.get("kind")
        what = "no key kind" if kind is None else f"no {section} of kind {str(kind)[:60]!r}"
        raise PydanticCustomError(
            "kind",
            "{what}; use one of {kinds}, or install the package that provides it",
            {"what": what, "kinds": kinds},
        )
    return model.model_validate(data)


def _kinds_of(section: str) -> list[str]:
    """List the kinds for one section, without those of packages that do not load."""
    return [kind for kind, found in INSTRUMENTS.usable().items() if found.section == section]
