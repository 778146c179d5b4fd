"""Who may write where: nothing that exists is overwritten, one program at a time has a folder."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from haselab.base import DeviceError, InputError
from haselab.store.session_lock import is_held

__all__ = ["claimed_folder", "create_exclusively", "is_occupied", "move_aside"]

_MOST_PREVIOUS = 10_000
_LOG = "guardian.log"  # grows at its end, whoever writes to it


def _unwritable(path: Path, error: OSError) -> DeviceError:
    return DeviceError(
        f"Cannot write ({error.strerror or error}). Free disk space or choose another place. {path}"
    )


def create_exclusively(path: Path) -> None:
    """Make an empty file that did not exist before.

    Raises:
        InputError: it exists.
        DeviceError: the disk refuses.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path, error) from None
    try:
        path.open("xb").close()
    except FileExistsError:
        raise InputError(
            "This file exists; nothing in it was changed. Name a new path, or add --force to move "
            f"the existing result aside. {path}"
        ) from None
    except OSError as error:
        raise _unwritable(path, error) from None


def is_occupied(path: Path) -> bool:
    """Whether something lies here that must not be overwritten: a file, or a folder with content.

    A pipe or a device is not.
    """
    if path.is_dir():
        return any(path.iterdir())
    return path.is_file() or path.is_symlink()


def move_aside(path: Path, *, is_claimed: bool = False) -> Path:
    """Rename a file or a folder to `NAME.previous-1`, or the next number that is free.

    Args:
        path: of what must make room.
        is_claimed: this process has the lock of the folder.
    Returns:
        Its new path. Nothing is deleted.
    Raises:
        InputError: it cannot be renamed, another program writes to it or below it, or it holds the
            working directory.
    """
    path = path.absolute() if path.is_symlink() else path.resolve()
    if Path.cwd().is_relative_to(path):
        raise InputError(
            f"--force would move the working directory aside. Name a folder inside it. {path}"
        )
    if path.is_dir() and not path.is_symlink():
        _refuse_in_use(path, is_claimed)
    for number in range(1, _MOST_PREVIOUS):
        aside = path.with_name(f"{path.name}.previous-{number}")
        if aside.exists() or aside.is_symlink():
            continue
        try:
            # A rename replaces an empty folder or file without a word: this one is made for it.
            if sys.platform != "win32":
                aside.mkdir() if path.is_dir() and not path.is_symlink() else aside.touch(
                    exist_ok=False
                )
            path.rename(aside)
        except FileExistsError:
            continue
        except OSError as error:
            raise InputError(
                f"Cannot move the existing result aside ({error.strerror or error}). Name a new "
                f"path. {path}"
            ) from None
        return aside
    raise InputError(f"There are {_MOST_PREVIOUS} previous results. Delete some. {path}")


def _refuse_in_use(path: Path, is_claimed: bool) -> None:
    """Refuse a folder that another program writes to, or that holds one."""
    for folder in (path, *(found for found in path.rglob("*") if found.is_dir())):
        if folder != path or not is_claimed:
            with _locked(folder):
                pass
        if is_held(folder / "session.h5"):
            raise _in_use(folder)


@contextlib.contextmanager
def claimed_folder(folder: Path, *, force: bool = False) -> Iterator[Path | None]:
    """Have a new folder for this process alone until the context ends.

    The lock lies on the folder itself and goes with the process, however it ends. Everything of a
    run is written while it is held: the guardian's log, manifest, session, video, results.

    Args:
        folder: new, or empty.
        force: move an existing one aside instead of refusing it.
    Returns:
        Where the existing one is now; None: there was none.
    Raises:
        InputError: the folder has content, or another program writes to it.
        DeviceError: the disk refuses.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out names a file, not a folder. Name another one. {folder}")
    aside, locked = None, False
    with contextlib.ExitStack() as held:
        if folder.is_dir():
            lock = held.enter_context(_locked(folder))
            locked = not _has_results(folder)
            if not locked:
                if not force:
                    raise InputError(
                        "--out names a folder that is not empty; nothing in it was changed. Name a "
                        f"new folder, or add --force to move this one aside. {folder}"
                    )
                aside = move_aside(folder, is_claimed=True)
                lock.close()
        if not locked:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise _unwritable(folder, error) from None
            held.enter_context(_locked(folder))
            if _has_results(folder):
                raise _in_use(folder)
        try:
            yield aside
        except BaseException:
            if not any(folder.iterdir()):
                _put_back(folder, aside)
            raise


def _has_results(folder: Path) -> bool:
    """Whether a folder holds more than the log of a bench that was never armed."""
    return any(path.name != _LOG for path in folder.iterdir())


def _put_back(folder: Path, aside: Path | None) -> None:
    """Leave things as they were: nothing has been written."""
    with contextlib.suppress(OSError):
        folder.rmdir()
        if aside is not None:
            aside.rename(folder)


def _in_use(folder: Path) -> InputError:
    return InputError(f"Another program writes to this folder. Name another one. {folder}")


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[contextlib.ExitStack]:
    """A lock on the folder, where the system has one; what is given can end it early."""
    with contextlib.ExitStack() as held:
        if sys.platform != "win32":
            import fcntl

            descriptor = os.open(folder, os.O_RDONLY)
            held.callback(os.close, descriptor)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise _in_use(folder) from None
            except OSError:  # a file system without such locks; files are made exclusively there
                pass
        yield held
