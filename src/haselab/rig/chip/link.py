"""The link to the microcontroller: commands and replies over any transport."""

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
    Fault,
    Hello,
    Identity,
    RequestArming,
    Result,
    State,
    Status,
)

__all__ = ["ChipLink"]

_HELLO_TRIALS = 3  # the first one may meet half a frame, or an output that is ramping down


class ChipLink(ABC):
    """Sends and receives the messages of `firmware/protocol`; a subclass transports the bytes.

    `messages` holds all received messages, oldest first; the reader may clear it.
    """

    patience_s = 5e-3  # longer than any reply takes

    def __init__(self) -> None:
        self.messages: list[Any] = []
        self._reader = FrameReader()
        self._sequence = 0

    @abstractmethod
    def put(self, data: bytes) -> None:
        """Send bytes; no time passes.

        Raises:
            DeviceError: The link is lost.
        """

    @abstractmethod
    def receive(self, duration_s: float) -> Iterator[Any]:
        """Yield messages that arrive while time passes; stop early if the caller does.

        Args:
            duration_s: in s.
        Raises:
            DeviceError: The link is lost.
        """

    @abstractmethod
    def close(self) -> None:
        """Close the link. The microcontroller then ramps its output down by itself."""

    @property
    def bad_frames(self) -> int:
        """Number of received frames that were damaged."""
        return self._reader.bad_frames

    def decoded(self, data: bytes) -> list[Any]:
        """Decode received bytes.

        Args:
            data: received bytes.
        Returns:
            The messages that they complete.
        """
        found = [message for message, _ in self._reader.feed(data)]
        self.messages += found
        return found

    def run(self, duration_s: float) -> list[Any]:
        """Let time pass.

        Args:
            duration_s: in s.
        Returns:
            The received messages.
        Raises:
            DeviceError: The link is lost.
        """
        return list(self.receive(duration_s))

    def send(self, message: Any, sequence: int | None = None) -> bytes:
        """Send a command; no time passes.

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

    def query(self, message: Any, wait_s: float | None = None) -> Any:
        """Send a command and wait for its reply.

        Args:
            message: of `haselab.firmware.messages`.
            wait_s: longest wait for the reply, in s; `patience_s` by default.
        Returns:
            `Ack` or `Identity`; None if there was no reply.
        """
        self.send(message)
        number = self._sequence & 0xFFFF
        for reported in self.receive(self.patience_s if wait_s is None else wait_s):
            is_identity = isinstance(reported, Identity) and isinstance(message, Hello)
            if is_identity or (isinstance(reported, Ack) and reported.answered == number):
                return reported
        return None

    def execute(self, message: Any, wait_s: float | None = None) -> Ack:
        """Send a command that must be accepted.

        Args:
            message: of `haselab.firmware.messages`.
            wait_s: longest wait for the reply, in s; `patience_s` by default.
        Returns:
            The ack.
        Raises:
            DeviceError: The command was refused, or there was no reply.
        """
        answer = self.query(message, wait_s)
        if not isinstance(answer, Ack) or answer.result != Result.ACCEPTED:
            what = "no reply" if answer is None else Result(answer.result).name.lower()
            states = [m for m in self.messages if isinstance(m, Status)]
            if states and states[-1].state == State.TRIPPED:
                what = f"tripped: {Fault(states[-1].fault).name.lower()}"
            raise DeviceError(
                f"The microcontroller did not accept {type(message).__name__} ({what}). Check its "
                "state, and clear its fault."
            )
        return answer

    def hello(self) -> Identity:
        """Connect with this version of the protocol.

        Returns:
            The microcontroller's identity.
        Raises:
            DeviceError: No reply: its output is on, or it has other firmware.
        """
        for _ in range(_HELLO_TRIALS):
            answer = self.query(Hello(VERSION))
            if isinstance(answer, Identity):
                return answer
        raise DeviceError(
            "The microcontroller does not reply to hello. Check its port and its power, wait until "
            "its output is off, and flash this firmware."
        )

    def arm(self, settle_s: float = 0.06) -> None:
        """Connect, and arm in two steps.

        Args:
            settle_s: time until the strain is valid, in s.
        Raises:
            DeviceError: The output is not off.
        """
        self.hello()
        self.arm_in_two_steps()
        self.run(settle_s)

    def arm_in_two_steps(self) -> None:
        """Request a token, then confirm arming with it.

        Raises:
            DeviceError: The output is not off.
        """
        token = self.execute(RequestArming()).token
        self.execute(ConfirmArming(token))
