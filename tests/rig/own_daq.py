"""A data acquisition device and a generator of somebody's own: the twin in this process.

Nothing here is an NI board or a Keysight generator: a bench of these drivers shows that no other
part of the program relies on them. `test_own_daq.py` installs this module as a package.
"""

from __future__ import annotations

from typing import Literal

from haselab.rig.instruments import (
    DaqConfig,
    DaqInstrument,
    GeneratorConfig,
    GeneratorInstrument,
    OpenContext,
)
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench

BENCHES: list[TwinBench] = []  # the one that was opened last stands at the end
FAULTS: list[Exception] = []  # that `write` raises under voltage


class OwnDaqConfig(DaqConfig):
    """Section `daq`."""

    kind: Literal["own-daq"] = "own-daq"
    number: str = "7"


class Connection:
    """Nothing runs on it yet."""

    identity = "own daq, number 7"

    def __init__(self, config: OwnDaqConfig) -> None:
        self.key = f"own daq {config.number}"

    def check_serial(self) -> None:
        """There is one only."""

    def reset(self) -> None:
        """Nothing is reserved."""

    def shut_down(self) -> None:
        """0 V."""
        if BENCHES:
            BENCHES[-1].zero()

    def close(self) -> None:
        """Nothing to close."""


class OwnDaqDevice:
    """The twin's drive output and monitors."""

    missed_outputs, identity, exposures = 0, Connection.identity, None

    def __init__(self) -> None:
        self._bench = TwinBench(twin_of_reading("hz"), 1)
        BENCHES.append(self._bench)
        self.zero, self.read = self._bench.zero, self._bench.read
        self.pass_time = self._bench.wait

    def write(self, voltage_v: float) -> None:
        """Put a value out, and fail where a test wants it."""
        self._bench.write(voltage_v)
        if voltage_v > 0.0 and FAULTS:
            raise FAULTS[0]

    @property
    def time_s(self) -> float:
        """See `Acquisition`."""
        return self._bench.time_s

    @property
    def fetched_s(self) -> float:
        """See `DaqDevice`."""
        return self._bench.time_s

    def keep(self, on: bool) -> None:
        """The twin never passes a block over."""

    def pause(self) -> None:
        """The twin waits."""

    def catch_up(self) -> None:
        """The twin has waited."""

    def close(self) -> None:
        """0 V."""
        self._bench.zero()


class OwnDaq(DaqInstrument[OwnDaqConfig]):
    """`kind = "own-daq"`."""

    kind = "own-daq"
    config = OwnDaqConfig

    def connect(self, config: OwnDaqConfig) -> Connection:
        """See `DaqInstrument`."""
        return Connection(config)

    def key_of(self, config: OwnDaqConfig) -> str | None:
        """See `DaqInstrument`."""
        return f"own daq {config.number}"

    def open(
        self, config: OwnDaqConfig, context: OpenContext, connection: Connection
    ) -> OwnDaqDevice:
        """See `DaqInstrument`."""
        return OwnDaqDevice()


class OwnGeneratorConfig(GeneratorConfig):
    """Section `generator`."""

    kind: Literal["own-generator"] = "own-generator"


class OwnGeneratorDevice:
    """The twin's sensing signal."""

    identity = "own generator"

    def __init__(self) -> None:
        self._bench = BENCHES[-1]
        self.sine, self.off, self.close = self._bench.sine, self._bench.off, self._bench.off

    def is_off(self) -> bool:
        """Asked of the physics."""
        return bool(self._bench.native.carrier_v == 0.0)


class OwnGenerator(GeneratorInstrument[OwnGeneratorConfig]):
    """`kind = "own-generator"`."""

    kind = "own-generator"
    config = OwnGeneratorConfig

    def open(self, config: OwnGeneratorConfig, context: OpenContext) -> OwnGeneratorDevice:
        """See `GeneratorInstrument`."""
        return OwnGeneratorDevice()

    def identify(self, config: OwnGeneratorConfig) -> str:
        """See `Instrument`."""
        return OwnGeneratorDevice.identity

    def addresses(self, config: OwnGeneratorConfig) -> tuple[str, ...]:
        """See `OutputInstrument`."""
        return ("own generator",)

    def shut_down(self, config: OwnGeneratorConfig, within_s: float) -> None:
        """See `OutputInstrument`."""
        BENCHES[-1].off()
