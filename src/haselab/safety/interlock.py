"""The interlock of one bench: a latch and two locks that every process on this computer sees.

One small file in shared memory and two lock files belong to each output device, named after its
serial number. Standard library only: the guardian processes use it too.

- The *owner lock* is held by the one program that uses the bench.
- The *latch* is a revision, a number drawn anew by every revocation. A permission to energise is
  valid for one revision: whoever draws a new one ends it, and nobody can give it back. A new
  permission needs an acknowledgement of the reason that the latch holds.
- The *output lock* is held during every call that may energise something, and by whoever makes the
  bench safe, so that no call that began with a valid permission ends after the bench was made safe.

A file that was damaged, emptied or removed means that no permission is valid: what is written anew
begins with a revision of its own. Instruments that two benches could share (a supply, a generator)
are named in the file, so that one program uses them, and whoever makes one bench safe reaches the
program that uses the other.
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

__all__ = ["HEARTBEATS", "Interlock", "InterlockBusyError", "interlock_folder"]

HEARTBEATS = 2  # of the two guardians
DAMAGED = -1  # the revision of a file that cannot be trusted: no permission has it
_MAGIC = b"HASELAB4"
_BYTES = 2048
_REVISION, _ACKNOWLEDGED, _LIVE, _OWNER, _SAFE, _HOLDER, _BEAT = range(8, 64, 8)
_LEASE, _TIME, _CALL = (_BEAT + 8 * (HEARTBEATS + k) for k in range(3))
_REASON, _USER, _SHARED = (128, 640), (640, 1024), (1024, 2048)  # texts, from byte to byte
_POLL_S = 0.002  # between two trials of a lock
_CALL_S = 2.0  # that a call of a driver may take, unless the owner says longer
_FOLDER = "HASELAB_INTERLOCKS"  # environment variable that names another folder
_T = TypeVar("_T")


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


def _open_shared(path: Path, content: bytes = b"") -> int:
    """A file that every user may open, not followed if it is a link; whole from its first moment.

    Args:
        path: of the file.
        content: of a new one.
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
            with contextlib.suppress(FileExistsError):  # another program was first
                os.link(new, path)
        finally:
            os.close(handle)
            new.unlink()
    return os.open(path, flags)


def _content(revision: int) -> bytes:
    """A file in which nothing is to be acknowledged: no permission has this revision."""
    return struct.pack("8sqq", _MAGIC, revision, revision).ljust(_BYTES, b"\0")


def _new_revision() -> int:
    return secrets.randbits(62) | 1


class _FileLock:
    """A lock that the system releases when the process ends; exclusive among threads as well.

    Whoever acquires it calls `release` with the same token, also where `acquire` did not return,
    and again where `release` did not: an interrupt at any place then leaves no lock behind.

    Args:
        path: of the lock file; None: threads of this process only.
    """

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self._handle = -1 if path is None else _open_shared(path)
        self._guard = threading.Lock()  # of the next two
        self._tokens: set[object] = set()  # all of one thread
        self._thread = 0
        self._pid = os.getpid()

    def acquire(self, token: object, wait_s: float) -> bool:
        """Whether it was acquired within this time; the holding thread may acquire it again."""
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
        """The file is the one that others open."""
        return self._path is None or _same(self._path, self._handle)

    @property
    def holder(self) -> int | None:
        """Process that has the lock, as the system says; None: none, or it does not say."""
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
        self._private = bytearray(_content(0))
        self._path: Path | None = None
        self._file = -1
        if not key:
            self._owner, self._output = _FileLock(None), _FileLock(None)
            return
        place = folder or interlock_folder()
        if not place.is_dir():
            place.mkdir(mode=0o777, parents=True, exist_ok=True)
            with contextlib.suppress(OSError):  # another user was first
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
        """All files are those that others open, and what is in them is an interlock's."""
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
        """Drawn anew by every revocation; `DAMAGED` where the file cannot be trusted."""
        return self._get(_REVISION) if self.intact else DAMAGED

    @property
    def reason(self) -> str:
        """Why the bench was made safe, with the time; empty where nothing is to be acknowledged."""
        if self.key and self._file >= 0 and not self.intact:
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
        revision = _new_revision()
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

    def own(self, user: str, call_s: float = _CALL_S, shared: Collection[str] = ()) -> bool:
        """Become the one program that uses the bench, until `close`.

        A program that ended while the bench was armed leaves its reason in the latch.

        Args:
            user: what the program is, for others.
            call_s: longest time that one call of a driver may take, in s.
            shared: addresses of instruments that another bench could name as well.
        Returns:
            Whether the last owner has vanished.
        Raises:
            InterlockBusyError: another program uses it, or one of the shared instruments.
            OSError: its files were removed meanwhile.
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
            raise OSError("its files were removed meanwhile; try again")
        self._put_text(_SHARED, "\n".join(shared))  # before the look at others: one of two sees it
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
        """A program that lives owns it."""
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
        """Leave the bench to others. Safe to call twice."""
        if self._owns:
            if os.getpid() == self._pid:
                self._put(_OWNER, 0)
            self._owner.release(self)
            self._owns = False
        self._owner.close()
        self._output.close()
        if self._file >= 0:  # what was read last stays to be asked for
            self._private[:] = self._bytes(0, _BYTES)
            os.close(self._file)
            self._file, self._path = -1, None

    # ---- output lock -------------------------------------------------------------------------

    def holding_output(self, act: Callable[[bool], _T], wait_s: float) -> _T:
        """Run an act under the output lock.

        The lock is released whatever happens. A `with` statement could not promise that: an
        interrupt between the lock and its first line, or in the first line of `__exit__`, would
        leave it behind.

        Args:
            act: gets whether the lock was acquired within `wait_s`.
            wait_s: for others that hold it.
        Returns:
            What the act returned.
        """
        token = object()
        try:
            acquired = self._output.acquire(token, wait_s)
            if acquired:
                with contextlib.suppress(OSError):  # then nobody is killed for holding it
                    self._put(_HOLDER, os.getpid())
            return act(acquired)
        finally:
            try:
                self._output.release(token)
            except BaseException:
                self._output.release(token)
                raise

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
        """Kill the process that has the output lock, and thus lives: a program, or a guardian.

        The system says which one that is. Where it does not, the file does, which any user could
        have changed: then only processes of the own user are killed, and none by root.
        """
        root = getattr(os, "geteuid", lambda: 1)() == 0
        pid = self._output.holder or (0 if root else self._get(_HOLDER))
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
