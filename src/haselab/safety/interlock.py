"""The interlock of one bench: a latch and two locks shared by all processes on this computer.

Each output device has one small file in shared memory and two lock files, named after its serial
number. This module uses only the standard library, because the guardian processes import it too.

- The *owner lock* is held by the one program that uses the bench.
- The *latch* is a revision: a random number that every revocation replaces. A permission to
  energise is valid for one revision, so a revocation ends it permanently. A new permission requires
  that the reason in the latch is acknowledged.
- The *output lock* is held during every call that may energise something, and by a process that
  makes the bench safe. So no call that began with a valid permission ends after the bench was made
  safe.

If a file was damaged, emptied or removed, no permission is valid: a new file starts with a new
revision. The file also names instruments that two benches could share (a supply, a generator), so
that only one program uses them, and a process that makes one bench safe reaches the program that
uses the other.
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
from collections.abc import Callable, Collection
from pathlib import Path
from typing import TypeVar

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

__all__ = ["HEARTBEATS", "Interlock", "InterlockBusyError", "interlock_folder", "lease_clock_s"]

HEARTBEATS = 2  # of the two guardians
DAMAGED = -1  # revision of a damaged file: no permission has it
_MAGIC = b"HASELAB4"
_WHOLE = struct.Struct("q")
_BYTES = 2048
_REVISION, _ACKNOWLEDGED, _LIVE, _OWNER, _SAFE, _HOLDER, _BEAT = range(8, 64, 8)
_LEASE, _TIME, _CALL = (_BEAT + 8 * (HEARTBEATS + k) for k in range(3))
_REASON, _USER, _SHARED = (128, 640), (640, 1024), (1024, 2048)  # byte ranges of the texts
_POLL_S = 0.002  # between two attempts to lock
_CALL_S = 2.0  # longest call of a driver, unless the owner allows more
_FOLDER = "HASELAB_INTERLOCKS"  # environment variable that sets another folder
_T = TypeVar("_T")


class InterlockBusyError(OSError):
    """Another program uses the bench."""


def lease_clock_s() -> float:
    """Time of all leases, in s: the same in all processes, and running while the computer sleeps.

    `time.monotonic` stops while the computer is suspended, but the output keeps its voltage. A
    lease on that clock would still be valid hours later.
    """
    boot = getattr(time, "CLOCK_BOOTTIME", None)  # Linux; on macOS, CLOCK_MONOTONIC keeps running
    clock = getattr(time, "CLOCK_MONOTONIC", None) if boot is None else boot
    return time.monotonic() if clock is None else time.clock_gettime(clock)


def interlock_folder() -> Path:
    """Folder shared by all users of this computer; on Linux in memory, so a restart clears it."""
    given = os.environ.get(_FOLDER)
    if given:
        if not Path(given).is_absolute():
            raise OSError(f"{_FOLDER} is {given!r}, but it must be an absolute path")
        return Path(given)
    shared = Path("/dev/shm")
    return (shared if shared.is_dir() else Path(tempfile.gettempdir())) / "haselab-interlocks"


def _open_shared(path: Path, content: bytes = b"") -> int:
    """Open or atomically create a file that every user may open; links are not followed.

    Args:
        path: of the file.
        content: written to a new file.
    """
    flags = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0)
    for _ in range(3):
        with contextlib.suppress(FileNotFoundError):
            return os.open(path, flags)
        new = path.with_name(f".{path.name}.{secrets.token_hex(8)}")
        handle = os.open(new, flags | os.O_CREAT | os.O_EXCL, 0o666)
        try:
            if hasattr(os, "fchmod"):
                os.fchmod(handle, 0o666)  # whatever the umask is
            os.write(handle, content)
            with contextlib.suppress(FileExistsError):  # another program created it first
                os.link(new, path)
        finally:
            os.close(handle)
            new.unlink()
    return os.open(path, flags)


def _content(revision: int) -> bytes:
    """Content of a new file: no reason to acknowledge, and a revision that no permission has."""
    return struct.pack("8sqq", _MAGIC, revision, revision).ljust(_BYTES, b"\0")


def _new_revision() -> int:
    return secrets.randbits(62) | 1


class _FileLock:
    """A lock that the system releases when the process ends; it also excludes other threads.

    Call `release` with the same token even if `acquire` was interrupted, and again if `release`
    was: then an interrupt at any place leaves no lock behind.

    Args:
        path: of the lock file; None: only for threads of this process.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._handle = -1 if path is None else _open_shared(path)
        self._guard = threading.Lock()  # protects the next two
        self._tokens: set[object] = set()  # all from one thread
        self._thread = 0
        self._pid = os.getpid()

    def acquire(self, token: object, wait_s: float) -> bool:
        """Whether the lock was acquired in time; the thread that holds it may acquire it again."""
        end_s = time.monotonic() + wait_s
        while True:
            with self._guard:
                if not self._tokens or self._thread == threading.get_ident():
                    again = bool(self._tokens)
                    self._thread = threading.get_ident()
                    self._tokens.add(token)
                    if again or self._try():
                        return True
                    self._tokens.discard(token)
            if time.monotonic() >= end_s:
                return False
            time.sleep(_POLL_S)

    def release(self, token: object) -> None:
        """Release what was acquired with this token, if it was.

        In a fork the lock stays with the process that acquired it.
        """
        with self._guard:
            if self._tokens == {token} and self._handle >= 0 and os.getpid() == self._pid:
                if sys.platform == "win32":
                    with contextlib.suppress(OSError):  # not locked
                        os.lseek(self._handle, 0, os.SEEK_SET)
                        msvcrt.locking(self._handle, msvcrt.LK_UNLCK, 1)
                else:
                    fcntl.flock(self._handle, fcntl.LOCK_UN)
            self._tokens.discard(token)

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

    @property
    def intact(self) -> bool:
        """Whether this is still the file that other processes open."""
        return self._path is None or _same(self._path, self._handle)

    @property
    def holder(self) -> int | None:
        """Process that holds the lock, according to the system; None: none, or unknown."""
        try:
            lines = Path("/proc/locks").read_text(encoding="ascii").splitlines()
            status = os.fstat(self._handle)
        except OSError:
            return None
        place = f"{os.major(status.st_dev):02x}:{os.minor(status.st_dev):02x}:{status.st_ino}"
        words = (line.split() for line in lines)  # number: FLOCK ADVISORY WRITE pid place ...
        return next((int(w[4]) for w in words if w[1] == "FLOCK" and w[5] == place), None)

    def close(self) -> None:
        """Close the file, which releases the lock."""
        if self._handle >= 0:
            os.close(self._handle)
            self._handle = -1


def _same(path: Path, handle: int) -> bool:
    try:
        there, ours = path.stat(), os.fstat(handle)
    except OSError:
        return False
    return (there.st_dev, there.st_ino) == (ours.st_dev, ours.st_ino)


class Interlock:
    """The latch and the locks of one bench.

    Args:
        key: identifies the output device, such as `NI 01A2B3C4`; empty: a bench that exists only
            in this process, such as the simulated one.
        folder: of the files; None: `interlock_folder()`.
    Raises:
        OSError: The folder cannot be used.
    """

    def __init__(self, key: str = "", folder: Path | None = None) -> None:
        self.key = key
        self._owns = False
        self._pid = os.getpid()
        self._private = bytearray(_content(0))
        self._path: Path | None = None
        self._file = -1
        if not key:
            self._owner, self._output = _FileLock(None), _FileLock(None)
            return
        place = folder or interlock_folder()
        if not place.is_dir():
            place.mkdir(mode=0o777, parents=True, exist_ok=True)
            with contextlib.suppress(OSError):  # another user created it first
                place.chmod(0o1777)
        name = re.sub(r"[^A-Za-z0-9._-]+", "_", key)
        with contextlib.ExitStack() as undo:
            self._owner = _FileLock(place / f"{name}.owner")
            undo.callback(self._owner.close)
            self._output = _FileLock(place / f"{name}.output")
            undo.callback(self._output.close)
            self._path = place / f"{name}.state"
            self._file = _open_shared(self._path, _content(_new_revision()))
            undo.callback(os.close, self._file)
            content = os.pread(self._file, _BYTES, 0)
            if len(content) < _BYTES or content[:8] != _MAGIC:
                os.pwrite(self._file, _content(_new_revision()), 0)
                self.revoke("The interlock's file was damaged and was replaced")
            undo.pop_all()

    # ---- fields ------------------------------------------------------------------------------

    def _bytes(self, at: int, count: int) -> bytes:
        """Read bytes; zeros beyond the end of the file."""
        if self._file < 0:
            return bytes(self._private[at : at + count])
        return os.pread(self._file, count, at).ljust(count, b"\0")

    def _store(self, at: int, data: bytes) -> None:
        """Write in one call, so that no reader sees half of a number."""
        if self._file < 0:
            self._private[at : at + len(data)] = data
        else:
            os.pwrite(self._file, data, at)

    def _get(self, at: int) -> int:
        if self._file < 0:
            return int(_WHOLE.unpack_from(self._private, at)[0])
        return int(_WHOLE.unpack(self._bytes(at, 8))[0])

    def _put(self, at: int, value: int) -> None:
        self._store(at, _WHOLE.pack(value))

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
        """Whether all files are those that other processes open, with valid content."""
        if not self.key:
            return True
        if self._path is None or self._file < 0:  # closed
            return False
        same = _same(self._path, self._file) and self._owner.intact and self._output.intact
        content = self._bytes(0, 8)
        return same and content == _MAGIC and os.fstat(self._file).st_size >= _BYTES

    # ---- latch -------------------------------------------------------------------------------

    @property
    def revision(self) -> int:
        """Random number, replaced by every revocation; `DAMAGED` if the file is not valid."""
        if not self.key:  # no other process can damage it
            return int(_WHOLE.unpack_from(self._private, _REVISION)[0])
        return self._get(_REVISION) if self.intact else DAMAGED

    @property
    def reason(self) -> str:
        """Why the bench was made safe, and when; empty if there is nothing to acknowledge."""
        if self.key and self._file >= 0 and not self.intact:
            return "The file of the software interlock was damaged or removed"
        if self._get(_ACKNOWLEDGED) == self._get(_REVISION):
            return ""
        text = self._text(_REASON) or "reason not recorded"
        try:
            when = time.strftime("on %Y-%m-%d at %H:%M:%S", time.localtime(self._number(_TIME)))
        except (OverflowError, ValueError, OSError):
            return text
        return f"{text.rstrip('.')} ({when})"

    def revoke(self, reason: str) -> int:
        """End every permission; the first reason is kept until acknowledged. Never waits.

        Args:
            reason: one sentence.
        Returns:
            The new revision.
        """
        if not self.reason or not self.intact:
            self._put_text(_REASON, reason)
            self._store(_TIME, struct.pack("d", time.time()))
        revision = _new_revision()
        self._put(_REVISION, revision)
        return revision

    def acknowledge(self, revision: int) -> None:
        """Acknowledge the reason as of this revision; a later one stays latched."""
        self._put(_ACKNOWLEDGED, revision)

    @property
    def live(self) -> bool:
        """Whether the bench was permitted to be energised and has not been found off since."""
        return self._get(_LIVE) != 0 or not self.intact

    def set_live(self, live: bool) -> None:
        """Record that the owner got a permission, or that it has taken the bench to 0 V."""
        if os.getpid() == self._pid:  # a fork must not change it
            self._put(_LIVE, self._get(_REVISION) + 1 if live else 0)

    def confirm_safe(self, revision: int) -> None:
        """Record that all instruments were found off after this revision.

        A permission that was given since, for this same revision, stays live.
        """
        self._put(_SAFE, revision)
        if self._get(_LIVE) != revision + 1:
            self._put(_LIVE, 0)

    @property
    def confirmed_safe(self) -> bool:
        """Whether all instruments were found off since the last revocation."""
        revision = self.revision
        return revision > 0 and self._get(_SAFE) == revision and self._get(_LIVE) == 0

    # ---- owner -------------------------------------------------------------------------------

    def own(self, user: str, call_s: float = _CALL_S, shared: Collection[str] = ()) -> bool:
        """Take the bench for this program alone, until `close`.

        If the last program ended while the bench was armed, this reason is latched.

        Args:
            user: name of the program, for the messages of others.
            call_s: longest time that one call of a driver may take, in s.
            shared: addresses of instruments that another bench could also use.
        Returns:
            Whether the last owner crashed.
        Raises:
            InterlockBusyError: Another program uses the bench or one of the shared instruments.
            OSError: The interlock's files were removed meanwhile.
        """
        if self._owns:
            return False
        if not self._owner.acquire(self, 0.0):
            raise InterlockBusyError(f"{self._text(_USER) or 'another program'}")
        self._owns = True
        try:
            self._check_shared(shared)
        except OSError:
            self._owner.release(self)
            self._owns = False
            raise
        vanished = self.owner_pid != 0
        if self.live:
            self.revoke(f"The program that used the bench ({self._text(_USER)}) ended while armed")
            self.set_live(False)
        self._put(_OWNER, os.getpid())
        self._store(_CALL, struct.pack("d", call_s))
        self._put_text(_USER, f"{user}, process {os.getpid()}")
        return vanished

    def _check_shared(self, shared: Collection[str]) -> None:
        if not self.intact:
            raise OSError("its files were removed meanwhile; run the command again")
        # before looking at others, so that one of two programs sees the other
        self._put_text(_SHARED, "\n".join(shared))
        others = self.sharing(shared)
        for other in others:
            other.close()
        if others:
            raise InterlockBusyError(f"{others[0]._text(_USER)}, with the board {others[0].key}")

    def sharing(self, shared: Collection[str]) -> list[Interlock]:
        """Other benches in use that name one of these instruments; to be closed by the caller."""
        return [] if self._path is None else _in_use_with(shared, self._path.parent, self._path)

    @staticmethod
    def using(shared: Collection[str]) -> list[Interlock]:
        """All benches in use that name one of these instruments; to be closed by the caller."""
        return _in_use_with(shared, interlock_folder())

    def names_one_of(self, shared: Collection[str]) -> bool:
        """Whether the program of the bench has named one of these instruments."""
        return bool(set(shared) & set(self._text(_SHARED).split("\n")))

    @property
    def in_use(self) -> bool:
        """Whether a running program owns the bench."""
        if self._owner.holder is not None:
            return True
        if self._owner.acquire(self, 0.0):
            self._owner.release(self)
            return False
        return True

    @property
    def owner_pid(self) -> int:
        """Process that uses the bench; 0: none."""
        return self._get(_OWNER)

    def close(self) -> None:
        """Release the bench for other programs. Safe to call twice."""
        if self._owns:
            if os.getpid() == self._pid:
                self._put(_OWNER, 0)
            self._owner.release(self)
            self._owns = False
        self._owner.close()
        self._output.close()
        if self._file >= 0:  # the last content stays readable
            self._private[:] = self._bytes(0, _BYTES)
            os.close(self._file)
            self._file, self._path = -1, None

    # ---- output lock -------------------------------------------------------------------------

    def holding_output(self, act: Callable[[bool], _T], wait_s: float) -> _T:
        """Call a function under the output lock.

        The lock is always released. A `with` statement cannot guarantee that: an interrupt between
        the lock and its first line, or in the first line of `__exit__`, would leave it locked.

        Args:
            act: function; its argument says whether the lock was acquired within `wait_s`.
            wait_s: longest wait for another holder of the lock.
        Returns:
            What the function returned.
        """
        token = object()
        try:
            acquired = self._output.acquire(token, wait_s)
            if acquired and self.key:
                with contextlib.suppress(OSError):  # then no holder is killed
                    self._put(_HOLDER, os.getpid())
            return act(acquired)
        finally:
            try:
                self._output.release(token)
            except BaseException:
                self._output.release(token)
                raise

    def make_safe(self, act: Callable[[], bool], wait_s: float) -> bool:
        """Call a function that takes the bench to 0 V, so that no other call can undo it.

        Call `revoke` first. A running call of the owner is waited for; if it takes longer than
        `wait_s`, the function is called at once, and again when that call has ended. A process
        whose call does not end within the time given to `own` is killed.

        Args:
            act: takes all instruments to 0 V; returns whether they confirmed it.
            wait_s: longest wait for a running call.
        Returns:
            Whether the last call of the function confirmed 0 V.
        """

        def after(acquired: bool) -> bool:
            if not acquired:
                self._kill_holder()
            return act()

        done = self.holding_output(lambda acquired: (acquired, act()), wait_s)
        if done[0]:
            return done[1]
        call_s = self._number(_CALL)
        return self.holding_output(after, call_s if 0.0 < call_s < 60.0 else _CALL_S)

    def _kill_holder(self) -> None:
        """Kill the process that holds the output lock: a program, or a guardian.

        The system reports the process. If it does not, the process number in the file is
        used; any user could have changed that, so then only processes of the same user are killed,
        and none by root.
        """
        root = getattr(os, "geteuid", lambda: 1)() == 0
        pid = self._output.holder or (0 if root else self._get(_HOLDER))
        if 1 < pid < 2**31 and pid != os.getpid():
            with contextlib.suppress(OSError):  # it has ended, or belongs to another user
                os.kill(pid, getattr(signal, "SIGKILL", signal.SIGTERM))

    # ---- heartbeats ---------------------------------------------------------------------------

    def count_heartbeat(self, slot: int) -> None:
        """Advance the counter of a guardian, which shows that it runs."""
        self._put(_BEAT + 8 * slot, abs(self._get(_BEAT + 8 * slot)) + 1)

    def stop_heartbeat(self, slot: int) -> None:
        """Mark a guardian as ended in order, so that it is not reported as lost."""
        self._put(_BEAT + 8 * slot, -1)

    def heartbeat_count(self, slot: int) -> int:
        """Counter of a guardian; negative if it does not watch."""
        return self._get(_BEAT + 8 * slot)

    def lease(self, for_s: float) -> None:
        """Give the owner's heartbeat and the latest time of the next one."""
        self._store(_LEASE, struct.pack("d", lease_clock_s() + for_s))

    @property
    def lease_end_s(self) -> float:
        """Time of `lease_clock_s` at which the owner's lease ends, in s."""
        return self._number(_LEASE)


def _in_use_with(shared: Collection[str], folder: Path, but: Path | None = None) -> list[Interlock]:
    """Benches in use that name one of these instruments, but for the one with this file."""
    found: list[Interlock] = []
    for path in folder.glob("*.state") if shared else ():
        if path == but:
            continue
        with contextlib.suppress(OSError):
            other = Interlock(path.stem, path.parent)
            if other.in_use and other.names_one_of(shared):
                found.append(other)
            else:
                other.close()
    return found
