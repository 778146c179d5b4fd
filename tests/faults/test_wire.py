"""The program is ended while the real drivers hold a served twin at 5 kV."""

from __future__ import annotations

import importlib.util
import json
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from haselab.rig.twin.config import twin_of_reading
from haselab.store.session import SessionReader

NEEDED = ("nidaqmx", "grpc", "pyvisa", "pymeasure", "serial")
MISSING = [name for name in NEEDED if importlib.util.find_spec(name) is None]
pytestmark = [
    pytest.mark.skipif(sys.platform == "win32", reason="signals and ptys are POSIX's"),
    pytest.mark.skipif(bool(MISSING), reason=f"pip install 'haselab[instruments]': no {MISSING}"),
]
PROGRAM = Path(__file__).with_name("wire_program.py")
PACE = 0.25  # of the wall clock: outputs are in time on a loaded machine too


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Any]:
    from haselab.rig.twin.serve.server import ServedTwin

    with ServedTwin(twin_of_reading("hz"), 1, PACE) as twin:
        (tmp_path / "rig.toml").write_text(twin.rig_file(ahead_blocks=4))
        yield twin


def ended(served: Any, folder: Path, number: int) -> float:
    """Seconds from the signal to an output below 50 V."""
    bench = served.hub.bench
    with (folder / "stderr").open("w") as told:
        program = subprocess.Popen(
            [sys.executable, str(PROGRAM), str(folder)], stdout=subprocess.PIPE, stderr=told,
            text=True,
        )  # fmt: skip
        with program:
            assert program.stdout is not None
            assert program.stdout.readline() == "there\n", (folder / "stderr").read_text()
            assert abs(bench.output_v) > 4500.0
            begun_s = time.monotonic()
            program.send_signal(number)
            while abs(bench.output_v) > 50.0:
                assert time.monotonic() < begun_s + 20.0
                time.sleep(0.001)
            return time.monotonic() - begun_s


@pytest.mark.parametrize(("name", "limit_s"), [("SIGKILL", 0.5), ("SIGTERM", 0.5)])
def test_the_output_goes_down_behind_the_real_drivers(
    served: Any, tmp_path: Path, name: str, limit_s: float
) -> None:
    after_s = ended(served, tmp_path, signal.Signals[name])
    print(f"{name}: {1e3 * after_s:.0f} ms")
    assert after_s < limit_s
    with SessionReader(tmp_path / "session.h5") as session:
        assert len(session.experiment("ramp").codes) >= 60
        events = [what for _, what in session.events()]
    if name == "SIGKILL":
        log, end_s = tmp_path / "guardian.log", time.monotonic() + 10.0
        while not log.exists() and time.monotonic() < end_s:
            time.sleep(0.01)
        record = json.loads(log.read_text())
        assert record["reason"] == "the program is gone"
        assert record["hands"] == [{"hand": "command", "answer": "done", "safe": True}]
    else:
        assert events[-1] == "ended by KeyboardInterrupt; output at 0 V"
