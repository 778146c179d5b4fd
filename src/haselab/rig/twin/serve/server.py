"""All instruments of one twin, served together, and the rig file that leads to them."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import Self, TypeVar

from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.serve.camera_faults import CameraFaults
from haselab.rig.twin.serve.daq import DEVICE, DaqServer
from haselab.rig.twin.serve.hands import HandsServer
from haselab.rig.twin.serve.hub import TwinHub
from haselab.rig.twin.serve.scpi import IDENTITY, ScpiServer
from haselab.rig.twin.serve.supply import NAME, SupplyServer

__all__ = ["Ports", "ServedTwin"]

Server = TypeVar("Server", DaqServer, ScpiServer, SupplyServer, HandsServer)


@dataclass(frozen=True)
class Ports:
    """TCP ports on loopback; 0: any free one."""

    daq: int = 0
    generator: int = 0
    hands: int = 0


class ServedTwin:
    """A twin behind NI's gRPC service, SCPI, a serial port and a socket. Use as a context.

    Args:
        config: the physical bench.
        seed: of every random number.
        pace: seconds of the bench in one second of the wall clock; 0: lock-step.
        ports: where.
        allow_others: also serve clients of other users of this computer.
        camera_faults: of the camera, its link and its exposure line.
    Raises:
        DeviceError: a package is missing, or a port is taken.
    """

    def __init__(
        self,
        config: TwinConfig,
        seed: int,
        pace: float = 1.0,
        ports: Ports | None = None,
        *,
        allow_others: bool = False,
        camera_faults: CameraFaults | None = None,
    ) -> None:
        ports = ports or Ports()
        self._config = config
        with contextlib.ExitStack() as opened:
            self.hub = opened.enter_context(TwinHub(config, seed, pace))
            self.hub.camera_faults = camera_faults or CameraFaults()

            def started(server: Server) -> Server:
                return opened.enter_context(contextlib.closing(server))

            self.daq = started(DaqServer(self.hub, ports.daq, allow_others=allow_others))
            self.generator = started(
                ScpiServer(self.hub, ports.generator, allow_others=allow_others)
            )
            self.supply = started(SupplyServer(self.hub, allow_others=allow_others))
            self.hands = started(HandsServer(self.hub, ports.hands, allow_others=allow_others))
            self._opened = opened.pop_all()

    @property
    def addresses(self) -> dict[str, str]:
        """Where each instrument answers."""
        return {
            "daq": self.daq.address,
            "generator": self.generator.address,
            "supply": self.supply.port,
            "hands": self.hands.address,
        }

    def rig_file(self, *, ahead_blocks: int = 1) -> str:
        """RIG.toml that leads to these servers."""
        config, serial = self._config, f"{self.daq.serial_number:08X}"
        acquisition, amplifier = config.acquisition, config.amplifier
        return f"""# A served twin, behind the drivers of the real instruments.
kind = "bench"
name = "{config.name} over the wire"
scale_m_per_px = {config.camera.scale_m_per_px!r}

[daq]
device = "{DEVICE}"
server = "{self.daq.address}"
serial_number = "{serial}"
rate_hz = {acquisition.rate_hz!r}
block_samples = {acquisition.block_samples}
bits = {acquisition.bits}
range_v = {acquisition.range_v!r}
skew_s = {acquisition.skew_s!r}
output_delay_s = {acquisition.output_delay_s!r}
ahead_blocks = {ahead_blocks}
drive_low_v = {acquisition.drive_low_v!r}
drive_high_v = {acquisition.drive_high_v!r}

[amplifier]
name = "{amplifier.name}"
gain = {amplifier.gain!r}
volt_per_monitor_volt = {amplifier.volt_per_monitor_volt!r}
ampere_per_monitor_volt = {amplifier.ampere_per_monitor_volt!r}

[generator]
address = "{self.generator.address}"
serial_number = "{IDENTITY.split(",")[2]}"

[supply]
port = "{self.supply.port}"
serial_number = "{NAME}"
highest_v = 5000.0

[specimen]
shell_width_m = {config.shell.width_m!r}
shell_thickness_m = {config.shell.thickness_m!r}
lateral_stretch = {config.shell.lateral_stretch!r}
mass_kg = {config.load.mass_kg!r}

[stand]
kind = "twin"
address = "{self.hands.address}"
lock_step = {str(self.hub.lock_step).lower()}

[camera]
kind = "twin"
address = "{self.hands.address}"
"""

    def close(self) -> None:
        """Everything at 0 V, all ports closed."""
        self._opened.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
