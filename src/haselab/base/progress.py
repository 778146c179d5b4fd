"""Progress reports of long jobs."""

from __future__ import annotations

from typing import Protocol

__all__ = ["Progress", "SilentProgress"]


class Progress(Protocol):
    """Listener for the progress of a long job."""

    def start(self, total: float) -> None:
        """Start a job of `total` units of work."""

    def advance(self, amount: float, what: str) -> None:
        """Report `amount` more units as done; `what` names the present step."""

    def stop(self) -> None:
        """End the job, finished or not."""


class SilentProgress:
    """A listener that ignores everything."""

    def start(self, total: float) -> None:
        """Ignore."""

    def advance(self, amount: float, what: str) -> None:
        """Ignore."""

    def stop(self) -> None:
        """Ignore."""
