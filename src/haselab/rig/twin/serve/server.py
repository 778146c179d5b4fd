"""Serve all instruments of one twin together, and write the rig file for them."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from typing import TypeVar

from haselab.base import Closing, InputError
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.serve.faults import BenchFaults
from haselab.rig.twin.serve.generator.scpi import IDENTITY, ScpiServer
from haselab.rig.twin.serve.hub import TICKS, TwinHub
from haselab.rig.twin.serve.ni.devices import DEVICES
from haselab.rig.twin.serve.ni.server import DEVICE, PRODUCT, DaqServer
from haselab.rig.twin.serve.operator import TwinClientServer
from haselab.rig.twin.serve.supply.server import NAME, SupplyServer

__all__ = ["Ports", "ServedTwin", "suited_to"]

TIMEBASE_HZ = 20e6  # that every board can divide its rates from
_LINE = """timed = true

[exposure]
input = "PFI0"
duration_s = {exposure_s!r}
"""
Server = TypeVar("Server", DaqServer, ScpiServer, SupplyServer, TwinClientServer)


@dataclass(frozen=True)
class Ports:
    """TCP ports on loopback; 0: any free one."""

    daq: int = 0
    generator: int = 0
    client: int = 0


def suited_to(config: TwinConfig, board: str) -> TwinConfig:
    """Adapt a bench to a board: its sample rate and the skew of its channels.

    Args:
        config: the physical bench.
        board: NI product, one of `ni_devices.DEVICES`.
    Returns:
        The same, but for a rate that is no higher than the board's, and for the board's skew.
    Raises:
        InputError: no such board, or no rate of it suits the blocks.
    """
    if board not in DEVICES:
        raise InputError(f"Board is {board!r}, but must be one of {', '.join(DEVICES)}.")
    device, daq = DEVICES[board], config.acquisition
    highest_hz = min(daq.rate_hz, device.allowed_rate_hz(2))
    block_s, delay_s = daq.block_samples / daq.rate_hz, daq.output_delay_s
    for rate_hz in (TIMEBASE_HZ / ticks for ticks in range(20, 2001)):
        block, delay = block_s * rate_hz, delay_s * rate_hz
        whole = [abs(n - round(n)) < 1e-6 for n in (rate_hz, block / 40, delay / TICKS)]
        if rate_hz <= highest_hz and all(whole):
            break
    else:
        raise InputError(f"No rate of the {board} suits blocks of {block_s:g} s. Change them.")
    skew_s = 0.0 if device.simultaneous else 1.0 / device.convert_rate_hz(2, rate_hz)
    changed = {"rate_hz": rate_hz, "block_samples": round(block), "skew_s": skew_s}
    return config.model_copy(update={"acquisition": daq.model_copy(update=changed)})


class ServedTwin(Closing):
    """A twin behind NI's gRPC service, SCPI, a serial port and a socket. Use as a context.

    Args:
        config: the physical bench; see `suited_to` for what the board changes of it.
        seed: of every random number.
        pace: seconds of the bench in one second of the wall clock; 0: lock-step.
        ports: where.
        allow_others: also serve clients of other users of this computer.
        board: NI product that the acquisition acts as, one of `ni_devices.DEVICES`.
        faults: what is wrong with the bench; None: nothing.
    Raises:
        DeviceError: a package is missing, or a port is taken.
        InputError: no such board.
    """

    def __init__(
        self,
        config: TwinConfig,
        seed: int,
        pace: float = 1.0,
        ports: Ports | None = None,
        *,
        allow_others: bool = False,
        board: str = PRODUCT,
        faults: BenchFaults | None = None,
    ) -> None:
        ports, faults = ports or Ports(), faults or BenchFaults()
        self._config = config = suited_to(config, board)
        with contextlib.ExitStack() as opened:
            self.hub = opened.enter_context(TwinHub(config, seed, pace, faults.wiring))
            self.hub.camera_faults = faults.camera
            if faults.at_amplifier_f is not None:
                self.hub.bench.connect(faults.at_amplifier_f)

            def started(server: Server) -> Server:
                return opened.enter_context(contextlib.closing(server))

            daq = DaqServer(
                self.hub, ports.daq, allow_others=allow_others, board=board, faults=faults.board
            )
            self.daq = started(daq)
            self.generator = started(
                ScpiServer(
                    self.hub, ports.generator, allow_others=allow_others, faults=faults.generator
                )
            )
            self.supply = started(
                SupplyServer(self.hub, allow_others=allow_others, faults=faults.supply)
            )
            self.client = started(
                TwinClientServer(self.hub, ports.client, allow_others=allow_others)
            )
            self._opened = opened.pop_all()

    @property
    def addresses(self) -> dict[str, str]:
        """Address of each instrument."""
        return {
            "daq": self.daq.address,
            "generator": self.generator.address,
            "supply": self.supply.port,
            "client": self.client.address,
        }

    def rig_file(self, *, ahead_blocks: int = 1, exposure_line: bool = False) -> str:
        """Write RIG.toml for these servers.

        Args:
            ahead_blocks: number of outputs queued in the device.
            exposure_line: whether frames arrive late and the camera's exposure line is wired.
        """
        config, serial = self._config, f"{self.daq.serial_number:08X}"
        acquisition, amplifier, law = config.acquisition, config.amplifier, config.law
        # Rounded to the digits of a product: 3 * 0.0498 / 3 is 0.04979999999999999.
        width_m = float(f"{law.width_m / law.lateral_stretch:.12g}")
        thickness_m = float(f"{law.area_m2 / width_m:.12g}")
        return f"""# A served twin, used through the drivers of the real instruments.
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
shell_width_m = {width_m!r}
shell_thickness_m = {thickness_m!r}
lateral_stretch = {law.lateral_stretch!r}
mass_kg = {config.load.mass_kg!r}

[stand]
kind = "twin"
address = "{self.client.address}"
lock_step = {str(self.hub.lock_step).lower()}

[camera]
kind = "twin"
address = "{self.client.address}"
{_LINE.format(exposure_s=config.camera.exposure_s) if exposure_line else ""}"""

    def close(self) -> None:
        """Take everything to 0 V and close all ports."""
        self._opened.close()
