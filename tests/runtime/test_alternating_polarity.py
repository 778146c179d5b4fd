"""`alternating` on a whole bench: watchdog, sensing from raw samples, camera as the oracle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import curve_fit

from haselab.base import SafetyError, SilentProgress
from haselab.control import Saturation
from haselab.controllers import CONTROLLERS
from haselab.models.actuator.strain_map import StrainMap
from haselab.models.maps import VoltageMap
from haselab.rig.twin.twin_bench import TwinBench, rig_of
from haselab.runtime.camera_recorder import CameraRecorder
from haselab.runtime.loop import LoopSettings
from haselab.runtime.runner import Runner
from haselab.safety.guarded import guard
from haselab.safety.state_machine import Safety, SafetySettings
from haselab.safety.watchdog.settings import WatchdogSettings
from haselab.scoreboard import CLASSES
from haselab.scoreboard.devices import find_device
from haselab.scoreboard.knowledge import true_actuator
from haselab.scoreboard.loop_class import noise_of
from haselab.store.session.writer import ExperimentPlan, SessionWriter

BIPOLAR = find_device("bipolar")
FEEDBACK = {"bandwidth_rad_s": 20.0, "load_n": 0.05, "shake_m_s2": 0.01}
STEP, REST, LOOP = 0.06, 60, 150


def loop_settings() -> LoopSettings:
    """Maps of the device, and the controller with the actuator as it is."""
    known = true_actuator(BIPOLAR)
    strain = np.linspace(-0.02, 0.15, 30)
    farad = known.law.capacitance_f(np.array([known.length_m(e) for e in strain]))
    volts = [known.static_drive_v(float(e)) for e in strain]
    start = (1.5, 1.0, -0.5, -14.0)
    eq4, _ = curve_fit(lambda e, *p: VoltageMap(*p).voltage_v(e), strain, volts, p0=start)
    cubic, curved, slope, offset = np.polyfit(farad, strain, 3)
    to_strain = StrainMap(slope, offset, curved, cubic, range_f=(farad.min(), farad.max()))
    noise_f = noise_of(CLASSES["host-100hz"], BIPOLAR.config, float(np.median(farad)))
    return LoopSettings(
        CONTROLLERS.find("alternating").choose(FEEDBACK), Saturation(-0.02, 0.15),
        VoltageMap(*map(float, eq4)), to_strain,
        actuator=replace(known, capacitance_noise_f=noise_f),
    )  # fmt: skip


def played(folder, charges_per_s: float):
    """The twin and the session of a run: at rest, then a step in a closed loop."""
    twin = TwinBench(BIPOLAR.config, 5)
    limits = SafetySettings(loop=WatchdogSettings(charges_per_s=charges_per_s))
    rig = guard(rig_of(twin, BIPOLAR.config), Safety(limits))
    rig.safety.arm(rig.safety.request())
    plans = [ExperimentPlan(name, "test", 6, {}) for name in ("rest", "loop")]
    session = SessionWriter(folder / "s.h5", plans, rig.description.block_samples, {})
    recorder = CameraRecorder(rig.camera, session, folder / "video", "none")
    reference = np.where(np.arange(LOOP) < 50, 0.0, STEP)
    loop = loop_settings()
    with Runner(rig, session, recorder, 2000.0, 0.02, SilentProgress()) as runner:
        rest_v = float(loop.voltage_map.voltage_v(0.0))
        runner.play("rest", np.full(REST, rest_v), 50.0, BIPOLAR.mass_kg)
        runner.close_loop("loop", reference, loop, 50.0, BIPOLAR.mass_kg)
    return twin, session


def length_px(session, name: str) -> np.ndarray:
    rows = session.experiment(name).tracks["y_px"]
    return rows[:, 3:].mean(axis=1) - rows[:, :3].mean(axis=1)


def test_a_step_with_alternating_polarity_is_played_on_the_bench(tmp_path):
    twin, session = played(tmp_path, 90.0)
    drive_v, seen = session.experiment("loop").drive_v, length_px(session, "loop")
    changes = np.flatnonzero(np.diff(np.sign(drive_v[5:])))
    assert set(np.diff(changes)) == {5} and changes.size > 20  # 0.05 s at 100 Hz
    # The strain of the last 0.2 s from that before the step, so that no map enters. The bench
    # starts at rest without a load before it, so 0.5 % of creep are still to come.
    grown = seen[-10:].mean() / seen[15:25].mean() - 1.0
    assert grown == pytest.approx(STEP, abs=0.005)
    assert twin.output_v == 0.0


def test_its_charging_needs_the_permission_of_the_rig_file(tmp_path):
    with pytest.raises(SafetyError, match=r"too often: .* Raise charges_per_s .* commanded to 0 V"):
        played(tmp_path, WatchdogSettings().charges_per_s)
