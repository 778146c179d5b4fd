"""Protocol of an observer, which watches the actuator while a runner plays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

__all__ = ["FIDUCIALS", "PARTICLES", "Observer", "Seen"]

PARTICLES = 400  # most particles that are tracked
FIDUCIALS = 6  # a row of three on the upper clamp, a row of three on the lower one


@dataclass(frozen=True)
class Seen:
    """The actuator in the last frame that has arrived.

    Args:
        time_s: middle of the exposure.
        length_px: between the rows of fiducials of both clamps; NaN if one of them is lost.
    """

    time_s: float
    length_px: float


class Observer(Protocol):
    """Watches the actuator while a runner plays."""

    def start(
        self, name: str, rate_hz: float, mass_kg: float, part: str = "", particles: str = ""
    ) -> None:
        """Begin an experiment, or a part of it; record particles under the name `particles`."""

    def look(self) -> Seen | None:
        """Process what has arrived since the last call; return None if nothing has."""

    def finish(self) -> None:
        """End the experiment, or the part of it."""
