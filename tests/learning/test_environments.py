"""The environments: by Gymnasium's own rules, and against the closed loop of the scoreboard."""

import copy
import pickle
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

from haselab.actuators import GRAVITY_M_S2
from haselab.base import InputError
from haselab.learning import TASKS, StrainEnv, StrainVectorEnv
from haselab.learning.simulation import StrainSimulation
from haselab.rig.twin.config import TwinConfig
from haselab.scoreboard.devices import Device, drawn, find_device
from haselab.scoreboard.loop_class import CLASSES
from haselab.scoreboard.plant import FastPlant

DEVICES = 3


@pytest.mark.parametrize("task", list(TASKS))
@pytest.mark.filterwarnings("ignore:.*render_fps.*")
def test_gymnasium_finds_and_accepts_each(task: str) -> None:
    env = gymnasium.make(f"haselab.learning:haselab/{task.capitalize()}-v0", devices=DEVICES)
    check_env(env.unwrapped, skip_render_check=False)


@pytest.mark.parametrize("task", list(TASKS))
def test_stable_baselines_accepts_each(task: str) -> None:
    reason = "stable-baselines3: pip install it"
    checker = pytest.importorskip("stable_baselines3.common.env_checker", reason=reason)
    env = gymnasium.make(f"haselab.learning:haselab/{task.capitalize()}-v0", devices=DEVICES)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        checker.check_env(env.unwrapped)


def test_the_vector_form_has_the_episodes_of_the_single_one() -> None:
    """One loop: the same numbers in both, up to the end of the episode and over it."""
    kwargs = {"devices": DEVICES, "episode_s": 0.5}
    single = StrainEnv("gait", **kwargs)
    many = gymnasium.make_vec(
        "haselab/Gait-v0", num_envs=1, vectorization_mode="vector_entry_point", **kwargs
    )
    assert many.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    first, about = single.reset(seed=5)
    others, about_all = many.reset(seed=5)
    np.testing.assert_array_equal(others[0], first)
    assert {name: about_all[name][0] for name in about} == about
    rng = np.random.default_rng(1)
    for k in range(50):
        action = rng.uniform(-1.0, 1.0, 1).astype(np.float32)
        found = single.step(action)
        observed, rewards, terminated, truncated, about_all = many.step(action[None])
        np.testing.assert_array_equal(observed[0], found[0])
        assert {name: about_all[name][0] for name in found[4]} == found[4]
        assert all(about_all[f"_{name}"].all() for name in found[4])
        assert (rewards[0], terminated[0], truncated[0]) == found[1:4]
        assert found[3] == (k == 49)
    observed, rewards, _, truncated, _ = many.step(np.zeros((1, 1), np.float32))
    assert rewards[0] == 0.0 and not truncated[0]
    assert observed[0, 4] == observed[0, 5], "a new episode, which begins at rest"


def test_the_motion_is_that_of_the_scoreboard() -> None:
    device = drawn(np.random.default_rng(3))
    simulation = StrainSimulation("track", 2, devices=[device], episode_s=1.0)
    simulation.reset(np.arange(2), np.random.default_rng(0))
    loop = CLASSES["host-100hz"]
    plant = FastPlant(device, loop, np.random.default_rng(0), 200)
    plant.train()
    plant.hold(0.0, 0.0)
    plant.hold(device.zero_v, 60.0)
    rng = np.random.default_rng(2)
    for _ in range(90):
        actions = rng.uniform(-1.0, 0.6, 2)
        simulation.step(actions, rng)
        plant.update(float(device.high_v * 0.5 * (actions[0] + 1.0)))
        assert simulation.length_m[0] == plant.true_lengths_m[-1]
    assert simulation.length_m[0] != simulation.length_m[1]


def test_devices_of_other_masses_and_voltages_move_as_they_do_alone() -> None:
    """Also in the slot that another device has left."""
    heavy = find_device("hz").config.model_dump(exclude={"origin"})
    heavy["load"]["mass_kg"] = 0.3
    devices = [
        replace(drawn(np.random.default_rng(3)), low_v=0.2, high_v=1.6, zero_v=0.9),
        TwinConfig(**heavy),
    ]
    together = StrainSimulation("hold", 6, devices=devices, episode_s=1.0)
    for seed in (0, 1):  # other devices in each slot
        together.reset(np.arange(6), np.random.default_rng(seed))
        chosen = together._device.copy()
        assert set(chosen) == {0, 1}
        pulls = together._pull_n.copy()
        alone = []
        for slot in range(6):
            one = StrainSimulation("hold", 1, devices=[devices[chosen[slot]]], episode_s=1.0)
            one.reset(np.zeros(1, np.int64), np.random.default_rng(9))
            one._pull_n[0] = pulls[slot]
            alone.append(one)
        rng = np.random.default_rng(2)
        for _ in range(30):
            actions = rng.uniform(-1.0, 0.6, 6)
            together.step(actions, rng)
            for slot, one in enumerate(alone):
                one.step(actions[[slot]], rng)
                assert one.length_m[0] == together.length_m[slot]
                assert one.drive_v[0] == together.drive_v[slot]
    assert together._load_n[chosen == 1][0] == pytest.approx(0.3 * GRAVITY_M_S2)


def test_the_sensed_strain_has_the_noise_of_the_monitors_and_an_error_of_the_map() -> None:
    simulation = StrainSimulation("track", 2000, devices=[drawn(np.random.default_rng(3))])
    rng = np.random.default_rng(0)
    simulation.reset(np.arange(2000), rng)
    sensed = 0.05 * simulation.observe()[:, 0].astype(float)
    device = drawn(np.random.default_rng(3))
    relative = simulation._pool.relative_noise[0]
    # d strain / d ln C is 1 / 3.33 by the nominal map.
    assert sensed.std() == pytest.approx(relative / 3.33, rel=0.1)
    assert abs(sensed.mean()) < 4.0 * relative / 3.33 / np.sqrt(2000) + 1e-4
    high = np.full(2000, 0.6)
    for _ in range(200):
        simulation.step(high, rng)
    off = 0.05 * simulation.observe()[:, 0].mean() - simulation.strain.mean()
    assert 1e-4 < abs(off) < 0.1, f"exponent {device.config.dielectric.capacitance_exponent}"


def test_a_pull_in_hold_elongates_by_the_compliance() -> None:
    simulation = StrainSimulation("hold", 1, devices=[drawn(np.random.default_rng(3))])
    rng = np.random.default_rng(0)
    simulation.reset(np.zeros(1, np.int64), rng)
    rest = float(simulation.length_m[0])
    simulation._pull_n[:] = 0.05 * GRAVITY_M_S2
    pool = simulation._pool
    at_rest = (pool.zero_v - pool.middle_v) / pool.scale_v
    for _ in range(400):
        simulation.step(at_rest, rng)
    assert float(simulation.length_m[0]) - rest > 1e-4


def test_an_episode_depends_on_the_seed_alone() -> None:
    envs = StrainVectorEnv(8, "hold", devices=DEVICES)

    def play(seed: int) -> np.ndarray:
        envs.reset(seed=seed)
        rng = np.random.default_rng(4)
        return np.stack([envs.step(rng.uniform(-1, 1, (8, 1)).astype(np.float32))[0]
                         for _ in range(30)])  # fmt: skip

    first = play(1)
    assert not np.array_equal(play(2), first)
    np.testing.assert_array_equal(play(1), first)


def test_a_device_that_breaks_down_within_the_range_of_the_references_is_refused() -> None:
    """Its reach would be that of a broken device."""
    thin = find_device("hz").config.model_dump(exclude={"origin"})
    thin["shell"]["thickness_m"] = 0.8e-3
    devices = [find_device("hz"), TwinConfig(**thin)]
    with pytest.raises(InputError, match=r"^Device 1 breaks down.* at a drive of 1\.7 V"):
        StrainEnv("track", devices=devices)


def changed(section: str, **values: float) -> TwinConfig:
    data = find_device("hz").config.model_dump(exclude={"origin"})
    return TwinConfig(**{**data, section: {**data[section], **values}})


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            changed("load", mass_kg=15.0),
            r"^Device 1 leaves the lengths in which its law is valid while it settles, at a drive "
            r"of 0 V under \d[.\d]* kg\.",
        ),
        (
            changed("dielectric", breakdown_v_per_m=1e6),
            r"^Device 1 breaks down while it settles, at a drive of 1\.04 V under 0\.25 kg\.",
        ),
        (
            changed("load", mass_kg=1e-6),
            r"^Device 1 moves too fast .* 1e-06 kg.* 1\.85e\+06 rad/s, above the limit of 10000",
        ),
        (
            changed("hysteresis", force_n=900.0, width=1.1e-4),
            "^Device 1 moves too fast to be simulated",
        ),
        (
            replace(find_device("hz"), late_s=0.009),
            r"^Device 1 has an output delay of 11 ms\.",
        ),
    ],
)
def test_a_device_that_cannot_be_simulated_is_refused_with_the_reason(
    wrong: object, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        StrainEnv("track", devices=[find_device("hz"), wrong])


def episode(device: TwinConfig | Device) -> tuple[np.ndarray, np.ndarray]:
    """True strains and observations while the drive changes."""
    env = StrainEnv("track", devices=[device])
    env.reset(seed=1)
    steps = [env.step(np.array([np.sin(k / 6.0)], np.float32)) for k in range(60)]
    return np.array([one[4]["strain"] for one in steps]), np.array([one[0] for one in steps])


def test_keys_of_a_device_have_an_effect_or_a_warning_names_them() -> None:
    public = find_device("hz").config
    strain, seen = episode(public)
    changes = {
        "amplifier": {
            "gain": 5100.0, "gain_error": 0.01, "bandwidth_hz": 5000.0, "damping_ratio": 0.7,
            "slew_v_per_s": 1e8, "current_limit_a": 0.01, "stray_f": 1e-9,
            "volt_per_monitor_volt": 4000.0, "ampere_per_monitor_volt": 1e-3,
            "v_monitor_gain_error": 0.01, "i_monitor_gain_error": 0.01, "v_monitor_lag_s": 1e-5,
            "i_monitor_lag_s": 1e-5, "v_monitor_offset_v": 0.01, "i_monitor_offset_v": 0.01,
        },
        "acquisition": {
            "rate_hz": 100e3, "block_samples": 4000, "bits": 12, "range_v": 5.0, "skew_s": 0.0,
            "v_noise_v": 1e-3, "i_noise_v": 1e-3, "output_delay_s": 4e-3, "drive_low_v": -1.0,
            "drive_high_v": 1.8,
        },
        "dielectric": {"series_ohm": 6e3, "leakage_ohm": 1e10},
        "camera": {"rate_hz": 300.0, "exposure_s": 5e-4},
    }  # fmt: skip
    for section in ("amplifier", "acquisition"):
        assert changes[section].keys() == type(getattr(public, section)).model_fields.keys() - {
            "name"
        }
    without = []
    for section, values in changes.items():
        for key, value in values.items():
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                found = episode(changed(section, **{key: value}))[1]
            name = "camera" if section == "camera" else f"{section}.{key}"
            expected = [f"The environments ignore {name} of the devices, so these values have no "
                        "effect."]  # fmt: skip
            alike = np.array_equal(found, seen)
            assert [str(one.message) for one in caught] == (expected if alike else []), key
            without += [key] if alike else []
    assert "stray_f" in without and "skew_s" in without and "output_delay_s" not in without
    # the rate of the converter changes the noise, and not the motion
    np.testing.assert_array_equal(episode(changed("acquisition", rate_hz=100e3))[0], strain)


def test_the_output_delay_of_a_device_delays_its_motion() -> None:
    """Whole updates later or earlier are other actions, so 10 ms more is one action before."""
    public = find_device("hz")
    none, usual = (episode(changed("acquisition", output_delay_s=s))[0] for s in (0.0, 0.002))
    whole = episode(replace(public, late_s=0.008))[0]
    np.testing.assert_array_equal(usual, episode(public)[0])
    assert np.abs(none - usual).max() > 1e-4
    np.testing.assert_allclose(whole[1:], none[:-1], atol=1e-6)


@pytest.mark.parametrize("task", list(TASKS))
def test_the_information_of_a_step_gives_its_reward_exactly(task: str) -> None:
    """With the formula of docs/control/learning.md; the drive goes from 0 to 2 V."""
    env, envs = StrainEnv(task, devices=DEVICES), StrainVectorEnv(4, task, devices=DEVICES)
    _, before = env.reset(seed=3)
    _, all_before = envs.reset(seed=3)
    rng = np.random.default_rng(2)
    for _ in range(300):
        action = rng.uniform(-1.0, 1.0, (4, 1)).astype(np.float32)
        seen, reward, _, _, about = env.step(action[0])
        change = about["drive_v"] - before["drive_v"]
        error = abs(about["strain"] - about["reference"])
        assert reward == -error / 0.05 - 0.05 * (change * change)  # pow may round another way
        _, rewards, _, _, all_about = envs.step(action)
        changes = all_about["drive_v"] - all_before["drive_v"]
        errors = np.abs(all_about["strain"] - all_about["reference"])
        np.testing.assert_array_equal(rewards, -errors / 0.05 - 0.05 * changes**2)
        before, all_before = about, all_about
    # the observation has the reference of the next update
    assert seen[3] == np.float32(env._simulation.reference[0] / 0.05)


@pytest.mark.parametrize("task", ["track", "hold"])
def test_long_episodes_change_until_their_end_and_short_ones_are_as_before(task: str) -> None:
    """A value is held for 2 s at most."""
    time_s = 0.01 * np.arange(1.0, 60002.0)
    for seed in range(6):
        long, short = (
            TASKS[task].draw(np.random.default_rng(seed), part)
            for part in (time_s, time_s[:501])
        )  # fmt: skip
        changing = long[0] if task == "track" else long[1]
        gaps = np.diff(np.flatnonzero(np.diff(changing)), append=time_s.size)
        assert gaps.max() <= 201
        for whole, begin in zip(long, short, strict=True):
            if task == "track":
                np.testing.assert_array_equal(whole[:501], begin)
    level, pulls = TASKS["hold"].draw(np.random.default_rng(5), time_s[:501])
    drawn_alike = np.random.default_rng(5)
    edges = np.cumsum(drawn_alike.uniform(0.4, 2.0, 64))
    values = drawn_alike.uniform(-0.05, 0.05, 65)
    values[0] = 0.0
    np.testing.assert_array_equal(pulls, values[np.searchsorted(edges, time_s[:501])])
    assert level[0] == drawn_alike.uniform(0.3, 0.7)


def test_a_breakdown_ends_the_episode_and_costs_100() -> None:
    weak = drawn(np.random.default_rng(3))
    data = weak.config.model_dump(exclude={"origin"})
    data["dielectric"]["breakdown_v_per_m"] = 30e6
    device = type(weak)(**{**weak.__dict__, "config": type(weak.config)(**data)})
    env = StrainEnv("track", devices=[device])
    env.reset(seed=1)
    for _ in range(100):
        _, reward, terminated, truncated, _ = env.step(np.ones(1, np.float32))
        if terminated:
            break
    assert terminated and not truncated and reward == -100.0


def test_references_are_what_the_device_reaches_without_breaking_down() -> None:
    """With the drive that is known to reach the level, the strain gets there."""
    simulation = StrainSimulation("hold", 200, devices=40)
    simulation.reset(np.arange(200), np.random.default_rng(0))
    low, high = (ends[simulation._device] for ends in simulation._reach)
    assert (low < 0.0).all() and (high - low > 0.03).all()
    assert (simulation.reference > low).all() and (simulation.reference < high).all()
    simulation._pull_n[:] = 0.0
    rng = np.random.default_rng(0)
    for _ in range(200):
        _, terminated, _ = simulation.step(np.full(200, 0.7), rng)  # 0.85 of the range
        assert not terminated.any()
    np.testing.assert_allclose(simulation.strain, high, atol=2e-3)


def test_a_frame_shows_the_actuator_of_the_camera() -> None:
    env = StrainEnv("track", devices=1, render_mode="rgb_array")
    env.reset(seed=1)
    frame = env.render()
    assert frame is not None and frame.ndim == 3 and frame.dtype == np.uint8
    assert frame.std() > 5.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "walk"}, "No task 'walk'. The tasks are track, hold, gait."),
        ({"devices": 0}, "The number of devices is 0. State a whole number from 1 to"),
        ({"devices": []}, "No devices are given."),
        ({"episode_s": 0.0}, "The episode lasts 0.0 s. State 0.1 to 3600 s."),
        ({"devices": [5]}, "The devices contain 5."),
        ({"devices": [find_device("peano-hasel")]}, "The devices contain a peano-hasel."),
        ({"render_mode": "human"}, "render_mode is 'human'. Use None or 'rgb_array'."),
    ],
)
def test_bad_arguments_are_refused_in_one_line(options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match="^" + message.replace("[", r"\[").split("(")[0]):
        StrainEnv(**{"task": "track", **options})


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.array([np.nan]), "An action is nan"),
        (np.array([-np.inf]), "An action is -inf"),
        (np.zeros(2), r"an array of shape \(2,\).*State 1 number"),
        (None, "The action is None"),
    ],
)
def test_an_action_that_is_none_is_refused(action: object, message: str) -> None:
    """Before, a NaN counted as a breakdown of the device, and the observation was NaN."""
    env = StrainEnv("track", devices=1)
    env.reset(seed=1)
    with pytest.raises(InputError, match=message):
        env.step(action)  # type: ignore[arg-type]
    assert np.isfinite(env.step(np.ones(1, np.float32))[0]).all()


def test_a_step_outside_of_an_episode_is_refused() -> None:
    env, action = StrainEnv("track", devices=1, episode_s=0.1), np.zeros(1, np.float32)
    for begun in (env, StrainVectorEnv(1, "track", devices=1)):
        with pytest.raises(InputError, match="has not begun"):
            begun.step(action)
    with pytest.raises(InputError, match="has not begun"):
        StrainEnv("track", devices=1, render_mode="rgb_array").render()
    env.reset(seed=1)
    while not env.step(action)[3]:
        pass
    with pytest.raises(InputError, match="is over"):
        env.step(action)


def test_seeds_of_numpy_are_seeds_and_none_is_random() -> None:
    envs = StrainVectorEnv(2, "track", devices=1)

    def first(seed: object) -> list[float]:
        return envs.reset(seed=seed)[0][:, 0].tolist()

    assert first(np.int64(5)) == first(5)
    assert first([None, None]) != first([None, None])
    assert first(np.array(5)) == first(np.array([5])) == first([5])
    single = StrainEnv("track", devices=1)
    assert single.reset(seed=np.int64(5))[0].tolist() == single.reset(seed=5)[0].tolist()
    for wrong in (-1, 1.5, True, "1"):
        with pytest.raises(InputError, match="The seed is"):
            single.reset(seed=wrong)  # type: ignore[arg-type]
    for wrong in (-1, 1.5, True, [1, "a"]):
        with pytest.raises(InputError, match="The seed is"):
            first(wrong)
    with pytest.raises(InputError, match="The options are 5"):
        envs.reset(options=5)


@pytest.mark.parametrize("shape", [(1, 4), (2, 2), (4, 2), (5,)])
def test_actions_of_another_shape_are_refused(shape: tuple[int, ...]) -> None:
    envs = StrainVectorEnv(4, "track", devices=1)
    envs.reset(seed=1)
    with pytest.raises(InputError, match="State 4 numbers from -1 to 1"):
        envs.step(np.zeros(shape, np.float32))
    assert envs.step(np.zeros(4, np.float32))[0].shape == (4, 6)


def test_copies_and_pictures_of_many_are_refused_with_the_remedy() -> None:
    env = StrainEnv("track", devices=1)
    for copied in (copy.copy, copy.deepcopy, pickle.dumps):
        for one in (env, StrainVectorEnv(2, "track", devices=1)):
            with pytest.raises(TypeError, match="Give each process a function that makes one"):
                copied(one)
    with pytest.raises(InputError, match="Leave out render_mode"):
        StrainVectorEnv(2, "track", devices=1, render_mode="rgb_array")


def test_two_processes_play_the_episodes_of_this_one() -> None:
    """With spawn, as on every system; the two environments have the seeds 5 and 6."""
    envs = gymnasium.make_vec(
        "haselab.learning:haselab/Hold-v0", 2, vectorization_mode="async", devices=1,
        vector_kwargs={"context": "spawn"},
    )  # fmt: skip
    try:
        found = [envs.reset(seed=5)[0], envs.step(np.full((2, 1), 0.5, np.float32))[0]]
    finally:
        envs.close()
    for k in range(2):
        env = StrainEnv("hold", devices=1)
        np.testing.assert_array_equal(found[0][k], env.reset(seed=5 + k)[0])
        np.testing.assert_array_equal(found[1][k], env.step(np.full(1, 0.5, np.float32))[0])


def test_the_mask_of_a_reset_says_which_episodes_begin() -> None:
    envs, action = StrainVectorEnv(3, "hold", devices=1), np.ones((3, 1), np.float32)
    envs.reset(seed=1)
    moved = envs.step(action)[0]
    found, _ = envs.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(found[[0, 2]], moved[[0, 2]])
    assert found[1, 4] < 1.0  # the drive of strain 0 again
    for wrong in ([True, False], [1], np.ones((3, 1), dtype=bool)):
        with pytest.raises(InputError, match="State 3 values of True or False"):
            envs.reset(options={"reset_mask": wrong})
