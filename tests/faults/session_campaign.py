"""Random damage to a session: no command hangs or passes other numbers for the recorded ones.

    python tests/faults/session_campaign.py --flips 2000 --overwrites 500 --cuts 200

Each case takes a small session recorded on the twin, changes it, and runs `recover`, `analyse`,
`session export` and `sense` on it, each in a child with limits. A command may refuse (exit code 2,
3 or 4, one line). It may end with 0 only when its output equals that of the intact session. The
exit code of the script is 1 where a case broke one of these rules.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from haselab.cli.main import main as haselab
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import make_twin
from haselab.store.manifest import Manifest
from haselab.store.session import opening as session_open
from haselab.store.session import probe as session_probe
from haselab.store.session.writer import ExperimentPlan, QueueRule, SessionWriter
from haselab.study.definition import builtin_study
from haselab.study.run import RunOptions, session_header

LONGEST_S, LARGEST_BYTES = 60.0, 1 << 30  # 10 s on an idle machine, which a busy one exceeds
STATES = ("sealed", "lone copy", "killed")
COMMANDS = ("recover", "analyse", "session export", "sense")
_BLOCKS = 57
_STARTED_BYTES = 1 << 30  # beside what the interpreter has when the child begins


# ---- the intact sessions --------------------------------------------------------------------


def record(folder: Path, *, killed: bool) -> None:
    """Two experiments on the twin, with a study's header, tracks and events."""
    rig = make_twin(TwinConfig(), 5)
    study = builtin_study(quick=True)
    header = session_header(study, rig.description, RunOptions(folder, 5, "none", {}))
    plans = [ExperimentPlan(name, "chirp", 6, {"gain": 0.5}) for name in ("chirp", "pi-1")]
    rng = np.random.default_rng(1)
    with (
        Manifest(folder, header),
        SessionWriter(
            folder / "session.h5", plans, rig.description.block_samples, header, QueueRule(2)
        ) as session,
    ):
        rig.generator.sine(study.sensing.carrier_hz, study.sensing.carrier_v)
        for name in ("chirp", "pi-1"):
            session.event(rig.acquisition.time_s, f"start {name}")
            for k in range(_BLOCKS):
                rig.source.write(1.0 + 0.01 * k)
                time_s, codes = rig.acquisition.time_s, rig.acquisition.read()
                session.append_block(name, codes, time_s, 1.0 + 0.01 * k, float("nan"))
            tracks = np.zeros((40, 6), SessionWriter.track_dtype())
            tracks["x_px"], tracks["valid"] = rng.standard_normal((40, 6)), True
            session.append_frames(name, np.arange(40) / 100.0, tracks, 0.25)
            session.event(rig.acquisition.time_s, f"end {name}")
        if killed:
            os.kill(os.getpid(), signal.SIGKILL)


def make_sessions(folder: Path) -> dict[str, Path]:
    """A folder for each state."""
    found = {state: folder / state.replace(" ", "-") for state in STATES}
    for state in ("sealed", "killed"):  # in processes of their own: this one must stay fit to fork
        command = [sys.executable, str(Path(__file__).resolve()), f"--{state}", str(found[state])]
        subprocess.run(command, check=False, timeout=300)
        assert (found[state] / "session.h5").is_file()
    found["lone copy"].mkdir()
    shutil.copy(found["sealed"] / "session.h5", found["lone copy"])
    return found


# ---- one command in a child -----------------------------------------------------------------


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Args:
        code: exit code; negative: the signal that ended it.
        output: what it wrote, without what differs from run to run.
        said: on stderr.
        duration_s: by the wall's clock.
        memory_bytes: of the largest process.
    """

    code: int
    output: bytes
    said: str
    duration_s: float
    memory_bytes: int


def run(arguments: list[str], outputs: Callable[[], bytes], folder: Path) -> Ended:
    """Run one command line in a fork of this process, with limits."""
    said, began_s = folder / "said", time.perf_counter()
    child = os.fork()
    if not child:
        code = 1
        with contextlib.suppress(BaseException):
            code = _in_child(arguments, folder / "told", said)
        os._exit(code)
    _, status, usage = os.wait4(child, 0)
    code = os.waitstatus_to_exitcode(status)
    written = (folder / "told").read_bytes() + outputs() if code == 0 else b""
    return Ended(code, written, said.read_text(errors="replace"),
                 time.perf_counter() - began_s, usage.ru_maxrss * 1024)  # fmt: skip


def _in_child(arguments: list[str], told: Path, said: Path) -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + _STARTED_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    signal.alarm(60)  # ends what hangs
    session_open.probed = forked_probe
    with (
        told.open("w") as out,
        said.open("w") as err,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            haselab(arguments)
        except SystemExit as ended:
            return int(ended.code or 0)
    return 1


def forked_probe(path: Path, patience_s: float) -> str:
    """`session_open.probed` by a fork: same reader, same limits, no start of an interpreter."""
    signal.alarm(int(patience_s))
    reading, writing = os.pipe()
    child = os.fork()
    if not child:
        with contextlib.suppress(BaseException):
            os.write(writing, session_probe.main(path).encode())
            os._exit(0)
        os._exit(1)
    os.close(writing)
    text = b""
    while piece := os.read(reading, 4096):
        text += piece
    os.close(reading)
    return text.decode(errors="replace") if os.waitpid(child, 0)[1] == 0 else ""


def commands(folder: Path, work: Path) -> Iterator[tuple[str, Ended]]:
    """Each command on one folder; `recover` on a copy of it, whose numbers are read afterwards."""
    path, export, table = folder / "session.h5", work / "out.mat", work / "out.csv"
    copy = work / "copy"

    def exported() -> bytes:
        return export.read_bytes()[128:]  # behind the date

    def recovered() -> bytes:
        export.unlink(missing_ok=True)
        again = run(["session", "export", str(copy), "--to", "mat", "--out", str(export)],
                    exported, work)  # fmt: skip
        return again.output if again.code == 0 else b"cannot be exported: " + again.said.encode()

    lines = {
        "session export": (
            ["session", "export", str(path), "--to", "mat", "--out", str(export)], exported,
        ),
        "sense": (
            ["sense", str(path), "--experiment", "chirp", "--out", str(table)],
            lambda: table.read_bytes(),
        ),
        "analyse": (["analyse", str(folder), "--out", str(work / "analysed")], lambda: b""),
        "recover": (["recover", str(copy), "--json"], recovered),
    }  # fmt: skip
    for name, (arguments, outputs) in lines.items():
        for old in (export, table):
            old.unlink(missing_ok=True)
        if name == "recover":
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(folder, copy)
        yield name, run(arguments, outputs, work)


# ---- damage ---------------------------------------------------------------------------------


def damaged(data: bytes, kind: str, rng: np.random.Generator) -> bytes:
    """The bytes with one random fault in them."""
    changed = bytearray(data)
    place = int(rng.integers(len(data)))
    if kind == "flip":
        changed[place] ^= 1 << int(rng.integers(8))
    elif kind == "overwrite":
        length = int(2 ** rng.uniform(0.0, 17.0))
        changed[place : place + length] = rng.bytes(min(length, len(data) - place))
    else:
        del changed[place:]
    return bytes(changed)


def judge(ended: Ended, intact: Ended) -> str:
    """Which rule a command broke; empty: none."""
    if ended.code not in (0, 2, 3, 4):
        return f"exit code {ended.code}"
    if "Traceback" in ended.said or len(ended.said.strip().splitlines()) > 2:
        return "more than a line"
    if ended.duration_s > LONGEST_S:
        return f"took {ended.duration_s:.1f} s"
    if ended.memory_bytes > LARGEST_BYTES:
        return f"took {ended.memory_bytes / 2**20:.0f} MiB"
    if ended.code == 0 and ended.output != intact.output:
        return "other numbers with exit code 0"
    return ""


@dataclass
class Tally:
    """What the cases of one kind and state did."""

    codes: Counter[tuple[str, str, str, int]]
    broken: list[str]
    longest_s: float = 0.0
    largest_bytes: int = 0

    def to_json(self) -> str:
        """For the parent."""
        return json.dumps([[[*key, n] for key, n in self.codes.items()], self.broken,
                           self.longest_s, self.largest_bytes])  # fmt: skip

    def add(self, text: str) -> None:
        """What a worker has found."""
        codes, broken, longest_s, largest = json.loads(text)
        for *key, count in codes:
            self.codes[tuple(key)] += count
        self.broken += broken
        self.longest_s = max(self.longest_s, longest_s)
        self.largest_bytes = max(self.largest_bytes, largest)


def work_through(cases: list[tuple[int, str, str]], bases: dict[str, Path], work: Path) -> Tally:
    """Cases of (seed, kind of damage, state of the session), one after the other."""
    work.mkdir()
    intact = {state: dict(commands(path, work)) for state, path in bases.items()}
    for state, found in intact.items():
        assert found["session export"].code == found["sense"].code == 0, (state, found)
        assert found["recover"].code == 0 and found["session export"].output, (state, found)
    tally = Tally(Counter(), [])
    folder = work / "case"
    random.Random(1).shuffle(cases)  # what is unfinished is then a sample of all
    for seed, kind, state in cases:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(bases[state], folder)
        path = folder / "session.h5"
        path.write_bytes(damaged(path.read_bytes(), kind, np.random.default_rng(seed)))
        for name, ended in commands(folder, work):
            tally.codes[kind, state, name, ended.code] += 1
            tally.longest_s = max(tally.longest_s, ended.duration_s)
            tally.largest_bytes = max(tally.largest_bytes, ended.memory_bytes)
            fault = judge(ended, intact[state][name])
            if fault:
                tally.broken.append(
                    f"seed {seed}, {kind}, {state}, {name}: {fault}: {ended.said[-300:]}"
                )
        (work.parent / f"{work.name}.json").write_text(tally.to_json())
    return tally


def _import_commands() -> None:
    """What the commands need, before the forks: each child would import it again."""
    for name in ("data.recover", "study.analyse", "data.session", "data.sense"):
        importlib.import_module(f"haselab.cli.{name}")
    for name in ("scipy.io", "haselab.store.columns.session", "haselab.runtime.runner"):
        importlib.import_module(name)


def campaign(counts: dict[str, int], first: int, workers: int, folder: Path) -> Tally:
    """All cases, shared out to forked workers."""
    bases = make_sessions(folder)
    _import_commands()
    cases: list[tuple[int, str, str]] = []
    for kind, count in counts.items():
        cases += [(first + k, kind, STATES[k % len(STATES)]) for k in range(count)]
    children = []
    for k in range(workers):
        child = os.fork()
        if not child:
            code = 1
            try:
                work_through(cases[k::workers], bases, folder / f"worker-{k}")
                code = 0
            finally:
                os._exit(code)
        children.append(child)
    tally = Tally(Counter(), [])
    for k, child in enumerate(children):
        assert os.waitpid(child, 0)[1] == 0, "a worker failed"
        tally.add((folder / f"worker-{k}.json").read_text())
    return tally


def table(tally: Tally) -> str:
    """Exit codes by damage, state and command."""
    lines = [f"{'damage':10s} {'session':10s} {'command':15s}  cases  exit 0  exit 2  other"]
    keys = sorted({key[:3] for key in tally.codes})
    for key in keys:
        codes = {code: n for (*k, code), n in tally.codes.items() if tuple(k) == key}
        other = sum(n for code, n in codes.items() if code not in (0, 2))
        lines.append(f"{key[0]:10s} {key[1]:10s} {key[2]:15s} {sum(codes.values()):6d} "
                     f"{codes.get(0, 0):7d} {codes.get(2, 0):7d} {other:6d}")  # fmt: skip
    lines.append(f"longest {tally.longest_s:.1f} s, largest {tally.largest_bytes / 2**20:.0f} MiB, "
                 f"{len(tally.broken)} rules broken")  # fmt: skip
    return "\n".join([*lines, *tally.broken[:50]])


def main() -> None:
    """Run the campaign and print its table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--flips", type=int, default=2000)
    parser.add_argument("--overwrites", type=int, default=500)
    parser.add_argument("--cuts", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--sealed", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--killed", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.killed or asked.sealed:
        record(asked.killed or asked.sealed, killed=asked.killed is not None)
        return
    counts = {"flip": asked.flips, "overwrite": asked.overwrites, "cut": asked.cuts}
    with tempfile.TemporaryDirectory() as folder:
        tally = campaign(counts, asked.seed, asked.workers, Path(folder))
    print(table(tally))
    sys.exit(bool(tally.broken))


if __name__ == "__main__":
    main()
