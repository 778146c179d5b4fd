"""Claims on output paths: nothing is overwritten, and one program at a time uses a folder."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import stat
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from haselab.base import DeviceError, HaselabError, InputError
from haselab.store.session.lock import CAN_TELL, hold, is_held

__all__ = [
    "claimed_file",
    "claimed_folder",
    "create_exclusively",
    "is_left_empty",
    "is_occupied",
    "joined_folder",
    "move_aside",
    "not_written",
    "refuse_linked_folders",
    "shared_folder",
]

_MOST_PREVIOUS = 10_000
_AGE_S = 1.0  # of an empty file, after which the program that created it has locked it
_LOG = "guardian.log"  # only appended to, by any program
_BAD_PATH = (errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ELOOP, errno.ENAMETOOLONG)
_NOT_PERMITTED = (errno.ENOENT, errno.EACCES, errno.EPERM, errno.EROFS)
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def not_written(path: Path, error: OSError, what: str = "Cannot write") -> DeviceError:
    """Make the error for what cannot be written, with what to do about this cause.

    Args:
        path: of the file or folder.
        error: of the system.
        what: what failed; the first words of the message.
    Returns:
        The error, which the caller raises.
    """
    if error.errno in _BAD_PATH:
        remedy = "Part of the path is a file, a broken link, or too long: name another one."
    elif error.errno in _FULL:
        remedy = "Free disk space, or choose another folder."
    elif error.errno in _NOT_PERMITTED:
        remedy = "Choose another folder, or change its permissions."
    else:
        remedy = "Check the disk, or choose another folder."
    return DeviceError(f"{what} ({error.strerror or error}). {remedy} {path}")


def _not_created(path: Path, error: OSError) -> HaselabError:
    """Make the error for a path that cannot be created: bad input if another one can."""
    found = not_written(path, error)
    return InputError(str(found)) if error.errno in _BAD_PATH + _NOT_PERMITTED else found


def _make_parents(folder: Path) -> list[Path]:
    """Create a folder with its parents; return the new ones, the lowest first."""
    missing = [each for each in (folder, *folder.parents) if not each.is_dir()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        _remove_empty(missing)
        raise _not_created(folder, error) from None
    return missing


def _remove_empty(folders: list[Path]) -> None:
    """Remove folders that this process has created, if they are empty."""
    for folder in folders:
        with contextlib.suppress(OSError):
            folder.rmdir()


@contextlib.contextmanager
def claimed_file(path: Path) -> Iterator[None]:
    """Reserve the name of a new file for this process until the context ends.

    The file is created empty at once, so that no other program takes its name, and locked if the
    system supports it. If it is still empty at the end, it is removed with the folders that were
    created for it.

    Args:
        path: of a file that does not exist, or that a program left empty which was killed; a pipe
            or a device is not touched.
    Raises:
        InputError: the path exists, another program has just created it, or no file can be created
            there.
        DeviceError: the disk refuses.
    """
    is_old = is_left_empty(path)
    if path.exists() and not (is_old or is_occupied(path)):
        yield
        return
    made = _make_parents(path.parent)
    try:
        if not is_old:
            create_exclusively(path)
        with path.open("r+b") as file:
            try:
                hold(file.fileno())
            except OSError:  # a file system without such locks, or another program was faster
                if is_old:
                    raise _in_use(path) from None
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
    """Whether the path still refers to this file."""
    try:
        return os.path.samestat(path.lstat(), status)
    except OSError:
        return False


def refuse_linked_folders(folder: Path, *names: str) -> None:
    """Refuse subfolders that are links, through which other folders would be written to.

    Args:
        folder: of a run.
        names: of its subfolders; they need not exist.
    Raises:
        InputError: one of them is a link.
    """
    for name in names:
        if (folder / name).is_symlink():
            raise InputError(
                f"This path is a link to {(folder / name).readlink()}, where the files would be "
                f"written. Remove the link, or replace it by a folder. {folder / name}"
            )


def create_exclusively(path: Path, content: bytes = b"") -> None:
    """Create a file that does not exist; a pipe or a device is not touched.

    Args:
        path: of the file.
        content: nobody finds the file with less of it, where the file system has links.
    Raises:
        InputError: it exists, or no file can be created there.
        DeviceError: the disk refuses.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _not_created(path, error) from None
    if path.exists() and not (path.is_file() or path.is_dir()):
        return
    try:
        if content:
            _create_whole(path, content)
        else:
            path.open("xb").close()
    except FileExistsError:
        raise InputError(
            "This file exists already; it was not changed. Name a new path, or add --force to move "
            f"the existing result aside. {path}"
        ) from None
    except OSError as error:
        raise _not_created(path, error) from None


def _create_whole(path: Path, content: bytes) -> None:
    """Write a file under a temporary name, and give it its name unless that is taken."""
    draft = path.with_name(f".haselab-{secrets.token_hex(8)}")
    try:
        with draft.open("xb") as file:
            file.write(content)
        try:
            path.hardlink_to(draft)  # unlike a rename, it replaces nothing
        except FileExistsError:
            raise
        except OSError:  # a file system without links
            path.open("xb").close()
            draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)


def is_left_empty(path: Path) -> bool:
    """Whether a path is an empty file that no program is about to write.

    Such a file is left if a program is killed before it has written its result. It is younger than
    its lock for a moment, so only one of some age counts.
    """
    try:
        status = path.lstat()
    except OSError:
        return False
    is_empty = stat.S_ISREG(status.st_mode) and status.st_size == 0
    return CAN_TELL and is_empty and time.time() - status.st_mtime > _AGE_S and not is_held(path)


def is_occupied(path: Path) -> bool:
    """Whether the path must not be overwritten: a file, a broken link, or a non-empty folder.

    An empty file that a killed program has left may be.

    Pipes and devices, and links to them, may be written to.
    """
    if path.is_dir():
        return any(path.iterdir())
    return (path.is_file() and not is_left_empty(path)) or (path.is_symlink() and not path.exists())


def move_aside(path: Path, *, is_claimed: bool = False) -> Path:
    """Rename a file or a folder to `NAME.previous-1`, or the next free number.

    Args:
        path: of the existing result.
        is_claimed: this process has the lock of the folder.
    Returns:
        Its new path. Nothing is deleted.
    Raises:
        InputError: it cannot be renamed, another program writes to it, or it contains the working
            directory.
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
            # A rename silently replaces an empty folder or file, so a placeholder is created first.
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
        except OSError as error:  # typically a mount point
            _remove_placeholder(aside)
            raise _immovable(path, error) from None
        if is_held(aside):  # created by another program in the meantime
            aside.rename(path)
            raise _in_use(path)
        return aside
    raise InputError(
        f"There are {_MOST_PREVIOUS} previous results already. Delete some of them. {path}"
    )


def _immovable(path: Path, error: OSError) -> InputError:
    return InputError(
        f"Cannot move the existing result aside ({error.strerror or error}). Name a new path. "
        f"{path}"
    )


def _remove_placeholder(aside: Path) -> None:
    """Remove the placeholder for a result that could not be moved."""
    with contextlib.suppress(OSError):
        aside.rmdir() if aside.is_dir() else aside.unlink()


def _refuse_in_use(path: Path, is_claimed: bool) -> None:
    """Refuse a folder that another program writes to, or that contains such a folder."""
    for folder in (path, *(found for found in path.rglob("*") if found.is_dir())):
        if folder != path or not is_claimed:
            with _locked(folder):
                pass
        if is_held(folder / "session.h5"):
            raise _in_use(folder)


@contextlib.contextmanager
def claimed_folder(folder: Path, *, force: bool = False) -> Iterator[Path | None]:
    """Reserve a new folder for this process until the context ends.

    The lock is on the folder itself; the system releases it when the process ends. All files of a
    run are written under the lock: the guardian's log, manifest, session, video, results.

    Args:
        folder: new, or empty.
        force: move an existing folder aside instead of refusing it.
    Returns:
        The new path of the existing folder; None: there was none.
    Raises:
        InputError: the folder is not empty, or another program writes to it.
        DeviceError: the disk refuses.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out names a file, not a folder. Name a new folder. {folder}")
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
                        "--out names a folder that is not empty; it was not changed. Name a "
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
    """Whether a folder contains more than the log of a bench that was never armed."""
    return any(path.name != _LOG for path in folder.iterdir())


def _put_back(folder: Path, aside: Path | None, made: list[Path]) -> None:
    """Undo the claim if nothing was written: restore what was moved, remove what was created."""
    if any(folder.iterdir()):
        return
    _remove_empty(made)
    if aside is not None and not folder.exists():
        with contextlib.suppress(OSError):
            aside.rename(folder)


def _in_use(folder: Path) -> InputError:
    kind = "folder" if folder.is_dir() else "file"
    return InputError(f"Another program is writing to this {kind}. Name another one. {folder}")


@contextlib.contextmanager
def shared_folder(folder: Path) -> Iterator[None]:
    """Reserve a folder whose files are rewritten each time, while the context lasts.

    Args:
        folder: new or existing.
    Raises:
        InputError: the path is a file, or another program uses the folder.
        DeviceError: the disk refuses.
    """
    made = _make_parents(folder)
    try:
        with _locked(folder):
            yield
    finally:
        _remove_empty(made)


@contextlib.contextmanager
def joined_folder(folder: Path) -> Iterator[None]:
    """Use a folder together with other programs that join it; no program may claim or move it.

    Args:
        folder: new or existing.
    Raises:
        InputError: the path is a file, or another program has claimed the folder.
        DeviceError: the disk refuses.
    """
    made = _make_parents(folder)
    try:
        with _locked(folder, together=True):
            yield
    finally:
        _remove_empty(made)


@contextlib.contextmanager
def _locked(folder: Path, *, together: bool = False) -> Iterator[contextlib.ExitStack]:
    """Lock the folder, if the system supports it; the yielded stack can release it early."""
    with contextlib.ExitStack() as held:
        if sys.platform != "win32":
            import fcntl

            descriptor = os.open(folder, os.O_RDONLY)
            held.callback(os.close, descriptor)
            try:
                kind = fcntl.LOCK_SH if together else fcntl.LOCK_EX
                fcntl.flock(descriptor, kind | fcntl.LOCK_NB)
            except BlockingIOError:
                raise _in_use(folder) from None
            except OSError:  # a file system without such locks; files are made exclusively there
                pass
        yield held
