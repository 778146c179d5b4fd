"""Co-simulation of the firmware, instruction by instruction, with the twin's physics."""

from __future__ import annotations

import contextlib
import ctypes
import struct
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from haselab.base import Closing, DeviceError, InputError
from haselab.rig.chip.link import ChipLink
from haselab.rig.twin.twin_bench import TwinBench

__all__ = ["CLOCK_HZ", "SLOTS", "SLOT_S", "CoSim", "Output", "Track"]

CLOCK_HZ = 16_000_000
SLOT_S = 125e-6  # from one conversion to the next
SLOTS = 8  # of an update


class Output(NamedTuple):
    """A change of the output: `time_s` since power-up, `code` of the converter, `enable` pin."""

    time_s: float
    code: int
    enable: int

    @property
    def on(self) -> bool:
        """Whether the high-voltage module gets more than 0 V."""
        return bool(self.enable and self.code)


class Track(NamedTuple):
    """True values: `time_s`, `length_m` of the sheet, `high_v` at the module's output."""

    time_s: float
    length_m: float
    high_v: float


class CoSim(Closing, ChipLink):
    """A simulated microcontroller with a twin. Use as a context, whose end ends the process.

    Args:
        program: of `build_cosim`.
        elf: the firmware.
        twin: bench from whose present state the co-simulation starts; it is not changed.
        supply_v: supply voltage of the microcontroller, in V.
    Raises:
        DeviceError: The program does not start.
    """

    def __init__(self, program: Path, elf: Path, twin: TwinBench, supply_v: float = 5.0) -> None:
        super().__init__()
        self.outputs: list[Output] = []
        self.tracks: list[Track] = []
        self.counts: dict[str, float] = {}
        self._folder = tempfile.TemporaryDirectory()
        physics = Path(self._folder.name) / "physics.bin"
        try:
            reported = subprocess.run(
                [str(program), "--sizes"], capture_output=True, text=True, check=True
            ).stdout
            sizes = [int(word) for word in reported.split()]
            places = zip(twin.native.addresses, sizes, strict=True)
            state = b"".join(ctypes.string_at(address, size) for address, size in places)
            physics.write_bytes(state + struct.pack("d", twin.load_n))
            self._process = subprocess.Popen(
                [str(program), str(elf), str(physics), str(round(1e3 * supply_v))],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                # Ctrl-C is for the main program, which stops the output first
                process_group=0,
            )  # fmt: skip
        except (OSError, subprocess.CalledProcessError) as error:
            self._folder.cleanup()
            raise DeviceError(
                f"The co-simulation does not start ({error}). Build it again. {program}"
            ) from None

    def close(self) -> None:
        """End the process."""
        process = self._process
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        try:
            process.wait(timeout=5.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        self._folder.cleanup()

    # ---- the program -----------------------------------------------------------------------------

    def command(self, line: str) -> list[list[str]]:
        """Send one command of firmware/sim/cosim.c.

        Args:
            line: the command, see there.
        Returns:
            Its reply without outputs, tracks and link data, split into words.
        Raises:
            DeviceError: The program ended.
            InputError: The program does not know the command.
        """
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        other: list[list[str]] = []
        link, unknown = bytearray(), False
        try:
            stdin.write(line + "\n")
            stdin.flush()
        except OSError:
            raise DeviceError(f"The co-simulation ended at {line!r}. Start it again.") from None
        for answer in stdout:
            kind, *words = answer.split()
            if kind == "ok":
                self.counts = {k: float(v) for k, v in (word.split("=") for word in words)}
                self.decoded(bytes(link))
                if unknown:
                    raise InputError(
                        f"The co-simulation has no command {line!r}. Use one of cosim.c."
                    )
                return other
            if kind == "uart":
                link += bytes.fromhex(words[0])
            elif kind == "out":
                at, code, enable = map(int, words)
                self.outputs.append(Output(at / CLOCK_HZ, code, enable))
            elif kind == "track":
                self.tracks.append(
                    Track(int(words[0]) / CLOCK_HZ, float(words[1]), float(words[2]))
                )
            elif kind == "bad":
                unknown = True
            else:
                other.append([kind, *words])
        raise DeviceError(f"The co-simulation ended at {line!r}. Start it again.")

    @property
    def time_s(self) -> float:
        """Time since power-up, in s."""
        return self.counts.get("cycle", 0.0) / CLOCK_HZ

    @property
    def load(self) -> float:
        """Fraction of the cycles since power-up in which the CPU did not sleep."""
        return 1.0 - self.counts["asleep"] / self.counts["cycle"]

    def put(self, data: bytes) -> None:
        """See `ChipLink`."""
        self.command(f"send {data.hex()}")

    def receive(self, duration_s: float) -> Iterator[Any]:
        """See `ChipLink`; the whole time passes, rounded to a cycle."""
        known = len(self.messages)
        self.command(f"run {round(duration_s * CLOCK_HZ)}")
        return iter(self.messages[known:])

    def fault(self, name: str) -> float:
        """Inject a fault; see cosim.c.

        Returns:
            Time of the fault, in s since power-up.
        """
        self.command(f"fault {name}")
        return self.time_s
