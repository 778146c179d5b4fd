"""What is open and closes itself at the end of a `with` block."""

from __future__ import annotations

from typing import Self

__all__ = ["Closing"]


class Closing:
    """A context whose end is `close`, whatever ended the block."""

    def close(self) -> None:
        """Give back what is open."""
        raise NotImplementedError

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
