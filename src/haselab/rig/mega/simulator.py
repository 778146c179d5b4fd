"""The chip in co-simulation: firmware, instruction by instruction, against the twin's physics."""

from __future__ import annotations

import contextlib
import ctypes
import struct
import subprocess
import tempfile
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

from haselab.base import DeviceError, InputError
from haselab.firmware import FrameReader, encode_message
from haselab.firmware.messages import (
    VERSION,
    Ack,
    ConfirmArming,
    Hello,
    Identity,
    RequestArming,
    Verdict,
)
from haselab.rig.twin.bench import TwinBench

__all__ = ["CLOCK_HZ", "CoSim", "Output", "Track"]

CLOCK_HZ = 16_000_000
_ANSWER_S = 5e-3  # longer than any answer takes


class Output(NamedTuple):
    """A change of the output: `time_s` since power-up, `code` of the converter, `enable` pin."""

    time_s: float
    code: int
    enable: int

    @property
    def on(self) -> bool:
        """The high-voltage module gets more than 0 V."""
        return bool(self.enable and self.code)


class Track(NamedTuple):
    """Truth: `time_s`, `length_m` of the sheet, `high_v` at the module's output."""

    time_s: float
    length_m: float
    high_v: float


class CoSim:
    """A chip that runs beside a twin. Use as a context: its end ends the process.

    Args:
        program: of `build_cosim`.
        elf: the firmware.
        twin: the bench, whose present state the co-simulation starts from; it stays as it is.
    Raises:
        DeviceError: the program does not start.
    """

    def __init__(self, program: Path, elf: Path, twin: TwinBench) -> None:
        self.outputs: list[Output] = []
        self.tracks: list[Track] = []
        self.messages: list[Any] = []
        self.counts: dict[str, float] = {}
        self._reader = FrameReader()
        self._sequence = 0
        self._folder = tempfile.TemporaryDirectory()
        physics = Path(self._folder.name) / "physics.bin"
        try:
            told = subprocess.run(
                [str(program), "--sizes"], capture_output=True, text=True, check=True
            ).stdout
            sizes = [int(word) for word in told.split()]
            places = zip(twin.native.addresses, sizes, strict=True)
            state = b"".join(ctypes.string_at(address, size) for address, size in places)
            physics.write_bytes(state + struct.pack("d", twin.load_n))
            self._process = subprocess.Popen(
                [str(program), str(elf), str(physics)],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
            )  # fmt: skip
        except (OSError, subprocess.CalledProcessError) as error:
            self._folder.cleanup()
            raise DeviceError(f"The co-simulation does not start ({error}). {program}") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

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
        """One command of firmware/sim/cosim.c.

        Args:
            line: see there.
        Returns:
            What it answered beyond outputs, tracks and the link, in words.
        Raises:
            DeviceError: the program ended.
            InputError: it does not know the command.
        """
        stdin, stdout = self._process.stdin, self._process.stdout
        assert stdin is not None
        assert stdout is not None
        other: list[list[str]] = []
        link = bytearray()
        try:
            stdin.write(line + "\n")
            stdin.flush()
        except OSError:
            raise DeviceError(f"The co-simulation ended at {line!r}. Start it again.") from None
        for answer in stdout:
            kind, *words = answer.split()
            if kind == "ok":
                self.counts = {k: float(v) for k, v in (word.split("=") for word in words)}
                self.messages += [message for message, _ in self._reader.feed(bytes(link))]
                return other
            if kind == "uart":
                link.append(int(words[0], 16))
            elif kind == "out":
                at, code, enable = map(int, words)
                self.outputs.append(Output(at / CLOCK_HZ, code, enable))
            elif kind == "track":
                self.tracks.append(
                    Track(int(words[0]) / CLOCK_HZ, float(words[1]), float(words[2]))
                )
            elif kind == "bad":
                raise InputError(f"The co-simulation does not know {line!r}. See cosim.c.")
            else:
                other.append([kind, *words])
        raise DeviceError(f"The co-simulation ended at {line!r}. Start it again.")

    @property
    def time_s(self) -> float:
        """Since power-up, in s."""
        return self.counts.get("cycle", 0.0) / CLOCK_HZ

    @property
    def load(self) -> float:
        """Share of the cycles that the CPU did not sleep, since power-up."""
        return 1.0 - self.counts["asleep"] / self.counts["cycle"]

    @property
    def bad_frames(self) -> int:
        """Frames of the chip that were not whole."""
        return self._reader.bad_frames

    def run(self, duration_s: float) -> list[Any]:
        """Let time pass.

        Args:
            duration_s: rounded to a cycle, in s.
        Returns:
            The chip's messages.
        """
        known = len(self.messages)
        self.command(f"run {round(duration_s * CLOCK_HZ)}")
        return self.messages[known:]

    def fault(self, name: str) -> float:
        """Break something; see cosim.c.

        Returns:
            When, in s since power-up.
        """
        self.command(f"fault {name}")
        return self.time_s

    # ---- the link --------------------------------------------------------------------------------

    def send(self, message: Any, sequence: int | None = None) -> bytes:
        """Put a command on the wire, and let no time pass.

        Args:
            message: of `haselab.firmware.messages`.
            sequence: its number; the next one by default.
        Returns:
            The frame.
        """
        if sequence is None:
            self._sequence += 1
            sequence = self._sequence
        frame = encode_message(message, sequence)
        self.command(f"send {frame.hex()}")
        return frame

    def ask(self, message: Any, wait_s: float = _ANSWER_S) -> Any:
        """A command and its answer.

        Args:
            message: of `haselab.firmware.messages`.
            wait_s: time that passes, in s.
        Returns:
            `Ack` or `Identity`; None where nothing came.
        """
        self.send(message)
        answers = [m for m in self.run(wait_s) if isinstance(m, (Ack, Identity))]
        return answers[0] if answers else None

    def tell(self, message: Any, wait_s: float = _ANSWER_S) -> Ack:
        """A command that has to be accepted.

        Args:
            message: of `haselab.firmware.messages`.
            wait_s: time that passes, in s.
        Returns:
            The ack.
        Raises:
            DeviceError: it was not, or no answer came.
        """
        answer = self.ask(message, wait_s)
        if not isinstance(answer, Ack) or answer.verdict != Verdict.ACCEPTED:
            what = "nothing" if answer is None else Verdict(answer.verdict).name.lower()
            raise DeviceError(
                f"{type(message).__name__} was answered by {what}, needed is accepted. Look at the "
                "chip's state, and clear its fault."
            )
        return answer

    def arm(self, settle_s: float = 0.06) -> None:
        """Greet, and arm in two steps.

        Args:
            settle_s: time until the strain is valid, in s.
        Raises:
            DeviceError: the chip is not off.
        """
        self.ask(Hello(VERSION))
        token = self.tell(RequestArming()).token
        self.tell(ConfirmArming(token))
        self.run(settle_s)
