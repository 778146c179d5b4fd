"""A program that plays on a served twin: `python wire_program.py FOLDER`; ends when it is ended.

FOLDER holds rig.toml. It says `there` at 5 kV, over NI's gRPC, SCPI and a serial port.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from haselab.app.interrupt import Interruptible
from haselab.base import SilentProgress
from haselab.rig import Camera
from haselab.rig.rig_file import load_rig, opened_rig
from haselab.runtime.guarded import guard
from haselab.runtime.guardian import CommandHand, Guardian
from haselab.runtime.runner import Runner
from haselab.runtime.safety import Safety, SafetySettings
from haselab.store.session import ExperimentPlan, SessionWriter


class Watcher:
    """Keeps the acquisition's clock unbroken, as a camera does; says when the output is up."""

    def __init__(self, camera: Camera) -> None:
        self._camera, self._looks = camera, 0

    def start(self, *given: object, **named: object) -> None:
        self._camera.start(50.0)

    def look(self) -> None:
        self._looks += 1
        if self._looks == 3:  # 60 blocks
            print("there", flush=True)

    def finish(self) -> None:
        self._camera.stop()


def main(folder: Path) -> None:
    path = folder / "rig.toml"
    progress = Interruptible(SilentProgress())
    command = (sys.executable, "-m", "haselab.app.stand_by", str(path))
    hand = CommandHand(command, 10.0, waits=True)
    plans = [ExperimentPlan("ramp", "test", 6, {})]
    with (
        opened_rig(load_rig(path), path) as plain,
        SessionWriter(folder / "session.h5", plans, plain.description.block_samples, {}) as session,
        Guardian([hand], folder / "guardian.log") as guardian,
    ):
        safety = Safety(SafetySettings(), guardian)
        rig = guard(plain, safety)
        runner = Runner(rig, session, Watcher(rig.camera), 2000.0, 0.02, progress)
        safety.arm(safety.request())
        with runner:
            drive_v = np.minimum(np.arange(100_000) * 0.02, 1.0)
            runner.play("ramp", drive_v, 50.0, 0.25)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
