"""Where a command shows its progress."""

import sys

import pytest

from haselab.base import SilentProgress
from haselab.cli.common import progress_bar


@pytest.mark.parametrize(
    ("terminal", "kernel", "silent"),
    [(True, False, False), (True, True, True), (False, False, True)],
)
def test_a_terminal_shows_a_bar_and_a_notebook_does_not(
    monkeypatch: pytest.MonkeyPatch, terminal: bool, kernel: bool, silent: bool
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    monkeypatch.delenv("JPY_PARENT_PID", raising=False)
    if kernel:
        monkeypatch.setenv("JPY_PARENT_PID", "1")
    assert isinstance(progress_bar(), SilentProgress) is silent
