"""What the built-in kinds of cases compute, compared with other ways to the same numbers."""

from __future__ import annotations

import json
import math
import random
import re
from collections.abc import Iterable
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from haselab.actuators import GRAVITY_M_S2
from haselab.base import HaselabError, InputError
from haselab.base.registry import Registry
from haselab.campaign.kinds.case_kind import CASE_KINDS, CaseKind, Inputs
from haselab.campaign.kinds.geometry import GEOMETRY, GeometrySettings
from haselab.campaign.work import compute_cases
from haselab.rig.twin.config import twin_of_reading
from haselab.scoreboard.devices import find_device
from haselab.scoreboard.plant import fast_bench

HZ = {"twin": twin_of_reading("hz").model_dump(mode="json")}


def computed(plan: Any) -> list[Any]:
    hashes = plan.hashes()
    rows = compute_cases(plan.problem, [plan.job(k, hashes[k]) for k in range(plan.count)])
    assert not any(row.error for row in rows), rows[0].traceback
    return rows


def test_the_intervals_of_quick_devices_contain_the_truth_in_95_percent(campaigns: Any) -> None:
    """Of 200 devices, within four standard deviations of the share."""
    text = campaigns.quick.replace("[0.01, 0.02]", "[0.02]").replace('"sobol"', '"random"')
    rows = computed(campaigns.plan(text.replace("samples = 8", "samples = 200")))
    spread = 4.0 * math.sqrt(0.95 * 0.05 / 200.0)
    for name in ("gain", "natural_frequency_rad_s", "damping_ratio", "delay_s"):
        found = [(row.results[f"{name}.low"], row.results[f"{name}.true"],
                  row.results[f"{name}.high"]) for row in rows]  # fmt: skip
        share = np.mean([low <= true <= high for low, true, high in found])
        assert abs(share - 0.95) < spread, name


def test_a_geometry_has_stroke_force_and_field_of_its_energy() -> None:
    """At the stroke's ends the total energy is least; the force is a difference of energies."""
    inputs = Inputs({**HZ, "case": GeometrySettings().model_dump()})
    found = GEOMETRY.compute(inputs, np.random.default_rng(0))
    law, load_n = twin_of_reading("hz").law, GRAVITY_M_S2 * 0.25
    lengths_m = np.linspace(0.04, 0.08, 40_001)  # 1 um apart
    elastic_j = np.array(law.elastic_energy_j(lengths_m))
    softened = law.losses.softening(np.maximum.accumulate(lengths_m) / law.free_length_m)
    ends = []
    for voltage_v in (0.0, 8000.0):
        force_n = load_n - np.gradient(elastic_j, lengths_m) * softened
        if voltage_v:
            force_n = force_n + np.gradient(law.coenergy_j(lengths_m, voltage_v), lengths_m)
        ends.append(lengths_m[np.flatnonzero(force_n > 0.0)[-1]])
    assert found["stroke_m"] == pytest.approx(ends[1] - ends[0], abs=3e-6)
    step = 1e-5
    pull_j = law.coenergy_j(ends[0] + step * np.array([-1.0, 1.0]), 8000.0)
    assert found["blocked_force_n"] == pytest.approx((pull_j[1] - pull_j[0]) / (2 * step), rel=1e-3)
    assert found["peak_field_v_per_m"] == pytest.approx(8000.0 / law.gap_m(ends[1]), rel=1e-3)


def test_the_bandwidth_is_where_the_sampled_model_has_fallen_by_3_db() -> None:
    from haselab.actuators import linearise

    found = GEOMETRY.compute(
        Inputs({**HZ, "case": GeometrySettings().model_dump()}), np.random.default_rng(0)
    )
    point = linearise(twin_of_reading("hz").law, 5600.0, GRAVITY_M_S2 * 0.25, 0.25)
    at_hz = float(found["bandwidth_hz"])
    # the phasor of a sine that is held between 2000 steps of a period, exact by the exponential
    period_s, count = 1.0 / at_hz / 2000.0, 2000
    step = expm(np.block([[point.a, point.b[:, None]], [np.zeros((1, 6))]]) * period_s)
    shift = np.exp(2j * np.pi / count)
    held = np.sinc(1.0 / count) * np.exp(-1j * np.pi / count)  # of an input held between steps
    state = np.linalg.solve(shift * np.eye(5) - step[:5, :5], step[:5, 5] / held)
    gain = abs(point.c @ state) / abs(point.gain_m_per_v)
    assert gain == pytest.approx(math.sqrt(0.5), rel=1e-3)
    assert 0.5 < float(found["resonance_hz"]) / at_hz < 1.0


@pytest.mark.parametrize(
    ("voltage_v", "message"), [(20_000.0, "no equilibrium"), (11_000.0, "breaks down at 4e.07")]
)
def test_a_geometry_that_cannot_work_has_no_results(voltage_v: float, message: str) -> None:
    case = GeometrySettings(voltage_v=voltage_v).model_dump()
    with pytest.raises(HaselabError, match=message):
        GEOMETRY.compute(Inputs({**HZ, "case": case}), np.random.default_rng(0))


CONTROLLER = """
name = "a"
kind = "controller"
[base]
twin = "hz"
[case]
task = "T3"
controller = "{}"
[parameters]
twin.shell.shear_modulus_pa = [15600.0, 17000.0]
"""


@pytest.mark.long
def test_a_controller_plays_its_task_on_the_device_of_the_case(
    campaigns: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On the public device it has the scores of the scoreboard; on a stiffer one others."""
    from haselab.campaign.kinds import controller as kind
    from haselab.controllers import CONTROLLERS, ChosenController
    from haselab.scoreboard import CLASSES, TASKS
    from haselab.scoreboard.board import known_in_class
    from haselab.scoreboard.entrants import PAPER_PI
    from haselab.scoreboard.knowledge import true_actuator
    from haselab.scoreboard.play import play

    public = find_device("hz")
    monkeypatch.setattr(kind, "_known", lambda name: true_actuator(find_device(name)))
    kind._design.cache_clear()
    nominal, stiffer = computed(campaigns.plan(CONTROLLER.format("pi")))
    kind._design.cache_clear()
    loop, rng = CLASSES["host-100hz"], np.random.default_rng(np.random.SeedSequence(
        0, spawn_key=(0, 0, 0)))  # fmt: skip
    known = known_in_class(true_actuator(public), public, loop)
    scenario = TASKS["T3"].scenario(known, rng)
    chosen = ChosenController(CONTROLLERS.find("pi"), tuple(PAPER_PI.items()))
    score = TASKS["T3"].score(play(scenario, chosen, loop, known, rng), scenario)
    for name, value in score.items():
        assert nominal.results[name] == value
        assert stiffer.results[name] != value
    assert nominal.results["violates"] == 0.0


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"T3"', '"T99"', "case.task is 'T99', but must be one of T1"),
        ('"T3"', '"T7-drawn"', "draws its own devices"),
        ('"T3"', '"T8-peano"', "played on a peano-hasel"),
        ('"pi"', '"nobody"', "No controller 'nobody'"),
        ('"pi"', '"chip-force"', "does not play T3 in the loop host-100hz"),
        ("[case]", '[case]\nloop = "fast"', "case.loop is 'fast', but must be one of host-100hz"),
    ],
)
def test_a_task_that_the_campaign_cannot_play_is_refused(
    campaigns: Any, old: str, new: str, message: str
) -> None:
    with pytest.raises(InputError, match=message):
        campaigns.plan(CONTROLLER.format("pi").replace(old, new))


STUDY = """
name = "one triangle"
[triangle]
low_v = 0.0
high_v = 2.0
frequency_hz = 0.25
cycles = 3
skipped_cycles = 1
frame_rate_hz = 50.0
"""
PLAY = """
name = "a"
kind = "play"
[base]
twin = "hz"
study = "one.toml"
[case]
results = ["S14.a1", "S15.slope"]
[parameters]
study.triangle.high_v = [1.8]
"""


@pytest.mark.long
def test_a_played_study_gives_the_chosen_results_with_their_intervals(campaigns: Any) -> None:
    (campaigns.folder / "one.toml").write_text(STUDY)
    plan = campaigns.plan(PLAY)
    (row,) = computed(plan)
    names = {f"{name}{end}" for name in ("S14.a1", "S15.slope")
             for end in ("", ".std", ".low", ".high")}  # fmt: skip
    assert set(row.results) == names
    for name in ("S14.a1", "S15.slope"):
        assert row.results[f"{name}.low"] < row.results[name] < row.results[f"{name}.high"]


@pytest.mark.long
def test_the_truth_of_a_played_study_is_its_result_without_noise(campaigns: Any) -> None:
    """The same at any noise, near each estimate, and another one at another amplitude."""
    (campaigns.folder / "one.toml").write_text(STUDY)
    text = PLAY.replace("[case]", "[case]\nnoise_free = true")
    noisy = "study.triangle.high_v = [1.8, 1.9]\ntwin.acquisition.i_noise_v = [0.3e-3, 1e-3]"
    rows = computed(campaigns.plan(text.replace("study.triangle.high_v = [1.8]", noisy)))
    name = "S15.slope"
    true = [row.results[f"{name}.true"] for row in rows]
    assert true[0] == pytest.approx(true[1], rel=1e-6)
    assert true[2] == pytest.approx(true[3], rel=1e-6)
    assert true[0] != true[2]
    for row in rows:
        off = row.results[name] - row.results[f"{name}.true"]
        assert 0.0 < abs(off) < 5.0 * row.results[f"{name}.std"]


def _change_numbers(table: dict[str, Any], keys: Iterable[str]) -> int:
    """Change the numbers of a table in place; return how many."""
    count = 0
    for key in keys:
        first, _, rest = key.partition(".")
        value = table.get(first)
        if isinstance(value, dict):
            count += _change_numbers(value, [rest] if rest else value)
        elif isinstance(value, int | float) and not isinstance(value, bool):
            lowest = -1.0 if first == "drive_low_v" else 1e-9
            table[first] = type(value)(0.8 * value) or lowest
            count += 1
    return count


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "case", "device"),
    [
        ("geometry", {}, "hz"),
        ("geometry", {}, "dea-stack"),
        ("controller", {}, "hz"),
        ("controller", {"loop": "chip-1khz"}, "hz"),
        ("controller", {"task": "T8-stack"}, "dea-stack"),
    ],
)
def test_what_a_kind_ignores_changes_no_result(name: str, case: Any, device: str) -> None:
    kind = CASE_KINDS.find(name)
    config = find_device(device).config.model_dump(mode="json", exclude={"origin"})
    inputs = Inputs({"case": {**kind.settings().model_dump(), **case}, "twin": config})
    if device == "dea-stack":
        config["actuator"] = {"series_ohm": 1e5, "leakage_ohm": 1e10}
    changed = json.loads(json.dumps(inputs.tables))
    ignored = [*kind.ignored, *kind.ignored_by(inputs)]
    if device == "dea-stack":  # which has no tables of a planar HASEL
        ignored = [key for key in ignored if not re.match(r"twin\.(dielectric|unmodelled)", key)]
    assert _change_numbers(changed, ignored) > 10
    public, found = (
        dict(kind.compute(one, np.random.default_rng(1))) for one in (inputs, Inputs(changed))
    )
    assert found == public


def test_a_controller_of_the_chip_has_the_noise_of_the_chip() -> None:
    kind = CASE_KINDS.find("controller")
    host, chip = (
        Inputs({"case": {**kind.settings().model_dump(), "loop": loop}, **HZ})
        for loop in ("host-100hz", "chip-1khz")
    )
    assert "twin.acquisition.bits" in kind.ignored_by(chip) and kind.ignored_by(host) == ()


def test_a_controller_that_draws_from_the_global_generators_is_reproducible(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from haselab.campaign.kinds import controller as kind
    from haselab.scoreboard.knowledge import true_actuator

    drawn = []

    class PlayedError(Exception):
        pass

    def play(*_: Any) -> None:
        drawn.append((random.random(), np.random.random()))  # noqa: NPY002
        raise PlayedError

    monkeypatch.setattr(kind, "_known", lambda name: true_actuator(find_device(name)))
    monkeypatch.setattr(kind, "play", play)
    inputs = Inputs({"case": kind.CONTROLLER.settings().model_dump(), **HZ})
    for seed in (1, 1, 2):
        with pytest.raises(PlayedError, match=r"^$"):
            kind.CONTROLLER.compute(inputs, np.random.default_rng(seed))
    assert drawn[0] == drawn[1] and drawn[0] != drawn[2]


@pytest.mark.parametrize("mass_kg", [0.2, 0.25, 0.275])
def test_changes_of_the_load_are_relative_to_what_hangs_on_the_twin(mass_kg: float) -> None:
    from haselab.campaign.kinds import controller as kind
    from haselab.scoreboard import TASKS
    from haselab.scoreboard.knowledge import true_actuator

    known = true_actuator(find_device("hz"))
    found = {
        name: kind._scenario(TASKS[name], known, mass_kg, np.random.default_rng(3))
        for name in ("T1", "T4", "T5", "T5-wide")
    }
    t4, t5, wide = ([kg for _, kg in found[name].loads] for name in ("T4", "T5", "T5-wide"))
    assert t4 == pytest.approx(mass_kg * np.array([1.1, 1.0, 0.9, 1.0, 1.2, 1.0]))
    assert t5[0] == pytest.approx(mass_kg + 0.025) and 0.7 <= t5[1] / mass_kg <= 1.6
    assert wide[0] == mass_kg
    same = TASKS["T1"].scenario(known, np.random.default_rng(3))
    assert (found["T1"].zero_m, found["T1"].events) == (same.zero_m, same.events)


def test_a_controller_moves_the_same_with_another_rate_of_the_converter() -> None:
    twin = twin_of_reading("hz")
    slow = twin.acquisition.model_copy(update={"rate_hz": 50e3})
    found = []
    for config in (twin, twin.model_copy(update={"acquisition": slow})):
        bench, lengths = fast_bench(config), np.empty(5000)
        bench.inertia_kg = twin.load.mass_kg
        bench.move(np.array([1.5]), 1, GRAVITY_M_S2 * twin.load.mass_kg, lengths)
        found.append(lengths)
    np.testing.assert_array_equal(*found)


def test_a_study_that_the_bench_cannot_play_is_refused_before_it_begins(campaigns: Any) -> None:
    (campaigns.folder / "one.toml").write_text(STUDY)
    with pytest.raises(InputError, match=r"study\.triangle\.high_v = 2\.5"):
        campaigns.plan(PLAY.replace("[1.8]", "[1.8, 2.5]"))


def test_a_kind_of_another_package_is_checked_when_it_is_found() -> None:
    fault: Any = CASE_KINDS._fault
    wrong = Registry("kind of case", "none", {"mine": "math:pi"}, fault)
    with pytest.raises(InputError, match="of the type 'float', not a CaseKind"):
        wrong.find("mine")
    wrong = Registry("kind of case", "none", {"mine": f"{GEOMETRY.__module__}:GEOMETRY"}, fault)
    with pytest.raises(InputError, match="its name is 'geometry'"):
        wrong.find("mine")
    assert all(isinstance(kind, CaseKind) for kind in CASE_KINDS.usable().values())

    class Mine(type(GEOMETRY)):
        name, ignored = "mine", "twin.camera"

    assert fault(Mine(), "mine") == "its attribute ignored is not a tuple of texts"
