"""Where a command shows its progress."""

import sys

import pytest

from haselab.base import SilentProgress
from haselab.cli.common import progress_bar, waiting


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


@pytest.mark.parametrize("terminal", [True, False])
def test_a_step_of_unknown_length_is_shown_on_a_terminal_alone(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], terminal: bool
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal, raising=False)
    monkeypatch.delenv("JPY_PARENT_PID", raising=False)
    with waiting("fit 300,000 outputs"):
        pass
    out, err = capfd.readouterr()
    assert out == ""
    assert ("fit 300,000 outputs" in err) is terminal
    if not terminal:
        assert err == ""
