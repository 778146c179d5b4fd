"""The computer that `haselab doctor` examines: files below a root, which a test can replace."""

from __future__ import annotations

import os
import stat
import sys
from dataclasses import dataclass, field
from pathlib import Path

__all__ = ["Finding", "Machine", "bad", "good"]


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Args:
        kind: runtime, extension, package, optional, program, rig, instrument or system.
        name: what was checked.
        found: it exists and works.
        detail: its version, or what is wrong.
        advice: what to do if it does not.
    """

    kind: str
    name: str
    found: bool
    detail: str
    advice: str = ""


@dataclass(frozen=True)
class Machine:
    """The computer that is examined.

    Args:
        root: of its files.
        platform: as `sys.platform`.
        user: number of the user.
        groups: numbers of the groups that the user is in.
    """

    root: Path = Path("/")
    platform: str = sys.platform
    user: int = field(default_factory=lambda: os.getuid() if hasattr(os, "getuid") else 0)
    groups: frozenset[int] = field(
        default_factory=lambda: frozenset(os.getgroups() if hasattr(os, "getgroups") else ())
    )

    def text(self, path: str) -> str:
        """Read a file, stripped; empty if it cannot be read."""
        try:
            return (self.root / path).read_text(encoding="utf-8", errors="replace").strip()
        except (OSError, ValueError):  # ValueError: a null character
            return ""

    def word(self, path: str) -> str:
        """Read a file as one printable line."""
        line = " ".join(self.text(path).split())
        return "".join(letter if letter.isprintable() else "?" for letter in line)

    def number(self, path: str) -> int | None:
        """Read a whole number from a file; None if there is none."""
        try:
            return int(self.text(path).split()[0])
        except (IndexError, ValueError):
            return None

    def entries(self, path: str) -> list[Path]:
        """List a folder, sorted."""
        try:
            return sorted((self.root / path).iterdir())
        except (OSError, ValueError):  # ValueError: a null character
            return []

    def runs(self, program: str) -> bool:
        """Whether a process of this name is running."""
        return any(
            self.text(f"proc/{entry.name}/comm") == program[:15]
            for entry in self.entries("proc")
            if entry.name.isdigit()
        )

    def may_use(self, path: str) -> bool | None:
        """Whether the user may read and write a device; None if it does not exist."""
        try:
            found = (self.root / path).stat()
        except (OSError, ValueError):  # ValueError: a null character
            return None
        if self.user in (0, found.st_uid):
            return True
        shift = 3 if found.st_gid in self.groups else 0
        wanted = (stat.S_IROTH | stat.S_IWOTH) << shift
        return found.st_mode & wanted == wanted

    def group(self, path: str) -> str:
        """Name of a device's group."""
        try:
            number = (self.root / path).stat().st_gid
        except (OSError, ValueError):  # ValueError: a null character
            return "dialout"
        for line in self.text("etc/group").splitlines():
            parts = line.split(":")
            if len(parts) > 2 and parts[2] == str(number):
                return parts[0]
        return "dialout"


def good(name: str, detail: str) -> Finding:
    """Make the finding of a check that passed."""
    return Finding("system", name, True, detail)


def bad(name: str, detail: str, advice: str) -> Finding:
    """Make the finding of a check that failed, with what to type."""
    return Finding("system", name, False, detail, advice)
