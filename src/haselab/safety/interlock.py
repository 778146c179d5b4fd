"""The interlock of one bench: a latch and two locks that every process on this computer sees.

One small file in shared memory and two lock files belong to each output device, named after its
product and serial number. Standard library only: the guardian processes use it too.

- The *owner lock* is held by the one program that uses the bench.
- The *latch* counts revocations. A permission to energise is valid for one count: whoever raises
  the count ends it, and nobody can give it back. A new permission needs an acknowledgement of the
  reason that the latch holds.
- The *output lock* is held during every call that may energise something, and by whoever makes the
  bench safe, so that no call that began with a valid permission ends after the bench was made safe.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import re
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
_MAGIC = b"HASELAB2"
_BYTES = 1024
_REVISION, _ACKNOWLEDGED, _LIVE, _OWNER, _SAFE, _BEAT = 8, 16, 24, 32, 40, 48
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
        """Release it once."""
        self._depth -= 1
        if self._depth == 0 and self._handle >= 0:
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
        key: what identifies the output device, as `USB-6212 01A2B3C4`; empty: a bench that lives
            in this process alone, such as the simulated one.
        folder: None: `interlock_folder()`.
    Raises:
        OSError: the folder cannot be used.
    """

    def __init__(self, key: str = "", folder: Path | None = None) -> None:
        self.key = key
        self._data: mmap.mmap | bytearray
        self._owns = False
        if not key:
            self._data = bytearray(_BYTES)
            self._owner, self._output = _FileLock(None), _FileLock(None)
            return
        place = folder or interlock_folder()
        place.mkdir(mode=0o777, parents=True, exist_ok=True)
        with contextlib.suppress(OSError):  # it belongs to another user, who has done this
            place.chmod(0o1777)
        name = re.sub(r"[^A-Za-z0-9._-]+", "_", key)
        self._owner = _FileLock(place / f"{name}.owner")
        self._output = _FileLock(place / f"{name}.output")
        handle = _open_shared(place / f"{name}.state")
        try:
            if os.fstat(handle).st_size < _BYTES:
                os.ftruncate(handle, _BYTES)
            self._data = mmap.mmap(handle, _BYTES)
        finally:
            os.close(handle)
        if self._data[:8] != _MAGIC:
            self._data[:8] = _MAGIC

    # ---- fields ------------------------------------------------------------------------------

    def _get(self, at: int) -> int:
        return int(struct.unpack_from("q", self._data, at)[0])

    def _put(self, at: int, value: int) -> None:
        struct.pack_into("q", self._data, at, value)

    def _text(self, place: tuple[int, int]) -> str:
        return bytes(self._data[slice(*place)]).split(b"\0")[0].decode(errors="replace")

    def _put_text(self, place: tuple[int, int], text: str) -> None:
        room = place[1] - place[0] - 1
        kept = text.encode()[:room].decode(errors="ignore").encode()
        self._data[slice(*place)] = kept.ljust(room + 1, b"\0")

    # ---- latch -------------------------------------------------------------------------------

    @property
    def revision(self) -> int:
        """How often the permission was revoked."""
        return self._get(_REVISION)

    @property
    def reason(self) -> str:
        """Why the bench was made safe, with the time; empty where nothing is to be acknowledged."""
        if self._get(_ACKNOWLEDGED) >= self.revision:
            return ""
        when = struct.unpack_from("d", self._data, _TIME)[0]
        text = self._text(_REASON) or "reason not recorded"
        return f"{text} ({time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(when))})"

    def revoke(self, reason: str) -> int:
        """End every permission; the first reason stays until it is acknowledged. Never waits.

        Args:
            reason: one sentence.
        Returns:
            The new revision.
        """
        if not self.reason:
            self._put_text(_REASON, reason)
            struct.pack_into("d", self._data, _TIME, time.time())
        self._put(_REVISION, self.revision + 1)
        return self.revision

    def acknowledge(self, revision: int) -> None:
        """The reason was read, as of this revision; one that came later stays latched."""
        self._put(_ACKNOWLEDGED, max(revision, self._get(_ACKNOWLEDGED)))

    @property
    def live(self) -> bool:
        """The bench was permitted to be energised, and has not been found off since."""
        return self._get(_LIVE) != 0

    def set_live(self, live: bool) -> None:
        """Record that the owner was given a permission, or that it has taken the bench to 0 V."""
        self._put(_LIVE, int(live))

    def confirm_safe(self, revision: int) -> None:
        """Record that all instruments were found off after this revision."""
        self._put(_SAFE, revision)
        self._put(_LIVE, 0)

    @property
    def confirmed_safe(self) -> bool:
        """All instruments were found off since the last revocation."""
        return self._get(_SAFE) >= self.revision > 0

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
        struct.pack_into("d", self._data, _CALL, call_s)
        self._put_text(_USER, f"{user}, process {os.getpid()}")
        return vanished

    @property
    def owner_pid(self) -> int:
        """Process that uses the bench; 0: none."""
        return self._get(_OWNER)

    def close(self) -> None:
        """Leave the bench to others. Safe to call twice."""
        if self._owns:
            self._put(_OWNER, 0)
            self._owner.release()
            self._owns = False
        self._owner.close()
        self._output.close()
        if isinstance(self._data, mmap.mmap):
            self._data = bytearray(self._data[:])

    # ---- output lock -------------------------------------------------------------------------

    @contextlib.contextmanager
    def output_lock(self, wait_s: float) -> Iterator[bool]:
        """Hold the output lock; yields whether it was acquired within `wait_s`."""
        acquired = self._output.acquire(wait_s)
        try:
            yield acquired
        finally:
            if acquired:
                self._output.release()

    def make_safe(self, act: Callable[[], bool], wait_s: float) -> bool:
        """Run an act that takes the bench to 0 V, so that no other call can undo it.

        `revoke` comes first. A call of the owner that is under way is waited for; where it takes
        longer than `wait_s` the act runs at once, and again when that call has ended. An owner
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
        call_s = struct.unpack_from("d", self._data, _CALL)[0] or _CALL_S
        with self.output_lock(call_s) as acquired:
            if not acquired:
                self._kill_owner()
            return act()

    def _kill_owner(self) -> None:
        if self._owner.acquire(0.0):  # it has ended; its number may be that of another process now
            self._owner.release()
            return
        pid = self.owner_pid
        if pid > 0 and pid != os.getpid():
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
        struct.pack_into("d", self._data, _LEASE, time.monotonic() + for_s)

    @property
    def lease_end_s(self) -> float:
        """Monotonic clock at which the owner's last lease ends, in s."""
        return float(struct.unpack_from("d", self._data, _LEASE)[0])
