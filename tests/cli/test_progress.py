"""Where a command shows its progress."""

import sys
import time

import pytest

from haselab.base import SilentProgress
from haselab.cli import common
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


def _until(capfd: pytest.CaptureFixture[str], text: str, read: str = "") -> str:
    """All of stderr, once it has a text; a busy computer may take long."""
    for _ in range(3000):
        read += capfd.readouterr().err
        if text in read:
            return read
        time.sleep(0.01)
    raise AssertionError(read)


@pytest.mark.parametrize("kernel", [False, True])
def test_a_long_step_prints_lines_where_no_bar_is_shown(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], kernel: bool
) -> None:
    """One at the first opportunity, then one for a new stage, and none of the same stage again."""
    monkeypatch.setattr(sys.stderr, "isatty", lambda: kernel, raising=False)
    monkeypatch.setenv("JPY_PARENT_PID", "1")
    monkeypatch.setattr(common, "_SHORTEST_S", 0.05)
    monkeypatch.setattr(common, "_LINES_IN_A_MINUTE", 1000)
    with waiting("search for the model") as on_stage:
        err = _until(capfd, "so far)")
        on_stage("last comparison")
        err = _until(capfd, "last comparison", err)
        time.sleep(0.2)  # nothing more is said of the same stage
    err += capfd.readouterr().err
    lines = err.splitlines()
    assert [line.partition(" (")[0] for line in lines] == [
        "haselab: search for the model",
        "haselab: search for the model: last comparison",
    ]
    assert all(line.endswith("s so far)") for line in lines)


def test_a_long_stage_prints_a_line_again(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    monkeypatch.setattr(common, "_SHORTEST_S", 0.02)
    monkeypatch.setattr(common, "_LINES_IN_A_MINUTE", 2)
    with waiting("search"):
        _until(capfd, "haselab: search (")
        _until(capfd, "haselab: search (")


def test_the_lines_end_with_the_step_even_if_it_fails(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: False, raising=False)
    monkeypatch.setattr(common, "_SHORTEST_S", 0.05)
    with pytest.raises(ValueError, match="no model"), waiting("search"):
        raise ValueError("no model")
    time.sleep(0.2)
    assert capfd.readouterr().err == ""
