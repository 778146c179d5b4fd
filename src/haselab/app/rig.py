"""`haselab rig`: check a bench step by step; make one safe from outside."""

from __future__ import annotations

import contextlib
import json
import tempfile
from collections.abc import Generator, Iterator
from dataclasses import asdict
from pathlib import Path

import click

from haselab.app.arming import bench_hand
from haselab.app.common import answer_options
from haselab.app.interrupt import Interruptible
from haselab.app.output import OutputRule
from haselab.base import DeviceError, InputError, SilentProgress
from haselab.rig import Rig
from haselab.rig.bench_config import BenchConfig
from haselab.rig.cameras.opening import check_driver
from haselab.rig.drivers import load_driver
from haselab.rig.ladder import Rung, climb_dry, climb_live
from haselab.rig.mega import MegaFile
from haselab.rig.rig_file import ReplayFile, RigFile, load_rig, opened_rig
from haselab.rig.twin.bench import make_twin
from haselab.rig.twin.config import twin_of_reading
from haselab.safety.guardian import Guardian
from haselab.safety.make_safe import make_safe
from haselab.store.folder import write_new

__all__ = ["check", "command", "safe"]

_LIVE_S = 60.0  # that the live rungs may take


@click.group("rig")
def command() -> None:
    """Check a bench, or make it safe."""


def _mock(file: RigFile, path: Path) -> Iterator[Rung]:
    """The file, its drivers, and the steps of this check on a twin: nothing is touched."""
    yield Rung("mock", "rig file", f"kind {file.kind}, no fault", True)
    if isinstance(file, BenchConfig):
        limits = file.describe().drive_limits
        top_kv = 1e-3 * limits.high * file.amplifier.gain
        yield Rung("mock", "limits", f"{limits.low:g} to {limits.high:g} V of drive, "
                   f"{top_kv:g} kV at most", True)  # fmt: skip
        modules = ["nidaqmx", "pymeasure", "pyvisa_py", "grpc"] + ["serial"] * bool(file.supply)
        for module in modules:
            load_driver(module, "This bench")
        camera = check_driver(file.camera)
        yield Rung("mock", "drivers", ", ".join([*modules, *camera]), True)
    if isinstance(file, ReplayFile):
        return
    rig = make_twin(twin_of_reading("hz"), 1)
    for rung in (*climb_dry(rig, real_time=False), *climb_live(rig)):
        yield Rung("mock", f"{rung.what} on a twin", rung.found, rung.passed)


def _climb(file: RigFile, path: Path, live: bool) -> Generator[Rung, None, None]:
    yield from _mock(file, path)
    with opened_rig(file, path) as rig:
        if isinstance(file, ReplayFile):
            yield Rung("dry", "recording", f"block of {len(_first_block(rig))} readings", True)
            return
        for name, told in (("source", rig.source), ("generator", rig.generator),
                           ("supply", rig.supply), ("camera", rig.camera)):  # fmt: skip
            identity = getattr(told, "identity", "")
            if identity:
                yield Rung("dry", name, identity, True)
        yield from climb_dry(rig, real_time=_by_hand(file))
        if live:
            with _watched(file, path):
                yield from climb_live(rig)


@contextlib.contextmanager
def _watched(file: RigFile, path: Path) -> Iterator[None]:
    """A guardian for what is energised without a run."""
    if not isinstance(file, BenchConfig):
        yield
        return
    with (
        tempfile.TemporaryDirectory() as folder,
        Guardian([bench_hand(path)], Path(folder) / "guardian.log") as guardian,
    ):
        guardian.renew(_LIVE_S)
        yield


def _by_hand(file: RigFile) -> bool:
    """A bench of real time; a served twin keeps the time that it was told to."""
    if isinstance(file, MegaFile):
        return file.port is not None
    return isinstance(file, BenchConfig) and file.stand.kind == "operator"


def _first_block(rig: Rig) -> bytes:
    return bytes(len(rig.acquisition.read()))


@command.command("check")
@click.argument("rig", type=click.Path(path_type=Path))
@click.option("--live", is_flag=True, help="Put out the sensing signal and a small step, too.")
@click.option("--yes", is_flag=True, help="Nobody touches the bench: high voltage may come.")
@answer_options()
def check(rig: Path, live: bool, yes: bool, as_json: bool, out: Path | None) -> None:
    """Climb the ladder: mock (nothing is touched), dry (no high voltage), with --live, live.

    It ends at the first rung that does not hold, with the outputs at 0 V.
    """
    if live and not yes:
        raise click.UsageError("--live puts out high voltage: keep clear and add --yes.")
    if yes and not live:
        raise click.UsageError("--yes belongs to --live.")
    file = load_rig(rig)
    Interruptible(SilentProgress())  # a signal ends the ladder, and that ends at 0 V
    rungs: list[Rung] = []
    try:
        # Closed at once where a rung does not hold: 0 V must not wait for Python's collector.
        with contextlib.closing(_climb(file, rig, live)) as ladder:
            for rung in ladder:
                rungs.append(rung)
                _tell(rung, as_json)
                if not rung.passed:
                    raise DeviceError(
                        f"{rung.step}: {rung.what}: {rung.found}. Put it right, then check again. "
                        f"{rig}"
                    )
    finally:
        _answer(rungs, as_json, out)


def _tell(rung: Rung, as_json: bool) -> None:
    if not as_json:
        mark = "ok" if rung.passed else "--"
        click.echo(f"{mark}  {rung.step:5s} {rung.what:32s} {rung.found}")


def _answer(rungs: list[Rung], as_json: bool, out: Path | None) -> None:
    text = json.dumps({"rungs": [asdict(rung) for rung in rungs]}, indent=2)
    if out is not None:
        write_new(out, text + "\n")
    if as_json:
        click.echo(text)


@command.command("safe")
@click.argument("rig", type=click.Path(path_type=Path))
@answer_options(OutputRule("last"))
def safe(rig: Path, as_json: bool, out: Path | None) -> None:
    """Take a bench to 0 V from outside, whichever program uses it or died using it."""
    file = load_rig(rig)
    if not isinstance(file, BenchConfig):
        raise InputError(f"kind = {file.kind!r}, allowed here is 'bench'. Name another rig. {rig}")
    faults = make_safe(file)
    rungs = [Rung("safe", name, fault or "at rest, read back", not fault) for name, fault in faults]
    for rung in rungs:
        _tell(rung, as_json)
    _answer(rungs, as_json, out)
    bad = [rung.what for rung in rungs if not rung.passed]
    if bad:
        raise DeviceError(
            f"Not confirmed at rest: {', '.join(bad)}. Switch the high voltage off by hand. {rig}"
        )
