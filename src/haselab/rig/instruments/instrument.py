"""The extension point for instruments: what a driver package has to implement.

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
    """What an instrument needs of the operating system; `haselab doctor` looks at it.

    Args:
        serial_ports: that it is on.
        local_daq: NI's driver on this computer.
        genicam: name or address of a GenICam camera; empty: the first one; None: it is none.
        frame_bytes: of one frame of it; None: not known.
    """

    serial_ports: tuple[str, ...] = ()
    local_daq: bool = False
    genicam: str | None = None
    frame_bytes: int | None = None

    def __or__(self, other: SystemNeeds) -> SystemNeeds:
        """The needs of both."""
        return SystemNeeds(
            (*self.serial_ports, *other.serial_ports),
            self.local_daq or other.local_daq,
            other.genicam if self.genicam is None else self.genicam,
            other.frame_bytes if self.frame_bytes is None else self.frame_bytes,
        )


@dataclass(frozen=True)
class OpenContext:
    """What an instrument may know of its bench when it is opened.

    Args:
        description: of the bench.
        exposure: section `exposure` of the rig file; None: no exposure signal is recorded.
    """

    description: RigDescription
    exposure: ExposureConfig | None = None


@dataclass(frozen=True)
class CameraContext:
    """What a camera may know of its bench when it is opened.

    Args:
        clock: of the acquisition, see `BlockClock`.
        exposures: where the camera's exposure signal is recorded; None: it is not.
        exposure_line: settings of the camera's exposure output; None: it is not wired.
    """

    clock: BlockClock = lambda: (0.0, time.monotonic())
    exposures: ExposureLog | None = None
    exposure_line: ExposureLine | None = None


class Instrument(ABC, Generic[C]):
    """One kind of instrument. The registry makes one object of the class, without arguments."""

    section: ClassVar[str]  # of RIG.toml: daq, generator, supply or camera
    kind: ClassVar[str]  # value of the section's key `kind`, and name of the entry point
    config: type[C]  # model of the section
    purpose: ClassVar[str] = ""  # what it is for, as `haselab doctor` lists it
    packages: ClassVar[tuple[str, ...]] = ()  # Python packages that it needs
    library: ClassVar[str] = ""  # another library that `check_driver` looks for

    @abstractmethod
    def identify(self, config: C) -> str:
        """Ask the instrument who it is, and leave its output as it is.

        Args:
            config: its section of the rig file.
        Returns:
            Maker, model, serial number, or what else it reports.
        Raises:
            DeviceError: the instrument does not answer.
            InputError: another instrument than the rig file names.
        """

    def check_driver(self) -> list[str]:
        """Load what the driver needs on this computer; the instrument is left alone.

        Returns:
            Names of what was loaded.
        Raises:
            DeviceError: something is missing.
        """
        return []

    def system_needs(self, config: C) -> SystemNeeds:
        """What `haselab doctor` looks at: ports, permissions, network.

        Args:
            config: its section of the rig file.
        """
        del config
        return SystemNeeds()


class OutputInstrument(Instrument[C]):
    """An instrument that puts out a voltage, and so has to be shut down from outside as well.

    The two guardian processes and `haselab rig safe` call `shut_down` while the program that uses
    the instrument may hang, be stopped, or still be connected.
    """

    shutdown_attempts: ClassVar[int] = 2  # the program may take an answer that was meant for us

    @abstractmethod
    def addresses(self, config: C) -> tuple[str, ...]:
        """What another rig file would call this instrument: ports and network addresses.

        It shows that two programs use the same instrument on two benches, so the text
        must be the same for the same instrument.

        Args:
            config: its section of the rig file.
        """

    @abstractmethod
    def shut_down(self, config: C, within_s: float) -> None:
        """Switch the output off over a new connection, and confirm that it is off.

        Args:
            config: its section of the rig file.
            within_s: how long a connection that is refused may be tried again, in s.
        Raises:
            DeviceError: it is not confirmed off.
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
            DeviceError: no driver, no answer, or not confirmed off.
            InputError: another instrument than the rig file names.
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
            DeviceError: no driver, or no such device.
        """

    @abstractmethod
    def key_of(self, config: D) -> str | None:
        """`DaqConnection.key`, from the rig file alone; None where the file does not hold it.

        With it the permission can be revoked while the device cannot be reached.
        """

    @abstractmethod
    def open(self, config: D, context: OpenContext, connection: Any) -> DaqDevice:
        """Start sampling; the output is at 0 V afterwards.

        Args:
            config: its section of the rig file.
            context: the bench.
            connection: of `connect`, closed with the device.
        Raises:
            DeviceError: the device refuses the configuration.
            InputError: a setting that the device does not have.
        """

    def route_checks(
        self, config: D, exposure: ExposureConfig | None, connection: Any
    ) -> Iterator[CheckResult]:
        """What `haselab rig check` asks the device before it is opened; by default nothing.

        Args:
            config: its section of the rig file.
            exposure: section `exposure`; None: there is none.
            connection: of `connect`.
        Yields:
            One result for each thing that was verified; no output changes.
        """
        del config, exposure, connection
        return iter(())

    def addresses(self, config: D) -> tuple[str, ...]:
        """None: a device is known by the key of its connection."""
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
        """See `OutputInstrument.shut_down`: 0 V is commanded; no meter confirms it."""
        del within_s
        connection = self.connect(config)
        try:
            connection.shut_down()
        finally:
            connection.close()


class CameraInstrument(Instrument[V]):
    """A camera: section `camera`. It puts out no voltage, so it needs no shutdown."""

    section = "camera"

    @abstractmethod
    def open(self, config: V, context: CameraContext) -> OpenedCamera:
        """Open the camera; it takes no frames yet.

        Args:
            config: its section of the rig file.
            context: the bench's clock and exposure signal.
        Raises:
            DeviceError: the camera or its driver is missing.
            InputError: another camera than the rig file names, or no such recording.
            LimitError: a setting beyond what the camera can do.
        """

    def identify(self, config: V) -> str:
        """See `Instrument.identify`: opens the camera and closes it again."""
        opened = self.open(config, CameraContext())
        opened.close()
        return opened.identity
