"""`haselab panel`: the bench in a browser."""

from __future__ import annotations

import contextlib
import ipaddress
import os
import subprocess
import tempfile
import threading
import time
import webbrowser
from pathlib import Path

import click

from haselab.base import DeviceError, InputError, shown
from haselab.cli.common import Real
from haselab.cli.options import shared_option
from haselab.cli.run_path import ACTUATOR_FILE
from haselab.panel.files import PanelFiles
from haselab.panel.page_server import serve
from haselab.panel.processes import Panel, running_panel, stop_answers
from haselab.store.folder import write_new, write_text
from haselab.study.definition import reference_actuator

__all__ = ["command"]

_ACTUATOR = "twin-actuator.toml"  # in the folder of --runs
_STOP_S, _STOP_TRIALS = 4.0, 3  # if STOP answers none of these trials, the panel ends at 0 V


def _check_lan(context: click.Context, option: click.Parameter, value: str) -> str:
    """Check that --lan is one IPv4 address other than 127.0.0.1, which is always served."""
    if not value:
        return value
    try:
        ip = ipaddress.IPv4Address(value)
    except ValueError:
        ip = None
    if ip is None or ip.is_unspecified or ip.is_multicast or value == "127.0.0.1":
        raise InputError(
            f"--lan is {shown(value)}. Use one IPv4 address of this computer in its network, for "
            "example 192.168.1.20."
        )
    if not ip.is_private:
        click.echo(
            f"haselab: warning: --lan is {value}, an address of the Internet. A firewall must keep "
            "other networks from the panel, or use a private address.",
            err=True,
        )
    return value


@click.command("panel")
@shared_option(
    "--rig", type=click.Path(path_type=Path), detail="Default: the twin of the reference study."
)
@shared_option(
    "--actuator", type=ACTUATOR_FILE,
    detail="With both maps and a controller, the panel can close the loop. With a model, its page "
    "Design changes the gains. Default: none; without --rig, the file twin-actuator.toml in DIR of "
    "--runs, which is written there if it is missing.",
)  # fmt: skip
@click.option(
    "--runs", type=click.Path(path_type=Path, file_okay=False), default=Path("out"),
    show_default=True, metavar="DIR", help="Write recordings to this folder, and list those in it.",
)  # fmt: skip
@shared_option("--page-port", type=click.IntRange(0, 65535), default=0, show_default=True)
@click.option(
    "--lease-s", type=Real(0.5, 10.0), default=1.5, show_default=True,
    help="Set how long the page that armed the bench may be silent, in s, before the output goes "
    "to 0 V. A larger value suits a slow tablet, but a lost page keeps its voltage longer.",
)  # fmt: skip
@click.option(
    "--lan", default="", metavar="IP", callback=_check_lan,
    help="Serve the page also on this IPv4 address of this computer, for a tablet in the same "
    "network. Whoever has the printed address can arm the bench, and the connection is not "
    "encrypted. Default: this computer only.",
)  # fmt: skip
@shared_option("--no-browser", is_flag=True)
def command(
    rig: Path | None,
    actuator: Path | None,
    runs: Path,
    page_port: int,
    lease_s: float,
    lan: str,
    no_browser: bool,
) -> None:
    """Show and drive a bench in a browser.

    HIGH VOLTAGE WILL BE APPLIED on a real bench when a page arms and drives it. Keep clear. The
    page Live has signals, STOP, arming, a manual drive and, with --actuator, a closed loop. Other
    pages play studies, pick points in videos, change the gains and check the computer. Ctrl-C takes
    the output to 0 V and ends the panel.
    """
    with contextlib.ExitStack() as opened:
        example = None
        if rig is None:
            folder = Path(opened.enter_context(tempfile.TemporaryDirectory()))
            rig = folder / "twin.toml"
            write_new(rig, 'kind = "twin"\n')
            if actuator is None:
                actuator = example = _twin_actuator(runs)
        panel = opened.enter_context(
            running_panel(PanelFiles(rig, actuator, runs), page_port, lease_s, lan)
        )
        click.echo("\n".join(panel.addresses))
        also = " or, on another computer, the second one" if lan else ""
        lent = " Whoever has the second address can operate the bench." if lan else ""
        click.echo(
            f"haselab: Open this address in a browser{also}. Ctrl-C ends the panel.{lent}", err=True
        )
        if example is not None:
            click.echo(f"haselab: The actuator file of this twin is {example}.", err=True)
        if not no_browser:
            webbrowser.open(panel.addresses[0])
        _serve(panel)


def _twin_actuator(runs: Path) -> Path:
    """The actuator file for the twin of the reference study; gains written to it are kept.

    Raises:
        DeviceError: it cannot be written.
    """
    path = runs / _ACTUATOR
    if not os.path.lexists(path):  # a link to a drive that is not there is kept
        try:
            write_text(path, reference_actuator())
        except DeviceError as error:
            raise DeviceError(f"--runs: {error}") from None
    return path


def _serve(panel: Panel) -> None:
    """Serve the page until Ctrl-C, or until the bench process or STOP has ended, or STOP hangs.

    Raises:
        DeviceError: the bench process or the stop process ended by itself, or STOP does not answer.
    """
    lost: list[str] = []

    def watch_stop() -> None:
        failed = 0
        while not panel.server.should_exit:
            answers = all(stop_answers(panel.stop_port, _STOP_S, ip) for ip in panel.ips)
            failed = 0 if answers else failed + 1
            if failed == _STOP_TRIALS and not panel.server.should_exit:
                lost.append("stop process does not answer")
                panel.server.should_exit = True
            time.sleep(1.0)

    def watch(name: str, process: subprocess.Popen[str]) -> None:
        process.wait()  # without a limit of time, which would poll
        if not panel.server.should_exit:
            lost.append(f"{name} has ended")
            panel.server.should_exit = True

    for name, process in (("bench process", panel.bench), ("stop process", panel.stop)):
        threading.Thread(target=watch, args=(name, process), daemon=True).start()
    threading.Thread(target=watch_stop, daemon=True).start()
    serve(panel.server, panel.listeners)
    panel.server.should_exit = True
    if lost:
        raise DeviceError(
            f"The {lost[0]}, so the panel ends. Check that the bench is at 0 V, then "
            "start the panel again."
        )
