"""The design of the force loop: it keeps its demands, or says which one it cannot keep."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from haselab.base import ResultError
from haselab.controllers import CONTROLLERS, ChosenController
from haselab.controllers.force import ForceDemands, design_force
from haselab.controllers.linear_loop import UNSTABLE, Demands, LinearLoop, penalty, shares_of
from haselab.scoreboard import CLASSES
from haselab.scoreboard.devices import find_device
from haselab.scoreboard.knowledge import true_actuator
from haselab.scoreboard.play import Scenario, play, setting_for
from haselab.scoreboard.tasks.task import staircase

HZ, HOST = find_device("hz"), CLASSES["host-100hz"]
ONE = np.ones(1)
# x is halved from update to update; noise adds to it and, threefold, to the drive at once
LOOP = LinearLoop(0.5 * np.ones((1, 1)), ONE, ONE, ONE, ONE, 2.0 * ONE, 3.0)


def test_the_shares_of_a_loop_of_first_order_are_those_of_its_closed_form():
    """Sums of 0.25^k: 4/3. The sensitivity 1 + 2 / (z - 0.5) is largest at z = 1."""
    found = shares_of(LOOP, 0.01, Demands(0.1, 1.0, 2.0, 1.0, 1.0))
    assert found["the noise of the length"] == pytest.approx((4.0 / 3.0) ** 0.5)
    assert found["the noise of the drive"] == pytest.approx(0.1 * (9.0 + 16.0 / 3.0) ** 0.5)
    # drives 3, 2, 1, 0.5, ...: changes 3, -1, -1, -0.5, ...
    assert found["the change of the drive by noise"] == pytest.approx(
        0.1 * (9.0 + 1.0 + 4.0 / 3.0) ** 0.5
    )
    assert found["the peak sensitivity"] == pytest.approx(2.5, rel=1e-3)


def test_the_penalty_rises_with_what_is_missed_however_much_it_is():
    """A search that begins far off must find its way back; UNSTABLE is for unstable loops."""
    found = [penalty(LOOP, 0.01, Demands(1.0, shaken, 9.0, 9.0)) for shaken in
             (4.0, 3.0, 1.0, 0.1, 1e-2, 1e-4)]  # fmt: skip
    assert found[0] == 1.0
    assert all(a < b < UNSTABLE for a, b in pairwise(found))


@pytest.mark.long
def test_a_change_of_the_load_vanishes_on_a_pouch_too():
    """The pull of a pouch changes with the voltage. 10 % more load for 1 s, with fixed gains."""
    device = find_device("peano-hasel")
    actuator = true_actuator(device)
    low, high = actuator.reachable()
    strain = low + 0.5 * (high - low)
    loads = ((-math.inf, actuator.mass_kg), (1.0, 1.1 * actuator.mass_kg))
    held = staircase(((-math.inf, strain),))
    scenario = Scenario(device, actuator.zero_length_m, 2.0, held, loads=loads)
    gains = {"kp": 33.8, "ki": 462.0, "kd": 0.23, "filter_s": 0.012, "reference_s": 0.0129}
    chosen = CONTROLLERS.find("force").choose(gains)
    trace = play(scenario, chosen, HOST, actuator, np.random.default_rng(1))
    assert trace.failure == ""
    error = np.abs(trace.strain - strain)
    largest = error[(trace.time_s > 1.0) & (trace.time_s < 1.2)].max()
    assert error[trace.time_s > 1.8].max() < 0.1 * largest


def test_demands_that_no_gains_keep_are_refused_with_the_one_that_is_missed():
    """A drive without noise cannot follow a noisy length."""
    known = replace(true_actuator(HZ), capacitance_noise_f=2e-13)
    setting = setting_for(ChosenController(CONTROLLERS.find("force"), ()), HOST, known, 0.0)
    with pytest.raises(ResultError, match=r"updates of 0\.01 s.*noise of the drive is [\d.e+]+ ti"):
        design_force(setting, ForceDemands(shaken=1e-9, slower=(0.0,)))
