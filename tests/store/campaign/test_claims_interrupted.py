"""Claims of programs that are interrupted or killed between any two steps."""

from __future__ import annotations

import contextlib
import errno
import os
import threading
from pathlib import Path
from typing import Any

import pytest

from haselab.store.campaign.claims import Claims


def claims_of(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "claims").iterdir())


def without_links(path: Path, target: Path) -> None:
    raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))


@pytest.mark.parametrize("step", ["hardlink_to", "open", "unlink"])
@pytest.mark.parametrize("after", [False, True])
def test_an_interrupt_leaves_no_claim(
    step: str, after: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = getattr(Path, step)

    def interrupted(path: Path, *args: Any, **settings: Any) -> Any:
        if path.parent.name != "claims" or (step == "open" and args[:1] != ("x",)):
            return real(path, *args, **settings)
        monkeypatch.undo()
        if after:
            answer = real(path, *args, **settings)
            if answer is not None:
                answer.close()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt, match=r"^$"), Claims(tmp_path) as claims:
        if step == "unlink":
            assert claims.take(7)
        if step == "open":
            monkeypatch.setattr(Path, "hardlink_to", without_links)
        monkeypatch.setattr(Path, step, interrupted)
        claims.release(7) if step == "unlink" else claims.take(7)
    assert claims_of(tmp_path) == []


def test_a_claim_never_exists_without_the_name_of_its_program(tmp_path: Path) -> None:
    """A program that is killed while it claims a block must not leave one that seems to be new."""
    names: set[str] = set()
    ended = threading.Event()

    def look() -> None:
        while not ended.is_set():
            for claim in (tmp_path / "claims").iterdir():
                with contextlib.suppress(FileNotFoundError):
                    names.add(claim.read_text())

    with Claims(tmp_path) as claims:
        watch = threading.Thread(target=look)
        watch.start()
        try:
            for block in range(3000):
                assert claims.take(block % 50)
                claims.release(block % 50)
        finally:
            ended.set()
            watch.join()
    assert names == {claims.writer}


def test_a_file_system_without_links_has_claims(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Path, "hardlink_to", without_links)
    with Claims(tmp_path) as first, Claims(tmp_path) as second:
        assert first.take(7) and not second.take(7)
        assert (tmp_path / "claims" / "7").read_text() == first.writer
    assert claims_of(tmp_path) == []


def test_an_interrupt_leaves_another_program_s_claim(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Claims(tmp_path) as first:
        assert first.take(7)
        with pytest.raises(KeyboardInterrupt, match=r"^$"), Claims(tmp_path) as second:

            def interrupted(self: Claims, claim: Path) -> bool:
                raise KeyboardInterrupt

            monkeypatch.setattr(Claims, "_is_alive", interrupted)
            second.take(7)
        assert claims_of(tmp_path) == ["7"]


@pytest.mark.parametrize("damaged", [bytes(30), b"\xff\xfe\x80abc", b"../shards", b"two\nlines"])
def test_a_damaged_claim_is_that_of_no_program(damaged: bytes, tmp_path: Path) -> None:
    """After a power failure, some file systems leave files of NUL bytes."""
    with Claims(tmp_path):
        (tmp_path / "claims" / "7").write_bytes(damaged)
        (tmp_path / "claims" / "8").write_bytes(damaged)
        with Claims(tmp_path) as second:
            assert claims_of(tmp_path) == []
            (tmp_path / "claims" / "8").write_bytes(damaged)
            assert second.take(8)
    assert claims_of(tmp_path) == []
