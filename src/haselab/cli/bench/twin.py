"""`haselab twin`: describe a simulated bench, or serve it over the instruments' protocols."""

from __future__ import annotations

import contextlib
import json
import signal
import threading
from pathlib import Path
from types import FrameType

import click

from haselab.cli.bench.twin_new import new
from haselab.cli.common import Real, answer_options
from haselab.cli.options import shared_option
from haselab.cli.output import OutputRule
from haselab.cli.study.run import rig_file
from haselab.rig.twin.serve.faults import FAULTS
from haselab.rig.twin.serve.local_user import can_tell_users
from haselab.rig.twin.serve.ni.devices import DEVICES
from haselab.rig.twin.serve.ni.server import PRODUCT
from haselab.rig.twin.serve.server import Ports, ServedTwin
from haselab.runtime.scheduling import with_priority
from haselab.store.folder import write_new

__all__ = ["command", "serve"]

_CANNOT_TELL = (
    "this system does not report which user owns a connection, so every user of this computer can "
    "connect and set outputs of the twin."
)
_PORT = "Set the TCP port of the {}. 0 uses a free one."
_TICK_S = 0.2  # Python handles signals between waits


@click.group("twin")
def command() -> None:
    """Describe a simulated bench, or serve it to the drivers."""


command.add_command(new)


@command.command("serve")
@click.argument("rig", type=click.Path(path_type=Path))
@click.option(
    "--pace",
    type=Real(0.0, 1000.0),
    default=1.0,
    show_default=True,
    help="Set the seconds of simulated time per second of real time. With 0, time passes only when "
    "a client requests data.",
)
@click.option(
    "--daq-port",
    type=click.IntRange(0, 65535),
    default=0,
    show_default=True,
    help=_PORT.format("data acquisition"),
)
@click.option(
    "--generator-port",
    type=click.IntRange(0, 65535),
    default=0,
    show_default=True,
    help=_PORT.format("function generator"),
)
@click.option(
    "--client-port", type=click.IntRange(0, 65535), default=0, show_default=True,
    help=_PORT.format("client interface"),
)  # fmt: skip
@click.option(
    "--ahead-blocks",
    type=click.IntRange(0, 10),
    default=2,
    show_default=True,
    help="Set the number of queued output blocks (daq.ahead_blocks) in the rig file.",
)
@shared_option(
    "--board", type=click.Choice(list(DEVICES)), default=PRODUCT, show_default=True,
    metavar="BOARD",
    detail=f"The acquisition behaves like this NI device: {', '.join(DEVICES)}.",
)  # fmt: skip
@click.option(
    "--fault",
    type=click.Choice(list(FAULTS)),
    metavar="FAULT",
    help="Simulate one fault of the bench, to practise with 'haselab rig check': "
    f"{', '.join(FAULTS)}. Default: none.",
)
@click.option(
    "--allow-other-users",
    is_flag=True,
    help="Serve every user of this computer instead of only the user who starts the server.",
)
@answer_options(OutputRule("late"), "It is a rig file for this bench. Default: print it.")
def serve(
    rig: Path,
    pace: float,
    daq_port: int,
    generator_port: int,
    client_port: int,
    ahead_blocks: int,
    board: str,
    fault: str | None,
    allow_other_users: bool,
    as_json: bool,
    out: Path | None,
) -> None:
    """Serve the twin of RIG as instruments on this computer.

    RIG is a rig file of kind "twin". The servers listen on 127.0.0.1 only. The command prints a
    rig file that connects to the served instruments, or writes it to --out, once they all answer.
    It ends on SIGINT (Ctrl-C) or SIGTERM.
    """
    config, seed = rig_file(rig)
    ended = threading.Event()

    def end(number: int, frame: FrameType | None) -> None:
        ended.set()

    if not (allow_other_users or can_tell_users()):
        click.echo(f"haselab: {_CANNOT_TELL}", err=True)
    first = with_priority() if pace > 0.0 else contextlib.nullcontext()
    before = {number: signal.signal(number, end) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        ports = Ports(daq_port, generator_port, client_port)
        with (
            first,
            ServedTwin(
                config,
                seed,
                pace,
                ports,
                allow_others=allow_other_users,
                board=board,
                faults=FAULTS[fault] if fault else None,
            ) as served,
        ):
            text = served.rig_file(ahead_blocks=ahead_blocks, exposure_line=fault is not None)
            if out is not None:
                write_new(out, text)
            if as_json:
                click.echo(json.dumps(served.addresses))
            elif out is None:
                click.echo(text)
            else:
                click.echo(f"serving; {out}", err=True)
            while not ended.wait(_TICK_S):
                pass
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
