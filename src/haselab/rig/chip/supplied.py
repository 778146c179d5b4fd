"""The simulated microcontroller with a serial high-voltage supply instead of an analogue module.

The microcontroller computes phase, strain and controller. The computer reads the output codes of
its updates from the link and sends the mean of those since the last command to the supply's serial
port.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from haselab.firmware import OUTPUT_V_PER_CODE
from haselab.firmware.messages import State, Trace
from haselab.rig.chip.simulator import CLOCK_HZ, SLOT_S, CoSim
from haselab.rig.instruments.petapicovoltron.section import PetaPicoVoltronConfig
from haselab.rig.instruments.petapicovoltron.supply import PetaPicoVoltron
from haselab.rig.twin.serve.supply.server import SupplyFaults, SupplyServer
from haselab.rig.twin.twin_bench import TwinBench
from haselab.store.toml import Section

__all__ = ["SuppliedCoSim", "SupplyModel", "SupplyOutput"]

_BITS_PER_BYTE = 10  # 8N1
_BAUD = 115_200
_REACH_V = 5000.0  # of `SupplyServer`
_LIVE = (State.RUNNING, State.STOPPING)


class SupplyModel(Section):
    """Limits of a supply of the Peta-Pico-Voltron family.

    Range, step of the set point, current and divider are published (HardwareX 2018 e00039,
    petapicovoltron.com); the other values are assumptions, to be replaced by measured ones.
    """

    highest_v: float = Field(_REACH_V, gt=100, le=_REACH_V)
    step_v: float = Field(5.0, gt=0, le=100, description="of the set point: reach / 1000")
    current_a: float = Field(
        110e-6, gt=0, le=1e-2, description="through the optocoupler bridge, up and down"
    )
    divider_ohm: float = Field(250e6, gt=1e6, description="voltage divider across the output")
    load_f: float = Field(1e-9, gt=0, le=1e-6, description="output, cable and actuator")
    response_s: float = Field(5e-3, gt=0, le=10, description="of the supply's own regulator")
    ripple_v: float = Field(1.0, ge=0, le=100, description="rms at the output, white up to 4 kHz")
    processing_s: float = Field(1e-3, ge=0, le=1, description="from a command's end to its effect")
    every_s: float = Field(10e-3, ge=5e-3, le=1, description="between two commands")

    @property
    def slew_v_per_s(self) -> float:
        """Slew rate at the highest voltage, which the current limits, in V/s."""
        return (self.current_a - self.highest_v / self.divider_ohm) / self.load_f

    def command_s(self, voltage_v: float) -> float:
        """Time from the first byte of a set point to its effect, in s."""
        sent = len(f"SVset {round(voltage_v)}\r")
        return sent * _BITS_PER_BYTE / _BAUD + self.processing_s

    @property
    def delay_s(self) -> float:
        """Delay from the output code to the middle of the voltage's response, in s.

        One command and the regulator's time constant, without the hold between two commands.
        """
        return self.command_s(self.highest_v) + self.response_s


class SupplyOutput:
    """Output voltage of a supply in simulated time; implements `Rail`.

    Args:
        model: its limits.
        seed: of the ripple.
    """

    def __init__(self, model: SupplyModel, seed: int) -> None:
        self._model = model
        self._random = np.random.default_rng(seed)
        self._set_v = self._target_v = self._output_v = 0.0
        self._wait_slots = 0

    @property
    def rail_v(self) -> float:
        """See `Rail`."""
        return self._output_v

    def rail(self, voltage_v: float) -> None:
        """See `Rail`; takes effect once the command has been sent and processed."""
        target_v = min(voltage_v, self._model.highest_v)
        target_v = self._model.step_v * round(target_v / self._model.step_v)
        if target_v == self._target_v:
            return
        self._target_v = target_v
        self._wait_slots = math.ceil(self._model.command_s(voltage_v) / SLOT_S)

    def advance(self, slots: int) -> NDArray[np.float64]:
        """Let time pass.

        Args:
            slots: number of slots of 125 us.
        Returns:
            The output voltage, one value per slot, in V.
        """
        m = self._model
        share = -math.expm1(-SLOT_S / m.response_s)
        out_v = np.empty(slots)
        for k in range(slots):
            if self._wait_slots == 0:
                self._set_v = self._target_v
            self._wait_slots = max(0, self._wait_slots - 1)
            leak_a = self._output_v / m.divider_ohm
            up_v = (m.current_a - leak_a) / m.load_f * SLOT_S
            down_v = (m.current_a + leak_a) / m.load_f * SLOT_S
            wanted_v = share * (self._set_v - self._output_v)
            self._output_v += min(max(wanted_v, -down_v), up_v)
            out_v[k] = self._output_v
        ripple_v = m.ripple_v * self._random.standard_normal(slots)
        return np.maximum(0.0, np.where(out_v > m.step_v, out_v + ripple_v, out_v))


class SuppliedCoSim(CoSim):
    """A simulated microcontroller whose high voltage comes from a serial supply.

    The supply's driver communicates with an emulated supply over a pseudo-terminal, byte by byte;
    only simulated time passes.

    Args:
        program: of `build_cosim`.
        elf: the firmware.
        twin: bench from whose present state the co-simulation starts.
        model: of the supply.
        gain: V at the actuator per V of the microcontroller's output.
        seed: of the supply's ripple.
    Raises:
        DeviceError: The program does not start, or pseudo-terminals or the serial driver are
            missing.
    """

    def __init__(
        self,
        program: Path,
        elf: Path,
        twin: TwinBench,
        model: SupplyModel,
        gain: float,
        seed: int = 0,
    ) -> None:
        super().__init__(program, elf, twin)
        self._model, self._gain = model, gain
        self._codes: list[int] = []  # of the updates since the last command
        self._next_cycle = 0
        self.commands = 0  # number of commands sent to the supply
        self.supply = SupplyOutput(model, seed)
        self._end = contextlib.ExitStack()
        try:
            # its voltage decays in simulated time, by its own model
            server = SupplyServer(self.supply, faults=SupplyFaults(decay_s=0.0))
            self._end.callback(server.close)
            self._driver = PetaPicoVoltron(
                PetaPicoVoltronConfig(port=server.port, highest_v=model.highest_v)
            )
            self._end.callback(self._driver.close)
        except BaseException:
            self.close()
            raise

    def decoded(self, data: bytes) -> list[Any]:
        """See `ChipLink`; the updates contain the voltage for the supply."""
        found = super().decoded(data)
        for message in found:
            if isinstance(message, Trace) and message.state in _LIVE:
                self._codes.append(message.code)
            elif isinstance(message, Trace):
                self._codes = [0]  # off or tripped: discard earlier codes
        return found

    def receive(self, duration_s: float) -> Iterator[Any]:
        """See `ChipLink`; sends the supply a command at regular times."""
        known = len(self.messages)
        cycle = round(self.counts.get("cycle", 0.0))
        end = cycle + round(duration_s * CLOCK_HZ)
        while cycle < end:
            if cycle >= self._next_cycle:
                self._pass_on()
                self._next_cycle = cycle + round(self._model.every_s * CLOCK_HZ)
            self.command(f"run {min(end, self._next_cycle) - cycle}")
            cycle = round(self.counts["cycle"])
        return iter(self.messages[known:])

    def _pass_on(self) -> None:
        """Send the mean output code to the supply as its set point."""
        code = float(np.mean(self._codes)) if self._codes else 0.0  # no update: no voltage
        self._codes = []
        volt = code * OUTPUT_V_PER_CODE * self._gain
        self._driver.set_voltage(min(volt, self._model.highest_v))
        self.commands += 1
        volts = self.supply.advance(round(self._model.every_s / SLOT_S))
        self.command("rail " + " ".join(f"{volt / self._gain:.6g}" for volt in volts))

    def close(self) -> None:
        """Switch the supply off and end the process."""
        self._end.close()
        super().close()
