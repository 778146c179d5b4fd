"""Command line: find the command, and turn errors into one line and an exit code."""

from __future__ import annotations

import atexit
import contextlib
import errno
import os
import select
import sys
import threading
from collections.abc import Callable
from typing import Any, TextIO

import click

from haselab.base.errors import HaselabError, described, named_files, text_of
from haselab.base.exits import SignalExit, exit_code_text
from haselab.base.foreign_code import foreign_failure, packages_of_threads
from haselab.cli.bench.revoke_first import revoke_first
from haselab.cli.invocation import Invocation
from haselab.cli.lazy_group import LazyGroup

__all__ = ["cli", "end_despite_threads", "main"]

# name: (module with an attribute `command`, one line of help). Modules load when they are used.
_COMMANDS = {
    "reproduce": ("haselab.cli.study.reproduce", "Run the reference study on the simulated bench."),
    "run": ("haselab.cli.study.run", "Run a study on a bench, real or simulated."),
    "analyse": ("haselab.cli.study.analyse", "Repeat fits, design and report from a recording."),
    "sense": ("haselab.cli.data.sense", "Compute capacitance from both monitors."),
    "init": ("haselab.cli.model.init", "Write an actuator file to start from."),
    "calibrate": ("haselab.cli.bench.calibrate", "Calibrate the monitors of a simulated bench."),
    "plan": ("haselab.cli.bench.plan", "Choose the carrier and check a study's feasibility."),
    "plan-experiment": (
        "haselab.cli.identify.plan_experiment",
        "Design the next experiment.",
    ),
    "track": ("haselab.cli.data.track", "Measure displacements and strain in a video."),
    "identify": ("haselab.cli.identify.group", "Identify models, with intervals, from records."),
    "design": ("haselab.cli.model.design", "Design controller gains and report their margins."),
    "compare": ("haselab.cli.model.compare", "Predict records that were not used for the fit."),
    "margins": ("haselab.cli.model.margins", "Compute the stability margins of given gains."),
    "scoreboard": (
        "haselab.cli.study.scoreboard",
        "Compare controllers with the physical limits.",
    ),
    "campaign": (
        "haselab.cli.campaign.command",
        "Compute many cases over parameters and seeds.",
    ),
    "export": ("haselab.cli.model.export", "Convert a model for another tool."),
    "session": ("haselab.cli.data.session", "Export a recording for another tool, or import one."),
    "example": ("haselab.cli.data.example", "Write example data and the commands that use it."),
    "recover": ("haselab.cli.data.recover", "Repair a recording whose program was killed."),
    "report": ("haselab.cli.study.report", "Write the report of a run or of an actuator file."),
    "twin": ("haselab.cli.bench.twin", "Describe or serve a simulated bench."),
    "panel": ("haselab.cli.bench.panel", "Show and drive a bench in a browser."),
    "rig": ("haselab.cli.bench.rig", "Check a bench in stages, or take it to 0 V."),
    "firmware": ("haselab.cli.model.firmware", "Build, simulate or flash the microcontroller."),
    "doctor": ("haselab.cli.doctor.command", "Report what is installed and which devices answer."),
}


_BAD_PATHS = (
    FileNotFoundError,
    FileExistsError,
    IsADirectoryError,
    NotADirectoryError,
)
# What click raises for a group without a command, since version 8.2; its message is the help.
_NO_COMMAND = getattr(click.exceptions, "NoArgsIsHelpError", ())
_INTERRUPTED = 130
_CLOSED_PIPE = 141  # 128 + SIGPIPE, the exit status of a program that this signal ended
_MOST_CHARACTERS = 2000  # of a message
_BAD_NAMES = (errno.ENAMETOOLONG, errno.ELOOP)


class _BrokenPipe(Exception):  # noqa: N818 -- never seen outside of this file
    """Wraps a `BrokenPipeError`: the reader of a pipe or a connection is gone."""

    def __init__(self, error: BrokenPipeError) -> None:
        self.error = error


class _Root(LazyGroup):
    """All commands, with their lines of help, so that --help imports none."""

    def make_context(self, *args: Any, **kwargs: Any) -> click.Context:
        """Parse the options; wrap a broken pipe, for which click would exit with 1."""
        try:
            return super().make_context(*args, **kwargs)
        except BrokenPipeError as error:
            raise _BrokenPipe(error) from error

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; wrap a broken pipe in the same way."""
        try:
            return super().invoke(ctx)
        except BrokenPipeError as error:
            raise _BrokenPipe(error) from error

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, text) for name, (_, text) in _COMMANDS.items()])


@click.group(
    cls=_Root,
    places={name: f"{module}:command" for name, (module, _) in _COMMANDS.items()},
    context_settings={"help_option_names": ["-h", "--help"]},
)
@click.version_option(package_name="haselab", prog_name="haselab")
def cli() -> None:
    """Measure, model and control soft electrostatic actuators (HASEL, DEA).

    A simulated bench, the twin, is built in, so every command can be tried without hardware. In all
    help texts, "the paper" and its equations are those of Schunk et al., System Identification and
    Closed-Loop Control of a HASEL Actuator, IROS 2018.
    """


def _fail(message: str, exit_code: int) -> int:
    line = named_files(" ".join(message.split()))
    if len(line) > _MOST_CHARACTERS:  # it quotes a damaged file; both ends say what to do
        line = f"{line[: _MOST_CHARACTERS // 2]} … {line[-_MOST_CHARACTERS // 2 :]}"
    try:
        click.echo(f"haselab: {line}", err=True)
    except OSError:  # stderr is closed too
        _silence(sys.stderr)
    return exit_code


def _notes(error: BaseException) -> list[str]:
    """Notes about the output and the recording that were added to the interrupt."""
    cause = error.__cause__  # click turns KeyboardInterrupt into Abort
    return [*getattr(cause, "__notes__", []), *getattr(error, "__notes__", [])]


def _silence(stream: TextIO) -> None:
    """Discard what is still written to a stream."""
    with contextlib.suppress(OSError, ValueError):  # no descriptor: nothing to silence
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def _is_unread(stream: TextIO) -> bool:
    """Whether this stream is a pipe whose reader is gone."""
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
    """Exit code: `head` may stop reading early, but a lost connection is a fault."""
    unread = [stream for stream in (sys.stdout, sys.stderr) if _is_unread(stream)]
    for stream in unread:
        _silence(stream)
    if unread:
        return _CLOSED_PIPE
    return _fail(f"A connection was lost ({error.strerror}). Check the instrument.", 4)


def end_despite_threads(stop: SystemExit) -> None:
    """End the program if threads of other packages would keep it from ending, or after Ctrl-C.

    A compiled library that was interrupted may abort the program when its destructors run: without
    this, about 1 of 80 campaigns ended by SIGABRT after Ctrl-C.

    Args:
        stop: what ends the command.
    """
    code = stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 1
    if packages := packages_of_threads():
        _fail(
            f"warning: A thread of the package {', '.join(packages)} still runs. The command ends "
            "without waiting for it. Make it a daemon thread, or end it.",
            code,
        )
    elif code == _INTERRUPTED:
        threading._shutdown()  # type: ignore[attr-defined]  # ends and joins those of pools, too
    else:
        return
    with contextlib.suppress(Exception):
        atexit._run_exitfuncs()  # one of them takes an armed bench to 0 V
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def _exit_if_foreign(error: Exception) -> None:
    """Report an error of a package that extends haselab as that package's."""
    found = foreign_failure(error)
    if found is None:
        return
    what = f"{found.place} of the package {found.package!r} failed: {described(error)}"
    advice = "Repair it; run again with --debug for the traceback"
    sys.exit(_fail(f"{what}. {advice}.", 4 if "haselab.instruments" in found.groups else 2))


def main(
    arguments: list[str] | None = None, *, on_command: Callable[[], None] = lambda: None
) -> None:
    """Run one command and exit: 0, 2 bad input, 3 no result, 4 device or safety, 130 Ctrl-C.

    A fault of the program itself exits with 1; a closed output pipe with 141, as other programs do.

    Args:
        arguments: of the command line; None: those of this process.
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
    except _NO_COMMAND as error:
        click.echo(error.format_message(), err=True)
        sys.exit(2)
    except click.UsageError as error:
        usage = error.ctx.command_path if error.ctx else "haselab"
        sys.exit(_fail(f"{error.format_message()} See '{usage} --help'.", 2))
    except click.ClickException as error:
        sys.exit(_fail(error.format_message(), 2))
    except (KeyboardInterrupt, click.Abort) as stop:
        sys.exit(_fail(" ".join(["Interrupted.", *_notes(stop)]), _INTERRUPTED))
    except SignalExit:
        raise
    except SystemExit as stop:  # of another package, where no one expects it
        if debug:
            raise RuntimeError("code of another package called sys.exit()") from stop
        what = f"Code of another package called sys.exit({exit_code_text(stop)})."
        sys.exit(_fail(f"{what} Run again with --debug to see which; uninstall or repair it.", 2))
    except HaselabError as error:
        if debug:
            raise
        sys.exit(_fail(text_of(error), error.exit_code))
    except OSError as error:
        if debug:
            raise
        _exit_if_foreign(error)
        if isinstance(error, _BAD_PATHS) or error.errno in _BAD_NAMES:
            sys.exit(_fail(f"{error.strerror}. Name another path. {error.filename}", 2))
        what = f"File error: {error.strerror or error}. Check the disk and your permissions."
        sys.exit(_fail(f"{what} {error.filename or ''}", 4))
    except Exception as error:
        if debug:
            raise
        _exit_if_foreign(error)
        what = f"A bug in haselab ({described(error)})."
        sys.exit(_fail(f"{what} Run again with --debug and report the traceback.", 1))
    sys.exit(0)
