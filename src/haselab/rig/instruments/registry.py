"""The instruments that rig files can name: those of this package, and those of other packages.

Another package lists its drivers in its own `pyproject.toml`:

    [project.entry-points."haselab.instruments"]
    mysupply = "mypackage.driver:MySupply"

A rig file then chooses one by `kind = "mysupply"`. Whoever loads a rig file (a run, a guardian
process, `rig safe`, `doctor`) finds its drivers here. A driver that does not load, or that cannot
be shut down from outside, is refused while the file is read: before anything is energised.

The drivers of this package are entry points too, but listed here and not in its metadata: an
installation that is out of date must not lose the driver that shuts a bench down.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import EntryPoint, entry_points
from typing import Any, cast

from pydantic import GetCoreSchemaHandler
from pydantic_core import PydanticCustomError, core_schema

from haselab.base import DeviceError, HaselabError
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
    "GROUP",
    "ByKind",
    "Driver",
    "camera_of",
    "config_class",
    "daq_of",
    "forget",
    "generator_of",
    "installed",
    "instrument_of",
    "reported_faults",
    "supply_of",
]

GROUP = "haselab.instruments"
DEFAULT_KINDS = {"daq": "nidaq", "generator": "keysight33500", "supply": "petapicovoltron"}
_OWN = "haselab"  # the package of the drivers below
_DRIVERS = {
    "nidaq": "haselab.rig.instruments.nidaq.instrument:NidaqInstrument",
    "keysight33500": "haselab.rig.instruments.keysight33500.instrument:KeysightInstrument",
    "petapicovoltron": (
        "haselab.rig.instruments.petapicovoltron.instrument:PetaPicoVoltronInstrument"
    ),
    "aravis": "haselab.rig.cameras.aravis.instrument:AravisInstrument",
    "v4l2": "haselab.rig.cameras.v4l2:V4l2Instrument",
    "folder": "haselab.rig.cameras.folder:FolderInstrument",
    "twin": "haselab.rig.cameras.twin_source:TwinCameraInstrument",
}
_ROLES: dict[str, tuple[type[Instrument[Any]], type[InstrumentConfig]]] = {
    "daq": (DaqInstrument, DaqConfig),
    "generator": (GeneratorInstrument, GeneratorConfig),
    "supply": (SupplyInstrument, SupplyConfig),
    "camera": (CameraInstrument, CameraConfig),
}


@dataclass(frozen=True)
class Driver:
    """One entry of the group.

    Args:
        kind: that a rig file names.
        package: that it comes from, with its version.
        entry: leads to the class.
    """

    kind: str
    package: str
    entry: EntryPoint

    @property
    def is_own(self) -> bool:
        """It comes with this package."""
        return self.package == _OWN

    def load(self) -> Instrument[Any]:
        """Import it and check that it is complete.

        Raises:
            DeviceError: it does not load, or lacks what every instrument needs.
        """
        try:
            found = self.entry.load()
            fault = _fault_of(found, self.kind)
            if not fault:
                return cast(Instrument[Any], found())
        except Exception as error:  # whatever somebody else's package does
            fault = f"it does not load ({type(error).__name__}: {error})"
        raise DeviceError(
            f"Instrument {self.kind!r} of package {self.package} cannot be used: {fault}. Nothing "
            f"was energised. Repair the package, or remove it. {self.entry.value}"
        )


def _fault_of(found: Any, kind: str) -> str:
    """What is wrong with a class that an entry point leads to; empty: nothing."""
    names = ", ".join(base.__name__ for base, _ in _ROLES.values())
    if not (inspect.isclass(found) and issubclass(found, Instrument)):
        return f"it is no class derived from one of {names}"
    role = next((each for each in _ROLES.values() if issubclass(found, each[0])), None)
    if role is None:
        return f"it is derived from none of {names}"
    missing = sorted(getattr(found, "__abstractmethods__", ()))
    if missing:
        return f"it has no {', '.join(missing)}"
    if getattr(found, "kind", None) != kind:
        own = getattr(found, "kind", None)
        return f"its entry point is named {kind!r}, but its attribute kind is {own!r}"
    config = getattr(found, "config", None)
    if not (inspect.isclass(config) and issubclass(config, role[1])):
        return f"its attribute config is not derived from {role[1].__name__}"
    return ""


@functools.cache
def installed() -> tuple[Driver, ...]:
    """Every entry of the group, this package's own first; none is imported."""
    own = [Driver(kind, _OWN, EntryPoint(kind, at, GROUP)) for kind, at in _DRIVERS.items()]
    return (*own, *_others())


def _others() -> Iterator[Driver]:
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: (entry.name, entry.value)):
        package = "?" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"
        yield Driver(entry.name, package, entry)


@functools.cache
def _load(section: str, kind: str) -> Instrument[Any] | None:
    """The instrument of this kind for this section; None where nobody offers one.

    Raises:
        DeviceError: it cannot be used, or more than one package offers it.
    """
    offered = [driver for driver in installed() if driver.kind == kind]
    if len(offered) > 1:
        raise DeviceError(
            f"Instrument {kind!r} is offered by {' and '.join(each.package for each in offered)}. "
            "Nothing was energised. Remove one of the packages."
        )
    found = [driver.load() for driver in offered]
    return next((each for each in found if each.section == section), None)


@contextlib.contextmanager
def reported_faults(config: InstrumentConfig) -> Iterator[None]:
    """Turn whatever a driver raises into an error of one line.

    Args:
        config: section of the instrument whose driver is called.
    Raises:
        DeviceError: the driver raised something that is no error of haselab.
    """
    try:
        yield
    except HaselabError:
        raise
    except Exception as error:
        raise DeviceError(
            f"The driver of instrument {config.kind!r} failed ({type(error).__name__}: {error}). "
            "Check the instrument; if it is well, report the fault to the authors of the driver."
        ) from error


def forget() -> None:
    """Look for packages again: some were installed or removed while this program runs."""
    installed.cache_clear()
    _load.cache_clear()


def _find(section: str, kind: str) -> Instrument[Any]:
    found = _load(section, kind)
    if found is None:
        raise DeviceError(f"No instrument of kind {kind!r} for section {section}.")
    return found


def instrument_of(section: str, config: InstrumentConfig) -> Instrument[Any]:
    """The instrument of a section of a rig file.

    Args:
        section: daq, generator, supply or camera.
        config: the section.
    Raises:
        DeviceError: it cannot be used.
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
    """The model of a section's table; None where its `kind` is missing or not known.

    Args:
        section: daq, generator, supply or camera.
        data: the table as it was read.
    Raises:
        DeviceError: the driver cannot be used.
    """
    kind = data.get("kind", DEFAULT_KINDS.get(section)) if isinstance(data, dict) else None
    found = _load(section, kind) if isinstance(kind, str) else None
    return None if found is None else found.config


@dataclass(frozen=True)
class ByKind:
    """Marks a field of a pydantic model: the table's key `kind` chooses the model of the table.

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
    """A table as the model of its instrument; what is no table is returned as it is."""
    if not isinstance(data, dict):
        return data
    model = config_class(section, data)
    if model is None:
        kinds = ", ".join(repr(each) for each in _kinds_of(section))
        kind = data.get("kind")
        what = "no key kind" if kind is None else f"no {section} of kind {str(kind)[:60]!r}"
        raise PydanticCustomError(
            "kind",
            "{what}; use one of {kinds}, or install the package that offers it",
            {"what": what, "kinds": kinds},
        )
    return model.model_validate(data)


def _kinds_of(section: str) -> list[str]:
    """Kinds for one section; those of packages that do not load are left out."""
    found = []
    for driver in installed():
        try:
            if driver.load().section == section:
                found.append(driver.kind)
        except DeviceError:
            continue
    return found
