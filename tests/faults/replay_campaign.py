"""Faults of a recorded session that is played as a rig: nothing is energised, all else holds."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import h5py
import numpy as np

from haselab.base import HaselabError, SilentProgress
from haselab.cli.interrupt import Interruptible
from haselab.rig.replay import ReplayBench
from haselab.runtime.runner import Runner
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.store.session.writer import ExperimentPlan, SessionWriter

campaign = sys.modules["fault_campaign"]
ARM, RAMP, STEP, CLOSE = campaign.MOMENTS
Undo = Callable[[], None]


def record(folder: Path) -> Path:
    """A session of a ramp and a step on the twin, to be replayed."""
    folder.mkdir(parents=True)
    twin = campaign.TwinBench(campaign.twin_of_reading("hz"), 3)
    trouble = campaign.Trouble(twin, lambda trouble: None)
    campaign.play(folder, trouble, "never", campaign.SafetySettings(), [])
    return folder / "session.h5"


def _over(bench: ReplayBench) -> None:
    """The recording ends here."""
    del bench._blocks[bench._next :]


def _other_drive(bench: ReplayBench) -> None:
    """A block is missing: the next one belongs to another output."""
    bench._next += 1


def _damaged(bench: ReplayBench) -> None:
    """The readings are not those of this output any more."""
    for name, found in bench._records.items():
        codes = np.array(found.codes)
        codes[:] = np.random.default_rng(3).integers(-32768, 32767, codes.shape, dtype=np.int16)
        bench._records[name] = mock.Mock(codes=codes, drive_v=found.drive_v)


def _other_carrier(bench: ReplayBench) -> None:
    bench._carrier = {"carrier_hz": 1000.0, "carrier_v": 0.02}


def _disk_full(bench: ReplayBench) -> None:
    full = mock.patch.object(shutil, "disk_usage", lambda path: mock.Mock(free=1000))
    full.start()
    bench.undo = full.stop  # type: ignore[attr-defined]


def _terminate(bench: ReplayBench) -> None:
    os.kill(os.getpid(), signal.SIGTERM)


FAULTS: dict[str, tuple[Callable[[ReplayBench], None], str, tuple[str, ...]]] = {
    "replay: the recording has ended": (_over, "recording ended", (ARM, RAMP, STEP)),
    "replay: another drive than recorded": (_other_drive, "was recorded", (RAMP, STEP)),
    "replay: garbage for readings": (_damaged, "Output does not follow", (RAMP, STEP)),
    "replay: another carrier than recorded": (_other_carrier, "was recorded", (ARM,)),
    "replay: full disk": (_disk_full, "disk is full", (RAMP, STEP)),
    "replay: SIGTERM": (_terminate, "ended by KeyboardInterrupt", (RAMP, STEP, CLOSE)),
}


def inside(recorded: Path, folder: Path, fault: str, moment: str) -> Any:
    """One fault while a session is replayed; the output is what is asked of the replayed bench."""
    folder.mkdir(parents=True)
    strike, told, blocks = FAULTS[fault][0], "", 0
    struck_s, highest_v, kept = 0.0, 0.0, {s: signal.getsignal(s) for s in _HANDLED}
    with ReplayBench(recorded) as bench:

        def now() -> None:
            nonlocal struck_s, highest_v
            struck_s, highest_v = time.monotonic(), abs(bench._requested_v) * campaign.GAIN
            strike(bench)

        counted: list[int] = []
        try:
            _play(bench, folder, moment, now, counted)
        except HaselabError as error:
            told = str(error)
        except KeyboardInterrupt:
            told = "exit code 130"
        finally:
            getattr(bench, "undo", lambda: None)()
            for number, handler in kept.items():
                signal.signal(number, handler)
        after_s, left_v = time.monotonic() - struck_s, abs(bench._requested_v) * campaign.GAIN
    events, readable = campaign.left(folder)
    blocks = counted[-1]
    return campaign.Outcome(after_s, left_v, told, events, blocks, readable, highest_v)


_HANDLED = [signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if os.name == "posix" else [])]


def _play(
    bench: ReplayBench, folder: Path, moment: str, now: Callable[[], None], counted: list[int]
) -> None:
    plans = [ExperimentPlan(name, "test", 6, {}) for name in ("ramp", "step")]
    hook = sys.unraisablehook
    progress = Interruptible(SilentProgress())
    with SessionWriter(folder / "session.h5", plans, 2000, {}) as session:
        safety = Safety(SafetySettings(read_back=False))  # there is no output to be read back
        recorder = campaign.Count(session)
        plain = recorder.append_block
        at = {
            RAMP: campaign.STRIKE_RAMP,
            STEP: campaign.RAMP_BLOCKS + campaign.STRIKE_STEP,
        }.get(moment)

        def append_block(*given: Any) -> None:
            plain(*given)
            if recorder.blocks == at:
                now()

        recorder.append_block = append_block
        rig = guard(bench.rig, safety)
        runner = Runner(rig, recorder, campaign.NoCamera(), 2000.0, 0.02, progress)
        try:
            if moment == ARM:
                now()
            safety.record_with(lambda what: session.event(0.0, what))
            safety.arm(safety.request())
            with runner:
                runner.play("ramp", np.linspace(0.0, 1.5, campaign.RAMP_BLOCKS), 50.0, 0.25)
                steps = np.full(campaign.STRIKE_STEP + 40, 0.02)
                runner.close_loop("step", steps, campaign.LOOP, 50.0, 0.25)
                if moment == CLOSE:
                    now()
        finally:
            counted.append(recorder.blocks)
            sys.unraisablehook = hook


def damaged_file(recorded: Path, copy: Path, how: str) -> Path:
    """A copy of a session with something wrong in it."""
    shutil.copy(recorded, copy)
    if how == "cut short":
        os.truncate(copy, copy.stat().st_size // 2)
    elif how == "overwritten":
        with copy.open("r+b") as file:
            file.write(b"not what it was" * 100)
    else:
        with contextlib.closing(h5py.File(copy, "r+")) as file:
            del file.attrs["header"]
    return copy
