"""`python -m haselab.panel.bench_process RIG.toml FOLDER RUNS LEASE_S [A.toml]`: has the bench.

It reads the bench block by block into shared memory, answers commands, and plays studies, whose
recordings are new folders in RUNS. FOLDER is private to one panel and holds

- `live`: the signals, see `columns`;
- `camera.jpg`: the last frame of the camera;
- `bench.sock`: commands of the web server, one JSON object per line, each with an `id` and `at_s`,
  the time of the last data that its page received. The state of the bench is sent 20 times a
  second, with the time `clock_s`;
- `stop.sock`: each datagram stops the bench; the answer is that the output was commanded to 0 V, or
  why this is not certain.

It prints `ready KEY`, where KEY names the interlock of the bench, and ends when its stdin or its
parent ends.
"""

from __future__ import annotations

import contextlib
import gc
import json
import math
import os
import select
import selectors
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

from haselab.api.design import Actuator
from haselab.base import HaselabError, InputError, JsonObject, LimitError, is_real
from haselab.panel.columns import LiveWriter
from haselab.panel.files import PanelFiles
from haselab.panel.live_bench import CARRIER_HZ, LiveBench
from haselab.panel.pages.study_job import StudyJob
from haselab.panel.stop_process import COMMANDED, rig_safe_runs
from haselab.panel.study_player import StudyPlayer
from haselab.pipelines.actuator_bench import prepare_bench
from haselab.pipelines.design.model_file import read_tables
from haselab.rig import Rig
from haselab.rig.bench_config import BenchConfig
from haselab.rig.operator import WeightHandler
from haselab.rig.rig_file import RigFile, TwinFile, load_rig, opened_rig
from haselab.runtime.loop import LoopSettings
from haselab.runtime.scheduling import with_priority
from haselab.safety.gate import Gate
from haselab.safety.guarded import guard
from haselab.safety.guardian.client import Guardians, guardian_command
from haselab.safety.interlock import lease_clock_s
from haselab.safety.rig_limits import safety_of
from haselab.safety.state_machine import Safety

__all__ = ["main"]

_STATES_HZ = 20.0
_BEHIND_S = 0.2  # a simulated bench that is further behind real time does not catch up
_MOST_BYTES = 65536  # of one command
_MOST_ANSWERED = 400  # bytes of an answer to STOP
_PARENT_S = 0.2  # between two checks of the parent


class _Link:
    """The socket of the web server: commands in, answers and states out. Runs in a thread."""

    def __init__(self, folder: Path, bench: LiveBench) -> None:
        self._bench = bench
        self._sending = threading.Lock()
        self._server = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._server.bind(str(folder / "bench.sock"))
        self._server.listen(4)

    def serve(self) -> None:
        """Serve one web server after the other, until the program ends."""
        while True:
            client, _ = self._server.accept()
            with client, contextlib.suppress(OSError, ValueError):
                self._talk(client)

    def _talk(self, client: socket.socket) -> None:
        client.setblocking(False)
        waiting, text, next_s = selectors.DefaultSelector(), b"", 0.0
        waiting.register(client, selectors.EVENT_READ)
        while True:
            now_s = time.monotonic()
            if now_s >= next_s:
                next_s = now_s + 1.0 / _STATES_HZ
                state: JsonObject = {"state": asdict(self._bench.state)}
                state["clock_s"] = lease_clock_s()
                self._send(client, state)
            if not waiting.select(max(next_s - time.monotonic(), 0.0)):
                continue
            data = client.recv(_MOST_BYTES)
            if not data or len(text) > _MOST_BYTES:
                return
            *lines, text = (text + data).split(b"\n")
            for command in map(json.loads, lines):
                # A study is checked first, which takes a second; STOP waits for no other command.
                if command.get("do") in ("arm", "stop"):
                    job = threading.Thread(target=self._reply, args=(client, command), daemon=True)
                    job.start()
                else:
                    self._reply(client, command)

    def _reply(self, client: socket.socket, command: JsonObject) -> None:
        with contextlib.suppress(OSError):  # the web server has gone
            self._send(client, self._answer(command))

    def _answer(self, command: JsonObject) -> JsonObject:
        number = command.get("id")
        try:
            given = command.get("values")
            values = given if isinstance(given, dict) else {}
            at_s = command.get("at_s")
            answer = self._bench.do(
                str(command.get("do")), str(command.get("holder")), values,
                float(at_s) if is_real(at_s) else -math.inf,
            )  # fmt: skip
        except HaselabError as error:
            return {"id": number, "error": str(error), "limit": isinstance(error, LimitError)}
        except Exception as error:  # other commands must still be answered
            traceback.print_exc()
            return {"id": number, "error": f"The command failed: {error!r}. See the terminal."}
        return {"id": number, "answer": answer, "state": asdict(self._bench.state)}

    def _send(self, client: socket.socket, message: JsonObject) -> None:
        with self._sending:
            client.settimeout(1.0)
            client.sendall(json.dumps(message).encode() + b"\n")
            client.setblocking(False)


def _stops(folder: Path, bench: LiveBench) -> None:
    """Stop the bench for each datagram, and answer when 0 V was commanded, or that it was not."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as box:
        box.bind(str(folder / "stop.sock"))
        while True:
            data, sender = box.recvfrom(512)
            try:
                fault = bench.stop(data.decode(errors="replace"))
            except BaseException:  # without an answer, the guardians act; the next STOP must work
                traceback.print_exc()
                continue
            with contextlib.suppress(OSError):
                box.sendto(fault.encode()[:_MOST_ANSWERED] or COMMANDED, sender)


@contextlib.contextmanager
def _opened(
    file: RigFile, path: Path, folder: Path, operator: WeightHandler
) -> Iterator[tuple[Rig, Safety]]:
    """Open the rig with its safety chain; a twin gets an interlock that other processes reach."""
    gate = Gate()
    with contextlib.ExitStack() as opened:
        if isinstance(file, TwinFile):
            gate.claim(f"simulated bench of panel {os.getppid()}", 1.0)
            opened.callback(gate.release)
        elif not isinstance(file, BenchConfig):
            raise InputError(
                f"The panel works with kind = 'twin' and 'bench', but the rig has kind = "
                f"{file.kind!r}. Use haselab run with this rig. {path}"
            )
        rig = opened.enter_context(opened_rig(file, path, gate, operator))
        safety = Safety(safety_of(file, getattr(file, "safety", {}), path))
        if isinstance(file, BenchConfig):
            safety.guardians = opened.enter_context(
                Guardians(guardian_command(path), folder / "guardian.log", gate.interlock)
            )
        yield rig, safety


def _loop_of(path: Path | None) -> LoopSettings | None:
    """The loop of an actuator file; None without one, or if a map or the controller is missing.

    Raises:
        InputError: The file is not valid.
    """
    if path is None:
        return None
    found = Actuator.load(path)
    known = (found.voltage_map, found.strain_map, found.controller)
    return None if None in known else found.loop()


def _run(bench: LiveBench, block_s: float, *, paced: bool, ended: threading.Event) -> None:
    next_s = time.monotonic()
    gc.freeze()  # the garbage collector need not look at the modules again: it would take 0.1 s
    with with_priority():
        while not ended.is_set():
            bench.step()
            if paced:
                next_s = max(next_s + block_s, time.monotonic() - _BEHIND_S)
                time.sleep(max(next_s - time.monotonic(), 0.0))


def _ended(fault: str) -> str:
    """The last line for the terminal."""
    if not fault:
        return "haselab: The panel has ended, and 0 V was commanded."
    return (
        f"haselab: The panel has ended, but 0 V IS NOT CONFIRMED ({fault.rstrip('.')}). Press the "
        "emergency stop of the bench."
    )


def _end_study_at(ended: threading.Event, bench: LiveBench) -> None:
    """End the study that is being played when the panel ends."""
    ended.wait()
    bench.end_study("The panel has ended.")


def _watch_parent(parent: int, ended: threading.Event) -> None:
    """End the process when the panel has ended, which means that stdin ends or the parent changes.

    The parent is checked too, because another process may keep the pipe to stdin open.
    """
    while os.getppid() == parent:
        ready, _, _ = select.select([0], [], [], _PARENT_S)
        if ready and not os.read(0, 4096):
            break
    ended.set()


def main(words: list[str]) -> int:
    """Run the bench process.

    Args:
        words: rig file, folder, folder of recordings, lease in s, and optionally the actuator
            file.
    Returns:
        0, or 1 if the bench cannot be used; the reason is printed after `failed`, or after
        `refused` if a file is the reason.
    """
    path, folder, runs, lease_s = *(Path(word) for word in words[:3]), float(words[3])
    actuator = Path(words[4]) if len(words) > 4 else None
    files, player = PanelFiles(path, actuator, runs), StudyPlayer()
    ended = threading.Event()
    for name in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(name, lambda *_: ended.set())
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the panel ends this process by its stdin
    watched = (os.getppid(), ended)
    threading.Thread(target=_watch_parent, args=watched, daemon=True).start()
    try:
        _loop_of(actuator)  # a file that is not valid is refused before the bench is opened
        file = load_rig(path)
        with _opened(file, path, folder, player.operator) as (rig, safety):
            bare, twin = rig.description, None
            if isinstance(file, TwinFile):
                twin = file.configuration(path)
            if actuator is not None:
                tables = read_tables(actuator)
                if note := prepare_bench(rig, tables, actuator, CARRIER_HZ, twin):
                    print(f"haselab: {note}", file=sys.stderr)
            about = rig.description

            def read_loop() -> LoopSettings | None:
                if actuator is not None:
                    now = replace(rig, description=bare)
                    prepare_bench(now, read_tables(actuator), actuator, CARRIER_HZ, twin)
                    if now.description != about:
                        raise InputError(
                            "The limits in [drive] or the calibration have changed since the "
                            f"panel was started. Start it again. {actuator}"
                        )
                return _loop_of(actuator)

            scales = (
                about.volt_per_code / about.v_monitor_v_per_v,
                about.volt_per_code / about.i_monitor_v_per_a,
            )
            live = folder / "live"
            with LiveWriter(live, about.rate_hz, about.block_samples, scales) as writer:
                guarded = guard(rig, safety)
                bench = LiveBench(
                    guarded, writer, read_loop, folder / "camera.jpg",
                    lambda chosen: StudyJob.of(files, file, chosen), player, lease_s,
                    lambda: rig_safe_runs(folder),
                )  # fmt: skip
                threading.Thread(target=_end_study_at, args=(ended, bench), daemon=True).start()
                link = _Link(folder, bench)
                threading.Thread(target=link.serve, daemon=True).start()
                threading.Thread(target=_stops, args=(folder, bench), daemon=True).start()
                assert rig.gate is not None
                key = rig.gate.interlock.key  # type: ignore[attr-defined]
                print(f"ready {key}", flush=True)
                try:
                    _run(bench, about.block_s, paced=rig.simulated, ended=ended)
                finally:
                    bench.close()
                    print(_ended(guarded.unconfirmed()), file=sys.stderr, flush=True)
    except HaselabError as error:
        verb = "refused" if isinstance(error, InputError) else "failed"
        print(f"{verb} {' '.join(str(error).split())}", flush=True)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
