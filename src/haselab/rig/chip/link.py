"""The chip's link: commands with their answers, on whatever carries the bytes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any

from haselab.base import DeviceError
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

__all__ = ["ChipLink"]

_GREETINGS = 3  # the first one may meet half a frame, or an output that is on its way down


class ChipLink(ABC):
    """Speaks the table of `firmware/protocol`. Who inherits moves the bytes.

    `messages` holds all that has come in, oldest first; whoever reads them may clear it.
    """

    patience_s = 5e-3  # longer than the chip takes for any answer

    def __init__(self) -> None:
        self.messages: list[Any] = []
        self._reader = FrameReader()
        self._sequence = 0

    @abstractmethod
    def put(self, data: bytes) -> None:
        """Bytes to the chip; no time passes.

        Raises:
            DeviceError: the link is gone.
        """

    @abstractmethod
    def arrivals(self, duration_s: float) -> Iterator[Any]:
        """What comes in while time passes; it need not pass to the end where nobody asks on.

        Args:
            duration_s: in s.
        Raises:
            DeviceError: the link is gone.
        """

    @abstractmethod
    def close(self) -> None:
        """End the link. The chip ramps its output down by itself when it hears nothing."""

    @property
    def bad_frames(self) -> int:
        """Frames of the chip that were not whole."""
        return self._reader.bad_frames

    def came(self, data: bytes) -> list[Any]:
        """Bytes of the chip to messages.

        Args:
            data: as they came.
        Returns:
            The messages that they end.
        """
        found = [message for message, _ in self._reader.feed(data)]
        self.messages += found
        return found

    def run(self, duration_s: float) -> list[Any]:
        """Let time pass.

        Args:
            duration_s: in s.
        Returns:
            The chip's messages.
        Raises:
            DeviceError: the link is gone.
        """
        return list(self.arrivals(duration_s))

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
        self.put(frame)
        return frame

    def ask(self, message: Any, wait_s: float | None = None) -> Any:
        """A command and its answer.

        Args:
            message: of `haselab.firmware.messages`.
            wait_s: for the answer, in s; `patience_s` by default.
        Returns:
            `Ack` or `Identity`; None where nothing came.
        """
        self.send(message)
        number = self._sequence & 0xFFFF
        for reported in self.arrivals(self.patience_s if wait_s is None else wait_s):
            greeted = isinstance(reported, Identity) and isinstance(message, Hello)
            if greeted or (isinstance(reported, Ack) and reported.answered == number):
                return reported
        return None

    def tell(self, message: Any, wait_s: float | None = None) -> Ack:
        """A command that has to be accepted.

        Args:
            message: of `haselab.firmware.messages`.
            wait_s: for the answer, in s; `patience_s` by default.
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

    def greet(self) -> Identity:
        """Say which table is spoken.

        Returns:
            The chip's word about itself.
        Raises:
            DeviceError: no answer: it is on, or no chip of this firmware.
        """
        for _ in range(_GREETINGS):
            answer = self.ask(Hello(VERSION))
            if isinstance(answer, Identity):
                return answer
        raise DeviceError(
            "The chip does not answer to hello; needed is one that runs this firmware and is off. "
            "Check port and power, flash it, and wait until its output is down."
        )

    def arm(self, settle_s: float = 0.06) -> None:
        """Greet, and arm in two steps.

        Args:
            settle_s: time until the strain is valid, in s.
        Raises:
            DeviceError: the chip is not off.
        """
        self.greet()
        self.arm_in_two_steps()
        self.run(settle_s)

    def arm_in_two_steps(self) -> None:
        """Ask for a token, and give it back.

        Raises:
            DeviceError: the chip is not off.
        """
        token = self.tell(RequestArming()).token
        self.tell(ConfirmArming(token))
