"""The extension point for instruments: the classes that a driver derives from.

A driver is a class that derives from one of `DaqInstrument`, `GeneratorInstrument`,
`SupplyInstrument` and `CameraInstrument`, and is listed in the entry-point group
`haselab.instruments`. The drivers in this package are written in the same way;
docs/extend/add-an-instrument.md is the tutorial.
"""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

from haselab.rig.cameras.opened import OpenedCamera
from haselab.rig.cameras.pairing import ExposureLog
from haselab.rig.cameras.source import BlockClock, ExposureLine
from haselab.rig.check_result import CheckResult
from haselab.rig.instruments.devices import (
    DaqConnection,
    DaqDevice,
    GeneratorDevice,
    SupplyDevice,
)
from haselab.rig.instruments.sections import (
    CameraConfig,
    DaqConfig,
    ExposureConfig,
    GeneratorConfig,
    InstrumentConfig,
    SupplyConfig,
)
from haselab.rig.protocols import RigDescription

__all__ = [
    "CameraContext",
    "CameraInstrument",
    "DaqInstrument",
    "GeneratorInstrument",
    "Instrument",
    "OpenContext",
    "OutputInstrument",
    "SupplyInstrument",
    "SystemNeeds",
]

C = TypeVar("C", bound=InstrumentConfig)
D = TypeVar("D", bound=DaqConfig)
G = TypeVar("G", bound=GeneratorConfig)
S = TypeVar("S", bound=SupplyConfig)
V = TypeVar("V", bound=CameraConfig)


@dataclass(frozen=True)
class SystemNeeds:
    """What an instrument needs from the operating system; `haselab doctor` checks it.

    Args:
        serial_ports: serial ports that it uses.
        local_daq: whether it needs NI's driver on this computer.
        genicam: name or address of a GenICam camera; empty: the first one; None: not a camera.
        frame_bytes: size of one of its frames; None: unknown.
    """

    serial_ports: tuple[str, ...] = ()
    local_daq: bool = False
    genicam: str | None = None
    frame_bytes: int | None = None

    def __or__(self, other: SystemNeeds) -> SystemNeeds:
        """Combine the needs of two instruments."""
        return SystemNeeds(
            (*self.serial_ports, *other.serial_ports),
            self.local_daq or other.local_daq,
            other.genicam if self.genicam is None else self.genicam,
            other.frame_bytes if self.frame_bytes is None else self.frame_bytes,
        )


@dataclass(frozen=True)
class OpenContext:
    """What an instrument gets to know about its bench when it is opened.

    Args:
        description: of the bench.
        exposure: section `exposure` of the rig file; None: no exposure signal is recorded.
    """

    description: RigDescription
    exposure: ExposureConfig | None = None


@dataclass(frozen=True)
class CameraContext:
    """What a camera gets to know about its bench when it is opened.

    Args:
        clock: of the acquisition, see `BlockClock`.
        exposures: log of the camera's exposure signal; None if it is not recorded.
        exposure_line: settings of the camera's exposure output; None: it is not wired.
    """

    clock: BlockClock = lambda: (0.0, time.monotonic())
    exposures: ExposureLog | None = None
    exposure_line: ExposureLine | None = None


class Instrument(ABC, Generic[C]):
    """One kind of instrument. The registry creates one object of the class, without arguments."""

    section: ClassVar[str]  # of RIG.toml: daq, generator, supply or camera
    kind: ClassVar[str]  # value of the section's key `kind`, and name of the entry point
    config: type[C]  # model of the section
    purpose: ClassVar[str] = ""  # its purpose, for the list of `haselab doctor`
    packages: ClassVar[tuple[str, ...]] = ()  # Python packages that it needs
    library: ClassVar[str] = ""  # another library that `check_driver` looks for

    @abstractmethod
    def identify(self, config: C) -> str:
        """Query the instrument's identity without changing its output.

        Args:
            config: its section of the rig file.
        Returns:
            Maker, model, serial number, or what else it reports.
        Raises:
            DeviceError: The instrument does not reply.
            InputError: The instrument is not the one that the rig file names.
        """

    def check_driver(self) -> list[str]:
        """Load what the driver needs on this computer, without connecting to the instrument.

        Returns:
            Names of what was loaded.
        Raises:
            DeviceError: Something is missing.
        """
        return []

    def system_needs(self, config: C) -> SystemNeeds:
        """List what `haselab doctor` checks: ports, permissions, network.

        Args:
            config: its section of the rig file.
        """
        del config
        return SystemNeeds()


class OutputInstrument(Instrument[C]):
    """An instrument with an output, which other processes must be able to shut down.

    The two guardian processes and `haselab rig safe` call `shut_down` while the program that uses
    the instrument may hang, be stopped, or still be connected.
    """

    shutdown_attempts: ClassVar[int] = 2  # the program may read our reply

    @abstractmethod
    def addresses(self, config: C) -> tuple[str, ...]:
        """Ports and network addresses by which another rig file could name this instrument.

        They show that two programs use the same instrument on two benches, so they must be the
        same for the same instrument.

        Args:
            config: its section of the rig file.
        """

    @abstractmethod
    def shut_down(self, config: C, within_s: float) -> None:
        """Switch the output off over a new connection, and confirm that it is off.

        Args:
            config: its section of the rig file.
            within_s: how long to retry a refused connection, in s.
        Raises:
            DeviceError: It is not confirmed off.
        """


class SupplyInstrument(OutputInstrument[S]):
    """A high-voltage supply: section `supply`."""

    section = "supply"

    @abstractmethod
    def open(self, config: S, context: OpenContext) -> SupplyDevice:
        """Connect; the output is off afterwards.

        Args:
            config: its section of the rig file.
            context: the bench.
        Raises:
            DeviceError: The driver is missing, there is no reply, or it is not confirmed off.
            InputError: The instrument is not the one that the rig file names.
        """


class GeneratorInstrument(OutputInstrument[G]):
    """A function generator: section `generator`."""

    section = "generator"

    @abstractmethod
    def open(self, config: G, context: OpenContext) -> GeneratorDevice:
        """Connect; the output is off afterwards. As `SupplyInstrument.open`."""


class DaqInstrument(OutputInstrument[D]):
    """A data acquisition device: section `daq`."""

    section = "daq"

    @abstractmethod
    def connect(self, config: D) -> DaqConnection:
        """Connect to the device; nothing is started and no output changes.

        Args:
            config: its section of the rig file.
        Raises:
            DeviceError: The driver or the device is missing.
        """

    @abstractmethod
    def key_of(self, config: D) -> str | None:
        """`DaqConnection.key` from the rig file alone; None if the file does not contain it.

        With it the permission can be revoked while the device does not respond.
        """

    @abstractmethod
    def open(self, config: D, context: OpenContext, connection: Any) -> DaqDevice:
        """Start sampling; the output is at 0 V afterwards.

        Args:
            config: its section of the rig file.
            context: the bench.
            connection: from `connect`; closed with the device.
        Raises:
            DeviceError: The device refuses the configuration.
            InputError: The device does not have a setting.
        """

    def route_checks(
        self, config: D, exposure: ExposureConfig | None, connection: Any
    ) -> Iterator[CheckResult]:
        """Checks of the device for `haselab rig check` before it is opened; none by default.

        Args:
            config: its section of the rig file.
            exposure: section `exposure`; None: there is none.
            connection: of `connect`.
        Yields:
            One result per check; no output changes.
        """
        del config, exposure, connection
        return iter(())

    def addresses(self, config: D) -> tuple[str, ...]:
        """No addresses: the device is identified by the key of its connection."""
        del config
        return ()

    def identify(self, config: D) -> str:
        """See `Instrument.identify`."""
        connection = self.connect(config)
        try:
            connection.check_serial()
            return connection.identity
        finally:
            connection.close()

    def shut_down(self, config: D, within_s: float) -> None:
        """See `OutputInstrument.shut_down`; 0 V is commanded, but no meter confirms it."""
        del within_s
        connection = self.connect(config)
        try:
            connection.shut_down()
        finally:
            connection.close()


class CameraInstrument(Instrument[V]):
    """A camera: section `camera`. It has no output, so it needs no shutdown."""

    section = "camera"

    @abstractmethod
    def open(self, config: V, context: CameraContext) -> OpenedCamera:
        """Open the camera; it takes no frames yet.

        Args:
            config: its section of the rig file.
            context: the bench's clock and exposure signal.
        Raises:
            DeviceError: The camera or its driver is missing.
            InputError: The camera is not the one that the rig file names, or the recording is
                missing.
            LimitError: A setting is outside the camera's limits.
        """

    def identify(self, config: V) -> str:
        """See `Instrument.identify`; opens the camera and closes it again."""
        opened = self.open(config, CameraContext())
        opened.close()
        return opened.identity
