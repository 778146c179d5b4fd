"""Drivers of instruments, and the base classes for drivers in other packages."""

from haselab.rig.instruments.devices import DaqConnection, DaqDevice, GeneratorDevice, SupplyDevice
from haselab.rig.instruments.instrument import (
    CameraContext,
    CameraInstrument,
    DaqInstrument,
    GeneratorInstrument,
    Instrument,
    OpenContext,
    OutputInstrument,
    SupplyInstrument,
    SystemNeeds,
)
from haselab.rig.instruments.sections import (
    CameraConfig,
    DaqConfig,
    ExposureConfig,
    GeneratorConfig,
    InstrumentConfig,
    SupplyConfig,
)

__all__ = [
    "CameraConfig",
    "CameraContext",
    "CameraInstrument",
    "DaqConfig",
    "DaqConnection",
    "DaqDevice",
    "DaqInstrument",
    "ExposureConfig",
    "GeneratorConfig",
    "GeneratorDevice",
    "GeneratorInstrument",
    "Instrument",
    "InstrumentConfig",
    "OpenContext",
    "OutputInstrument",
    "SupplyConfig",
    "SupplyDevice",
    "SupplyInstrument",
    "SystemNeeds",
]
