"""A served twin behind links that break, its voltmeter, and the run that meets the faults."""

from __future__ import annotations

import contextlib
import importlib.util
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import numpy as np
from numpy.typing import NDArray

from haselab.base import SafetyError, SilentProgress
from haselab.cli.bench.arming import gated_rig
from haselab.rig import Camera, Rig
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.config import twin_of_reading
from haselab.rig.twin.serve.hub import TwinHub
from haselab.rig.twin.serve.server import ServedTwin
from haselab.runtime.runner import Runner
from haselab.safety.gate import Gate
from haselab.safety.guarded import guard
from haselab.safety.guardian.client import Guardians
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.store.session.writer import ExperimentPlan, SessionWriter


def sibling(name: str) -> ModuleType:
    """Another file of this folder."""
    key = f"fault_{name}"
    if key not in sys.modules:
        spec = importlib.util.spec_from_file_location(key, Path(__file__).with_name(f"{name}.py"))
        assert spec is not None and spec.loader is not None
        sys.modules[key] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[key])
    return sys.modules[key]


campaign, links = sibling("campaign"), sibling("links")
MOMENTS = campaign.MOMENTS
RAMP_BLOCKS, STEP_BLOCKS, STRIKE = 24, 40, 20  # struck after as many blocks of an experiment
RAMP_V = np.minimum(np.arange(1, RAMP_BLOCKS + 1) * 0.1, 1.0)
DRIVER_S = {"daq": 0.5, "generator": 0.5, "supply": 0.5}  # timeouts of the drivers
LEASE_S = 1.0
# Where only the loss of a process is the fault. Program and guardian may read each other's replies
# on the supply's port, so that a driver waits its whole time and tries again.
PATIENT_DRIVER_S, PATIENT_LEASE_S = 3.0, 20.0
PACE = 0.1  # of the wall clock, once the bench's time passes by itself


# ---- the bench ---------------------------------------------------------------------------------


class Voltmeter:
    """Sees every sample of the output, after the amplifier: since when it is below 50 V for good.

    Args:
        hub: of the served twin.
    """

    def __init__(self, hub: TwinHub) -> None:
        self._hub, self.plain = hub, hub.bench.sample
        self._volts = hub.volt_per_code / hub.description.v_monitor_v_per_v
        self._last = round(hub.rate_hz / 2000.0)  # a period of the carrier
        self.peak_v = 0.0  # in the last samples
        self.physics_s = 0.0  # that this computer took for what a bench does by itself
        self.safe_s, self.safe_rig_s = self.now_s(), hub.bench.time_s
        hub.bench.sample = self.sample  # type: ignore[method-assign]

    def sample(self, drive_v: float, samples: int) -> NDArray[np.int16]:
        begun_s = time.monotonic()
        try:
            codes = self._sampled(drive_v, samples)
        finally:
            if self._hub.lock_step:
                self.physics_s += time.monotonic() - begun_s
        return codes

    def _sampled(self, drive_v: float, samples: int) -> NDArray[np.int16]:
        try:
            codes = self.plain(drive_v, samples)
        except SafetyError:
            if self.peak_v >= campaign.SAFE_V:
                self._safe_since(0)
            self.peak_v = 0.0
            raise
        volts = np.abs(codes[:, 0] * self._volts)
        high = np.flatnonzero(volts >= campaign.SAFE_V)
        self.peak_v = float(volts[-self._last :].max())
        if high.size:
            self._safe_since(samples - 1 - int(high[-1]))
        return codes

    def now_s(self) -> float:
        """The wall clock, in lock-step without the time that the physics took."""
        return time.monotonic() - self.physics_s

    def _safe_since(self, samples: int) -> None:
        self.safe_s = self.now_s()
        self.safe_rig_s = self._hub.bench.time_s - samples / self._hub.rate_hz


def told_of(act: Callable[..., Any], note: Callable[[], None]) -> Callable[..., Any]:
    """The same; notes when a driver has said something."""

    def noted(*given: Any) -> Any:
        try:
            return act(*given)
        finally:
            note()

    return noted


@dataclass
class Bench:
    """A served twin, its cables, and the fault's stop-watch. Use as a context.

    The guardian's rig file leads to the servers of board and generator by cables of its own; the
    supply has but one port.
    """

    folder: Path
    strike: Callable[[Bench], None]
    later: bool = False  # counted from what the driver of the broken link says when it is used
    struck_s: float = -1.0
    struck_rig_s: float = 0.0
    used_s: float = -1.0
    highest_v: float = 0.0
    guardians: Guardians | None = None
    undo: list[Callable[[], object]] = field(default_factory=list)
    stopped: list[int] = field(default_factory=list)  # processes, to be continued at the end
    config: Any = None
    pace: float = 0.0

    def __enter__(self) -> Bench:
        self.folder.mkdir(parents=True, exist_ok=True)
        with contextlib.ExitStack() as opened:
            self.served = opened.enter_context(
                ServedTwin(self.config or twin_of_reading("hz"), 1, 0.0)
            )
            self.hub = self.served.hub
            self.meter = Voltmeter(self.hub)
            closing = contextlib.closing
            addresses = self.served.addresses
            self.daq = opened.enter_context(closing(links.Relay(addresses["daq"])))
            self.client = opened.enter_context(closing(links.Relay(addresses["client"])))
            port = addresses["generator"].split("::")[2]
            self.scpi = opened.enter_context(closing(links.Relay(f"127.0.0.1:{port}")))
            self.serial = opened.enter_context(closing(links.SerialCable(self._supply)))
            self.supply_says: Callable[[str], str] = self.served.supply.answer
            opened.callback(self._undo)
            self._opened = opened.pop_all()
        text = self.served.rig_file(ahead_blocks=1)
        text = text.replace(addresses["supply"], self.serial.port)
        for section, timeout_s in DRIVER_S.items():
            text = text.replace(f"[{section}]\n", f"[{section}]\ntimeout_s = {timeout_s}\n")
        (self.folder / "guardian.toml").write_text(text)
        for old, new in (
            (addresses["daq"], self.daq.address),
            (addresses["client"], self.client.address),
            (f"::{port}::", f"::{self.scpi.port}::"),
        ):
            text = text.replace(old, new)
        (self.folder / "rig.toml").write_text(text)
        return self

    def _supply(self, line: str) -> str:
        return self.supply_says(line)

    def _undo(self) -> None:
        while self.undo:
            self.undo.pop()()

    def __exit__(self, *_: object) -> None:
        for pid in self.stopped:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        self._opened.close()

    def configure(self, daq: str) -> None:
        """Other times in the table [daq] of the program's rig file; none: as they are."""
        path, usual = self.folder / "rig.toml", f"[daq]\ntimeout_s = {DRIVER_S['daq']}\n"
        if daq:
            path.write_text(path.read_text().replace(usual, f"[daq]\n{daq}"))

    def be_patient(self) -> None:
        """Let every driver wait long for a reply: a busy machine is not the fault."""
        for path in (self.folder / "rig.toml", self.folder / "guardian.toml"):
            text = path.read_text()
            for timeout_s in DRIVER_S.values():
                text = text.replace(
                    f"timeout_s = {timeout_s}\n", f"timeout_s = {PATIENT_DRIVER_S}\n"
                )
            path.write_text(text)

    def go_on(self) -> None:
        """From now on the bench's time passes by itself, as nobody may ask for readings."""
        hub, self.pace = self.hub, PACE
        with hub._lock:
            hub._pace = PACE
            hub._started = time.monotonic() - hub._total / (hub.rate_hz * PACE)
            hub._keeper = threading.Thread(target=hub._keep_pace, name="twin pace")
            hub._keeper.start()

    def now(self) -> None:
        """The fault happens."""
        self.struck_s, self.struck_rig_s = self.meter.now_s(), self.hub.bench.time_s
        self.highest_v = abs(self.hub.output_v)
        self.strike(self)

    def noted(self) -> None:
        """A driver has said something that the fault may have to do with."""
        if self.later and self.struck_s >= 0.0 and self.used_s < 0.0:
            self.used_s, self.struck_rig_s = self.meter.now_s(), self.hub.bench.time_s

    def after_s(self) -> float:
        """From the fault to below 50 V for good."""
        since_s = max(self.struck_s, self.used_s)
        rig_s = max(self.meter.safe_rig_s - self.struck_rig_s, 0.0)
        return max(self.meter.safe_s - since_s, 0.0) + (0.0 if self.pace else rig_s)

    def settled_v(self) -> float:
        """What a voltmeter shows in one more block, in V, at its highest."""
        self._undo()
        with self.hub._lock:
            self.hub._advance(self.hub.description.block_samples)
        return self.meter.peak_v

    def replace(self, owner: object, name: str, new: Callable[..., Any]) -> None:
        """From now on a part of the served bench does something else; put right at the end."""
        patch = mock.patch.object(owner, name, new)
        patch.start()
        self.undo.append(patch.stop)


class Camcorder:
    """Keeps the acquisition's clock unbroken, as every camera does; takes frames where asked."""

    def __init__(self, camera: Camera, takes: bool, noted: Callable[[], None]) -> None:
        self._camera, self._takes, self._noted = camera, takes, noted

    def start(self, *given: object, **named: object) -> None:
        try:
            self._camera.start(50.0)
        finally:
            self._noted()

    def look(self) -> None:
        if self._takes:
            try:
                self._camera.take()
            finally:
                self._noted()

    def finish(self) -> None:
        self._camera.stop()


@dataclass
class Play:
    """Arm, ramp, close the loop on a step, close.

    Args:
        folder: with rig.toml; session.h5 and guardian.log come there.
        command: of a guardian.
        at: told at each moment that is reached.
        noted: told when generator or supply are used.
        endless: the experiment that goes on until the program is ended.
        brief: without the step.
        lease_s: of the program's permission.
    """

    folder: Path
    command: tuple[str, ...]
    at: Callable[[str], None]
    noted: Callable[[], None] = lambda: None
    takes: bool = False
    endless: str = ""
    brief: bool = False
    lease_s: float = LEASE_S
    progress: Any = field(default_factory=SilentProgress)
    guardians: Guardians | None = None
    recorder: Any = None

    def run(self, shown: Any = None) -> None:
        path = self.folder / "rig.toml"
        self.at("opening")
        plans = [ExperimentPlan(name, "test", 6, {}) for name in ("ramp", "step")]
        with (
            gated_rig(load_rig(path), path) as opened,
            SessionWriter(self.folder / "session.h5", plans, 2000, {}) as session,
        ):
            assert isinstance(opened.gate, Gate)
            log = self.folder / "guardian.log"
            with Guardians(self.command, log, opened.gate.interlock) as self.guardians:
                self._guarded(opened, session, shown)

    def _guarded(self, opened: Rig, session: SessionWriter, shown: Any) -> None:
        self.recorder = campaign.Count(session, shown)
        safety = Safety(SafetySettings(lease_s=self.lease_s, idle_s=30.0), self.guardians)
        safety.record_with(lambda what: session.event(0.0, what))
        self._play(guard(self._watched(opened), safety), safety)

    def _watched(self, rig: Any) -> Rig:
        """The same rig; moments are told."""
        for instrument, names in (
            (rig.generator, ("sine", "off", "is_off")),
            (rig.supply, ("set_voltage", "read_voltage", "off", "is_off")),
        ):
            for name in names:
                setattr(instrument, name, told_of(getattr(instrument, name), self.noted))
        zero = rig.source.zero

        def zeroing() -> None:
            self.at("zeroing")
            zero()

        rig.source.zero = zeroing
        return rig

    def _play(self, rig: Any, safety: Safety) -> None:
        name, plain = "ramp", self.recorder.append_block
        blocks = 0

        def append_block(*given: Any) -> None:
            nonlocal blocks
            plain(*given)
            blocks += 1
            if blocks == STRIKE + (0 if name == "ramp" else RAMP_BLOCKS):
                self.at(f"in {name}")

        self.recorder.append_block = append_block
        camera_recorder = Camcorder(rig.camera, self.takes, self.noted)
        runner = Runner(rig, self.recorder, camera_recorder, 2000.0, 0.02, self.progress)
        self.at("before arming")
        safety.arm(safety.request())
        with runner:
            drive_v = RAMP_V if self.endless != "ramp" else np.append(RAMP_V, np.ones(100_000))
            runner.play("ramp", drive_v, 50.0, 0.25)
            if not self.brief:
                name = "step"
                steps = 100_000 if self.endless == "step" else STEP_BLOCKS
                runner.close_loop("step", np.full(steps, 0.02), campaign.LOOP, 50.0, 0.25)
            self.at("in closing")
