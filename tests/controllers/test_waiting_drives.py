"""Controllers in a loop whose outputs wait: for whole blocks, or queued in the device."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from haselab.controllers import CONTROLLERS, KnownActuator, Measurement
from haselab.controllers.motion_model import MotionModel
from haselab.scoreboard import CLASSES
from haselab.scoreboard.devices import find_device
from haselab.scoreboard.knowledge import true_actuator
from haselab.scoreboard.loop_class import noise_of
from haselab.scoreboard.play import setting_for

HOST, BIPOLAR = CLASSES["host-100hz"], find_device("bipolar")
FEEDBACK = {"bandwidth_rad_s": 20.0, "load_n": 0.05, "shake_m_s2": 0.01}
CHOSEN = {
    "observer": FEEDBACK,
    "alternating": FEEDBACK,
    "learning": {**FEEDBACK, "cutoff_hz": 10.0},
    "hybrid": FEEDBACK,
    "mpc": {**FEEDBACK, "pole_rad_s": 180.0, "stage_s": 0.01},
}
LOST = {31, 32, 60}  # blocks without a measurement, whose outputs are kept


@pytest.fixture(scope="module")
def known() -> KnownActuator:
    found = true_actuator(BIPOLAR)
    farad = float(found.law.capacitance_f(found.zero_length_m))
    return replace(found, capacitance_noise_f=noise_of(HOST, BIPOLAR.config, farad))


@pytest.mark.parametrize("kind", CHOSEN)
@pytest.mark.parametrize("waiting", [0, 1, 2])
def test_the_model_in_a_controller_gets_each_drive_when_it_acts(known, kind, waiting):
    """On its own model without noise, the actuator stays on the planned step."""
    chosen = CONTROLLERS.find(kind).choose(CHOSEN[kind])
    start_v, period_s = known.static_drive_v(0.0), HOST.period_s
    setting = setting_for(chosen, HOST, known, start_v)
    setting = replace(setting, delay_s=setting.delay_s + waiting * period_s)
    late_s = HOST.delay_s
    controller, model = chosen.make(), MotionModel(known)
    controller.start(setting)
    past_v, state, strains = [start_v] * 5, model.at_rest(known.length_m(0.0), start_v), []
    for k in range(130):
        wanted = 0.05 if k >= 20 else 0.0
        sensed = Measurement(
            known.strain(state[0]), float("nan"), past_v[waiting], k * period_s,
            valid=k not in LOST, preview=(wanted,) * chosen.kind.preview_steps(period_s),
        )  # fmt: skip
        drive_v = controller.step(wanted, sensed)
        past_v = [drive_v if sensed.valid else past_v[0], *past_v[:-1]]
        state = model.moved(state, past_v[waiting + 1], late_s)
        state = model.moved(state, past_v[waiting], period_s - late_s)
        strains.append(known.strain(state[0]))
    np.testing.assert_allclose(strains[80:], 0.05, rtol=0, atol=2e-4)
    assert max(strains) < 0.052


@pytest.mark.parametrize("kind", ["observer", "mpc"])
@pytest.mark.parametrize("far", [100.0, -100.0])
def test_a_desired_strain_far_out_of_reach_is_as_one_just_beyond_the_range(known, kind, far):
    """Such as one in percent. The drive goes to the near end of its range, and back at once."""
    chosen, low_high, ends = CONTROLLERS.find(kind).choose(CHOSEN[kind]), known.reachable(), []
    for asked in (far, known.limited_strain(far)):
        controller, model = chosen.make(), MotionModel(known)
        start_v = known.static_drive_v(0.0)
        controller.start(setting_for(chosen, HOST, known, start_v))
        drive_v, state = start_v, model.at_rest(known.length_m(0.0), start_v)
        strains = []
        for k in range(120):
            wanted = asked if 10 <= k < 60 else 0.0
            drive_v = controller.step(
                wanted,
                Measurement(known.strain(state[0]), float("nan"), drive_v, 0.0,
                            preview=(wanted,) * 5),
            )  # fmt: skip
            state = model.moved(state, drive_v, HOST.period_s)
            strains.append(known.strain(state[0]))
        ends.append(strains)
    assert ends[0] == ends[1]
    middle = 0.5 * sum(low_high)
    assert (ends[0][59] > middle) == (far > 0.0)
    np.testing.assert_allclose(ends[0][100:], 0.0, rtol=0, atol=2e-3)


@pytest.mark.parametrize("rate_hz", [100, 250, 1000])
def test_no_rate_of_the_updates_lets_a_plan_move_before_a_step(known, rate_hz):
    """At 1 kHz, the 50 desired strains that are known in advance show the step long before."""
    chosen, period_s = CONTROLLERS.find("mpc").choose(CHOSEN["mpc"]), 1.0 / rate_hz
    start_v = known.static_drive_v(0.0)
    setting = replace(setting_for(chosen, HOST, known, start_v), period_s=period_s, delay_s=0.0)
    controller, model = chosen.make(), MotionModel(known)
    controller.start(replace(setting, sensed_before_s=0.0))
    ahead, state, drive_v = chosen.kind.preview_steps(period_s), [], start_v
    wanted = [0.0] * (rate_hz // 10) + [0.05] * (rate_hz // 5 + ahead)
    state = model.at_rest(known.length_m(0.0), start_v)
    strains = []
    for k in range(len(wanted) - ahead):
        preview = tuple(wanted[k + 1 : k + 1 + ahead])
        sensed = Measurement(known.strain(state[0]), float("nan"), drive_v, 0.0, preview=preview)
        drive_v = controller.step(wanted[k], sensed)
        state = model.moved(state, drive_v, period_s)
        strains.append(known.strain(state[0]))
    first = rate_hz // 10
    np.testing.assert_allclose(strains[: first - 3], 0.0, rtol=0, atol=1e-6)
    assert strains[-1] > 0.04
