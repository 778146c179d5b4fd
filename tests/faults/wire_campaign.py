"""Faults on the real drivers' wires: a served twin, links that break, a guardian beside them.

The client, the servers and the physics share this process, and the physics goes on only as it is
asked for readings: times are rig time plus wall-clock time, as in campaign.py, without what the
computer takes for the physics. Signals go to a program of its own; after one that ends it at once
the physics goes on by the wall clock.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import shutil
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from haselab.base import HaselabError, SafetyError, SilentProgress
from haselab.cli.interrupt import Interruptible
from haselab.rig import drivers as rig_drivers
from haselab.rig.twin.serve.hub import UNDERFLOW
from haselab.rig.twin.serve.ni.status import StatusError
from haselab.safety.guardian import process as guardian_process


def sibling(name: str) -> ModuleType:
    """Another file of this folder."""
    key = f"fault_{name}"
    if key not in sys.modules:
        spec = importlib.util.spec_from_file_location(key, Path(__file__).with_name(f"{name}.py"))
        assert spec is not None and spec.loader is not None
        sys.modules[key] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[key])
    return sys.modules[key]


wires = sibling("wire_bench")
campaign, links, Bench, Play = wires.campaign, wires.links, wires.Bench, wires.Play
LEASE_S, PATIENT_LEASE_S = wires.LEASE_S, wires.PATIENT_LEASE_S
MOMENTS = campaign.MOMENTS


# ---- faults ------------------------------------------------------------------------------------


def _board_cut(bench: Bench) -> None:
    bench.daq.cut()


def _board_garbled(bench: Bench) -> None:
    bench.daq.garbles = True


def _board_hushed(bench: Bench) -> None:
    bench.daq.hush(2.0)


def _scpi_cut(bench: Bench) -> None:
    bench.scpi.cut()


def _scpi_garbled(bench: Bench) -> None:
    bench.scpi.garbles = True


def _scpi_hushed(bench: Bench) -> None:
    bench.scpi.hush(30.0)


def _serial_cut(bench: Bench) -> None:
    bench.serial.cut()


def _serial_garbled(bench: Bench) -> None:
    bench.serial.garbles = True


def _serial_hushed(bench: Bench) -> None:
    bench.serial.hushed = True


def _hands_cut(bench: Bench) -> None:
    bench.client.cut()


def _hands_hushed(bench: Bench) -> None:
    bench.client.hush(2.0)


def _status(code: int) -> Callable[[Bench], None]:
    """The board answers every reading with a status of DAQmx."""

    def refuse(*given: object) -> None:
        raise StatusError(code)

    return lambda bench: bench.replace(bench.hub, "readings", refuse)


def _overwritten(bench: Bench) -> None:
    def lost(*given: object) -> None:
        raise LookupError("overwritten")

    bench.replace(bench.hub, "readings", lost)


def _clock_stands(bench: Bench) -> None:
    bench.replace(bench.hub, "readings", lambda *given: None)


def _underflow(bench: Bench) -> None:
    """The output has run dry, and does not come back however often it is started."""

    def dry(*given: object) -> None:
        raise StatusError(UNDERFLOW)

    bench.hub._streaming, bench.hub.output_status = False, UNDERFLOW
    bench.replace(bench.hub, "queue_output", dry)


def _codes(change: Callable[[NDArray[np.int16]], None]) -> Callable[[Bench], None]:
    """The board sends other readings than there were."""

    def strike(bench: Bench) -> None:
        plain = bench.hub.readings

        def readings(*given: Any) -> NDArray[np.int16] | None:
            codes = plain(*given)
            if codes is not None:
                codes = codes.copy()
                change(codes)
            return codes

        bench.replace(bench.hub, "readings", readings)

    return strike


def _garbage(codes: NDArray[np.int16]) -> None:
    codes[:] = np.random.default_rng(3).integers(-32768, 32767, codes.shape, dtype=np.int16)


def _astray(codes: NDArray[np.int16]) -> None:
    codes[:, 0] += np.int16(round(0.4 / (20.0 / 65536)))  # 2 kV more than there are


def _leak(codes: NDArray[np.int16]) -> None:
    codes[:, 1] += np.int16(round(1.0 / (20.0 / 65536)))  # 2 mA


def _carrier_lost(bench: Bench) -> None:
    """The generator says that it is on; its plug is out."""
    bench.hub.carrier(2000.0, 0.0)
    bench.replace(bench.hub, "carrier", lambda *given: None)


def _breakdown(bench: Bench) -> None:
    """The bench protects itself; its monitors read nothing any more."""

    def through(*given: object) -> None:
        bench.hub.bench.zero()
        raise SafetyError("Dielectric breakdown at 41 kV/mm.")

    bench.replace(bench.meter, "plain", through)


def _stays_on(bench: Bench) -> None:
    """The generator switches off; it says that it has not."""
    plain = bench.served.generator.answer

    def says_on(line: str) -> bytes:
        told = plain(line)
        return b"1" + told[1:] if re.search(r"OUTP1\?(;|$)", line) and told else told

    bench.replace(bench.served.generator, "answer", says_on)


def _unconfirmed(bench: Bench) -> None:
    """The supply's switch stays closed, whatever it is told."""
    plain = bench.supply_says
    bench.supply_says = lambda line: "1" if line == "QSwMode" else plain(line)


def _disk_full(bench: Bench) -> None:
    def full(path: object) -> Any:
        bench.noted()
        return mock.Mock(free=1000)

    bench.replace(shutil, "disk_usage", full)


def _guardian(number: signal.Signals, slot: int) -> Callable[[Bench], None]:
    """One of the guardians is killed or stopped; the other one, or the program, has to act."""

    def strike(bench: Bench) -> None:
        assert bench.guardians is not None
        os.kill(bench.guardians.pids[slot], number)
        if number == signal.SIGSTOP:
            bench.stopped.append(bench.guardians.pids[slot])
        end_s = time.monotonic() + 60.0
        while bench.guardians.lost() == "" and time.monotonic() < end_s:
            time.sleep(0.01)

    return strike


def _other_serial(section: str, value: str) -> Callable[[Bench], None]:
    def strike(bench: Bench) -> None:
        path = bench.folder / "rig.toml"
        lines = path.read_text().splitlines()
        at = lines.index(f"[{section}]")
        k = next(k for k in range(at, len(lines)) if lines[k].startswith("serial_number"))
        lines[k] = f'serial_number = "{value}"'
        path.write_text("\n".join(lines))

    return strike


def _no_driver(bench: Bench) -> None:
    bench.replace(rig_drivers.importlib, "import_module", mock.Mock(side_effect=_missing))


def _missing(name: str) -> None:
    raise ImportError(name=name)


@dataclass(frozen=True)
class Fault:
    """One row of the table.

    Args:
        strike: what happens.
        words: of its reason.
        moments: at which it is tried.
        opening: before arming means: before the instruments are opened.
        later: nothing is asked of the link at the moment: counted from what its driver says first.
        guardian: it has to act, and its outcome is recorded.
        daq: more lines of the rig file's table [daq].
    """

    strike: Callable[[Bench], None]
    words: str
    moments: tuple[str, ...] = MOMENTS
    opening: bool = False
    later: bool = False
    guardian: bool = False
    daq: str = ""


ARM, RAMP, STEP, CLOSE = MOMENTS
FAULTS: dict[str, Fault] = {
    "board: gRPC link cut": Fault(_board_cut, "does not reply", guardian=True),
    "board: garbage on the gRPC link": Fault(_board_garbled, "does not reply", guardian=True),
    "board: gRPC link silent": Fault(
        _board_hushed, "no heartbeat from the program", (STEP,), guardian=True
    ),
    "board: gRPC link silent, server_patience_s = 0.2": Fault(
        _board_hushed,
        "does not reply",
        (RAMP, STEP),
        guardian=True,
        daq="timeout_s = 0.2\nserver_patience_s = 0.2\n",
    ),
    "board: overrun, -200279": Fault(_overwritten, "status -200279", guardian=True),
    "board: underflow, -200290": Fault(_underflow, "status -200290", (RAMP, STEP)),
    "board: clock stands still, -200284": Fault(_clock_stands, "status -200284", guardian=True),
    "board: a status nobody knows": Fault(
        _status(-209999), "status -209999", (RAMP, STEP), guardian=True
    ),
    "board: garbage for readings": Fault(_codes(_garbage), "Output", (ARM, RAMP, STEP)),
    "board: wrong read-back": Fault(_codes(_astray), "Output"),
    "board: over-current": Fault(_codes(_leak), "Over-current", (RAMP, STEP)),
    "generator: SCPI link cut": Fault(_scpi_cut, "generator", later=True, guardian=True),
    "generator: garbage": Fault(_scpi_garbled, "generator", later=True, guardian=True),
    "generator: silent": Fault(
        _scpi_hushed, "generator", (ARM, RAMP, CLOSE), later=True, guardian=True
    ),
    "generator: on after OFF": Fault(_stays_on, "generator", (ARM, CLOSE), opening=True),
    "generator: carrier lost": Fault(_carrier_lost, "No strain in 5 blocks", (STEP,)),
    "supply: serial link cut": Fault(_serial_cut, "supply", (ARM, RAMP, CLOSE), later=True),
    "supply: garbage": Fault(_serial_garbled, "supply", (RAMP, CLOSE), later=True),
    "supply: silent": Fault(_serial_hushed, "supply", (CLOSE,), later=True),
    "supply: not confirmed off": Fault(_unconfirmed, "supply is on", (CLOSE,)),
    "camera: link cut": Fault(_hands_cut, "does not reply", (ARM, RAMP, STEP), later=True),
    "camera: link silent": Fault(
        _hands_hushed, "no heartbeat from the program", (RAMP,), guardian=True
    ),
    "breakdown in the bench": Fault(_breakdown, "Output does not follow: 0 V", (RAMP, STEP)),
    "full disk": Fault(_disk_full, "disk is full", (RAMP, STEP), later=True),
    "guardian 1 killed": Fault(_guardian(signal.SIGKILL, 0), "(?i)guardian 1", (ARM, RAMP, STEP)),
    "guardian 2 killed": Fault(_guardian(signal.SIGKILL, 1), "(?i)guardian 2", (RAMP,)),
    "guardian 1 ended": Fault(_guardian(signal.SIGTERM, 0), "received SIGTERM", (RAMP, STEP)),
    "guardian 1 stopped": Fault(_guardian(signal.SIGSTOP, 0), "(?i)guardian 1", (RAMP, STEP)),
    "guardian 2 stopped": Fault(_guardian(signal.SIGSTOP, 1), "(?i)guardian 2", (RAMP,)),
    "other board": Fault(
        _other_serial("daq", "DEADBEEF"), "the rig file names", (ARM,), opening=True
    ),
    "other generator": Fault(
        _other_serial("generator", "MY1"), "the rig file names", (ARM,), opening=True
    ),
    "other supply": Fault(
        _other_serial("supply", "rev2"), "the rig file names", (ARM,), opening=True
    ),
    "driver not installed": Fault(_no_driver, "is not installed", (ARM,), opening=True),
}


def inside(folder: Path, fault: str, moment: str, forks: Any) -> Any:
    """One fault on the wire."""
    given = FAULTS[fault]
    with Bench(folder, given.strike, later=given.later) as bench:
        when = "opening" if given.opening and moment == ARM else moment

        def at(what: str) -> None:
            bench.guardians = play.guardians
            if what == when:
                bench.now()

        bench.configure(given.daq)
        told, command = "", forks.command("guardian", str(folder / "guardian.toml"))
        play = Play(folder, command, at, bench.noted, takes=fault.startswith("camera"))
        try:
            play.run()
        except HaselabError as error:
            told = str(error)
        after_s, left_v = bench.after_s(), bench.settled_v()
    recorded, readable = "", 0
    if (folder / "session.h5").exists():
        recorded, readable = campaign.left(folder)
    blocks = play.recorder.blocks if play.recorder is not None else 0
    return campaign.Outcome(after_s, left_v, told, recorded, blocks, readable, bench.highest_v)


# ---- signals to a program of its own, by the wall clock ----------------------------------------

SIGNALS = {
    "SIGINT": ("ended by KeyboardInterrupt", (STEP,)),
    "SIGTERM": ("ended by KeyboardInterrupt", MOMENTS),
    "SIGHUP": ("ended by KeyboardInterrupt", (CLOSE,)),
    "SIGQUIT": ("the program has ended", (RAMP,)),
    "SIGKILL": ("the program has ended", MOMENTS),
}
ENDS_AT_ONCE = ("SIGQUIT", "SIGKILL")


class NotStruckError(AssertionError):
    """The program had ended before its moment, as on a machine that is too busy: no fault yet."""


def program(folder: Path, socket: Path, moment: str, lease_s: float) -> None:
    """Plays until it is ended; says `there` when the moment is reached."""
    progress = Interruptible(SilentProgress())

    def at(what: str) -> None:
        nonlocal moment
        if what == "in closing" and moment == what:
            moment = "zeroing"  # the next thing that it does
        elif what == moment:
            moment = ""
            pids = [] if play.guardians is None else play.guardians.pids
            print("there", *pids, flush=True)
            if what in ("before arming", "zeroing"):
                for _ in range(600):  # a driver that takes its time
                    time.sleep(0.05)
                    progress.advance(0.0, what)

    command = (sys.executable, "-I", "-S", links.__file__, str(socket))
    command += ("guardian", str(folder / "guardian.toml"))
    endless = {RAMP: "ramp", STEP: "step"}.get(moment, "")
    brief = moment == CLOSE
    play = Play(
        folder, command, at, endless=endless, brief=brief, progress=progress, lease_s=lease_s
    )
    with contextlib.closing(links.SharedNumber(folder / "count")) as shown:
        play.run(shown)


LOWEST_V = 4500.0  # that a fault has to meet


def outside(folder: Path, *case: Any, patient: bool = False) -> Any:
    """`outside_once`, repeated when the program had ended by itself: then it tested nothing."""
    for trial in range(3):
        try:
            return outside_once(folder / f"run-{trial}", *case, patient=patient)
        except NotStruckError as error:
            reason = error
    raise reason


def outside_once(
    folder: Path,
    name: str,
    moment: str,
    forks: Any,
    helpers: Sequence[tuple[int, str]] = (),
    *,
    patient: bool = False,
) -> Any:
    """One signal to a program that plays on a served twin through the real drivers.

    Args:
        name: of the signal; empty: the program itself is left alone.
        helpers: guardians that get a signal at the same moment: slot and name of the signal.
        patient: drivers and lease do not run out on a busy machine, which would end the program.
    Raises:
        NotStruckError: the program had ended before.
    """
    with Bench(folder, lambda bench: None) as bench:
        if patient:
            bench.be_patient()
        lease_s = PATIENT_LEASE_S if patient else LEASE_S
        read, write = os.pipe()
        with (
            (folder / "stderr").open("w") as errors,
            os.fdopen(read) as words,
            contextlib.closing(links.SharedNumber(folder / "count")) as count,
        ):
            words_of = ["program", str(folder), str(forks.path), moment, str(lease_s)]
            started = forks.start(words_of, write, errors.fileno())
            os.close(write)
            there, *pids = words.readline().split() or [""]
            if there != "there":
                started.ended()
                raise NotStruckError((folder / "stderr").read_text()[-300:])
            acknowledged = round(count.read())
            bench.now()
            if moment != ARM and bench.highest_v <= LOWEST_V:
                with contextlib.suppress(ProcessLookupError):
                    os.kill(started.pid, signal.SIGTERM)
                started.ended()
                raise NotStruckError((folder / "stderr").read_text()[-300:])
            if name in ENDS_AT_ONCE:
                bench.go_on()
            if name:
                os.kill(started.pid, signal.Signals[name])
            for slot, signal_name in helpers:
                os.kill(int(pids[slot]), signal.Signals[signal_name])
                bench.stopped.append(int(pids[slot]))
            code = started.ended()
        if code < 0:
            campaign.wait_for_log(folder)
        if not bench.pace:
            bench.go_on()
        _wait_until_safe(bench)
        after_s, left_v = bench.after_s(), bench.meter.peak_v
    recorded, readable = campaign.left(folder)
    told = (folder / "stderr").read_text() or f"exit code {code}"
    return campaign.Outcome(
        after_s, left_v, told, recorded, acknowledged, readable, bench.highest_v
    )


def _wait_until_safe(bench: Bench) -> None:
    """Until the voltmeter has seen two blocks below 50 V; ten seconds at most."""
    two_s, end_s = 2.0 * bench.hub.description.block_s / bench.pace, time.monotonic() + 10.0
    time.sleep(two_s)
    while bench.meter.now_s() < bench.meter.safe_s + two_s and time.monotonic() < end_s:
        time.sleep(0.01)


def cases() -> Iterator[tuple[str, str]]:
    """All faults at all their moments."""
    for fault, given in FAULTS.items():
        yield from ((fault, moment) for moment in given.moments)
    for name, (_, moments) in SIGNALS.items():
        yield from ((name, moment) for moment in moments)


DRIVERS = ("pyvisa", "pyvisa_py", "pymeasure.instruments.agilent", "serial")


def run(words: list[str]) -> Any:
    """A fork: a guardian, or the program."""
    if words[0] == "guardian":
        for name in DRIVERS:  # imported before the fork
            assert name in sys.modules
        return guardian_process.main(words[1:])
    return program(Path(words[1]), Path(words[2]), words[3], float(words[4]))


if __name__ == "__main__":
    for needed in ("nidaqmx", "nidaqmx.system.device", "nidaqmx.stream_readers", "grpc",
                   "nidaqmx.stream_writers", *DRIVERS):  # fmt: skip
        importlib.import_module(needed)
    assert threading.active_count() == 1
    links.serve_forks(Path(sys.argv[1]), run)
