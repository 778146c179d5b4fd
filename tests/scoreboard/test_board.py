"""The whole board: designs, failures, plug-ins, rows, and independence of the processes."""

from __future__ import annotations

import json
import math
import re
import time
from pathlib import Path

import numpy as np
import pytest

from haselab.base import InputError
from haselab.base.registry import Registry
from haselab.controllers import CONTROLLERS, ControllerKind, OpenLoop, Parameter
from haselab.report.scoreboard_page import scoreboard_page
from haselab.scoreboard import (
    CLASSES,
    TASKS,
    Entry,
    Plan,
    Played,
    board,
    board_rows,
    entering_kinds,
    play_board,
)
from haselab.scoreboard.devices import drawn, find_device
from haselab.scoreboard.entrants import designed, plant_at_zero
from haselab.scoreboard.knowledge import identified, known_by, true_actuator
from haselab.scoreboard.processes import Lost

HZ = find_device("hz")


@pytest.fixture
def truth(monkeypatch):
    """The true model in place of the identified one, which takes 10 s of processor time."""
    monkeypatch.setattr(board, "_identify", lambda name: (true_actuator(find_device(name)), "true"))


class Raises(OpenLoop):
    def step(self, reference, measurement):
        raise ZeroDivisionError("division by zero")


class Nan(OpenLoop):
    def step(self, reference, measurement):
        return math.nan


class Greedy(OpenLoop):
    def step(self, reference, measurement):
        return 2.5


class BadLoad(OpenLoop):
    @property
    def estimated_load_kg(self):
        raise LookupError("no load")


class Late(OpenLoop):
    def step(self, reference, measurement):
        time.sleep(0.06)
        return reference


class Feedforward(OpenLoop):
    """A plug-in of another package: the static drive, by the extension point alone."""

    def start(self, setting):
        self.known = setting.actuator

    def step(self, reference, measurement):
        return min(self.known.static_drive_v(reference), self.known.high_v)


OTHERS = {
    "raises": ControllerKind("raises", Raises),
    "nan": ControllerKind("nan", Nan),
    "greedy": ControllerKind("greedy", Greedy, output="voltage"),
    "bad-load": ControllerKind("bad-load", BadLoad),
    "late": ControllerKind("late", Late),
    "bad-design": ControllerKind(
        "bad-design", OpenLoop, (Parameter("k"),), design=lambda setting: {"k": 1.0 / 0.0}
    ),
    "their-feed-forward": ControllerKind(
        "their-feed-forward", Feedforward, output="voltage", needs_actuator=True
    ),
    "no-default": ControllerKind("no-default", OpenLoop, (Parameter("gain"),)),
}


@pytest.fixture
def installed(monkeypatch):
    """Kinds of another package, as installed ones."""
    find, packages = Registry.find, Registry.packages

    def finds(self, name):
        return OTHERS[name] if self is CONTROLLERS and name in OTHERS else find(self, name)

    def lists(self):
        return packages(self) | (dict.fromkeys(OTHERS, "theirs 1.0") if self is CONTROLLERS else {})

    monkeypatch.setattr(Registry, "find", finds)
    monkeypatch.setattr(Registry, "packages", lists)


def test_a_controller_that_fails_ends_its_task_and_the_others_go_on(truth, installed):
    names = ("raises", "nan", "greedy", "late", "bad-load", "bad-design", "open-loop",
             "their-feed-forward")  # fmt: skip
    game = play_board(Plan(names, ("T4",), ("host-100hz",), seeds=2))
    reasons = {one.controller: one.failure for one in game.played}
    assert "ZeroDivisionError: division by zero" in reasons["raises"]
    assert "returned nan" in reasons["nan"]
    assert "2.5 V, outside its limits of 0 to 2 V" in reasons["greedy"]
    assert reasons["bad-load"] == "estimated_load_kg failed: LookupError: no load"
    assert reasons["late"] == "5 steps in a row took longer than 5 periods"
    assert reasons["bad-design"] == "no design: ZeroDivisionError: float division by zero"
    assert reasons["open-loop"] == reasons["their-feed-forward"] == ""
    rows = {(row.controller, row.metric): row for row in board_rows(game)}
    for name in names[:6]:
        row = rows[name, "peak"]
        assert (row.median, row.worst, row.ratio_to_bound, row.seeds) == (None, None, 0.0, 2)
        assert row.violations == (0 if name == "bad-design" else 2)
    # the static feed-forward is an open loop: the same peak, by another way to the voltage
    theirs, ours = rows["their-feed-forward", "peak"], rows["open-loop", "peak"]
    assert theirs.median == pytest.approx(ours.median, rel=0.01)
    assert ours.violations == 0 and ours.bound == theirs.bound
    assert ours.ratio_to_bound == pytest.approx(ours.bound / ours.median)
    page = scoreboard_page(game)
    assert "division by zero" in page and "their-feed-forward" in page and "<svg" in page
    assert page == scoreboard_page(game)


def _compute(*_):
    while True:
        pass


@pytest.mark.parametrize("hangs", [_compute, lambda *_: time.sleep(60.0)], ids=["busy", "waits"])
def test_a_task_that_takes_too_long_ends_with_its_reason(monkeypatch, hangs):
    """Wherever the deadline falls: here between two steps of the controller."""
    monkeypatch.setattr(board, "_SLOWEST", 1e-3)
    monkeypatch.setattr(board, "_LEAST_S", 1e-3)
    monkeypatch.setattr(board, "play", hangs)
    entry = Entry("open-loop", "host-100hz", "hz")
    played = board._play(board._PlayJob(entry, "T4", 0, 7, true_actuator(HZ)))
    said = r"the controller takes longer than 0\.\d+ s( of processor time)?"
    assert re.fullmatch(said, played.failure)
    assert played.violates and math.isnan(played.numbers["peak"])


def test_a_kind_without_design_or_default_is_refused(installed):
    with pytest.raises(InputError, match=r"'no-default' cannot enter.*gain without a default"):
        entering_kinds(("no-default",))
    names = [kind.name for kind in entering_kinds()]
    assert "no-default" not in names and {"force", "pid", "their-feed-forward"} <= set(names)


def test_the_page_explains_every_metric_with_its_unit():
    """A row of the table is for one task, several, all kinds of T8, or all tasks."""
    path = Path(__file__).resolve().parents[2] / "docs" / "control" / "scoreboard.md"
    rows = re.findall(r"^\| (.+?) \| `(\w+)` \| (.*?) ?\| (.*) \|$", path.read_text("utf-8"), re.M)
    told = set()
    for tasks, *metric in rows:
        names = TASKS if tasks == "all" else re.findall(r"`([^`]+)`", tasks)
        for name in names:
            several = [task for task in TASKS if task.startswith("T8-")] if "*" in name else [name]
            told |= {(task, *metric) for task in several}
    assert told == {
        (task.name, metric.name, metric.unit, metric.title)
        for task in TASKS.values() for metric in task.metrics
    }  # fmt: skip


def test_a_kind_that_alternates_is_told_to_play_the_task_with_a_drive_of_both_signs():
    kind, loop = CONTROLLERS.find("alternating"), CLASSES["host-100hz"]
    reason = designed(kind, loop, true_actuator(HZ)).reason
    assert reason == (
        "no design: the controller needs a drive of both signs. Use the task T6-bipolar."
    )
    assert designed(kind, loop, true_actuator(find_device("bipolar"))).chosen is not None


def test_the_results_do_not_depend_on_the_number_of_processes():
    known = true_actuator(HZ)
    entries = [Entry("open-loop", loop, "hz") for loop in ("host-100hz", "chip-1khz")]
    jobs = [board._PlayJob(entry, "T8-drawn", index, 7, known)
            for entry in entries for index in range(2)]  # fmt: skip
    results = []
    for workers in (0, 1, 2):
        with board._mapper(workers, board.SilentProgress()) as mapped:
            results.append(mapped("play", board._play, jobs))
    texts = [[json.dumps(one.numbers) for one in result] for result in results]
    assert texts[0] == texts[1] == texts[2]
    assert results[0][0].bounds != results[0][1].bounds  # another seed, another device
    assert results[0][0].bounds == results[0][2].bounds  # of the same seed in the other class
    assert results[0][0].trace is not None and results[0][1].trace is None


def test_a_task_or_design_whose_process_ended_has_its_reason_and_no_numbers():
    known = true_actuator(HZ)
    ended, jobs = Lost("its process was ended by SIGSEGV"), []

    def mapped(what, job, items):
        """The second job of each list ends its process, until it is only reported."""
        jobs.append(items)
        return [ended if k == 1 else job(item) for k, item in enumerate(items)]

    entry = Entry("open-loop", "host-100hz", "hz")
    plays = [board._PlayJob(entry, "T1", index, 7, known) for index in range(3)]
    first, second, third = board._all_played(mapped, plays)
    assert [len(items) for items in jobs] == [3, 1]
    assert second.failure == "Controller 'open-loop': its process was ended by SIGSEGV"
    assert second.violates and all(math.isnan(value) for value in second.numbers.values())
    assert second.bounds and not first.failure and not third.failure
    designs = [board._DesignJob("open-loop", "host-100hz", "hz", known, "ok")] * 2
    good, bad = board._entries(mapped, designs)
    assert good.reason == "" and bad.reason == "no design: its process was ended by SIGSEGV"


def test_rows_have_the_median_and_worst_over_the_seeds_and_count_what_was_not_done():
    def played(index: int, value: float) -> Played:
        numbers = {metric.name: value for metric in TASKS["T4"].metrics}
        return Played("c", "host-100hz", "T4", index, numbers, {"peak": 0.001}, "", False)

    def row(values):
        parts = tuple(played(k, value) for k, value in enumerate(values))
        game = board.Game(Plan(("c",), ("T4",)), (), parts, {})
        return next(one for one in board_rows(game) if one.metric == "peak")

    found = row([0.002, 0.004, 0.01])
    assert (found.median, found.worst, found.ratio_to_bound) == (0.004, 0.01, 0.25)
    one_failed = row([0.002, math.nan, 0.004])
    assert (one_failed.median, one_failed.worst) == (0.004, None)
    most_failed = row([math.nan, 0.004, math.nan])
    assert (most_failed.median, most_failed.ratio_to_bound) == (None, 0.0)
    assert row([0.0005]).ratio_to_bound == 1.0
    assert found.answer()["class"] == "host-100hz" and "loop" not in found.answer()


def test_the_force_loop_designs_itself_and_is_better_than_an_open_loop(truth):
    game = play_board(Plan(("force", "open-loop"), ("T1", "T4"), ("host-100hz",), seeds=1))
    rows = {(row.controller, row.task, row.metric): row for row in board_rows(game)}
    force = [entry for entry in game.entries if entry.controller == "force"]
    assert force[0].reason == "" and set(force[0].values) == {
        "kp", "ki", "kd", "filter_s", "reference_s"
    }  # fmt: skip
    for task, metric in (("T1", "iae"), ("T4", "peak")):
        assert rows["force", task, metric].median < rows["open-loop", task, metric].median
    # the open loop ends 0.28 of the step before the desired strain
    assert rows["force", "T1", "settling_s"].median < 0.5
    assert rows["open-loop", "T1", "settling_s"].median is None
    assert rows["force", "T4", "recovery_s"].median < 0.5  # the open loop does not come back
    assert rows["open-loop", "T4", "recovery_s"].median is None


def test_the_plant_of_the_pid_s_design_has_the_poles_of_the_law():
    known = true_actuator(HZ)
    plant = plant_at_zero(known)
    assert plant.numerator[-1] / plant.denominator[-1] == pytest.approx(1.0)
    fast = plant.poles[np.argmax(np.abs(plant.poles))]
    assert abs(fast) / (2.0 * math.pi) == pytest.approx(5.2, abs=0.1)  # Hz, control.md of the twin
    assert designed(CONTROLLERS.find("pi"), CLASSES["host-100hz"], known).chosen is not None


def test_drawn_devices_differ_but_sense_the_same_at_strain_0():
    rng = np.random.default_rng(4)
    devices = [drawn(rng) for _ in range(5)]
    exponents = {d.config.dielectric.capacitance_exponent for d in devices}
    assert len(exponents) == 5 and all(2.0 <= value <= 4.0 for value in exponents)
    farads = [float(d.law.capacitance_f(0.051)) for d in (*devices, HZ)]
    np.testing.assert_allclose(farads, farads[-1], rtol=1e-9)
    assert all(0.0 <= d.late_s <= 0.005 for d in devices)


def test_the_identified_stack_is_that_of_the_bench_within_its_standard_deviations():
    device = find_device("dea-stack")
    fit = identified(device)
    assert fit.status == "ok"
    known, true = known_by(device, fit), true_actuator(device)
    assert known is not true and known.law != true.law
    values = true.law.parameters()
    for name in ("actuator.permittivity", "actuator.shear_modulus_pa"):
        estimate = fit.parameters[name]
        assert abs(estimate.value - values[name]) < 5.0 * estimate.std
    low, high = true.reachable()
    for share in (0.1, 0.5, 0.9):
        strain = low + share * (high - low)
        assert known.static_drive_v(strain) == pytest.approx(true.static_drive_v(strain), rel=5e-3)


def test_tasks_that_no_class_plays_are_refused():
    with pytest.raises(InputError, match=r"T6 is not played in the class chip-1khz\. Add --class"):
        play_board(Plan(("open-loop",), ("T6",), ("chip-1khz",)))


def test_a_device_that_is_not_identified_leaves_its_tasks_not_done(monkeypatch):
    monkeypatch.setattr(board, "_identify", lambda name: (None, "the records contradict the model"))
    game = play_board(Plan(("open-loop", "force"), ("T4",), ("host-100hz",), seeds=1))
    assert {one.failure for one in game.played} == {"the records contradict the model"}
    rows = board_rows(game)
    assert rows and all(row.median is None and row.bound is None for row in rows)
    assert "the records contradict the model" in scoreboard_page(game)
