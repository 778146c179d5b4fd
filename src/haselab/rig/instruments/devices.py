"""What an opened instrument can do: the objects that the drivers' `open` returns."""

from __future__ import annotations

from typing import Protocol

from haselab.rig.cameras.pairing import ExposureLog
from haselab.rig.protocols import (
    Acquisition,
    FunctionGenerator,
    GaplessAcquisition,
    HighVoltageSupply,
    ReportsOutputState,
    VoltageSource,
)

__all__ = ["DaqConnection", "DaqDevice", "GeneratorDevice", "SupplyDevice"]


class SupplyDevice(HighVoltageSupply, ReportsOutputState, Protocol):
    """An opened supply. Its output is off after opening."""

    @property
    def identity(self) -> str:
        """What it reports to be."""

    @property
    def tolerance_v(self) -> float:
        """What its meter may show while the output is off, in V."""

    def close(self) -> None:
        """Output off, connection closed. Never raises."""


class GeneratorDevice(FunctionGenerator, ReportsOutputState, Protocol):
    """An opened function generator. Its output is off after opening."""

    @property
    def identity(self) -> str:
        """What it reports to be."""

    def close(self) -> None:
        """Output off, connection closed. Never raises."""


class DaqConnection(Protocol):
    """A connection to a data acquisition device on which nothing runs yet."""

    @property
    def key(self) -> str:
        """What identifies the device on this computer: product and serial number."""

    @property
    def identity(self) -> str:
        """What it reports to be."""

    def check_serial(self) -> None:
        """Refuse another device than the rig file names, with an `InputError`."""

    def reset(self) -> None:
        """Release what a program that has crashed may still hold."""

    def shut_down(self) -> None:
        """Stop every task of every program on the device, then put out 0 V.

        Raises:
            DeviceError: the device does not confirm it.
        """

    def close(self) -> None:
        """Close it. Never raises."""


class DaqDevice(VoltageSource, Acquisition, GaplessAcquisition, Protocol):
    """An opened data acquisition device: drive output and both monitors."""

    @property
    def identity(self) -> str:
        """What it reports to be."""

    @property
    def missed_outputs(self) -> int:
        """Outputs since opening that came too late and were left out."""

    @property
    def fetched_s(self) -> float:
        """End of a block that has come in, on the acquisition's clock; `time_s` may be ahead."""

    @property
    def exposures(self) -> ExposureLog | None:
        """The recorded exposure signal of a camera; None: none is recorded."""

    def pause(self) -> None:
        """The output stands; blocks pass."""

    def catch_up(self) -> None:
        """Pass over the blocks that have passed."""

    def pass_time(self, duration_s: float) -> None:
        """Let time pass, in s."""

    def close(self) -> None:
        """0 V, connection closed. Never raises."""
