"""Training: the same network from the same seed, and the same numbers as the controller's."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from haselab.actuators import DeaStack, PlanarHasel
from haselab.base import InputError
from haselab.controllers import ControllerSetting, KnownActuator, Measurement
from haselab.controllers.network import (
    FEATURES,
    HIDDEN,
    NETWORK,
    Network,
    NetworkController,
    network_kind,
)
from haselab.learning import Progress, train
from haselab.learning.simulation import StrainSimulation
from haselab.learning.training import WEIGHTS, _Objective, changes
from haselab.scoreboard.devices import drawn

SMALL = {"generations": 3, "population": 8, "loops": 4, "devices": 3}


def network(seed: int) -> Network:
    return Network.from_vector(np.random.default_rng(seed).uniform(-4.5, 4.5, WEIGHTS))


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1), st.lists(st.integers(-20_000, 20_000), min_size=6, max_size=6))
def test_many_networks_at_once_answer_as_each_alone(seed: int, features: list[int]) -> None:
    networks = [network(seed), network(seed + 1)]
    rows = [np.concatenate([*each.hidden, each.output]) for each in networks]
    weights = np.array(rows, dtype=np.int32)
    seen = np.tile(np.array(features, dtype=np.int32), (2, 3, 1))
    seen[1] //= 7
    found = changes(weights, seen)
    for k, each in enumerate(networks):
        assert found[k].tolist() == [each.change(tuple(seen[k, 0].tolist()))] * 3


@given(st.integers(0, 2**32 - 1))
def test_a_network_begins_the_next_search_with_its_own_weights(seed: int) -> None:
    assert Network.from_vector(network(seed).to_vector()) == network(seed)


def test_an_error_counts_more_after_a_step_and_more_again_beyond_it() -> None:
    """Equation: reward (1 + min(k / 10, 4)) - cost * overshoot / 0.05, k updates after a step."""
    simulation = StrainSimulation("track", 2, devices=1)
    simulation.reset(np.arange(2), np.random.default_rng(1))
    simulation._reference[:] = 0.0
    simulation._reference[:, 3:] = [[0.02], [-0.02]]  # up in one loop, down in the other
    simulation.length_m[:] = 1.01 * simulation._pool.zero_m[0]  # strain 0.01 in both
    objective, rewards, found = _Objective(simulation, 4.0), np.array([-1.0, -1.0]), []
    for update in range(1, 60):
        simulation._update[:] = update
        found.append(objective.of(rewards, np.zeros(2, dtype=bool)))
    weights = np.array([1.0 + min(0.1 * k, 4.0) for k in range(57)])
    np.testing.assert_allclose(np.array(found)[2:, 0], -weights)  # below its reference
    np.testing.assert_allclose(np.array(found)[2:, 1], -weights)  # above it, from above
    simulation.length_m[:] = 1.03 * simulation._pool.zero_m[0]
    beyond = objective.of(rewards, np.array([False, True]))
    np.testing.assert_allclose(beyond, [-5.0 - 4.0 * 0.01 / 0.05, -1.0])  # broken: its reward alone


def test_the_loop_of_the_training_is_that_of_the_controller() -> None:
    """One device without noise: the controller drives the environment as the training does."""
    trained = train(**SMALL, seed=3)
    device = drawn(np.random.default_rng(3))
    rewards = []
    for through_controller in (True, False):
        simulation = StrainSimulation("gait", 1, devices=[device], episode_s=1.0)
        rng = np.random.default_rng(5)
        simulation.reset(np.zeros(1, np.int64), rng)
        controller = NetworkController(trained)
        controller.start(ControllerSetting(0.01, device.low_v, device.high_v))
        total, drive = 0.0, None
        seen = simulation.observe()[0].astype(float)
        last = now = round(1024 * seen[4])
        for _ in range(100):
            if through_controller:
                measured = Measurement(0.05 * seen[0], 1e-9, float(simulation.drive_v[0]), 0.0)
                drive_v = controller.step(0.05 * seen[3], measured)
                drive = np.array([drive_v / (0.5 * device.high_v) - 1.0])
            else:
                s = [round(1024 * x) for x in seen[:4]]
                features = (s[3] - s[0], 10 * (s[0] - s[1]), 10 * (s[1] - s[2]), s[3] >> 1,
                            now, 4 * (now - last))  # fmt: skip
                change = trained.change(features)
                last, now = now, min(max(now + (change >> 1), -1024), 1024)
                drive = np.array([now / 1024])
            reward, _, _ = simulation.step(drive, rng)
            total += float(reward[0])
            seen = simulation.observe()[0].astype(float)
        rewards.append(total)
    assert rewards[0] == pytest.approx(rewards[1], rel=1e-3)  # float32 of the strain may round


def test_a_seed_gives_the_same_network_again_and_the_search_improves() -> None:
    progress: list[Progress] = []
    first = train(**SMALL, seed=1, report=progress.append)
    assert train(**SMALL, seed=1) == first != train(**SMALL, seed=2)
    assert [each.generation for each in progress] == [1, 2, 3]
    assert all(each.best >= each.median for each in progress)


def test_a_file_gives_its_network_back_and_a_bad_one_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "network.json"
    path.write_text(json.dumps(network(1).to_dict()))
    assert Network.load(path) == network(1)
    assert network_kind("mine", network(1)).choose().make().c_text  # type: ignore[attr-defined]
    path.write_text('{"hidden": [[1, 2]], "output": [1]}')
    with pytest.raises(InputError, match=f"It must have {HIDDEN} rows of {FEATURES + 1}"):
        Network.load(path)
    for text in ("{}", "[" * 100_000):  # Python reads no list that is so deep
        path.write_text(text)
        with pytest.raises(InputError, match="No network can be read"):
            Network.load(path)
    with pytest.raises(InputError, match=r"a weight of 128\. All weights must be whole"):
        Network(((128,) * (FEATURES + 1),) * HIDDEN, (0,) * (HIDDEN + 1))
    for wrong in ("1.7", "NaN", "Infinity", "true", '"5"'):
        path.write_text(json.dumps(network(1).to_dict()).replace("[[", f"[[{wrong},", 1))
        text = path.read_text().split(", ")
        path.write_text(", ".join([text[0], *text[2:]]))
        with pytest.raises(InputError, match=r"All weights must be whole numbers .*\.json"):
            Network.load(path)


def test_a_network_keeps_to_the_drive_and_the_rate_that_it_is_trained_for() -> None:
    """On a drive of both signs, its lowest output is 0 V: below, the force would rise again."""
    planar = KnownActuator(PlanarHasel(), 0.25, 0.051, -2.0, 1.2, 5000.0)
    highest = []
    for low_v, asked in ((-2.0, -0.5), (0.0, -0.5), (0.0, 0.5)):
        controller, drive_v = NETWORK.make(), 0.6
        controller.start(ControllerSetting(0.01, low_v, 1.2, actuator=planar))
        for k in range(60):
            drive_v = controller.step(asked, Measurement(0.0, 6e-10, drive_v, 0.01 * k))
            assert 0.0 <= drive_v <= 1.2  # 1.2 is 1.2000000477 in single precision
        highest.append(drive_v)
    assert highest == [0.0, 0.0, 1.2]
    both = ControllerSetting(0.01, -2.0, 1.2, actuator=planar)
    assert NETWORK.make().c_text(both) == NETWORK.make().c_text(replace(both, drive_low=0.0))
    with pytest.raises(InputError, match=r"those of this loop last 0\.02 s"):
        NETWORK.make().start(replace(both, period_s=0.02))
    with pytest.raises(InputError, match=r"limited to -2 to 0 V\. Use another"):
        NETWORK.make().start(replace(both, drive_high=0.0))


def test_a_training_neither_uses_nor_changes_the_random_numbers_of_its_caller() -> None:
    """And what it reports is the network so far, with which an interrupted one goes on."""
    before = np.random.get_state(legacy=False)  # noqa: NPY002
    reported: list[Network] = []

    def report(progress: Progress) -> None:
        reported.append(progress.network)
        np.random.seed(7)  # noqa: NPY002

    alone = train(**SMALL, seed=1)
    after = np.random.get_state(legacy=False)  # noqa: NPY002
    np.testing.assert_equal(after, before)
    assert train(**SMALL, seed=1, report=report) == alone == reported[-1]
    shorter = {**SMALL, "generations": 2}
    assert train(**shorter, seed=1) == reported[1]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"generations": 0}, "generations is 0"),
        ({"population": 1}, "population is 1"),
        ({"loops": 2.5}, r"loops is 2\.5"),
        ({"seed": -1}, "seed is -1"),
        ({"tasks": ()}, "No tasks are given"),
        ({"start": "trained.json"}, r"start is 'trained\.json'\. State a Network; Network\.load"),
    ],
)
def test_a_training_that_cannot_be_is_refused(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        train(**{**SMALL, **options})


def test_an_actuator_that_networks_are_not_trained_on_is_refused() -> None:
    """A stack contracts where a planar HASEL elongates: the loop would be unstable."""
    stack = KnownActuator(DeaStack(), 0.2, 0.036, 0.0, 1.8, 5000.0)
    setting = ControllerSetting(0.01, 0.0, 1.8, actuator=stack)
    controller = NETWORK.make()
    assert NETWORK.design is not None
    for use in (controller.start, controller.c_text, NETWORK.design):
        with pytest.raises(InputError, match=r"planar-hasel.*but this one is a dea-stack\."):
            use(setting)


def test_without_its_extra_the_package_says_how_to_install_it() -> None:
    code = "import sys; sys.modules['gymnasium'] = None; import haselab.learning"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stderr.splitlines()[-1] == (
        "ModuleNotFoundError: haselab.learning needs gymnasium, which is not installed. "
        "Run: pip install 'haselab[learning]'"
    )
