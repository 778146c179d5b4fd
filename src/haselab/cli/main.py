"""Entry point: finds the command, turns errors into one line and an exit code."""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
import select
import sys
from collections.abc import Callable
from typing import Any, TextIO

import click

from haselab import __version__
from haselab.base.errors import HaselabError
from haselab.cli.bench.revoke_first import revoke_first
from haselab.cli.invocation import Invocation

__all__ = ["cli", "main"]

# name: (module with an attribute `command`, one line of help). Modules load when they are used.
_COMMANDS = {
    "reproduce": ("haselab.cli.study.reproduce", "The whole reference study on the twin."),
    "run": ("haselab.cli.study.run", "Any study on any rig."),
    "analyse": ("haselab.cli.study.analyse", "Fits, designs and report again from recorded data."),
    "sense": ("haselab.cli.data.sense", "Monitors to capacitance, block by block."),
    "init": ("haselab.cli.model.init", "Write an actuator file to start from."),
    "calibrate": ("haselab.cli.bench.calibrate", "Monitors against reference capacitors."),
    "plan": ("haselab.cli.bench.plan", "Choices before an experiment: the carrier."),
    "plan-experiment": (
        "haselab.cli.identify.plan_experiment",
        "The next drive signal for a model.",
    ),
    "track": ("haselab.cli.data.track", "Video to displacements and strain."),
    "identify": ("haselab.cli.identify.group", "Models with uncertainty from records."),
    "design": ("haselab.cli.model.design", "Controller gains and margins from a model."),
    "compare": ("haselab.cli.model.compare", "Predict a record that the model has not seen."),
    "margins": ("haselab.cli.model.margins", "Stability margins of given gains on a model."),
    "export": ("haselab.cli.model.export", "A model in the form of another tool."),
    "session": ("haselab.cli.data.session", "A recording in the form of other tools, and back."),
    "example": ("haselab.cli.data.example", "Small data sets and the commands that use them."),
    "recover": ("haselab.cli.data.recover", "Repair a recording whose program was killed."),
    "report": ("haselab.cli.study.report", "The page of a run, or of an actuator file."),
    "twin": ("haselab.cli.bench.twin", "The simulated bench: its parameters and its instruments."),
    "rig": ("haselab.cli.bench.rig", "Check a bench in stages, or make it safe."),
    "firmware": ("haselab.cli.model.firmware", "The controller on a microcontroller."),
    "doctor": ("haselab.cli.doctor.command", "What is installed and what answers."),
}


_BAD_PATHS = (
    FileNotFoundError,
    FileExistsError,
    IsADirectoryError,
    NotADirectoryError,
)
_CLOSED_PIPE = 141  # 128 + SIGPIPE, the exit status of a program that the signal ended
_BAD_NAMES = (errno.ENAMETOOLONG, errno.ELOOP)


class _BrokenPipe(Exception):  # noqa: N818 -- never seen outside of this file
    """Around the error that says that nobody reads a pipe or a connection any more."""

    def __init__(self, error: BrokenPipeError) -> None:
        self.error = error


class _LazyGroup(click.Group):
    """A group whose commands are imported on demand, so that --help answers at once."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in _COMMANDS:
            return None
        command: click.Command = importlib.import_module(_COMMANDS[cmd_name][0]).command
        return command

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        """Read the options; a pipe that broke is handed on, for click would exit with 1."""
        try:
            return super().make_context(*args, **kwargs)
        except BrokenPipeError as error:
            raise _BrokenPipe(error) from error

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command, in the same way."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError as error:
            raise _BrokenPipe(error) from error

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Import the command, and say so."""
        found = super().resolve_command(ctx, args)
        if isinstance(ctx.obj, Invocation):
            ctx.obj.on_command()
        return found

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in _COMMANDS.items()])


@click.group(cls=_LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="haselab")
def cli() -> None:
    """haselab: the open bench for soft electrostatic actuators."""


def _fail(message: str, exit_code: int) -> int:
    try:
        click.echo(f"haselab: {' '.join(message.split())}", err=True)
    except OSError:  # nobody reads this either
        _silence(sys.stderr)
    return exit_code


def _notes(error: BaseException) -> list[str]:
    """What is known of the output and the recording, noted where the interrupt passed."""
    cause = error.__cause__  # click turns KeyboardInterrupt into Abort
    return [*getattr(cause, "__notes__", []), *getattr(error, "__notes__", [])]


def _silence(stream: TextIO) -> None:
    """Let what is still written to a stream go nowhere."""
    with contextlib.suppress(OSError, ValueError):  # no descriptor: nothing to be silenced
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _is_unread(stream: TextIO) -> bool:
    """Whether this stream is a pipe that nobody reads."""
    try:
        stream.flush()
        poll = select.poll()
        poll.register(stream.fileno(), 0)
        return any(what & select.POLLERR for _, what in poll.poll(0))
    except BrokenPipeError:
        return True
    except (AttributeError, OSError, ValueError):  # a system without poll, or no descriptor
        return False


def _broken_pipe(error: BrokenPipeError) -> int:
    """A reader such as `head` that has seen enough is no fault; a lost connection is one."""
    unread = [stream for stream in (sys.stdout, sys.stderr) if _is_unread(stream)]
    for stream in unread:
        _silence(stream)
    if unread:
        return _CLOSED_PIPE
    return _fail(f"A connection was lost ({error.strerror}); check the instrument.", 4)


def main(
    arguments: list[str] | None = None, *, on_command: Callable[[], None] = lambda: None
) -> None:
    """Run one command and exit: 0, 2 bad input, 3 no result, 4 device or safety, 130 Ctrl-C.

    A fault of the program itself is 1. Where nobody reads the output any more it is 141, as with
    other programs in a pipe.

    Args:
        arguments: of the command line; None: those of the process.
        on_command: called when the command's modules are imported, before it does anything.
    """
    arguments = sys.argv[1:] if arguments is None else arguments
    debug = "--debug" in arguments
    revoke_first(arguments)  # before the command's module, which imports drivers
    try:
        call = Invocation(tuple(arguments), on_command)
        cli.main(args=arguments, prog_name="haselab", standalone_mode=False, obj=call)
    except _BrokenPipe as broken:
        if debug:
            raise
        sys.exit(_broken_pipe(broken.error))
    except click.exceptions.Exit as stop:
        sys.exit(stop.exit_code)
    except click.UsageError as error:
        usage = error.ctx.command_path if error.ctx else "haselab"
        sys.exit(_fail(f"{error.format_message()} See '{usage} --help'.", 2))
    except click.ClickException as error:
        sys.exit(_fail(error.format_message(), 2))
    except (KeyboardInterrupt, click.Abort) as stop:
        sys.exit(_fail(" ".join(["Interrupted.", *_notes(stop)]), 130))
    except HaselabError as error:
        if debug:
            raise
        sys.exit(_fail(str(error), error.exit_code))
    except OSError as error:
        if debug:
            raise
        if isinstance(error, _BAD_PATHS) or error.errno in _BAD_NAMES:
            sys.exit(_fail(f"{error.strerror}; name another path. {error.filename}", 2))
        what = f"The system refuses ({error.strerror or error}); check the disk and its rights."
        sys.exit(_fail(f"{what} {error.filename or ''}", 4))
    except Exception as error:
        if debug:
            raise
        what = f"A fault of haselab itself ({type(error).__name__}: {error})."
        sys.exit(_fail(f"{what} Repeat it with --debug and report what that shows.", 1))
    sys.exit(0)
