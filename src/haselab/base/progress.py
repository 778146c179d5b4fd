"""Progress of long work, told to whoever listens."""

from __future__ import annotations

from typing import Protocol

__all__ = ["Progress", "SilentProgress"]


class Progress(Protocol):
    """Listener of a long job."""

    def start(self, total: float) -> None:
        """A job of `total` units of work begins."""

    def advance(self, amount: float, what: str) -> None:
        """`amount` further units are done; `what` names the present step."""

    def stop(self) -> None:
        """The job is over, done or not."""


class SilentProgress:
    """Listens to nothing."""

    def start(self, total: float) -> None:
        """Ignore."""

    def advance(self, amount: float, what: str) -> None:
        """Ignore."""

    def stop(self) -> None:
        """Ignore."""
