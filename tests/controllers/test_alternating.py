"""Alternating polarity: valid sensing on the full twin, less charge, and what is refused."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from haselab.base import InputError
from haselab.controllers import CONTROLLERS, KnownActuator, Measurement
from haselab.rig.twin.twin_bench import TwinBench, describe
from haselab.runtime.lockin import lockin_of
from haselab.scoreboard import CLASSES, TASKS
from haselab.scoreboard.devices import find_device
from haselab.scoreboard.knowledge import true_actuator
from haselab.scoreboard.loop_class import CARRIER_HZ, CARRIER_V, noise_of
from haselab.scoreboard.play import play, setting_for

HOST, BIPOLAR = CLASSES["host-100hz"], find_device("bipolar")
KIND, OBSERVER = CONTROLLERS.find("alternating"), CONTROLLERS.find("observer")
FEEDBACK = {"bandwidth_rad_s": 38.5, "load_n": 0.21, "shake_m_s2": 0.01}
CHOSEN = KIND.choose(FEEDBACK)
HALF = 5  # blocks between two changes of the sign


@pytest.fixture(scope="module")
def known() -> KnownActuator:
    """The device on a drive of both signs, with the noise of the host's lock-in."""
    found = true_actuator(BIPOLAR)
    farad = float(found.law.capacitance_f(found.zero_length_m))
    return replace(found, capacitance_noise_f=noise_of(HOST, BIPOLAR.config, farad))


def drives(seen: list[Measurement], known: KnownActuator) -> list[float]:
    controller = CHOSEN.make()
    controller.start(setting_for(CHOSEN, HOST, known, seen[0].voltage_v))
    return [controller.step(0.0, measured) for measured in seen]


def test_the_magnitude_is_that_of_the_observer_and_the_sign_alternates(known):
    """A wrong length in a block with a change of the sign changes nothing."""
    start_v = known.static_drive_v(0.0)
    controller, inner = CHOSEN.make(), OBSERVER.choose(FEEDBACK).make()
    controller.start(setting_for(CHOSEN, HOST, known, start_v))
    inner.start(setting_for(CHOSEN, HOST, replace(known, low_v=0.0), start_v))
    drive_v, signs, before = start_v, [], 1.0
    for k in range(40):
        changed = drive_v * before < 0.0
        before = drive_v
        strain = 0.05 if changed else 1e-4 * math.sin(k)
        measured = Measurement(strain, math.nan, drive_v, 0.01 * k)
        drive_v = controller.step(0.0, measured)
        expected = inner.step(0.0, replace(measured, voltage_v=abs(before), valid=not changed))
        assert abs(drive_v) == expected > 0.0
        signs.append(math.copysign(1.0, drive_v))
    changes = np.flatnonzero(np.diff(signs))
    assert set(np.diff(changes)) == {HALF} and changes.size >= 6


def test_on_the_full_twin_the_blocks_between_the_changes_are_sensed_as_without_them(known):
    """From raw samples at +-8 kV: the amplifier slews through zero for a millisecond."""
    bench = TwinBench(BIPOLAR.config, 3)
    bench.sine(CARRIER_HZ, CARRIER_V)
    bench.hang(2.4 * BIPOLAR.mass_kg)
    bench.wait(20.0)
    bench.hang(BIPOLAR.mass_kg)
    bench.wait(60.0)
    bench.write(1.6)
    bench.wait(20.0)
    lockin = lockin_of(describe(BIPOLAR.config), CARRIER_HZ)
    lockin.step(bench.read())
    errors, changed, sign = [], [], 1.0
    for k in range(200):
        if k % HALF == 0:
            sign = -sign
        before_m = bench.length_m
        bench.write(sign * 1.6)
        farad = lockin.step(bench.read())[0]
        # the samples that count are the last 7.2 of 10 ms
        length_m = 0.36 * before_m + 0.64 * bench.length_m
        errors.append(known.strain(known.sensed_length_m(farad)) - known.strain(length_m))
        changed.append(k % HALF == 0)
    errors, changed = np.array(errors[2 * HALF :]), np.array(changed[2 * HALF :])
    strain = known.strain(bench.length_m)
    noise = known.length_noise_m(strain) / known.zero_length_m
    between = errors[~changed]
    # the law is an exact function of the length; motion within a block is below its noise
    assert abs(between.mean()) < 5.0 * noise / math.sqrt(between.size) + 0.5 * noise
    assert between.std() < 1.5 * noise
    assert np.abs(errors[changed]).max() > 5.0 * noise  # these are the ones that are left out


def test_after_a_hold_less_is_left_of_retained_charge_but_the_hold_is_noisier(known):
    task, scores = TASKS["T6-bipolar"], []
    for chosen in (CHOSEN, OBSERVER.choose(FEEDBACK)):
        scenario = task.scenario(known, np.random.default_rng(1))
        trace = play(scenario, chosen, HOST, known, np.random.default_rng(2))
        assert trace.failure == ""
        scores.append(task.score(trace, scenario))
    ours, observer = scores
    assert ours["error_after_return"] < 0.9 * observer["error_after_return"]
    assert ours["error"] < 3e-4  # 0.3 % of a span of 0.1
    assert observer["noise_at_rest"] < ours["noise_at_rest"] < 2.0 * observer["noise_at_rest"]


def test_a_drive_of_one_sign_or_a_slow_one_is_refused(known):
    one_sign = setting_for(CHOSEN, HOST, replace(known, low_v=0.0), 0.0)
    for act in (KIND.design, CHOSEN.make().start):
        with pytest.raises(InputError, match=r"both signs .* 0 to 2 V\. Set drive\.low_v below 0"):
            act(one_sign)
    slow = replace(setting_for(CHOSEN, HOST, known, 0.0), highest_rate_per_s=100.0)
    with pytest.raises(InputError, match=r"by up to 4 V in one update, but the rate limit .* 1 V"):
        CHOSEN.make().start(slow)
