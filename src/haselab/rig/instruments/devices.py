"""Protocols of opened instruments, as returned by the drivers' `open`."""

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
        """Its own identification."""

    @property
    def tolerance_v(self) -> float:
        """Largest reading of its meter while the output is off, in V."""

    def close(self) -> None:
        """Switch the output off and close the connection. Never raises."""


class GeneratorDevice(FunctionGenerator, ReportsOutputState, Protocol):
    """An opened function generator. Its output is off after opening."""

    @property
    def identity(self) -> str:
        """Its own identification."""

    def close(self) -> None:
        """Switch the output off and close the connection. Never raises."""


class DaqConnection(Protocol):
    """A connection to a data acquisition device that is not running yet."""

    @property
    def key(self) -> str:
        """Key that identifies the device on this computer: product and serial number."""

    @property
    def identity(self) -> str:
        """Its own identification."""

    def check_serial(self) -> None:
        """Raise `InputError` if the device is not the one that the rig file names."""

    def reset(self) -> None:
        """Release resources that a crashed program may still hold."""

    def shut_down(self) -> None:
        """Stop every task of every program on the device, then put out 0 V.

        Raises:
            DeviceError: The device does not confirm it.
        """

    def close(self) -> None:
        """Close the connection. Never raises."""


class DaqDevice(VoltageSource, Acquisition, GaplessAcquisition, Protocol):
    """An opened data acquisition device: drive output and both monitors."""

    @property
    def identity(self) -> str:
        """Its own identification."""

    @property
    def missed_outputs(self) -> int:
        """Number of outputs since opening that came too late and were skipped."""

    @property
    def fetched_s(self) -> float:
        """End of the last block fetched, on the acquisition's clock; `time_s` may be later."""

    @property
    def exposures(self) -> ExposureLog | None:
        """The recorded exposure signal of a camera, or None."""

    def pause(self) -> None:
        """Hold the output while blocks pass."""

    def catch_up(self) -> None:
        """Skip the blocks that have passed."""

    def pass_time(self, duration_s: float) -> None:
        """Let time pass, in s."""

    def close(self) -> None:
        """Go to 0 V and close the connection. Never raises."""
