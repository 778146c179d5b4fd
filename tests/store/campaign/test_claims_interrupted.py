"""Ctrl-C between any two steps of a claim."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from haselab.store.campaign.claims import Claims


def claims_of(folder: Path) -> list[str]:
    return sorted(path.name for path in (folder / "claims").iterdir())


@pytest.mark.parametrize("step", ["open", "unlink"])
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
        monkeypatch.setattr(Path, step, interrupted)
        claims.take(7) if step == "open" else claims.release(7)
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
