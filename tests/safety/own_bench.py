"""A bench of drivers that a lab has written itself, without a line of haselab in them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from haselab.base import Limits
from haselab.rig import Frames, Rig, RigDescription

GAIN = 5000.0
BLOCK = 2000
RATE_HZ = 200e3
VOLT_PER_CODE = 20.0 / 2**16


@dataclass
class Amplifier:
    """What really stands at the output, whatever any program believes.

    Args:
        drive_v: ahead of the amplifier.
        carrier: frequency in Hz and peak in V.
        supply_v: of the rail.
        highest_v: largest drive so far.
    """

    drive_v: float = 0.0
    carrier: tuple[float, float] = (0.0, 0.0)
    supply_v: float = 0.0
    history: list[float] = field(default_factory=list)

    def put(self, drive_v: float) -> None:
        """Put this drive out."""
        self.drive_v = drive_v
        self.history.append(drive_v)


class Board:
    """Source and acquisition. `zero_fault`: nothing, 'no effect' or 'raises'."""

    def __init__(self, amplifier: Amplifier) -> None:
        self.amplifier, self.zero_fault, self.dead = amplifier, "", False
        self._blocks = 0
        self._rng = np.random.default_rng(1)

    def write(self, voltage_v: float) -> None:
        """Put it out."""
        self.amplifier.put(voltage_v)

    def zero(self) -> None:
        """0 V, unless it is broken."""
        if self.zero_fault == "raises":
            raise RuntimeError("USB gone")
        if not self.zero_fault:
            self.amplifier.put(0.0)

    def jump(self, voltage_v: float) -> None:
        """A method of its own, which nobody else knows."""
        self.amplifier.put(voltage_v)

    def read(self) -> NDArray[np.int16]:
        """Both monitors with a noise of one code."""
        if self.dead:
            raise RuntimeError("USB gone")
        t = (np.arange(BLOCK) + self._blocks * BLOCK) / RATE_HZ
        self._blocks += 1
        hz, peak_v = self.amplifier.carrier
        volt = self.amplifier.drive_v + peak_v * np.sin(2 * np.pi * hz * t)
        codes = np.stack([volt, np.zeros(BLOCK)], 1) / VOLT_PER_CODE
        noisy = np.round(codes + self._rng.normal(size=codes.shape))
        return np.clip(noisy, -32768, 32767).astype(np.int16)

    @property
    def time_s(self) -> float:
        """Of the last block's end."""
        return self._blocks * BLOCK / RATE_HZ


class Generator:
    """Takes whatever it is given."""

    def __init__(self, amplifier: Amplifier) -> None:
        self._amplifier = amplifier

    def sine(self, frequency_hz: float, amplitude_v: float) -> None:
        """Put it out."""
        self._amplifier.carrier = (frequency_hz, amplitude_v)

    def off(self) -> None:
        """Nothing more."""
        self._amplifier.carrier = (0.0, 0.0)


class OffTellingGenerator(Generator):
    """One that says whether it is off."""

    def is_off(self) -> bool:
        """Its own word."""
        return self._amplifier.carrier == (0.0, 0.0)


class Supply:
    """Takes whatever it is given."""

    def __init__(self, amplifier: Amplifier) -> None:
        self._amplifier = amplifier

    def set_voltage(self, voltage_v: float) -> None:
        """Put it out."""
        self._amplifier.supply_v = voltage_v

    def read_voltage(self) -> float:
        """Its meter."""
        return self._amplifier.supply_v

    def off(self) -> None:
        """0 V."""
        self._amplifier.supply_v = 0.0


class Camera:
    """`writes`: what it puts out past the gate whenever it is stopped; None: nothing."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self.writes: float | None = None

    def start(self, rate_hz: float) -> None:
        """No frames."""

    def take(self) -> Frames | None:
        """No frames."""
        return None

    def stop(self) -> None:
        """The board's stream restarts with the output that it remembers."""
        if self.writes is not None:
            self._board.write(self.writes)


class Stand:
    """`writes`: what it puts out past the gate whenever it waits; None: nothing."""

    def __init__(self, board: Board) -> None:
        self._board = board
        self.writes: float | None = None

    def hang(self, mass_kg: float) -> None:
        """Nobody is there."""

    def lift(self) -> None:
        """Nobody is there."""

    def drop(self) -> None:
        """Nobody is there."""

    def wait(self, duration_s: float) -> None:
        """Time passes at once."""
        if self.writes is not None:
            self._board.write(self.writes)


class OwnBench:
    """The whole bench: its parts stay reachable for faults."""

    def __init__(self, *, tells_off: bool = False, supply: bool = False) -> None:
        self.amplifier = Amplifier()
        self.board = Board(self.amplifier)
        self.generator = (OffTellingGenerator if tells_off else Generator)(self.amplifier)
        self.camera, self.stand = Camera(self.board), Stand(self.board)
        description = RigDescription(
            name="own", rate_hz=RATE_HZ, block_samples=BLOCK, switch_sample=400, skew_s=2.5e-6,
            volt_per_code=VOLT_PER_CODE, amplifier_gain=GAIN, v_monitor_v_per_v=1 / GAIN,
            i_monitor_v_per_a=500.0, drive_limits=Limits("drive voltage", 0.0, 2.0, "V"),
            shell_area_m2=6e-5, lateral_stretch=3.0, scale_m_per_px=3.5e-4, mass_kg=0.25,
        )  # fmt: skip
        self.rig = Rig(
            description, self.board, self.board, self.generator, self.camera, self.stand,
            supply=Supply(self.amplifier) if supply else None,
        )  # fmt: skip
