"""Small files of a run's folder: whole or not there at all."""

import errno
import json
import os
import stat
import sys
from pathlib import Path

import numpy as np
import pytest

from haselab.base import DeviceError, Estimate, InputError
from haselab.store.folder import read_json, write_json, write_new, write_text


def test_numbers_come_back_as_they_were_and_what_is_not_finite_as_null(tmp_path):
    path = tmp_path / "new" / "folder" / "a.json"
    rng = np.random.default_rng(2)
    numbers = rng.standard_normal(50) * 10.0 ** rng.integers(-300, 300, 50)
    one = Estimate(1.0, 0.5, (0.0, 2.0), "s")
    write_json(path, {"numbers": numbers, "bad": [np.nan, np.inf], "é": one})
    back = read_json(path)
    np.testing.assert_array_equal(back["numbers"], numbers)  # bit for bit
    assert back["bad"] == [None, None]
    assert back["é"] == {"value": 1.0, "std": 0.5, "ci95": [0.0, 2.0], "unit": "s"}
    assert json.loads(path.read_text(encoding="utf-8")) == back


def test_a_new_text_replaces_the_old_one_and_leaves_no_draft(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "a long first text")
    write_text(path, "short")
    assert path.read_text() == "short"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("step", ["write_bytes", "replace"])
def test_a_disk_that_fills_up_keeps_the_old_file_whole(tmp_path, monkeypatch, step):
    path = tmp_path / "a.txt"
    write_text(path, "old")
    real = Path.write_bytes

    def full(self: Path, *args: object, **kwargs: object) -> None:
        if step == "write_bytes":
            real(self, b"half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, step, full)
    with pytest.raises(DeviceError, match=r"\(No space left on device\)\. Free .*txt$"):
        write_text(path, "new")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_in_the_place_of_the_file_is_a_device_error(tmp_path):
    (tmp_path / "a.json").mkdir()
    with pytest.raises(DeviceError, match=r"Cannot write .*a\.json$"):
        write_json(tmp_path / "a.json", {})
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, "No such file. Give the name"),
        (b"", "a.json is not a JSON document"),
        (b'{"a": 1', "a.json is not a JSON document"),
        (b"\xff\xfe\x00", "not a text in UTF-8"),
        (b"[" * 100_000, "nested too deeply"),
    ],
)
def test_a_file_that_is_no_json_is_an_input_error_with_the_path_last(tmp_path, content, words):
    path = tmp_path / "a.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=rf"{words}.*a\.json$"):
        read_json(path)


def test_a_folder_is_no_json_file(tmp_path):
    with pytest.raises(InputError, match="The path is a folder"):
        read_json(tmp_path)


def test_nothing_else_in_the_folder_is_touched(tmp_path):
    other = tmp_path / "other"
    other.write_text("of another program")
    (tmp_path / "a.txt.part").symlink_to(other)
    write_text(tmp_path / "a.txt", "new")
    assert other.read_text() == "of another program"
    assert (tmp_path / "a.txt.part").is_symlink()
    (tmp_path / "a.txt").unlink()
    (tmp_path / "a.txt").symlink_to(other)
    write_text(tmp_path / "a.txt", "newer")  # the link goes, what it led to stays
    assert (tmp_path / "a.txt").read_text() == "newer"
    assert other.read_text() == "of another program"


def test_a_new_file_has_the_rights_that_the_user_gives_to_new_files(tmp_path):
    write_text(tmp_path / "a", "x")
    (tmp_path / "b").write_text("x")
    assert (tmp_path / "a").stat().st_mode == (tmp_path / "b").stat().st_mode


@pytest.mark.skipif(sys.platform == "win32", reason="permissions of POSIX")
def test_a_private_file_stays_private(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    path.chmod(0o600)
    write_text(path, "new")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600 and path.read_text() == "new"


@pytest.mark.skipif(sys.platform == "win32", reason="devices are files on POSIX systems")
def test_a_device_is_written_to_and_not_replaced(tmp_path):
    (tmp_path / "sink").symlink_to("/dev/null")
    write_text(tmp_path / "sink", "x")
    assert (tmp_path / "sink").is_symlink()
    write_new(tmp_path / "sink", "x")
    assert (tmp_path / "sink").is_symlink() and Path("/dev/null").is_char_device()


def test_a_new_file_has_its_name_when_it_is_complete_and_replaces_nothing(tmp_path, monkeypatch):
    """Seen by whoever looks at each call that could make the name visible."""
    path, seen = tmp_path / "new" / "a.txt", []
    plain = {name: getattr(os, name) for name in ("link", "open", "replace")}

    def watched(name):
        def call(*given, **named):
            try:
                return plain[name](*given, **named)
            finally:
                seen.append(path.read_text() if path.exists() else None)

        return call

    for name in plain:
        monkeypatch.setattr(os, name, watched(name))
    write_new(path, "whole")
    assert seen[-1] == "whole" and set(seen) <= {None, "whole"}
    with pytest.raises(InputError, match="exists already"):
        write_new(path, "other")
    assert path.read_text() == "whole"
    assert list(path.parent.iterdir()) == [path]


def test_without_links_of_the_file_system_a_new_file_is_written_as_well(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    write_new(tmp_path / "a.txt", "whole")
    assert (tmp_path / "a.txt").read_text() == "whole"
    assert list(tmp_path.iterdir()) == [tmp_path / "a.txt"]
    with pytest.raises(InputError, match="exists already"):
        write_new(tmp_path / "a.txt", "other")
    assert (tmp_path / "a.txt").read_text() == "whole"
