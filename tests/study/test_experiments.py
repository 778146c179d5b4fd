"""Experiments as objects: any of them in a study, declared drives, reasons for what is missing."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab.base import Estimate, InputError, LimitError, ResultError
from haselab.cli.main import main
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.twin_bench import describe
from haselab.safety.feasibility import Drive
from haselab.store.toml import Section
from haselab.study import Analysis, Experiment, ExperimentResult, NotPlayedError, Player, Quantity
from haselab.study.analysis import experiments_of
from haselab.study.definition import Study, builtin_study, builtin_table, load_study
from haselab.study.feasibility import rating_of_twin, study_drives, study_masses_kg
from haselab.study.fits.maps import Maps
from haselab.study.fits.static import Static
from haselab.study.paper.quantity_table import quantities
from haselab.study.pipeline import play_and_fit
from haselab.study.registry import EXPERIMENTS
from haselab.study.tables import ModelControl

REFERENCE = builtin_study(quick=True)
TRIANGLE = """
[triangle]
low_v = 0.0
high_v = 2.0
frequency_hz = 0.5
cycles = 3
skipped_cycles = 1
frame_rate_hz = 100.0
"""


class _Settings(Section):
    drive_v: float = 1.0


class _Own(Experiment[_Settings]):
    """An experiment of somebody else's."""

    table = "own"
    title = "Own"
    settings_type = _Settings

    def drives(self, rig: Any) -> list[Drive]:
        return [Drive("own", np.linspace(0.0, self.settings.drive_v, 11))]

    def play(self, player: Player) -> None:
        raise NotImplementedError

    def fit(self, analysis: Analysis) -> ExperimentResult:
        raise NotImplementedError

    def rows(self) -> Mapping[str, Quantity]:
        return {}


def part(*tables: str, **changes: Any) -> Study:
    """Some tables of the reference study, under another name."""
    data = REFERENCE.model_dump(mode="json")
    kept = {name: data[name] for name in ("sensing", *tables)}
    return Study.model_validate({"name": "part", **kept, **changes})


def analysis_of(study: Study, source: Any = None) -> Analysis:
    return Analysis(study, describe(TwinConfig()), source or (lambda name: None))


def test_the_rows_of_the_experiments_and_of_the_chip_are_the_table_of_results() -> None:
    table = builtin_table("model-control", ModelControl).model_copy(update={"outer_mass_kg": 0.35})
    session = Study(name="own", sensing=REFERENCE.sensing, model_control=table.model_dump())
    played = (*experiments_of(REFERENCE), *experiments_of(session))
    named = {key for one in played for key in one.rows()}
    others = ("S26.", "S28.", "S25.rise_own", "S25.overshoot_own", "S25.error_own")
    assert named == {key for key in quantities() if not key.startswith(others)}


def test_every_recording_belongs_to_one_experiment() -> None:
    names = [plan.name for one in experiments_of(REFERENCE) for plan in one.plans()]
    assert len(names) == len(set(names))
    assert {"triangle", "particles", "static", "hold-5", "free-1", "chirp", "open-1"} <= set(names)


def test_the_order_of_the_tables_does_not_change_what_is_played() -> None:
    data = REFERENCE.model_dump(mode="json")
    turned = Study.model_validate(dict(reversed(data.items())))
    for study in (REFERENCE, turned):
        assert [one.table for one in experiments_of(study)] == [
            "triangle", "static_load", "operating_point", "free_response", "chirp", "control",
            "steps",
        ]  # fmt: skip
    assert list(turned.tables) == [name for name in reversed(data) if name in REFERENCE.tables]


@pytest.mark.parametrize("table", ["triangle", "static_load", "free_response", "chirp", "steps"])
def test_each_experiment_alone_declares_its_drives(table: str) -> None:
    study = part(table, operating_point={"baseline_v": 1.0})
    rig = describe(TwinConfig())
    assert study_drives(study, rig)
    for drive in study_drives(study, rig):
        rig.drive_limits.check(drive.values_v)
    heaviest = max(REFERENCE.static_load.masses_kg)
    assert max(study_masses_kg(study), default=0.0) == (heaviest if table == "static_load" else 0)
    assert rating_of_twin(TwinConfig(), study).stretch > 1.0


def test_a_drive_about_an_unknown_baseline_is_refused_before_anything_moves() -> None:
    with pytest.raises(InputError, match=r"no \[triangle\].*Add operating_point.baseline_v"):
        study_drives(part("chirp"), describe(TwinConfig()))


def test_a_chirp_declares_the_range_about_every_baseline_that_may_be_found() -> None:
    """The baseline is found while the study is played, after the check."""
    study = part("triangle", "static_load", "chirp")
    swept = [d for d in study_drives(study, describe(TwinConfig())) if d.name == "chirp"]
    low_v, high_v = (
        f(float(f_(d.values_v)) for d in swept) for f, f_ in ((min, np.min), (max, np.max))
    )
    assert low_v == pytest.approx(study.triangle.low_v, abs=0.01)
    assert high_v == pytest.approx(study.triangle.high_v, abs=0.01)


def test_what_an_experiment_needs_and_does_not_find_is_named() -> None:
    with pytest.raises(NotPlayedError, match=r"needs \[triangle\], which is not in this study"):
        analysis_of(part("chirp")).need(Maps)
    assert analysis_of(part("chirp")).find(Static) is None
    with pytest.raises(NotPlayedError, match="an experiment that finds a int"):
        analysis_of(part("chirp")).need(int)


def test_an_experiment_cannot_be_made_without_its_drives() -> None:
    class Silent(_Own):
        drives = Experiment.drives

    with pytest.raises(TypeError, match=r"abstract method '?drives"):
        Silent(REFERENCE, _Settings())


class _Bench:
    """Notes what would be put out."""

    mass_kg = 0.25

    def __init__(self) -> None:
        self.played: list[float] = []

    def play(self, name: str, drive_v: Any, *_: Any, **__: Any) -> None:
        self.played += list(drive_v)

    def settle(self, drive_v: float, duration_s: float) -> None:
        self.played.append(drive_v)

    def rest(self) -> None:
        self.played.append(0.0)


@pytest.mark.parametrize(
    ("drive_v", "fault"),
    [
        ([0.0, 1.2], "declares drives of 0 to 1 V, but plays 1.2 V"),
        ([-0.1, 0.0], "declares drives of 0 to 1 V, but plays -0.1 V"),
        ([0.0, 0.5], "steps of at most 0.1 V, but plays one of 0.5 V"),
    ],
)
def test_what_was_not_declared_is_not_played(drive_v: list[float], fault: str) -> None:
    bench: Any = _Bench()
    player = Player(bench, _Own(REFERENCE, _Settings()), analysis_of(REFERENCE))
    player.play("own", np.linspace(0.0, 1.0, 11), 100.0)
    before = len(bench.played)
    with pytest.raises(LimitError, match=fault):
        player.play("own", np.array(drive_v), 100.0)
    with pytest.raises(LimitError, match=r"plays 2 V"):
        player.settle(2.0, 1.0)
    assert len(bench.played) == before


def test_a_recording_that_is_not_planned_or_was_made_is_not_played() -> None:
    """Two drives in one recording would be fitted as one."""
    bench: Any = _Bench()
    player = Player(bench, _Own(REFERENCE, _Settings()), analysis_of(REFERENCE))
    drive_v = np.linspace(0.0, 1.0, 11)
    with pytest.raises(InputError, match=r"plays 'other', which its method 'recordings' does not"):
        player.play("other", drive_v, 100.0)
    player.play("own", drive_v, 100.0)
    with pytest.raises(InputError, match=r"plays 'own' twice"):
        player.play("own", drive_v, 100.0)
    assert len(bench.played) == drive_v.size


class _Failing(_Own):
    def play(self, player: Player) -> None:
        raise KeyError("nothing here")

    def fit(self, analysis: Analysis) -> ExperimentResult:
        raise ZeroDivisionError("by nothing")


class _Unnamed(_Own):
    def fit(self, analysis: Analysis) -> ExperimentResult:
        return ExperimentResult({"own.result": Estimate.normal(1.0, 0.1, "s")})


def test_the_code_of_another_package_that_fails_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    own = _Failing(REFERENCE, _Settings())
    with pytest.raises(ResultError, match=r"'fit' of the experiment \[own\].*ZeroDivisionError"):
        analysis_of(REFERENCE).outcome(own)
    monkeypatch.setattr("haselab.study.analysis.experiments_of", lambda study: (own,))
    bench: Any = _Bench()
    found = play_and_fit(lambda name: None, REFERENCE, describe(TwinConfig()), bench)  # type: ignore[arg-type,return-value]
    with pytest.raises(ResultError, match=r"'play' of the experiment \[own\].*KeyError"):
        found.require_complete()
    assert bench.played[-1] == 0.0


def test_a_result_without_a_row_is_refused() -> None:
    with pytest.raises(ResultError, match=r"\[own\] returns own.result.*'rows' does not list"):
        analysis_of(REFERENCE).outcome(_Unnamed(REFERENCE, _Settings()))


def test_packages_that_cannot_be_loaded_or_take_a_name_are_named(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def with_package(name: str, value: str) -> None:
        points = (EntryPoint(name, value, EXPERIMENTS.group),)
        monkeypatch.setattr(EXPERIMENTS, "others", lambda: points)

    path = tmp_path / "study.toml"
    path.write_text('name = "x"\n[theirs]\n')
    with_package("theirs", "no_such_package:Theirs")
    with pytest.raises(InputError, match=r"^The experiment 'theirs' .*load \(ModuleNotFoundError"):
        load_study(path)
    with_package("theirs", "haselab.study.experiments.chirp:ChirpTest")
    with pytest.raises(InputError, match=r"its attribute table is 'chirp'"):
        load_study(path)
    path.write_text('name = "x"\n' + TRIANGLE)
    assert load_study(path).has("triangle")  # which needs none of theirs
    with_package("triangle", "haselab.study.experiments.chirp:ChirpTest")
    with pytest.raises(InputError, match=r"The experiment 'triangle' is registered more than once"):
        load_study(path)


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ('name = "x"\n[tringle]\nlow_v = 0\n', r"\[tringle\], but no installed experiment"),
        ('name = "x"\n', "has no experiment"),
        (
            'name = "x"\n' + TRIANGLE.replace("2.0", "200.0"),
            "triangle.high_v: .*less than or equal",
        ),
    ],
)
def test_a_study_file_with_a_fault_is_refused(text: str, fault: str, tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text(text)
    with pytest.raises(InputError, match=fault):
        load_study(tmp_path / "study.toml")


def test_steps_without_a_plant_are_played_in_open_loop_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    steps = {"step": 0.04, "zero_s": 6.0, "step_s": 8.0, "rest_s": 20.0, "frame_rate_hz": 20.0,
             "open_trials": 1, "pi_trials": 1, "pid_trials": 0}  # fmt: skip
    lines = [f"{key} = {value}" for key, value in steps.items()]
    text = 'name = "open loop"\n[steps]\n' + "\n".join(lines) + TRIANGLE
    (tmp_path / "study.toml").write_text(text)
    (tmp_path / "rig.toml").write_text('kind = "twin"\n')
    with pytest.raises(SystemExit) as stop:
        main(["run", str(tmp_path / "study.toml"), "--rig", str(tmp_path / "rig.toml"),
              "--out", str(tmp_path / "out"), "--keep-video", "none"])  # fmt: skip
    assert stop.value.code == 0, capsys.readouterr().err
    results = json.loads((tmp_path / "out/results.json").read_text())
    found = {row["id"] for row in results["quantities"]}
    assert {"S24.rise_open", "S24.error_open"} <= found
    assert "S24.rise_closed" not in found
    reasons = {key: item["reason"] for item in results["not_played"] for key in item["ids"]}
    assert "needs [control]" in reasons["S24.rise_closed"]
    assert reasons["S25.rise_pid"] == "steps.pid_trials is 0 in this study."


def test_the_experiments_know_how_long_the_study_takes(recorded: Any) -> None:
    """On the clock of the bench, from the first event to the end of the last experiment."""
    study, bench = builtin_study(quick=True), describe(twin_of_reading("hz"))
    known_s = sum(one.seconds(bench) for one in experiments_of(study))
    events = recorded.file["events"][()]
    ends_s = [time_s for time_s, what, *_ in events if what.startswith(b"end ")]
    static, lifts = study.static_load, study.free_response.trials
    hung = len(static.masses_kg) + 1 + lifts  # each takes the person of the twin 1 s
    frames_s = len(static.masses_kg) * 41 / static.frame_rate_hz
    more_s = hung * 1.0 + frames_s + lifts * 0.1  # what no experiment counts
    assert max(ends_s) - events[0][0] == pytest.approx(known_s + more_s, abs=0.1)
