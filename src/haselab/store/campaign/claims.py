"""Claims on blocks of cases, so that several programs share a campaign without a server.

A claim only saves work: if two programs compute the same case, their rows are equal. It is a file
with the name of the program that made it. It expires when that program has ended: on the same
computer, or with locks that other computers see, at once; otherwise, or on a file system without
locks, after `EXPIRES_S` without a sign of life.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import socket
import threading
import time
from pathlib import Path
from types import TracebackType
from typing import Self

from haselab.store.claim import not_written
from haselab.store.session.lock import CAN_TELL, hold, is_held

__all__ = ["EXPIRES_S", "Claims"]

EXPIRES_S = 120.0
_SIGN_S = 15.0  # between two signs of life
_FOLDER, _PROGRAMS = "claims", "programs"


class Claims:
    """This program's claims. Use as a context: they end with it.

    Args:
        folder: of the campaign.
    """

    def __init__(self, folder: Path) -> None:
        self.writer = f"{socket.gethostname()[:40]}-{os.getpid()}-{secrets.token_hex(4)}"
        self._claims, self._programs = folder / _FOLDER, folder / _PROGRAMS
        self._own = self._programs / self.writer
        self._held: set[int] = set()
        self._ended = threading.Event()

    def __enter__(self) -> Self:
        try:
            self._claims.mkdir(parents=True, exist_ok=True)
            self._programs.mkdir(exist_ok=True)
            self._file = self._own.open("x+b")
            self._file.write(self.writer.encode())
            self._file.flush()
        except OSError as error:
            raise not_written(self._own, error) from None
        try:
            hold(self._file.fileno())
            self._has_locks = CAN_TELL
        except OSError:  # a file system without locks
            self._has_locks = False
        self._remove_ended()
        threading.Thread(target=self._sign, daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self._ended.set()
        for block in tuple(self._held):
            with contextlib.suppress(OSError):
                # After an interrupt, the claim may be that of another program.
                if _program_of(self._claims / str(block)) in ("", self.writer):
                    self.release(block)
        self._file.close()
        self._own.unlink(missing_ok=True)

    def _remove_ended(self) -> None:
        """Remove what programs that were killed have left."""
        for other in self._programs.iterdir():
            if other != self._own and not self._is_program_alive(other):
                other.unlink(missing_ok=True)
        for claim in self._claims.iterdir():
            if not self._is_alive(claim):
                claim.unlink(missing_ok=True)

    def _sign(self) -> None:
        while not self._ended.wait(_SIGN_S):
            with contextlib.suppress(OSError):
                os.utime(self._own)

    def take(self, block: int) -> bool:
        """Claim a block.

        Args:
            block: number.
        Returns:
            False: a program that is alive has claimed it.
        Raises:
            DeviceError: the disk is full, or refuses.
        """
        path = self._claims / str(block)
        self._held.add(block)  # first: an interrupt must not leave a claim that nobody releases
        for _ in range(2):
            try:
                self._make(path)
            except FileExistsError:
                if self._is_alive(path):
                    break
                with contextlib.suppress(OSError):
                    path.unlink()
                continue
            except OSError as error:
                path.unlink(missing_ok=True)
                raise not_written(path, error) from None
            return True
        self._held.discard(block)
        return False

    def _make(self, claim: Path) -> None:
        """Make a claim with the name of this program.

        It is a link to the file of this program, so that it never exists without the name: a
        program that is killed here leaves no claim of which nobody knows whose it is.

        Raises:
            FileExistsError: there is such a claim.
            OSError: the disk is full, or refuses.
        """
        try:
            claim.hardlink_to(self._own)
        except FileExistsError:
            raise
        except (OSError, NotImplementedError):  # a file system without links
            with claim.open("x", encoding="utf-8") as file:
                file.write(self.writer)

    def release(self, block: int) -> None:
        """End a claim.

        Args:
            block: number.
        """
        with contextlib.suppress(OSError):
            (self._claims / str(block)).unlink()
        self._held.discard(block)

    def _is_alive(self, claim: Path) -> bool:
        """Whether the program of a claim still works on it."""
        try:
            name = _program_of(claim)
            if not name:  # just created without a link, or its program ended in between
                return name is not None and _is_recent(claim)
            return self._is_program_alive(self._programs / name)
        except OSError:  # the claim has gone
            return False

    def _is_program_alive(self, program: Path) -> bool:
        """Whether the program of this file is at work."""
        if is_held(program):
            return True
        here = program.name.startswith(f"{socket.gethostname()[:40]}-")
        if here and self._has_locks:
            return False
        try:
            return _is_recent(program)
        except OSError:  # it has ended
            return False


def _program_of(claim: Path) -> str | None:
    """Name of the program that made a claim; empty if it has none yet; None if it is damaged.

    A file system may fill the file with NUL bytes after a power failure.

    Raises:
        OSError: there is no such claim.
    """
    name = claim.read_bytes().decode("utf-8", "replace")
    return name if name.isprintable() and "/" not in name else None


def _is_recent(path: Path) -> bool:
    """Whether the last sign of life is less than `EXPIRES_S` away from now.

    A sign from the future is of a clock that was set back, or of another computer. It does not
    count, else the claim of a program that has ended would last until the clock reaches it.

    Raises:
        OSError: there is no such file.
    """
    return abs(time.time() - path.stat().st_mtime) < EXPIRES_S
