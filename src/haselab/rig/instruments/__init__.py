"""Drivers of instruments, and what a driver in another package derives from."""

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
