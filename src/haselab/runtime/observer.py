"""Whoever watches the actuator while a runner plays."""

from __future__ import annotations

from typing import Protocol

__all__ = ["FIDUCIALS", "PARTICLES", "Observer"]

PARTICLES = 400  # at most so many particles are followed
FIDUCIALS = 6  # a row of three on the upper clamp, a row of three on the lower one


class Observer(Protocol):
    """Whoever watches the actuator while a runner plays."""

    def start(
        self, name: str, rate_hz: float, mass_kg: float, part: str = "", particles: str = ""
    ) -> None:
        """Begin an experiment, or a part of it; `particles` names where particles are recorded."""

    def look(self) -> None:
        """Take in what has happened since the last look."""

    def finish(self) -> None:
        """End the experiment or the part."""
