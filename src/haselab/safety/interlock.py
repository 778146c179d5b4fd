"""The interlock of one bench: a latch and two locks that every process on this computer sees.

One small file in shared memory and two lock files belong to each output device, named after its
serial number. Standard library only: the guardian processes use it too.

- The *owner lock* is held by the one program that uses the bench.
- The *latch* is a revision, a number drawn anew by every revocation. A permission to energise is
  valid for one revision: whoever draws a new one ends it, and nobody can give it back. A new
  permission needs an acknowledgement of the reason that the latch holds.
- The *output lock* is held during every call that may energise something, and by whoever makes the
  bench safe, so that no call that began with a valid permission ends after the bench was made safe.

A file that was damaged, emptied or removed means that no permission is valid.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import signal
import struct
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["HEARTBEATS", "Interlock", "InterlockBusyError", "interlock_folder"]

HEARTBEATS = 2  # of the two guardians
DAMAGED = -1  # the revision of a file that cannot be trusted: no permission has it
_MAGIC = b"HASELAB3"
_BYTES = 1024
_REVISION, _ACKNOWLEDGED, _LIVE, _OWNER, _SAFE, _HOLDER, _BEAT = range(8, 64, 8)
_LEASE, _TIME, _CALL = (_BEAT + 8 * (HEARTBEATS + k) for k in range(3))
_REASON, _USER = (128, 640), (640, 1024)  # texts, from byte to byte
_POLL_S = 0.002  # between two trials of a lock
_CALL_S = 2.0  # that a call of a driver may take, unless the owner says longer
_FOLDER = "HASELAB_INTERLOCKS"  # environment variable that names another folder


class InterlockBusyError(OSError):
    """Another program uses the bench."""


def interlock_folder() -> Path:
    """Folder that all users of this computer share; on Linux in memory, so a restart clears it."""
    given = os.environ.get(_FOLDER)
    if given:
        if not Path(given).is_absolute():
            raise OSError(f"{_FOLDER} is {given!r}, but it must be an absolute path")
        return Path(given)
    shared = Path("/dev/shm")
    return (shared if shared.is_dir() else Path(tempfile.gettempdir())) / "haselab-interlocks"


def _open_shared(path: Path) -> int:
    """A file that every user may open, not followed if it is a link."""
    flags = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
    for _ in range(3):
        with contextlib.suppress(FileNotFoundError):
            return os.open(path, flags)
        with contextlib.suppress(FileExistsError):
            handle = os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o666)
            if hasattr(os, "fchmod"):
                os.fchmod(handle, 0o666)  # whatever the umask is
            return handle
    return os.open(path, flags)


class _FileLock:
    """A lock that the system releases when the process ends; exclusive among threads as well.

    Args:
        path: of the lock file; None: threads of this process only.
    """

    def __init__(self, path: Path | None) -> None:
        self._handle = -1 if path is None else _open_shared(path)
        self._threads = threading.RLock()
        self._depth = 0
        self._pid = os.getpid()

    def acquire(self, wait_s: float) -> bool:
        """Whether it was acquired within this time; the holding thread may acquire it again."""
        end_s = time.monotonic() + wait_s
        if not self._threads.acquire(timeout=max(0.0, wait_s)):
            return False
        if self._depth == 0:
            while not self._try():
                if time.monotonic() >= end_s:
                    self._threads.release()
                    return False
                time.sleep(_POLL_S)
        self._depth += 1
        return True

    def release(self) -> None:
        """Release it once. In a fork it stays with the process that acquired it."""
        self._depth -= 1
        if self._depth == 0 and self._handle >= 0 and os.getpid() == self._pid:
            if sys.platform == "win32":
                os.lseek(self._handle, 0, os.SEEK_SET)
                msvcrt.locking(self._handle, msvcrt.LK_UNLCK, 1)
            else:
                fcntl.flock(self._handle, fcntl.LOCK_UN)
        self._threads.release()

    def _try(self) -> bool:
        if self._handle < 0:
            return True
        try:
            if sys.platform == "win32":
                os.lseek(self._handle, 0, os.SEEK_SET)
                msvcrt.locking(self._handle, msvcrt.LK_NBLCK, 1)
            else:
                fcntl.flock(self._handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return False
        return True

    def close(self) -> None:
        """Close the file, which releases the lock."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1


class Interlock:
    """One bench's latch and locks.

    Args:
        key: what identifies the output device, as `NI 01A2B3C4`; empty: a bench that lives
            in this process alone, such as the simulated one.
        folder: None: `interlock_folder()`.
    Raises:
        OSError: the folder cannot be used.
    """

    def __init__(self, key: str = "", folder: Path | None = None) -> None:
        self.key = key
        self._owns = False
        self._pid = os.getpid()
        self._private = bytearray(_MAGIC.ljust(_BYTES, b"\0"))
        self._path: Path | None = None
        self._file = -1
        if not key:
            self._owner, self._output = _FileLock(None), _FileLock(None)
            return
        place = folder or interlock_folder()
        place.mkdir(mode=0o777, parents=True, exist_ok=True)
        with contextlib.suppress(OSError):  # it belongs to another user, who has done this
            place.chmod(0o1777)
        name = re.sub(r"[^A-Za-z0-9._-]+", "_", key)
        with contextlib.ExitStack() as undo:
            self._owner = _FileLock(place / f"{name}.owner")
            undo.callback(self._owner.close)
            self._output = _FileLock(place / f"{name}.output")
            undo.callback(self._output.close)
            self._path = place / f"{name}.state"
            self._file = _open_shared(self._path)
            undo.callback(os.close, self._file)
            content = os.pread(self._file, _BYTES, 0)
            if len(content) < _BYTES or content[:8] != _MAGIC:
                os.pwrite(self._file, _MAGIC.ljust(_BYTES, b"\0"), 0)
                if content:
                    self.revoke("The interlock's file was damaged and had to be written anew")
            undo.pop_all()

    # ---- fields ------------------------------------------------------------------------------

    def _bytes(self, at: int, count: int) -> bytes:
        """So many bytes; zeros where the file is too short."""
        if self._file < 0:
            return bytes(self._private[at : at + count])
        return os.pread(self._file, count, at).ljust(count, b"\0")

    def _store(self, at: int, data: bytes) -> None:
        """Written in one call, so that no reader sees a part of a number."""
        if self._file < 0:
            self._private[at : at + len(data)] = data
        else:
            os.pwrite(self._file, data, at)

    def _get(self, at: int) -> int:
        return int(struct.unpack("q", self._bytes(at, 8))[0])

    def _put(self, at: int, value: int) -> None:
        self._store(at, struct.pack("q", value))

    def _number(self, at: int) -> float:
        return float(struct.unpack("d", self._bytes(at, 8))[0])

    def _text(self, place: tuple[int, int]) -> str:
        raw = self._bytes(place[0], place[1] - place[0])
        return raw.split(b"\0")[0].decode(errors="replace")

    def _put_text(self, place: tuple[int, int], text: str) -> None:
        room = place[1] - place[0] - 1
        kept = text.encode(errors="replace")[:room].decode(errors="ignore").encode()
        self._store(place[0], kept.ljust(room + 1, b"\0"))

    @property
    def intact(self) -> bool:
        """The file is the one that others open, and what is in it is an interlock's."""
        if self._path is None or self._file < 0:
            return True
        try:
            there, ours = self._path.stat(), os.fstat(self._file)
        except OSError:
            return False
        same = (there.st_dev, there.st_ino) == (ours.st_dev, ours.st_ino)
        return same and ours.st_size >= _BYTES and self._bytes(0, 8) == _MAGIC

    # ---- latch -------------------------------------------------------------------------------

    @property
    def revision(self) -> int:
        """Drawn anew by every revocation; `DAMAGED` where the file cannot be trusted."""
        return self._get(_REVISION) if self.intact else DAMAGED

    @property
    def reason(self) -> str:
        """Why the bench was made safe, with the time; empty where nothing is to be acknowledged."""
        if not self.intact:
            return "The interlock's file was damaged or removed"
        if self._get(_ACKNOWLEDGED) == self._get(_REVISION):
            return ""
        text = self._text(_REASON) or "reason not recorded"
        try:
            when = time.strftime("on %Y-%m-%d at %H:%M:%S", time.localtime(self._number(_TIME)))
        except (OverflowError, ValueError, OSError):
            return text
        return f"{text.rstrip('.')} ({when})"

    def revoke(self, reason: str) -> int:
        """End every permission; the first reason stays until it is acknowledged. Never waits.

        Args:
            reason: one sentence.
        Returns:
            The new revision.
        """
        if not self.reason or not self.intact:
            self._put_text(_REASON, reason)
            self._store(_TIME, struct.pack("d", time.time()))
        revision = secrets.randbits(62) | 1
        self._put(_REVISION, revision)
        return revision

    def acknowledge(self, revision: int) -> None:
        """The reason was read, as of this revision; one that came later stays latched."""
        self._put(_ACKNOWLEDGED, revision)

    @property
    def live(self) -> bool:
        """The bench was permitted to be energised, and has not been found off since."""
        return self._get(_LIVE) != 0 or not self.intact

    def set_live(self, live: bool) -> None:
        """Record that the owner was given a permission, or that it has taken the bench to 0 V."""
        if os.getpid() == self._pid:  # a fork has no part in this
            self._put(_LIVE, self._get(_REVISION) + 1 if live else 0)

    def confirm_safe(self, revision: int) -> None:
        """Record that all instruments were found off after this revision.

        A permission that was given since, for this very revision, stays live.
        """
        self._put(_SAFE, revision)
        if self._get(_LIVE) != revision + 1:
            self._put(_LIVE, 0)

    @property
    def confirmed_safe(self) -> bool:
        """All instruments were found off since the last revocation."""
        revision = self.revision
        return revision > 0 and self._get(_SAFE) == revision and self._get(_LIVE) == 0

    # ---- owner -------------------------------------------------------------------------------

    def own(self, user: str, call_s: float = _CALL_S) -> bool:
        """Become the one program that uses the bench, until `close`.

        A program that ended while the bench was armed leaves its reason in the latch.

        Args:
            user: what the program is, for others.
            call_s: longest time that one call of a driver may take, in s.
        Returns:
            Whether the last owner has vanished.
        Raises:
            InterlockBusyError: another program uses it.
        """
        if self._owns:
            return False
        if not self._owner.acquire(0.0):
            raise InterlockBusyError(f"{self._text(_USER) or 'another program'}")
        self._owns = True
        vanished = self.owner_pid != 0
        if self.live:
            self.revoke(f"The program that used the bench ({self._text(_USER)}) ended while armed")
            self.set_live(False)
        self._put(_OWNER, os.getpid())
        self._store(_CALL, struct.pack("d", call_s))
        self._put_text(_USER, f"{user}, process {os.getpid()}")
        return vanished

    @property
    def owner_pid(self) -> int:
        """Process that uses the bench; 0: none."""
        return self._get(_OWNER)

    def close(self) -> None:
        """Leave the bench to others. Safe to call twice."""
        if self._owns:
            if os.getpid() == self._pid:
                self._put(_OWNER, 0)
            self._owner.release()
            self._owns = False
        self._owner.close()
        self._output.close()
        if self._file >= 0:  # what was read last stays to be asked for
            self._private[:] = self._bytes(0, _BYTES)
            os.close(self._file)
            self._file, self._path = -1, None

    # ---- output lock -------------------------------------------------------------------------

    @contextlib.contextmanager
    def output_lock(self, wait_s: float) -> Iterator[bool]:
        """Hold the output lock; yields whether it was acquired within `wait_s`."""
        acquired = self._output.acquire(wait_s)
        if acquired:
            with contextlib.suppress(OSError):  # then nobody is killed for holding it
                self._put(_HOLDER, os.getpid())
        try:
            yield acquired
        finally:
            if acquired:
                self._output.release()

    def make_safe(self, act: Callable[[], bool], wait_s: float) -> bool:
        """Run an act that takes the bench to 0 V, so that no other call can undo it.

        `revoke` comes first. A call of the owner that is under way is waited for; where it takes
        longer than `wait_s` the act runs at once, and again when that call has ended. A process
        whose call does not end within the time that `own` stated is killed.

        Args:
            act: takes all instruments to 0 V; whether they confirmed it.
            wait_s: for a call that is under way.
        Returns:
            Whether the last act confirmed 0 V.
        """
        with self.output_lock(wait_s) as acquired:
            done = act()
        if acquired:
            return done
        call_s = self._number(_CALL)
        with self.output_lock(call_s if 0.0 < call_s < 60.0 else _CALL_S) as acquired:
            if not acquired:
                self._kill_holder()
            return act()

    def _kill_holder(self) -> None:
        """Kill the process that has the output lock, and thus lives: a program, or a guardian."""
        pid = self._get(_HOLDER)
        if 1 < pid < 2**31 and pid != os.getpid():
            with contextlib.suppress(OSError):  # it has ended, or belongs to another user
                os.kill(pid, getattr(signal, "SIGKILL", signal.SIGTERM))

    # ---- signs of life -----------------------------------------------------------------------

    def count_heartbeat(self, slot: int) -> None:
        """A guardian is alive: its counter goes on."""
        self._put(_BEAT + 8 * slot, abs(self._get(_BEAT + 8 * slot)) + 1)

    def stop_heartbeat(self, slot: int) -> None:
        """A guardian ends as it should; nobody is to miss it."""
        self._put(_BEAT + 8 * slot, -1)

    def heartbeat_count(self, slot: int) -> int:
        """Counter of a guardian; below zero: it does not watch."""
        return self._get(_BEAT + 8 * slot)

    def lease(self, for_s: float) -> None:
        """The owner gives a sign of life and says when the next one comes at the latest."""
        self._store(_LEASE, struct.pack("d", time.monotonic() + for_s))

    @property
    def lease_end_s(self) -> float:
        """Monotonic clock at which the owner's last lease ends, in s."""
        return self._number(_LEASE)
