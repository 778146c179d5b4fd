"""Runs one case in a forked child with limits of time and memory, and says what came of it."""

from __future__ import annotations

import contextlib
import os
import resource
import select
import signal
import sys
import tempfile
import traceback
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

from mutations import Case

from haselab.cli.main import main

__all__ = ["ExperimentResult", "run"]

CPU_S, WALL_S = 10, 60  # what a case may compute; how long it may wait on a busy machine
MEMORY_BYTES = 2 << 30  # beyond what the parent has
_FILE_BYTES = 256 << 20
_ALLOWED = (0, 2, 3, 4, 130)
# What would play for minutes or needs a compiler: the fuzzer is after what is read before that.
_LEFT_OUT = (
    "haselab.cli.study.run.execute",
    "haselab.cli.study.run.play_on_chip",
    "haselab.cli.study.reproduce.execute",
    "haselab.cli.model.firmware.build_firmware",
)
_NOTHING = SimpleNamespace(flash_bytes=0, static_bytes=0, hex="")


@dataclass(frozen=True)
class ExperimentResult:
    """What a case did.

    Args:
        exit_code: of the command; minus the signal where one ended it.
        fault: "" or the kind: traceback, exit code, hang, memory, signal.
        where: last lines of the traceback, or of what went to stderr.
        cpu_s: computing time.
        bytes: resident memory, the parent's included.
    """

    exit_code: int
    fault: str
    where: str
    cpu_s: float
    bytes: int


def run(case: Case) -> ExperimentResult:
    """Run a case in a child of its own; nothing of it is left behind."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as name:
        folder = Path(name)
        (folder / "case").mkdir()
        _lay_out(case, folder / "case")
        child = os.fork()
        if child == 0:
            _child(case, folder)
        code, usage, in_time = _wait(child)
        printed = (
            (folder / "stderr").read_text(errors="replace") if (folder / "stderr").exists() else ""
        )
    resident = usage.ru_maxrss * 1024
    cpu_s = usage.ru_utime + usage.ru_stime
    fault = _fault(code, printed, cpu_s, resident, in_time)
    return ExperimentResult(code, fault, "\n".join(printed.splitlines()[-40:]), cpu_s, resident)


def _lay_out(case: Case, folder: Path) -> None:
    for name, data in case.files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    for name, kind in case.special.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if kind == "folder":
            path.mkdir()
        elif kind == "fifo":
            os.mkfifo(path)
        elif kind == "loop":
            path.symlink_to(path)
        elif kind == "dangling":
            path.symlink_to(path.with_name("nowhere"))
        elif kind.startswith("/dev/"):
            path.symlink_to(kind)


def _child(case: Case, folder: Path) -> None:
    """Never returns: `main` in this process, its output in files."""
    code = 70
    try:
        os.setsid()
        os.chdir(folder / "case")
        for number, name in ((0, os.devnull), (1, "../stdout"), (2, "../stderr")):
            handle = os.open(name, os.O_RDONLY if number == 0 else os.O_WRONLY | os.O_CREAT, 0o600)
            os.dup2(handle, number)
        _limit()
        with contextlib.ExitStack() as patched:
            for name in _LEFT_OUT:
                patched.enter_context(mock.patch(name, lambda *_, **__: _NOTHING))
            code = _call(list(case.argv))
    except BaseException:
        traceback.print_exc()
    finally:
        with contextlib.suppress(Exception):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code)


def _limit() -> None:
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY_BYTES,) * 2)
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_S, CPU_S + 5))
    resource.setrlimit(resource.RLIMIT_FSIZE, (_FILE_BYTES,) * 2)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)


def _call(argv: list[str]) -> int:
    """The exit code; of a fault of the program also the traceback that `main` keeps to itself."""
    try:
        main(argv)
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 1
        if code not in (0, 2, 3, 130) and stop.__context__ is not None:
            traceback.print_exception(stop.__context__)
        return code
    return 0


def _wait(child: int) -> tuple[int, resource.struct_rusage, bool]:
    """Exit code, use, and whether the child ended by itself before the wall clock ran out."""
    handle = os.pidfd_open(child)
    try:
        in_time = bool(select.select([handle], [], [], WALL_S)[0])
    finally:
        os.close(handle)
    with contextlib.suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)  # also what it may have started
    if not in_time:
        with contextlib.suppress(ProcessLookupError):
            os.kill(child, signal.SIGKILL)
    _, status, usage = os.wait4(child, 0)
    return os.waitstatus_to_exitcode(status), usage, in_time


def _fault(code: int, printed: str, cpu_s: float, resident: int, in_time: bool) -> str:
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    if not in_time or cpu_s > CPU_S or code == -signal.SIGXCPU:
        return "hang"
    if "MemoryError" in printed or resident > used + MEMORY_BYTES:
        return "memory"
    if code < 0:
        return f"signal {-code}"
    if "Traceback (most recent call last)" in printed:
        return (
            "exit 4" if code == 4 and "File error" in printed else "" if code == 4 else "traceback"
        )
    return "" if code in _ALLOWED else f"exit {code}"
