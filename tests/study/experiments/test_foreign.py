"""What an experiment of another package does wrong is named in one line, with what to do."""

from __future__ import annotations

import signal
import sys
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from haselab.base import Estimate, InputError, ResultError
from haselab.base.exits import SignalExit
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_bench import describe
from haselab.safety.feasibility import Drive
from haselab.store.toml import Section
from haselab.study import Analysis, Experiment, ExperimentResult, Player, Quantity
from haselab.study.definition import builtin_study
from haselab.study.experiment import Chart, Curve
from haselab.study.experiments.foreign import refuse_repeated
from haselab.study.feasibility import check_settings, study_drives, study_masses_kg
from haselab.study.pipeline import play_and_fit
from haselab.study.results import rows_of

REFERENCE = builtin_study(quick=True)
RIG = describe(TwinConfig())
GOOD = Estimate.normal(1.0, 0.1, "s")


class _Settings(Section):
    pass


class _Own(Experiment[_Settings]):
    """An experiment of somebody else's, which returns what a test sets."""

    table, title, settings_type = "own", "Own", _Settings
    found: Any = None

    def drives(self, rig: Any) -> list[Drive]:
        return [Drive("own", np.zeros(2))]

    def play(self, player: Player) -> None:
        sys.exit(0)

    def fit(self, analysis: Analysis) -> ExperimentResult:
        if isinstance(self.found, BaseException):
            raise self.found
        return self.found

    def rows(self) -> Mapping[str, Quantity]:
        return {"own.time": Quantity("time", "s"), "own.ratio": Quantity("ratio", "")}


def own(found: Any = None) -> _Own:
    made = _Own(REFERENCE, _Settings())
    made.found = found
    return made


def outcome(found: Any) -> ExperimentResult:
    return Analysis(REFERENCE, RIG, lambda name: None).outcome(own(found))  # type: ignore[arg-type,return-value]


def with_time(value: float, std: float, unit: str = "s") -> ExperimentResult:
    return ExperimentResult({"own.time": Estimate.normal(value, std, unit)})


def chart(*curves: Any) -> ExperimentResult:
    drawn = Chart("creep", "Creep", "", "Time (s)", "Strain (%)", curves)
    return ExperimentResult({"own.time": GOOD}, charts=(drawn,))


def one(value: Any = 1.0, std: Any = 0.1, ci95: Any = (0.8, 1.2)) -> ExperimentResult:
    return ExperimentResult({"own.time": Estimate(value, std, ci95, "s")})


def result(**parts: Any) -> ExperimentResult:
    return ExperimentResult(**parts)


@pytest.mark.parametrize(
    ("found", "said"),
    [
        (with_time(2.0, 0.1, "ms"), r"own\.time in 'ms', but its row is in 's'\. Convert"),
        (ExperimentResult({"own.ratio": GOOD}), r"own\.ratio in 's', but its row is in 'no unit'"),
        (with_time(1.0, -0.5), r"own\.time = 1 with .* deviation of -0\.5 and .* at least 0"),
        (with_time(np.nan, 0.1), r"own\.time = nan with .* not all finite\. .*'missing'"),
        (with_time(1.0, np.nan), r"own\.time = 1 with a standard deviation of nan"),
        (with_time(1.0, np.inf), r"own\.time = 1 with a standard deviation of inf"),
        (
            ExperimentResult({"own.time": Estimate(1.0, 0.1, (1.2, 0.8), "s")}),
            r"the interval 1\.2 to 0\.8\. Return .* the lower end first",
        ),
        (ExperimentResult({"own.time": 1.0}), r"returns for own\.time 1\.0 \(float\), .*Estimate"),  # type: ignore[dict-item]
        (None, r"The method 'fit' of .*\[own\] returns None \(NoneType\), .*ExperimentResult"),
        (2.5, r"returns 2\.5 \(float\), which is no ExperimentResult"),
        (chart(Curve("a", np.arange(5.0), np.arange(4.0))), r"'creep', whose curve 'a' .*\(4,\)"),
        (chart(Curve("a", 1.0, 2.0)), r"curve 'a' has x of shape \(\) and y of shape \(\)"),
        (chart(Curve("a", ["x"], [1.0])), r"'fit' of the experiment \[own\].*ValueError"),
        (chart("a"), r"returns in chart 'creep' 'a' \(str\), which is no Curve"),
        (ExperimentResult([1.0]), r"as quantities \[1\.0\] \(list\), which is no Mapping"),  # type: ignore[arg-type]
        (ExperimentResult(missing=["own.time"]), r"as missing .* \(list\), which is no Mapping"),  # type: ignore[arg-type]
        (
            ExperimentResult({"own.time": Estimate("1", 0.1, (0.9, 1.1), "s")}),  # type: ignore[arg-type]
            r"returns for own\.time '1' \(str\), which is no number",
        ),
        (
            ExperimentResult({"own.time": GOOD}, missing={"own.time": "why"}),
            r"own\.time both as a result and as missing",
        ),
        (
            ExperimentResult({"own.time": Estimate(5.0, 0.1, (0.0, 1.0), "s")}),
            r"own\.time = 5 with .* the interval 0 to 1\. Return .* around the value",
        ),
        (one(1j), r"for own\.time 1j \(complex\), which is no number"),
        (one(np.ones(2)), r"for own\.time array.* \(ndarray\), which is no number"),
        (one(std=None), r"as std of own\.time None \(NoneType\), which is no number"),
        (one(ci95=None), r"as ci95 of own\.time None \(NoneType\)"),
        (one(ci95=(1.0,)), r"a ci95 of own\.time with 1 numbers\. Return the lower"),
        (result(quantities={1: GOOD}), r"as a key of quantities 1 \(int\), which is no str"),
        (result(missing={"own.time": 5}), r"in missing for own\.time 5 \(int\)"),
        (result(notes={"own.time": 5}), r"in notes for own\.time 5 \(int\)"),
        (result(charts=Chart("a", "A", "", "x", "y", ())), r"as charts Chart.* no tuple"),
        (result(charts=(Chart("a", None, "", "x", "y", ()),)), r"as title of a chart None"),  # type: ignore[arg-type]
        (result(figures={"a": object()}), r"in figures for a what JSON cannot hold: .*object"),
        (result(values=5), r"as values 5 \(int\), which is no tuple"),
        (SystemExit(0), r"'fit' of the experiment \[own\].*it called sys\.exit\(0\)\. The rec"),
    ],
)  # fmt: skip
def test_a_wrong_result_is_refused_with_the_experiment_and_the_value(found: Any, said: str) -> None:
    with pytest.raises(ResultError, match=rf"\[own\].*{said}|{said}") as refused:
        outcome(found)
    assert "[own]" in str(refused.value) and "\n" not in str(refused.value)


def test_a_right_result_is_returned_as_it_is() -> None:
    found = chart(Curve("gap", [0.0, 1.0], [0.0, np.nan]))
    assert outcome(found) is found


@pytest.mark.parametrize("ends", [SignalExit(143), KeyboardInterrupt()])
def test_a_signal_during_a_fit_still_ends_the_program(ends: BaseException) -> None:
    with pytest.raises(type(ends), match=r"143|^$"):
        outcome(ends)


@pytest.mark.parametrize("where", ["thread", "ignored signal"])
def test_a_keyboard_interrupt_that_nobody_pressed_is_an_error(where: str) -> None:
    """As in the processes of the panel, which would end with it."""
    said = r"'fit' of the experiment \[own\].*it raised KeyboardInterrupt"
    if where == "thread":
        with ThreadPoolExecutor(1) as pool, pytest.raises(ResultError, match=said):
            pool.submit(outcome, KeyboardInterrupt()).result()
        return
    former = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with pytest.raises(ResultError, match=said):
            outcome(KeyboardInterrupt())
    finally:
        signal.signal(signal.SIGINT, former)


def test_an_experiment_that_exits_while_it_plays_is_named(monkeypatch: Any) -> None:
    monkeypatch.setattr("haselab.study.analysis.experiments_of", lambda study: (own(),))
    ended: list[str] = []
    runner: Any = SimpleNamespace(mass_kg=0.25, rest=lambda: ended.append("0 V"))
    found = play_and_fit(lambda name: None, REFERENCE, RIG, runner)  # type: ignore[arg-type,return-value]
    with pytest.raises(ResultError, match=r"'play' of the experiment \[own\].*sys\.exit\(0\)"):
        found.require_complete()
    assert ended == ["0 V"]


@pytest.mark.parametrize(
    ("method", "returned", "said"),
    [
        ("drives", None, r"'drives' .*TypeError"),
        ("drives", [np.zeros(3)], r"'drives' .*\(ndarray\), which is no Drive"),
        ("drives", [Drive("own", [0.0, 1.0])], r"values_v of a Drive \[0\.0, 1\.0\] \(list\)"),  # type: ignore[arg-type]
        ("drives", [Drive("own", np.zeros((3, 2)))], r"an array of shape \(3, 2\)"),
        ("masses_kg", ("heavy",), r"'masses_kg' .*returns 'heavy' \(str\), which is no number"),
    ],
)
def test_wrong_declarations_are_refused_before_anything_is_played(
    monkeypatch: Any, method: str, returned: Any, said: str
) -> None:
    monkeypatch.setattr(_Own, method, lambda self, *_: returned)
    monkeypatch.setattr("haselab.study.feasibility.experiments_of", lambda study: (own(),))
    with pytest.raises(InputError, match=said):
        study_drives(REFERENCE, RIG)
        study_masses_kg(REFERENCE)


@pytest.mark.parametrize("ends", [ValueError("no"), SystemExit(0)])
def test_a_check_that_fails_is_named(monkeypatch: Any, ends: BaseException) -> None:
    def check(self: _Own) -> None:
        raise ends

    monkeypatch.setattr(_Own, "check", check)
    monkeypatch.setattr("haselab.study.feasibility.experiments_of", lambda study: (own(),))
    with pytest.raises(InputError, match=r"'check' of the experiment \[own\].*(no|sys\.exit)"):
        check_settings(REFERENCE)


def test_rows_of_the_wrong_type_are_named(monkeypatch: Any) -> None:
    monkeypatch.setattr(_Own, "rows", lambda self: {"own.time": "s"})
    monkeypatch.setattr("haselab.study.results.experiments_of", lambda study: (own(),))
    with pytest.raises(ResultError, match=r"'rows' .*for own\.time 's' \(str\), .*no Quantity"):
        rows_of(REFERENCE)


def test_two_experiments_with_the_same_result_are_refused() -> None:
    refuse_repeated("result", ["a", "b"])
    with pytest.raises(InputError, match=r"have a result named 'b'\. Rename it"):
        refuse_repeated("result", ["a", "b", "b"])
