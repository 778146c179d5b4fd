"""The table does not depend on order, workers, losses and restarts; failed cases are kept."""

from __future__ import annotations

import errno
import json
import os
from typing import Any

import numpy as np
import pytest

from haselab.base import DeviceError, Estimate, InputError
from haselab.campaign import work
from haselab.campaign.definition import load_campaign
from haselab.campaign.folder import finished_rows, open_folder, plan_of
from haselab.campaign.kinds.transfer import TRANSFER
from haselab.store.campaign.claims import Claims
from haselab.store.campaign.shards import CaseRow, Shards


@pytest.fixture
def undisturbed(campaigns: Any) -> bytes:
    found = campaigns.run("undisturbed", workers=1)
    assert (found.cases, found.done, found.failed, found.computed) == (16, 16, 0, 16)
    return campaigns.table("undisturbed")


def test_the_table_is_the_same_for_any_number_of_workers_and_any_order(
    campaigns: Any, undisturbed: bytes
) -> None:
    for workers, seed in ((2, 1), (5, 2), (16, 3)):
        campaigns.run(f"{workers}", workers=workers, seed=seed)
        assert campaigns.table(f"{workers}") == undisturbed


def test_lost_chunks_are_computed_again(campaigns: Any, undisturbed: bytes) -> None:
    rng = np.random.default_rng(5)
    lost = []

    def loses(chunk: Any) -> bool:
        lost.append(bool(rng.random() < 0.3))
        return lost[-1]

    assert campaigns.run("losses", lost=loses).done == 16
    assert any(lost) and campaigns.table("losses") == undisturbed


def test_a_case_in_which_every_worker_ends_fails_alone(campaigns: Any, undisturbed: bytes) -> None:
    def loses(chunk: Any) -> bool:
        return any(job.index == 5 for job in chunk.jobs)

    found = campaigns.run("deadly", lost=loses)
    assert (found.done, found.failed) == (15, 1)
    columns = campaigns.columns("deadly")
    assert columns["error"][5] == "The worker ended 4 times while it computed this case."
    assert [k for k, status in enumerate(columns["status"]) if status == "failed"] == [5]
    assert campaigns.run("deadly", retry=True).done == 16
    assert campaigns.table("deadly") == undisturbed


def test_a_program_that_ends_anywhere_is_continued_by_the_next(
    campaigns: Any, undisturbed: bytes
) -> None:
    """It computes only what is missing: cases minus finished ones."""
    computed = 0
    for allowed in (1, 0, 3, 2):
        left = iter(range(allowed))

        def ends(chunk: Any, left: Any = left) -> bool:
            if next(left, None) is None:
                raise KeyboardInterrupt
            return False

        with pytest.raises(KeyboardInterrupt) as caught:
            campaigns.run("ends", lost=ends)
        computed += allowed
        assert caught.value.__notes__ == [
            f"{computed} of 16 cases are finished and kept; the same command continues."
        ]
    found = campaigns.run("ends", workers=3)
    assert found.computed == 16 - computed and found.done == 16
    assert campaigns.table("ends") == undisturbed


def test_a_full_disk_ends_in_one_line_and_nothing_is_lost(
    campaigns: Any, undisturbed: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    written, fsync = [], os.fsync

    def full(descriptor: int) -> None:
        written.append(descriptor)
        if len(written) > 6:  # a file and its folder are synchronised for each shard
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(DeviceError, match=r"No space left.*3 of 16 cases are finished") as caught:
        campaigns.run("full", workers=16)
    assert "\n" not in str(caught.value)
    shards = campaigns.folder / "full" / "shards"
    assert not list(shards.glob(".haselab-*"))
    monkeypatch.setattr(os, "fsync", fsync)
    assert campaigns.run("full").computed == 13
    assert campaigns.table("full") == undisturbed


def test_failed_cases_keep_their_traceback_and_are_computed_again_alone(
    campaigns: Any, undisturbed: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    compute = type(TRANSFER).compute

    def fails(kind: Any, inputs: Any, rng: Any) -> Any:
        if inputs.tables["case"]["noise_std"] == 0.02:
            raise ZeroDivisionError(f"of {object()!r}")
        return compute(kind, inputs, rng)

    with monkeypatch.context() as patch:
        patch.setattr(type(TRANSFER), "compute", fails)
        assert campaigns.run("fails").failed == 8
        assert campaigns.run("fails").computed == 0  # failed is finished
        other = campaigns.run("fails too", workers=7, seed=4)
    assert (other.done, other.failed) == (8, 8)
    assert campaigns.table("fails") == campaigns.table("fails too")  # addresses are left out
    text = (campaigns.folder / "fails" / "failed.txt").read_text()
    assert text.count("Traceback (most recent call last)") == 8
    assert "ZeroDivisionError" in text and "case 8 (" in text and "case.noise_std = 0.02" in text
    found = campaigns.run("fails", retry=True)
    assert (found.computed, found.done, found.failed) == (8, 16, 0)
    assert campaigns.table("fails") == undisturbed


def test_two_programs_share_the_cases(campaigns: Any, undisturbed: bytes) -> None:
    """The second one takes what the first has not claimed, and what it has not finished."""
    plan, out = campaigns.plan(), campaigns.folder / "shared"
    open_folder(plan, out)
    hashes = plan.hashes()
    with Claims(out) as first:
        assert first.take(0) and first.take(1)
        rows = [work.compute_case(plan.problem, plan.job(k, hashes[k])) for k in (1, 2)]
        Shards(out, first.writer).write(rows)
        first.release(1)
        found = campaigns.run("shared")
        assert (found.computed, found.done, found.elsewhere) == (13, 15, 1)
        assert not found.is_complete
    found = campaigns.run("shared")
    assert (found.computed, found.done) == (1, 16)
    assert campaigns.table("shared") == undisturbed


def test_the_claims_of_a_program_that_has_ended_expire(campaigns: Any, undisturbed: bytes) -> None:
    plan, out = campaigns.plan(), campaigns.folder / "expired"
    open_folder(plan, out)
    with Claims(out) as claims:
        for block in range(16):
            assert claims.take(block)
        kept = {path.name: path.read_text() for path in (out / "claims").iterdir()}
    for name, writer in kept.items():  # as after kill -9
        (out / "claims" / name).write_text(writer)
    (out / "programs" / claims.writer).write_text("")
    assert campaigns.run("expired").computed == 16
    assert campaigns.table("expired") == undisturbed


def test_a_worker_with_other_code_computes_nothing(campaigns: Any) -> None:
    plan = campaigns.plan()
    plan.code = "0.0.0+other"
    with pytest.raises(DeviceError, match=r"A worker has haselab .*started by 0\.0\.0\+other"):
        work.compute_cases(plan.problem, [plan.job(0, "a")])


def test_a_folder_of_another_campaign_is_refused_and_says_what_differs(campaigns: Any) -> None:
    campaigns.run("out")
    before = sorted(path.name for path in (campaigns.folder / "out").rglob("*"))
    other = campaigns.quick.replace("samples = 8", "samples = 16").replace("[0.4", "[0.3")
    with pytest.raises(InputError, match=r"design\.samples is 8 there and 16 here.*\[0\.4, 0\.6\]"):
        campaigns.run("out", other)
    assert sorted(path.name for path in (campaigns.folder / "out").rglob("*")) == before
    (campaigns.folder / "mine").mkdir()
    (campaigns.folder / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"not empty and has no campaign.*mine"):
        campaigns.run("mine")


def test_cases_of_another_version_are_computed_again_and_kept(campaigns: Any) -> None:
    plan, out = campaigns.plan(), campaigns.folder / "old"
    open_folder(plan, out)
    row = CaseRow("0" * 32, 0, plan.values(0), {"gain": 1.0})
    Shards(out, "old").write([row])
    found = campaigns.run("old")
    assert (found.outdated, found.computed) == (1, 16)
    assert "0" * 32 not in campaigns.columns("old")["case"]
    assert json.loads((out / "campaign.json").read_text())["kind"] == "transfer"


SWAPPED = """
name = "two distributions"
kind = "transfer"

[case]
duration_s = 1.0
rate_hz = 100.0

[parameters]
{}
{}

[design]
kind = "random"
samples = 8
"""


def test_parameters_in_another_order_do_not_take_each_others_drawn_values(campaigns: Any) -> None:
    """The drawn values of a folder are kept as columns in the order of the file."""
    lines = "case.gain = { uniform = [0.4, 0.6] }", "case.amplitude = { uniform = [5.0, 9.0] }"
    campaigns.run("out", SWAPPED.format(*lines))
    swapped = SWAPPED.format(*reversed(lines))
    plan = plan_of(load_campaign(campaigns.file(swapped)), campaigns.folder / "out")
    assert all(0.4 <= plan.values(index)["case.gain"] <= 0.6 for index in range(8))
    with pytest.raises(InputError, match=r"order of the parameters is \['case\.gain'"):
        campaigns.run("out", swapped)


@pytest.mark.parametrize("content", [b"", b"\x93NUMPY", bytes(400)])
def test_damaged_points_are_drawn_again(campaigns: Any, content: bytes) -> None:
    campaigns.run("out")
    (campaigns.folder / "out" / "design.npy").write_bytes(content)
    plan = plan_of(load_campaign(campaigns.file()), campaigns.folder / "out")
    assert plan.drawn.tolist() == campaigns.plan().drawn.tolist()


@pytest.mark.parametrize("begin", [0, 4])
def test_a_damaged_shard_is_named(campaigns: Any, begin: int) -> None:
    """Bytes that changed inside give another error of pyarrow than a file that was cut."""
    campaigns.run("out")
    shard = min((campaigns.folder / "out" / "shards").glob("*.parquet"))
    whole = shard.read_bytes()
    wrong = bytes(byte ^ 0x5A for byte in whole[4:400]) if begin else b""
    shard.write_bytes(whole[:begin] + wrong + whole[400:] if begin else whole[:100])
    with pytest.raises(InputError, match=rf"Not a shard .*Delete the file.*{shard.name}"):
        finished_rows(campaigns.plan(), campaigns.folder / "out")


@pytest.mark.parametrize(
    ("results", "error"),
    [
        ({"index": 5.0}, "cannot have the result 'index'"),
        ({"compute_s": 5.0}, "cannot have the result 'compute_s'"),
        ({"case.gain": 5.0}, "cannot have the result 'case.gain'"),
        ({"a": Estimate.normal(1.0, 0.1, ""), "a.low": 0.0}, "cannot have the result 'a.low'"),
        ({"": 5.0}, "a result has no name"),
        ({"a": "7"}, "the result 'a' is the text '7', not a number"),
        ({"a\udcff": 5.0}, "surrogates not allowed"),
        (RuntimeError("no file \udcff"), r"no file \udcff"),
    ],
)
def test_a_kind_of_another_package_cannot_damage_the_table(
    campaigns: Any, monkeypatch: pytest.MonkeyPatch, results: Any, error: str
) -> None:
    def computed(kind: Any, inputs: Any, rng: Any) -> Any:
        if isinstance(results, Exception):
            raise results
        return results

    monkeypatch.setattr(type(TRANSFER), "compute", computed)
    assert campaigns.run("out").failed == 16
    columns = campaigns.columns("out")
    assert columns["index"] == list(range(16)) and error in columns["error"][0]
    assert set(columns["case.gain"]) == {campaigns.plan().values(k)["case.gain"] for k in range(16)}
