"""The entry point: exit codes, one-line errors, help that answers at once."""

import json
import os
import subprocess
import sys

import click
import pytest

from haselab import __version__
from haselab.base import DeviceError, InputError, LimitError, ResultError, SafetyError
from haselab.base.exits import SignalExit
from haselab.cli import main as entry


def run(arguments: list[str]) -> int:
    with pytest.raises(SystemExit) as stop:
        entry.main(arguments)
    return int(stop.value.code)


def command_that_raises(error: BaseException, monkeypatch: pytest.MonkeyPatch) -> None:
    @click.command("design")
    @click.option("--debug", is_flag=True)
    def failing(debug: bool) -> None:
        raise error

    monkeypatch.setattr(entry._Root, "get_command", lambda self, context, name: failing)


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (InputError("no"), 2),
        (LimitError("no"), 2),
        (ResultError("no"), 3),
        (DeviceError("no"), 4),
        (SafetyError("no"), 4),
        (PermissionError(13, "Permission denied", "x.csv"), 4),
        (KeyboardInterrupt(), 130),
    ],
)
def test_each_kind_of_error_has_its_exit_code_and_one_line(
    error: BaseException,
    code: int,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    command_that_raises(error, monkeypatch)
    assert run(["design"]) == code
    captured = capsys.readouterr()
    assert captured.out == ""
    message = captured.err.lstrip("\n")  # click ends the line of the terminal's ^C first
    assert message.startswith("haselab: ")
    assert message.count("\n") == 1


def test_a_message_that_quotes_a_damaged_file_keeps_both_of_its_ends(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    error = InputError(f"Column u has '{'1' * 300_000}'. Remove line 7: a.csv")
    command_that_raises(error, monkeypatch)
    assert run(["design"]) == 2
    message = capsys.readouterr().err
    assert len(message) < 2100
    assert message.startswith("haselab: Column u has '111")
    assert message.endswith("111'. Remove line 7: a.csv\n")


def test_code_of_another_package_cannot_end_a_command_as_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command_that_raises(SystemExit(0), monkeypatch)
    assert run(["design"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "Code of another package called sys.exit(0). Run again with --debug" in error
    with pytest.raises(RuntimeError, match=r"another package called sys\.exit\(\)"):
        entry.main(["design", "--debug"])


def test_a_signal_keeps_its_exit_code(monkeypatch: pytest.MonkeyPatch) -> None:
    command_that_raises(SignalExit(143), monkeypatch)
    assert run(["design"]) == 143


def test_a_message_of_several_lines_is_folded_into_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command_that_raises(InputError("first\n   second"), monkeypatch)
    run(["design"])
    assert capsys.readouterr().err == "haselab: first second\n"


def test_debug_lets_the_error_through(monkeypatch: pytest.MonkeyPatch) -> None:
    command_that_raises(InputError("what went wrong"), monkeypatch)
    with pytest.raises(InputError, match="what went wrong"):
        entry.main(["design", "--debug"])


@pytest.mark.parametrize("arguments", [["no-such-command"], ["sense"], ["sense", "--no-such"]])
def test_bad_usage_exits_with_2_and_points_to_the_help(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert "--help" in captured.err


@pytest.mark.parametrize("name", list(entry._COMMANDS))
def test_each_command_explains_itself(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run([name, "--help"]) == 0
    assert capsys.readouterr().out.startswith(f"Usage: haselab {name}")


@pytest.mark.parametrize("arguments", [[], ["identify"], ["rig"]])
def test_a_group_without_a_command_prints_its_help_line_by_line(
    arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    code = run(arguments)
    printed = "".join(capsys.readouterr()).splitlines()
    assert code in (0, 2)  # click before 8.2: 0
    assert printed[0].startswith("Usage: haselab") and "Commands:" in printed


def test_the_version_is_that_of_the_package(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["--version"]) == 0
    assert __version__ in capsys.readouterr().out


def test_help_loads_no_numerical_package() -> None:
    code = (
        "import sys\n"
        "from haselab.cli.main import main\n"
        "try:\n    main(['--help'])\n"
        "except SystemExit as stop:\n    assert stop.code == 0\n"
        "heavy = {'scipy', 'matplotlib', 'h5py', 'pydantic', 'av'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_doctor_finds_the_extensions_and_the_twin(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["doctor", "--json"]) == 0
    findings = {item["name"]: item for item in json.loads(capsys.readouterr().out)["findings"]}
    assert findings["haselab"]["detail"] == __version__
    for name in ("_core", "_twin", "_camera", "_track", "twin", "numpy"):
        assert findings[name]["found"], findings[name]
    for item in findings.values():
        assert item["found"] or item["advice"], f"{item['name']} is missing and no advice is given"


@pytest.mark.skipif(sys.platform == "win32", reason="pipes break in another way on Windows")
@pytest.mark.parametrize("arguments", [["--help"], ["sense", "--help"], ["doctor", "--json"]])
@pytest.mark.parametrize("both", [False, True])
def test_a_closed_output_pipe_ends_the_command_silently(arguments: list[str], both: bool) -> None:
    """`haselab ... | head -0`: 141, as a shell tells it of every program that SIGPIPE ends."""
    unread, end = os.pipe()
    os.close(unread)
    program = subprocess.Popen(
        [sys.executable, "-m", "haselab.cli", *arguments], stdout=end,
        stderr=end if both else subprocess.PIPE, text=True,
    )  # fmt: skip
    os.close(end)
    _, said = program.communicate(timeout=300)
    assert (program.returncode, said or "") == (141, "")


def test_a_lost_connection_is_no_reader_that_has_seen_enough(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @click.command("design")
    def failing() -> None:
        raise BrokenPipeError(32, "Broken pipe")

    monkeypatch.setattr(entry._Root, "get_command", lambda self, context, name: failing)
    assert run(["design"]) == 4
    assert "A connection was lost (Broken pipe)" in capsys.readouterr().err


def test_python_runs_the_package_as_the_console_script():
    line = [sys.executable, "-m", "haselab", "no-such-command"]
    done = subprocess.run(line, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == "haselab: No such command 'no-such-command'. See 'haselab --help'.\n"
