"""Change the hung mass: by a person at the terminal, or by the client of a served twin."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Protocol

from haselab.base import DeviceError, LimitError

__all__ = [
    "Answers", "BenchStand", "Clock", "OperatorWeights", "Prompts", "WeightHandler", "check_mass",
    "check_wait",
]  # fmt: skip

_LONGEST_WAIT_S = 86400.0
_HEAVIEST_KG = 20.0
_CALL_S = 0.5  # longest time that one call lets pass


def check_mass(mass_kg: float) -> None:
    """Refuse a mass outside 0 to 20 kg.

    Raises:
        LimitError: The mass is outside 0 to 20 kg.
    """
    if not 0.0 <= mass_kg <= _HEAVIEST_KG:
        raise LimitError(
            f"The mass is {mass_kg:g} kg, but it must be within [0, {_HEAVIEST_KG:g}] kg. Use "
            "another mass."
        )


def check_wait(duration_s: float) -> None:
    """Refuse a waiting time outside 0 s to a day.

    Raises:
        LimitError: The time is outside 0 s to a day.
    """
    if not 0.0 <= duration_s <= _LONGEST_WAIT_S:
        raise LimitError(
            f"The waiting time is {duration_s:g} s, but it must be within [0, {_LONGEST_WAIT_S:g}] "
            "s. Split it."
        )


class WeightHandler(Protocol):
    """Changes the hung mass; does not let time pass on the bench's clock."""

    def hang(self, mass_kg: float) -> None:
        """Hang this mass."""

    def lift(self) -> None:
        """Lift the mass off the actuator."""

    def drop(self) -> None:
        """Release the mass."""


class Clock(Protocol):
    """The calls of an acquisition that a stand needs."""

    def pause(self) -> None:
        """Hold the output while blocks pass."""

    def catch_up(self) -> None:
        """Skip the blocks that have passed."""

    def pass_time(self, duration_s: float) -> None:
        """Let time pass."""


class Answers(Protocol):
    """Where the confirmations of a person come from."""

    def readline(self) -> str:
        """Wait for a confirmation; empty: there will be none."""


class Prompts(Protocol):
    """Where prompts to a person go."""

    def write(self, text: str, /) -> int:
        """Show a prompt."""

    def flush(self) -> None:
        """Show it now."""


class OperatorWeights:
    """A person at the terminal, who reads each step and confirms it with Enter.

    Args:
        ask: stream from which the reply is read.
        output: stream to which prompts are written.
    """

    def __init__(self, ask: Answers | None = None, output: Prompts | None = None) -> None:
        self._ask, self._output = ask or sys.stdin, output or sys.stderr

    def _request(self, prompt: str, task: str) -> None:
        self._output.write(prompt)
        self._output.flush()
        if not self._ask.readline():
            raise DeviceError(
                f"The prompt to {task} was not answered. Run this study in a terminal, or remove "
                "its loads."
            )

    def hang(self, mass_kg: float) -> None:
        """See `WeightHandler`; the output was commanded to 0 V and read back before."""
        task = f"hang {1e3 * mass_kg:g} g on the lower clamp" if mass_kg else "remove the mass"
        self._request(
            "All outputs were commanded to 0 V. Charge may remain. Switch the amplifier off, short "
            f"the electrodes and measure. Then {task}, remove the short, switch the amplifier on, "
            "keep clear and press Enter: ",
            task,
        )

    def lift(self) -> None:
        """See `WeightHandler`: the output keeps its voltage."""
        self._request(
            "HIGH VOLTAGE MAY BE ON. Do not touch the mass, the clamp or the actuator. Lift the "
            "mass by its insulating string, hold it and press Enter: ",
            "lift the mass",
        )

    def drop(self) -> None:
        """See `WeightHandler`; the recording runs, so this does not wait."""
        self._output.write("\aRelease the mass now.\n")
        self._output.flush()


class BenchStand:
    """Implements `haselab.rig.LoadStand`: changes the mass while the bench's clock continues.

    Args:
        weights: changes the mass.
        clock: of the bench.
    """

    def __init__(self, weights: WeightHandler, clock: Clock) -> None:
        self._weights = weights
        self._clock = clock

    def hang(self, mass_kg: float) -> None:
        """See `haselab.rig.LoadStand`."""
        check_mass(mass_kg)
        self._meanwhile(lambda: self._weights.hang(mass_kg))

    def lift(self) -> None:
        """See `haselab.rig.LoadStand`."""
        self._meanwhile(self._weights.lift)

    def _meanwhile(self, act: Callable[[], None]) -> None:
        self._clock.pause()
        act()
        self._clock.catch_up()

    def drop(self) -> None:
        """See `haselab.rig.LoadStand`."""
        self._weights.drop()

    def wait(self, duration_s: float) -> None:
        """See `haselab.rig.LoadStand`; waits for whole blocks."""
        check_wait(duration_s)
        left_s = duration_s
        while left_s > 0.0:  # in short calls: a bench can be made safe between two of them
            self._clock.pass_time(min(left_s, _CALL_S))
            left_s -= _CALL_S
