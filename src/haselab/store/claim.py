"""Who may write where: nothing that exists is overwritten, one program at a time has a folder."""

from __future__ import annotations

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from haselab.base import DeviceError, HaselabError, InputError
from haselab.store.session.lock import hold, is_held

__all__ = [
    "claimed_file",
    "claimed_folder",
    "create_exclusively",
    "is_occupied",
    "move_aside",
    "refuse_linked_folders",
    "shared_folder",
]

_MOST_PREVIOUS = 10_000
_LOG = "guardian.log"  # grows at its end, whoever writes to it
_BAD_PATH = (errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG)
_FULL = (errno.ENOSPC, errno.EDQUOT)


def _unwritable(path: Path, error: OSError) -> HaselabError:
    """The error of a path that cannot be made: bad input where its name is at fault."""
    why = error.strerror or str(error)
    if error.errno in _BAD_PATH:
        return InputError(
            f"Cannot create this path ({why}): a part of it is a file, a link that leads nowhere, "
            f"or too long. Name another one. {path}"
        )
    if error.errno in _FULL:
        return DeviceError(f"Cannot write ({why}). Free disk space. {path}")
    return DeviceError(f"Cannot write ({why}). Choose another place, or allow it. {path}")


def _make_parents(folder: Path) -> list[Path]:
    """Make a folder and those above it; which ones are new, the lowest first."""
    missing = [each for each in (folder, *folder.parents) if not each.is_dir()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        _remove_empty(missing)
        raise _unwritable(folder, error) from None
    return missing


def _remove_empty(folders: list[Path]) -> None:
    """Remove folders that this process has made, as far as nothing lies in them."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


@contextlib.contextmanager
def claimed_file(path: Path) -> Iterator[None]:
    """Have the name of a new file for this process alone until the context ends.

    The file is made at once, empty, so that no other program takes its name, and locked where the
    system has such locks. One that is still empty at the end goes again, and so do the folders
    that were made for it.

    Args:
        path: of a file that does not exist; a pipe or a device is left as it is.
    Raises:
        InputError: there is something already, or another program has just made it.
        DeviceError: the disk refuses.
    """
    if path.exists() and not is_occupied(path):
        yield
        return
    made = _make_parents(path.parent)
    try:
        create_exclusively(path)
        with path.open("r+b") as file:
            with contextlib.suppress(OSError):  # a file system without such locks
                hold(file.fileno())
            mine = os.fstat(file.fileno())
            if not _is_file(path, mine):  # moved aside between the two lines above
                raise _in_use(path)
            try:
                yield
            finally:
                if os.fstat(file.fileno()).st_size == 0 and _is_file(path, mine):
                    path.unlink()
    finally:
        _remove_empty(made)


def _is_file(path: Path, status: os.stat_result) -> bool:
    """Whether the path leads to this very file."""
    try:
        return os.path.samestat(path.lstat(), status)
    except OSError:
        return False


def refuse_linked_folders(folder: Path, *names: str) -> None:
    """Refuse to write into a folder of others through a link in the place of a subfolder.

    Args:
        folder: of a run.
        names: of its subfolders, which may be missing.
    Raises:
        InputError: one of them is a link.
    """
    for name in names:
        if (folder / name).is_symlink():
            raise InputError(
                f"This is a link to {(folder / name).readlink()}, and files would be written "
                f"there. Put a folder in its place, or remove it. {folder / name}"
            )


def create_exclusively(path: Path) -> None:
    """Make an empty file that did not exist before; a pipe or a device is left as it is.

    Raises:
        InputError: it exists.
        DeviceError: the disk refuses.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(path, error) from None
    if path.exists() and not (path.is_file() or path.is_dir()):
        return
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

    A pipe or a device is not, nor is a link to one; a link that leads nowhere is.
    """
    if path.is_dir():
        return any(path.iterdir())
    return path.is_file() or (path.is_symlink() and not path.exists())


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
    elif is_held(path):
        raise _in_use(path)
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
        except FileExistsError:
            continue
        except OSError as error:
            raise _immovable(path, error) from None
        try:
            path.rename(aside)
        except OSError as error:  # a mount point, above all
            _remove_placeholder(aside)
            raise _immovable(path, error) from None
        if is_held(aside):  # made by another program after the look above
            aside.rename(path)
            raise _in_use(path)
        return aside
    raise InputError(f"There are {_MOST_PREVIOUS} previous results. Delete some. {path}")


def _immovable(path: Path, error: OSError) -> InputError:
    return InputError(
        f"Cannot move the existing result aside ({error.strerror or error}). Name a new path. "
        f"{path}"
    )


def _remove_placeholder(aside: Path) -> None:
    """Take away what was made in the place of a result that then could not be moved."""
    with contextlib.suppress(OSError):
        aside.rmdir() if aside.is_dir() else aside.unlink()


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
    aside, locked, made = None, False, list[Path]()
    with contextlib.ExitStack() as held:
        if folder.is_symlink() and not folder.exists():
            if not force:
                raise InputError(
                    f"--out is a link to {folder.readlink()}, which does not exist. Name another "
                    f"folder, or add --force to move the link aside. {folder}"
                )
            aside = move_aside(folder)
        elif folder.is_dir():
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
            made = _make_parents(folder)
            held.enter_context(_locked(folder))
            if _has_results(folder):
                raise _in_use(folder)
        try:
            yield aside
        except BaseException:
            _put_back(folder, aside, made)
            raise


def _has_results(folder: Path) -> bool:
    """Whether a folder holds more than the log of a bench that was never armed."""
    return any(path.name != _LOG for path in folder.iterdir())


def _put_back(folder: Path, aside: Path | None, made: list[Path]) -> None:
    """Leave things as they were where nothing has been written; what was there before stays."""
    if any(folder.iterdir()):
        return
    _remove_empty(made)
    if aside is not None and not folder.exists():
        with contextlib.suppress(OSError):
            aside.rename(folder)


def _in_use(folder: Path) -> InputError:
    kind = "folder" if folder.is_dir() else "file"
    return InputError(f"Another program writes to this {kind}. Name another one. {folder}")


@contextlib.contextmanager
def shared_folder(folder: Path) -> Iterator[None]:
    """Have a folder whose files are made anew each time, while the context lasts.

    Args:
        folder: new or not.
    Raises:
        InputError: a file lies there, or another program has the folder.
        DeviceError: the disk refuses.
    """
    made = _make_parents(folder)
    try:
        with _locked(folder):
            yield
    finally:
        _remove_empty(made)


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
