"""Open a real bench: RIG.toml with `kind = "bench"` becomes a `Rig`."""

from __future__ import annotations

import contextlib
import time
from dataclasses import dataclass

from haselab.base import Closing, HaselabError
from haselab.rig import Frames, Gate, Rig
from haselab.rig.bench_config import BenchConfig
from haselab.rig.cameras.opening import OpenedCamera, open_camera
from haselab.rig.drivers import quietly
from haselab.rig.instruments.devices import DaqDevice, SupplyDevice
from haselab.rig.instruments.instrument import OpenContext
from haselab.rig.instruments.registry import daq_of, generator_of, reported_faults, supply_of
from haselab.rig.operator import BenchStand, OperatorWeights, WeightHandler
from haselab.rig.twin.client import TwinClient

__all__ = ["GaplessCamera", "Instrument", "RealBench", "identify"]

_CALLS_S = 2.0  # longest call of a driver, not counting the blocks that it waits for
_CALL_BLOCKS = 50  # `DaqDevice.pass_time` at most, see `stand.BenchStand.wait`


@dataclass(frozen=True)
class Instrument:
    """One device that replied.

    Args:
        name: section of the rig file.
        identity: its own identification.
    """

    name: str
    identity: str


def identify(config: BenchConfig) -> list[tuple[str, str | HaselabError]]:
    """Identify every instrument of a bench, one by one; outputs are not changed.

    Args:
        config: of the bench.
    Returns:
        Section of the rig file, and the instrument's identification or the error.
    """
    found: list[tuple[str, str | HaselabError]] = []
    for each in config.instruments():
        try:
            with reported_faults(each.config):
                found.append((each.section, each.instrument.identify(each.config)))
        except HaselabError as error:
            found.append((each.section, error))
    return found


class _NoCamera:
    """The camera of a bench without one: no frames."""

    def start(self, rate_hz: float) -> None:
        """Nothing to start."""

    def take(self) -> Frames | None:
        """No frames."""
        return None

    def stop(self) -> None:
        """Nothing to stop."""


class GaplessCamera:
    """A camera that makes the acquisition keep every block for as long as it takes frames.

    Frames are timed on the acquisition's clock, so no block may be skipped meanwhile.

    Args:
        opened: the camera that takes the frames.
        board: the device whose clock is used.
    """

    def __init__(self, opened: OpenedCamera, board: DaqDevice) -> None:
        self._opened = opened
        self._camera = opened.camera
        self._board = board
        self._since_s = 0.0  # time of the first block that is kept

    @property
    def identity(self) -> str:
        """Identification of the camera; empty if there is none."""
        return self._opened.identity

    @property
    def dropped(self) -> int:
        """Number of frames lost since the last start."""
        return self._opened.dropped()

    @property
    def uncertainty_s(self) -> float:
        """Uncertainty of a frame's time (half width), in s."""
        return self._opened.uncertainty_s()

    @property
    def remarks(self) -> tuple[str, ...]:
        """See `haselab.rig.cameras.source.ReportsRemarks`."""
        return self._opened.remarks()

    @property
    def lag_s(self) -> float:
        """Delay from an exposure's middle to its estimate from the frame, in s; NaN: unknown."""
        return self._opened.lag_s()

    @property
    def rate_hz(self) -> float:
        """Frames per second, measured by the camera's own clock; 0: unknown."""
        return self._opened.rate_hz()

    def start(self, rate_hz: float) -> None:
        """See `haselab.rig.Camera`."""
        self._board.pause()
        self._board.catch_up()
        self._camera.start(rate_hz)
        self._board.keep(True)
        self._since_s = self._board.time_s

    def take(self) -> Frames | None:
        """See `haselab.rig.Camera`. Drops frames from the blocks that starting the output took."""
        frames = self._camera.take()
        if frames is None or frames.time_s[0] >= self._since_s:
            return frames
        kept = frames.time_s >= self._since_s
        return Frames(frames.images[kept], frames.time_s[kept]) if kept.any() else None

    def stop(self) -> None:
        """See `haselab.rig.Camera`. Never raises."""
        quietly(self._camera.stop)
        quietly(lambda: self._board.keep(False))


class RealBench(Closing):
    """Opens every instrument of a rig file. Use as a context, which ends at 0 V and closes all.

    Args:
        config: of the bench.
        gate: wraps all its drivers.
        operator: hangs the masses; None: a person at the terminal.
    Raises:
        DeviceError: An instrument or its driver is missing or does not reply correctly; or another
            program uses the bench.
        InputError: An instrument is not the one that the rig file names.
    """

    def __init__(
        self, config: BenchConfig, gate: Gate, operator: WeightHandler | None = None
    ) -> None:
        self.config = config
        self._operator = operator
        description = config.describe()
        context = OpenContext(description, config.exposure)
        daq = daq_of(config.daq)
        with contextlib.ExitStack() as opened:
            with reported_faults(config.daq):
                link = daq.connect(config.daq)
                opened.callback(link.close)
                link.check_serial()
            call_s = _CALLS_S + _CALL_BLOCKS * description.block_s
            vanished = gate.claim(link.key, call_s, config.shared_instruments)
            opened.callback(gate.release)
            if vanished:  # a device server keeps its reservations
                link.reset()
            with reported_faults(config.daq):
                self.board = gate.instrument(daq.open(config.daq, context, link))
            opened.callback(self.board.close)
            generator = generator_of(config.generator)
            with reported_faults(config.generator):
                self.generator = gate.instrument(generator.open(config.generator, context))
            opened.callback(self.generator.close)
            self.supply: SupplyDevice | None = None
            if config.supply is not None:
                supply = supply_of(config.supply)
                with reported_faults(config.supply):
                    self.supply = gate.instrument(supply.open(config.supply, context))
                opened.callback(self.supply.close)
            stand = BenchStand(self._weight_handler(opened), self.board)
            self.camera = self._camera(opened)
            self._opened = opened.pop_all()
        self.rig = Rig(
            description,
            self.board,
            self.board,
            self.generator,
            self.camera,
            stand,
            supply=self.supply,
            gate=gate,
        )

    def _weight_handler(self, opened: contextlib.ExitStack) -> WeightHandler:
        if self.config.stand.address is None:
            return self._operator or OperatorWeights()
        client = TwinClient(self.config.stand.address)
        opened.callback(client.close)
        return client

    def _camera(self, opened: contextlib.ExitStack) -> GaplessCamera:
        found = OpenedCamera(_NoCamera(), "", lambda: None)
        if self.config.camera is not None:
            found = open_camera(
                self.config.camera, self._clock, self.board.exposures, self.config.exposure_line
            )
        opened.callback(found.close)
        return GaplessCamera(found, self.board)

    def _clock(self) -> tuple[float, float]:
        """End of the last block, and the time at which it is read."""
        return self.board.fetched_s, time.monotonic()

    @property
    def instruments(self) -> list[Instrument]:
        """All devices that replied, with their identification."""
        found = [
            Instrument("daq", self.board.identity),
            Instrument("generator", self.generator.identity),
        ]
        if self.supply is not None:
            found.append(Instrument("supply", self.supply.identity))
        if self.camera.identity:
            found.append(Instrument("camera", self.camera.identity))
        return found

    def close(self) -> None:
        """Go to 0 V, switch everything off, and close all connections. Never raises."""
        self.rig.safe()
        quietly(self._opened.close)
