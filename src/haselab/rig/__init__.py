"""A bench and its devices: protocols and description."""

from haselab.rig.protocols import (
    Acquisition,
    Camera,
    ClosesLoop,
    Frames,
    FunctionGenerator,
    GaplessAcquisition,
    Gate,
    HighVoltageSupply,
    LoadStand,
    PreloadsOutputs,
    ReferenceFixture,
    ReportsOutput,
    ReportsOutputState,
    Rig,
    RigDescription,
    VoltageSource,
)

__all__ = [
    "Acquisition",
    "Camera",
    "ClosesLoop",
    "Frames",
    "FunctionGenerator",
    "GaplessAcquisition",
    "Gate",
    "HighVoltageSupply",
    "LoadStand",
    "PreloadsOutputs",
    "ReferenceFixture",
    "ReportsOutput",
    "ReportsOutputState",
    "Rig",
    "RigDescription",
    "VoltageSource",
]
