"""The help of every command: complete, readable on 80 columns, one meaning per option name."""

from collections.abc import Iterator

import click
import pytest
from click.testing import CliRunner

from haselab.cli.common import SEED
from haselab.cli.main import cli

COLUMNS = 80
# The first word of an option's help: what the option does.
VERBS = {
    "Acknowledge", "Add", "Apply", "Assume", "Average", "Check", "Choose", "Compare", "Compile",
    "Compute", "Convert", "Correct", "Describe", "Draw", "Estimate", "Export", "Find", "Fit", "Fix",
    "Forecast", "Identify", "Ignore", "Keep", "Leave", "Limit", "Move", "Name", "Permit", "Play",
    "Print", "Read", "Record", "Refuse", "Require", "Serve", "Set", "Show", "Simulate", "Skip",
    "State", "Subtract", "Treat", "Use", "Write",
}  # fmt: skip
# The end of an option's name, and how its help states the unit.
UNITS = {
    "-s": "in s", "-hz": "in Hz", "-v": "in V", "-f": "in F", "-m": "in m", "-kg": "in kg",
    "-ohm": "in ohm", "-a": "in A", "-px": "in px", "-mm-per-px": "in mm per pixel",
    "-monitor-volt": "/V",
}  # fmt: skip
PER_SECOND = {"--samples-per-s"}


def _walk(command: click.Command, path: tuple[str, ...]) -> Iterator[tuple[str, click.Command]]:
    yield " ".join(path), command
    if isinstance(command, click.Group):
        with click.Context(command) as context:
            for name in command.list_commands(context):
                child = command.get_command(context, name)
                assert child is not None
                yield from _walk(child, (*path, name))


COMMANDS = dict(_walk(cli, ()))
OPTIONS = [
    (path, option)
    for path, command in COMMANDS.items()
    for option in command.params
    if isinstance(option, click.Option)
]


def _help(path: str) -> str:
    runner = CliRunner(env={"COLUMNS": str(COLUMNS)})
    result = runner.invoke(cli, [*path.split(), "--help"], prog_name="haselab")
    assert result.exit_code == 0
    return result.output


def _name(option: click.Option) -> str:
    return next(name for name in option.opts if name.startswith("--"))


def _text(option: click.Option) -> str:
    """The help of an option with its default, as one line."""
    record = option.get_help_record(click.Context(click.Command("any")))
    return "" if record is None else record[1]


def _meaning(option: click.Option) -> str:
    """The first sentence of the help: what the option means in every command."""
    return (option.help or "").partition(". ")[0].rstrip(".")


@pytest.mark.parametrize("path", COMMANDS)
def test_help_fits_80_columns_and_cuts_no_sentence(path: str) -> None:
    usage, _, rest = _help(path).partition("\n\n")
    for line in (*usage.splitlines(), *rest.splitlines()):
        assert len(line) <= COLUMNS, line
    assert "..." not in rest and "…" not in rest
    _, _, commands = rest.partition("\nCommands:\n")
    for entry in commands.splitlines():
        assert entry.endswith("."), entry


@pytest.mark.parametrize("path", COMMANDS)
def test_a_command_says_what_it_does_with_each_argument(path: str) -> None:
    command = COMMANDS[path]
    assert command.help
    first = command.help.splitlines()[0]
    assert first.endswith("."), first
    if path:
        assert not first.startswith(("The ", "A ", "An ", "Whether ", "What ")), first
    for argument in command.params:
        if isinstance(argument, click.Argument):
            name = argument.metavar or (argument.name or "").upper()
            for part in name.split("|"):
                assert part in command.help, f"{part} is not described"


@pytest.mark.parametrize(
    ("path", "option"), OPTIONS, ids=lambda each: str(getattr(each, "name", each))
)
def test_the_help_of_an_option_starts_with_a_verb_and_has_default_and_unit(
    path: str, option: click.Option
) -> None:
    name, text = _name(option), _text(option)
    assert text.split()[0].rstrip(".,") in VERBS, text
    takes_value = not option.is_flag and not option.count
    if takes_value and not option.required and "[required]" not in text:
        assert "default" in text.lower(), f"{path} {name}: {text}"
    ends = [end for end in UNITS if name.endswith(end)]
    if takes_value and ends and name not in PER_SECOND:
        assert UNITS[max(ends, key=len)] in text, f"{path} {name}: {text}"


@pytest.mark.parametrize(
    ("path", "option"), OPTIONS, ids=lambda each: str(getattr(each, "name", each))
)
def test_the_help_of_an_option_states_a_range_that_helps(path: str, option: click.Option) -> None:
    text = _text(option)
    assert "9223372036854775807" not in text, f"{path} {_name(option)}: {text}"
    assert "[default: (" not in text, f"{path} {_name(option)}: {text}"


def test_a_seed_outside_its_range_is_refused_with_the_limit() -> None:
    for value, limit in (("-1", "x>=0"), (str(2**63), "Use at most 9223372036854775807")):
        with pytest.raises(click.BadParameter, match=limit):
            SEED.convert(value, None, None)
    assert SEED.convert(str(2**63 - 1), None, None) == 2**63 - 1


def test_an_option_means_the_same_in_every_command() -> None:
    known: dict[str, tuple[str, str]] = {}
    for path, option in OPTIONS:
        name, meaning = _name(option), _meaning(option)
        first, same = known.setdefault(name, (path, meaning))
        assert meaning == same, f"{name}: '{same}' in {first}, '{meaning}' in {path}"


@pytest.mark.parametrize(
    ("path", "option"),
    [each for each in OPTIONS if isinstance(each[1].type, click.types.FloatParamType)],
    ids=lambda each: str(getattr(each, "name", each)),
)
def test_every_number_refuses_nan(path: str, option: click.Option) -> None:
    with pytest.raises(click.BadParameter, match="nan"):
        option.type.convert("nan", option, None)
