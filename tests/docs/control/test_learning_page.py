"""What the page on learning shows is run here as it stands."""

from pathlib import Path

import pytest

from tests.docs.page import Page

PAGE = Page("control/learning.md")


def test_the_examples_of_the_page_run(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (devices,) = PAGE.toml
    (tmp_path / "training-devices.toml").write_text(devices, encoding="utf-8")
    names: dict[str, object] = {}
    for code in PAGE.python:
        PAGE.execute(code, names)
    first, second, *_ = capsys.readouterr().out.splitlines()
    assert first == "(6,) ['drive_v', 'reference', 'strain']"
    assert second == "(64, 6) (64,)"
