"""A bench and its devices: protocols and description."""

from haselab.rig.protocols import (
    Acquisition,
    BuiltInController,
    Camera,
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
    "BuiltInController",
    "Camera",
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
