"""Nothing that exists is overwritten, and one program at a time has a folder."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from haselab.base import DeviceError, InputError
from haselab.store.claim import (
    claimed_file,
    claimed_folder,
    create_exclusively,
    is_left_empty,
    is_occupied,
    move_aside,
)
from haselab.store.manifest import Manifest, read_manifest

_OTHER = """
    import sys
    from pathlib import Path
    from haselab.base import InputError
    from haselab.store.claim import claimed_folder
    try:
        with claimed_folder(Path(sys.argv[1]), force=True):
            print("claimed")
    except InputError as error:
        print(error)
"""


def other_process(folder: Path) -> str:
    code = "\n".join(line[4:] for line in _OTHER.splitlines())
    done = subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, text=True,
                          check=True, timeout=300)  # fmt: skip
    return done.stdout


def test_a_folder_belongs_to_one_process_until_its_context_ends(tmp_path):
    folder = tmp_path / "deep" / "run"
    with claimed_folder(folder):
        assert "Another program is writing to this folder" in other_process(folder)
        (folder / "session.h5").write_text("x")
        assert "Another program is writing to this folder" in other_process(folder)
        assert (folder / "session.h5").read_text() == "x"
    assert "claimed" in other_process(folder)
    assert (tmp_path / "deep" / "run.previous-1" / "session.h5").read_text() == "x"


def test_a_folder_with_content_is_refused_or_moved_aside_but_never_emptied(tmp_path):
    folder = tmp_path / "run"
    for number in range(3):
        with claimed_folder(folder, force=number > 0) as aside:
            assert aside == (None if number == 0 else tmp_path / f"run.previous-{number}")
            (folder / "data").write_text(str(number))
        with pytest.raises(InputError, match=r"not empty; it was not changed"):
            claimed_folder(folder).__enter__()
    found = {path.parent.name: path.read_text() for path in tmp_path.rglob("data")}
    assert found == {"run.previous-1": "0", "run.previous-2": "1", "run": "2"}


def test_a_command_that_wrote_nothing_leaves_things_as_they_were(tmp_path):
    folder = tmp_path / "run"
    with pytest.raises(ZeroDivisionError, match="by"), claimed_folder(folder):
        raise ZeroDivisionError("by zero")
    assert not folder.exists()
    folder.mkdir()
    (folder / "data").write_text("old")
    with pytest.raises(ZeroDivisionError, match="by"), claimed_folder(folder, force=True):
        raise ZeroDivisionError("by zero")
    assert [path.name for path in tmp_path.rglob("*")] == ["run", "data"]


def test_the_log_of_a_bench_that_was_never_armed_does_not_count_as_a_result(tmp_path):
    (tmp_path / "guardian.log").write_text("{}\n")
    with claimed_folder(tmp_path):
        pass
    assert (tmp_path / "guardian.log").read_text() == "{}\n"


def test_a_file_cannot_become_a_folder(tmp_path):
    (tmp_path / "a").write_text("x")
    with pytest.raises(InputError, match="--out names a file, not a folder"):
        claimed_folder(tmp_path / "a", force=True).__enter__()


def test_files_move_to_the_next_free_number(tmp_path):
    path = tmp_path / "a.csv"
    (tmp_path / "a.csv.previous-1").write_text("other")
    path.write_text("x")
    assert is_occupied(path)
    assert move_aside(path).name == "a.csv.previous-2"
    assert not is_occupied(path)
    assert (tmp_path / "a.csv.previous-1").read_text() == "other"


def test_a_file_is_created_once(tmp_path):
    create_exclusively(tmp_path / "a")
    with pytest.raises(InputError, match="This file exists already; it was not changed"):
        create_exclusively(tmp_path / "a")


def test_a_second_recording_in_a_folder_is_refused_by_its_manifest(tmp_path):
    with Manifest(tmp_path, {"seed": 1}):
        before = (tmp_path / "manifest.json").read_bytes()
        with pytest.raises(InputError, match="This file exists"):
            Manifest(tmp_path, {"seed": 2})
        assert (tmp_path / "manifest.json").read_bytes() == before
    assert read_manifest(tmp_path)["seed"] == 1


@pytest.mark.skipif(sys.platform == "win32", reason="folders are locked by flock")
def test_a_folder_that_is_written_to_is_not_moved_aside_nor_one_that_holds_it(tmp_path):
    live = tmp_path / "runs" / "today"
    with claimed_folder(live):
        (live / "session.h5").write_bytes(b"being recorded")
        for path in (live, tmp_path / "runs"):
            with pytest.raises(InputError, match="Another program is writing to this folder"):
                move_aside(path)
    assert (live / "session.h5").read_bytes() == b"being recorded"
    assert move_aside(tmp_path / "runs").name == "runs.previous-1"


def test_the_working_directory_is_not_moved_aside(tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    for path in (Path(), tmp_path):
        with pytest.raises(InputError, match="would move the working directory aside"):
            move_aside(path)


def test_a_failure_leaves_a_folder_that_was_there_and_removes_those_made_for_it(tmp_path):
    (tmp_path / "mine").mkdir()
    for path in (tmp_path / "mine", tmp_path / "a" / "b"):
        with pytest.raises(ZeroDivisionError, match="by"), claimed_folder(path):
            raise ZeroDivisionError("by zero")
    with pytest.raises(ZeroDivisionError, match="by"), claimed_file(tmp_path / "c" / "d" / "e"):
        raise ZeroDivisionError("by zero")
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]


def test_the_name_of_a_file_belongs_to_one_command_while_it_runs(tmp_path):
    path = tmp_path / "a.csv"
    with claimed_file(path):
        with pytest.raises(InputError, match="This file exists"):
            claimed_file(path).__enter__()
        path.write_text("result")
    assert path.read_text() == "result"
    with pytest.raises(InputError, match="This file exists"):
        claimed_file(path).__enter__()


@pytest.mark.skipif(sys.platform != "linux", reason="locks of open files are Linux's")
def test_a_file_that_is_being_written_is_not_moved_aside(tmp_path):
    path = tmp_path / "a.csv"
    with claimed_file(path):
        with pytest.raises(InputError, match="Another program is writing to this file"):
            move_aside(path)
        path.write_text("result")
    assert [each.name for each in tmp_path.iterdir()] == ["a.csv"]
    assert move_aside(path).read_text() == "result"


def test_a_result_that_cannot_be_moved_leaves_nothing_beside_it(tmp_path, monkeypatch):
    """A mount point: the system refuses to rename it."""

    def busy(self: Path, target: Path) -> Path:
        raise OSError(errno.EBUSY, "Device or resource busy")

    (tmp_path / "run").mkdir()
    (tmp_path / "a.csv").write_text("x")
    monkeypatch.setattr(Path, "rename", busy)
    for name in ("run", "a.csv"):
        with pytest.raises(InputError, match=r"Cannot move .*Device or resource busy"):
            move_aside(tmp_path / name)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.csv", "run"]


@pytest.mark.skipif(sys.platform == "win32", reason="links need rights on Windows")
def test_a_link_that_leads_nowhere_is_bad_input_with_its_cause(tmp_path):
    link = tmp_path / "run"
    link.symlink_to("missing")
    with pytest.raises(InputError, match="--out is a link to missing, which does not exist"):
        claimed_folder(link).__enter__()
    with pytest.raises(InputError, match=r"Cannot write \(.*Part of the path is a file"):
        claimed_folder(link / "below").__enter__()
    with claimed_folder(link, force=True) as aside:
        assert aside is not None and aside.is_symlink() and link.is_dir()


@pytest.mark.parametrize(
    ("number", "kind", "remedy"),
    [
        (errno.ENOENT, InputError, "Choose another folder, or change its permissions"),
        (errno.EACCES, InputError, "Choose another folder, or change its permissions"),
        (errno.EROFS, InputError, "Choose another folder, or change its permissions"),
        (errno.ENOTDIR, InputError, "Part of the path is a file"),
        (errno.ENOSPC, DeviceError, "Free disk space"),
        (errno.EIO, DeviceError, "Check the disk"),
    ],
)
def test_a_place_without_permission_is_bad_input_and_a_failing_disk_is_not(
    tmp_path, monkeypatch, number, kind, remedy
):
    def refuse(*_, **__):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "open", refuse)
    line = rf"^Cannot write \({os.strerror(number)}\)\. {remedy}.*a\.toml$"
    with pytest.raises(kind, match=line):
        create_exclusively(tmp_path / "a.toml")


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no file can be created in /proc")
def test_a_file_system_that_permits_no_files_is_bad_input():
    with (
        pytest.raises(InputError, match=r"Cannot write .*Choose another folder.* /proc/x$"),
        claimed_file(Path("/proc/x")),
    ):
        raise AssertionError("must not be entered")


_KILLED = """
import sys, time
from pathlib import Path
from haselab.store.claim import claimed_file
with claimed_file(Path(sys.argv[1])):
    print("claimed", flush=True)
    time.sleep(600)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="the lock cannot be seen here")
def test_an_empty_file_of_a_killed_program_does_not_block_the_next_one(tmp_path):
    path = tmp_path / "figure.svg"
    with subprocess.Popen(
        [sys.executable, "-c", _KILLED, str(path)], stdout=subprocess.PIPE, text=True
    ) as other:
        assert other.stdout is not None and other.stdout.readline() == "claimed\n"
        os.utime(path, (0.0, 0.0))
        assert is_occupied(path)  # it has the lock
        with pytest.raises(InputError, match="exists already"), claimed_file(path):
            pass
        other.kill()
    assert is_left_empty(path) and not is_occupied(path)
    path.chmod(0o600)
    with claimed_file(path):
        assert not is_left_empty(path)
        path.write_text("result")
    assert path.read_text() == "result" and path.stat().st_mode & 0o777 == 0o600
    os.utime(path, (0.0, 0.0))
    assert is_occupied(path)


def test_a_new_empty_file_is_not_taken(tmp_path):
    (tmp_path / "new").touch()
    assert is_occupied(tmp_path / "new")
