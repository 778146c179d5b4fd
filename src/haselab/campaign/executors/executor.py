"""What every executor does: take chunks of cases, and return their rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from haselab.campaign.plan import Job
from haselab.store.campaign.shards import CaseRow

__all__ = ["Chunk", "Executor", "Outcome"]


@dataclass(frozen=True)
class Chunk:
    """Cases that one worker computes one after the other.

    Args:
        number: of the chunk.
        jobs: the cases.
    """

    number: int
    jobs: tuple[Job, ...]


@dataclass(frozen=True)
class Outcome:
    """What became of a chunk.

    Args:
        chunk: that was submitted.
        rows: of its cases; cases without a row are computed again. None: the worker ended before
            it returned any.
        blamed: whether the worker may have ended because of these cases.
    """

    chunk: Chunk
    rows: list[CaseRow] | None
    blamed: bool = True


class Executor(Protocol):
    """Computes chunks. An executor keeps no results: what is lost is submitted again."""

    @property
    def workers(self) -> int:
        """How many chunks are computed at the same time."""

    def submit(self, chunk: Chunk) -> None:
        """Queue a chunk."""

    def wait(self, longest_s: float) -> list[Outcome]:
        """Wait until at least one chunk has an outcome, or a time has passed.

        Raises:
            DeviceError: the executor itself has failed.
        """

    def longest(self) -> tuple[Job, float] | None:
        """The case that has been running for the longest time, and this time in s.

        None: no case is running, or the executor does not know.
        """

    def close(self) -> None:
        """End all workers; chunks in work are given up."""
