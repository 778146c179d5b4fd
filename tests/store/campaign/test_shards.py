"""Shards of finished cases, and claims on cases."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow
import pyarrow.parquet
import pytest

from haselab.base import InputError
from haselab.store.campaign import claims as module
from haselab.store.campaign.claims import EXPIRES_S, Claims
from haselab.store.campaign.shards import CaseRow, CaseState, Shards


def row(index: int, **more: object) -> CaseRow:
    found: dict[str, object] = {"results": {"y": float(index)}, **more}
    return CaseRow(f"case-{index}", index, {"case.gain": 0.1 * index}, **found)  # type: ignore[arg-type]


def test_rows_are_read_as_they_were_written_in_the_order_of_their_indices(tmp_path: Path) -> None:
    failed = row(7, results={}, error="it failed", traceback="Traceback\n  line")
    written = [row(3, compute_s=0.5), failed, row(1)]
    shards = Shards(tmp_path, "a")
    shards.write(written[:2])
    shards.write(written[2:])
    names = [one.case for one in written]
    assert Shards(tmp_path, "b").rows(names, ["case.gain"]) == [written[2], written[0], failed]
    assert Shards(tmp_path, "b").rows(["case-1", "none"], ["case.gain"]) == [written[2]]


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="lists the threads of Linux")
def test_no_thread_holds_a_shard_that_was_read(tmp_path: Path) -> None:
    """Such a thread aborts the program that ends meanwhile: 5 of 60, in a measurement."""
    Shards(tmp_path, "a").write([row(index) for index in range(2000)])
    text = """
import os, sys
from pathlib import Path
from haselab.store.campaign.shards import Shards
shards = Shards(Path(sys.argv[1]), "b")
before = set(os.listdir("/proc/self/task"))
assert len(shards.states()) == 2000
print(len(set(os.listdir("/proc/self/task")) - before))
"""
    line = [sys.executable, "-c", text, str(tmp_path)]
    assert subprocess.check_output(line, text=True) == "0\n"


def test_a_result_beats_a_failure_and_a_later_failure_an_earlier_one(tmp_path: Path) -> None:
    shards = Shards(tmp_path, "a")
    shards.write([row(0, error="late", results={}, attempt=2), row(1)])
    shards.write([row(0, error="early", results={}), row(1, error="x", results={}, attempt=2)])
    assert Shards(tmp_path, "b").states() == {
        "case-0": CaseState(failed=True, attempt=2), "case-1": CaseState(failed=False, attempt=1),
    }  # fmt: skip
    found = Shards(tmp_path, "b").rows(["case-0", "case-1"], ["case.gain"])
    assert [one.error for one in found] == ["late", ""]


def test_small_shards_are_merged_and_no_row_is_lost(tmp_path: Path) -> None:
    shards, reader = Shards(tmp_path, "a"), Shards(tmp_path, "b")
    assert reader.states() == {}
    for index in range(70):
        shards.write([row(index)])
    files = list((tmp_path / "shards").glob("*.parquet"))
    assert len(files) == 7
    assert len(reader.news()) == 70 and reader.news() == {}
    found = reader.rows([f"case-{index}" for index in range(70)], ["case.gain"])
    assert found == [row(index) for index in range(70)]


def test_a_program_that_ended_between_merging_and_deleting_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shards = Shards(tmp_path, "a")
    for index in range(40):
        shards.write([row(index)])
    with monkeypatch.context() as patch:
        patch.setattr(Path, "unlink", lambda path, missing_ok=False: None)
        shards.merge()
    assert len(list((tmp_path / "shards").glob("*.parquet"))) == 41
    found = Shards(tmp_path, "b").rows([f"case-{index}" for index in range(40)], ["case.gain"])
    assert found == [row(index) for index in range(40)]


def test_a_damaged_shard_is_named(tmp_path: Path) -> None:
    Shards(tmp_path, "a").write([row(0)])
    (file,) = (tmp_path / "shards").glob("*.parquet")
    file.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"Not a shard of a campaign .*Delete the file.*\.parquet"):
        Shards(tmp_path, "b").states()


def test_no_flipped_bit_gives_other_values(tmp_path: Path) -> None:
    """The checksum covers all bytes, so that a flip anywhere is found."""
    written = [row(index) for index in range(20)]
    Shards(tmp_path, "a").write(written)
    (file,) = (tmp_path / "shards").glob("*.parquet")
    whole = file.read_bytes()
    for place in range(0, 8 * len(whole), 41):
        damaged = bytearray(whole)
        damaged[place // 8] ^= 1 << place % 8
        file.write_bytes(damaged)
        for read in (Shards.states, lambda shards: shards.rows(["case-1"], ["case.gain"])):
            with pytest.raises(InputError, match=r"^Not a shard .*damaged.*Delete the file"):
                read(Shards(tmp_path, "b"))
    file.write_bytes(whole)
    assert len(Shards(tmp_path, "b").states()) == 20


def test_a_shard_of_an_older_version_has_no_checksum_and_is_read(tmp_path: Path) -> None:
    Shards(tmp_path, "a").write([row(0)])
    (file,) = (tmp_path / "shards").glob("*.parquet")
    file.rename(file.with_name("host.abcdef01-000001.parquet"))
    assert Shards(tmp_path, "b").rows(["case-0"], ["case.gain"]) == [row(0)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.drop_columns(["case"]), "it has no column 'case'"),
        (lambda table: table.select(["y"]), "it has no column 'case'"),
        (
            lambda table: table.append_column("case", table["case"]),
            "it has 2 columns 'case'",
        ),
        (
            lambda table: table.set_column(1, "index", table["status"]),
            "its column 'index' has the type string, not int64",
        ),
        (
            lambda table: table.set_column(0, "case", table["case"].cast("large_string")),
            "its column 'case' has the type large_string, not string",
        ),
        (
            lambda table: table.set_column(
                4, "attempt", pyarrow.array([None] * table.num_rows, pyarrow.int64())
            ),
            "its column 'attempt' has empty places",
        ),
        (
            lambda table: table.append_column("z", table["status"]),
            "its column 'z' has the type string, not double",
        ),
        (lambda table: table.drop_columns(["case.gain"]), "it has no column 'case.gain'"),
    ],
)
def test_a_foreign_table_among_the_shards_is_refused_in_one_line(
    tmp_path: Path, change: Callable[[Any], Any], message: str
) -> None:
    shards = Shards(tmp_path, "a")
    shards.write([row(0), row(1)])
    (file,) = (tmp_path / "shards").glob("*.parquet")
    foreign = file.with_name("foreign.parquet")
    pyarrow.parquet.write_table(change(pyarrow.parquet.read_table(file)), foreign)
    with pytest.raises(InputError, match=rf"^Not a shard of a campaign \({message}\)\. Delete"):
        reader = Shards(tmp_path, "b")
        reader.states()
        reader.rows(["case-0"], ["case.gain"])


def test_small_shards_stay_if_one_of_them_is_foreign(tmp_path: Path) -> None:
    shards = Shards(tmp_path, "a")
    for index in range(40):
        shards.write([row(index)])
    (file, *_) = (tmp_path / "shards").glob("*.parquet")
    table = pyarrow.parquet.read_table(file)
    texts = table.set_column(table.column_names.index("y"), "y", table["status"])
    pyarrow.parquet.write_table(texts, file.with_name("foreign.parquet"))
    shards.merge()
    assert len(list((tmp_path / "shards").glob("*.parquet"))) == 41


def test_a_claim_excludes_others_until_its_program_releases_it_or_ends(tmp_path: Path) -> None:
    with Claims(tmp_path) as first, Claims(tmp_path) as second:
        assert first.take(4) and not second.take(4) and second.take(5)
        first.release(4)
        assert second.take(4)
    with Claims(tmp_path) as third:
        assert third.take(4) and third.take(5)
    assert not list((tmp_path / "programs").iterdir())


def test_a_program_of_another_computer_has_its_claims_until_it_gives_no_sign_of_life(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Claims(tmp_path) as first:
        assert first.take(1)
        other = tmp_path / "programs" / "elsewhere-1-abc"
        other.write_text("")
        (tmp_path / "claims" / "2").write_text(other.name)
        assert not first.take(2)
        # the last sign of life is too old, or of a clock that was set back since
        for block, shift_s in ((2, -EXPIRES_S - 1.0), (3, EXPIRES_S + 60.0)):
            os.utime(other)
            (tmp_path / "claims" / str(block)).write_text(other.name)
            assert not first.take(block)
            sign_s = time.time() + shift_s
            os.utime(other, (sign_s, sign_s))
            assert first.take(block)


def test_without_locks_two_programs_of_one_computer_respect_each_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Otherwise the second program takes the first for ended, and computes all cases again."""

    def refuses(descriptor: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(module, "hold", refuses)
    monkeypatch.setattr(module, "is_held", lambda path: False)
    with Claims(tmp_path) as first:
        assert first.take(4)
        with Claims(tmp_path) as second:
            assert not second.take(4) and second.take(5) and not first.take(5)
        old_s = time.time() - EXPIRES_S - 1.0
        os.utime(tmp_path / "programs" / first.writer, (old_s, old_s))
        with Claims(tmp_path) as third:
            assert third.take(4)


def test_a_program_gives_signs_of_life(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_SIGN_S", 0.01)
    with Claims(tmp_path) as claims:
        own = tmp_path / "programs" / claims.writer
        os.utime(own, (0.0, 0.0))
        end = time.monotonic() + 60.0
        while own.stat().st_mtime == 0.0 and time.monotonic() < end:
            time.sleep(0.01)
        assert own.stat().st_mtime > 0.0
