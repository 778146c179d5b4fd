"""The reference study is feasible on both twins, a heavier wish is refused with numbers."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from haselab.app.arming import armed_rig
from haselab.app.feasibility import command, judge_study, rating_of_twin, safety_of
from haselab.app.stand_by import main as stand_by
from haselab.base import InputError, LimitError, SafetyError
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.bench import TwinBench, describe, rig_of
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.study import definition
from haselab.study.definition import builtin_study

STUDY = Path(definition.__file__).parent / "studies" / "hasel-iros2018.toml"


@pytest.mark.parametrize("reading", ["hz", "rad"])
def test_the_reference_study_is_feasible_on_the_twin(reading: str) -> None:
    config, study = twin_of_reading(reading), builtin_study()
    judge_study(study, describe(config), rating_of_twin(config, study)).require()


def test_the_field_foretold_is_the_field_that_breaks_the_twin() -> None:
    # A ramp to the highest output with the twin's own weight; its breakdown set just around.
    study = builtin_study()
    told = judge_study(study, describe(TwinConfig()), rating_of_twin(TwinConfig(), study))
    field = next(c.asked for c in told.checks if c.name == "field") * 1e6
    for factor, breaks in ((0.95, True), (1.05, False)):
        breakdown = factor * field / 1.01  # the carrier's 1 % is not in the twin's slow ramp
        config = TwinConfig.model_validate({"dielectric": {"breakdown_v_per_m": breakdown}})
        twin = TwinBench(config, 1)
        for k in range(401):  # 20 s in steps, without the protection of the bench itself
            twin._native.move(np.array([min(2.0, 0.01 * k)]), 500, twin._load_n, np.empty(500))
        assert twin._native.broken is breaks


def test_the_command_tells_every_number_and_refuses_a_thin_dielectric(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text('kind = "twin"\n')
    arguments = [str(STUDY), "--rig", str(tmp_path / "rig.toml"), "--json"]
    done = CliRunner().invoke(command, arguments, catch_exceptions=False)
    answer = json.loads(done.stdout)
    assert answer["feasible"] and all(check["ok"] for check in answer["checks"])
    (tmp_path / "twin.toml").write_text("[dielectric]\nbreakdown_v_per_m = 20e6\n")
    (tmp_path / "rig.toml").write_text('kind = "twin"\ntwin = "twin.toml"\n')
    with pytest.raises(LimitError, match=r"field of \d.* MV/m in triangle, allowed 18 MV/m"):
        CliRunner().invoke(command, arguments, catch_exceptions=False)


def test_a_recorded_session_is_not_judged_and_not_read_back(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('kind = "replay"\nsession = "s.h5"\n')
    with pytest.raises(InputError, match=r"No table \[rating\] for a rig of kind 'replay'"):
        CliRunner().invoke(command, [str(STUDY), "--rig", str(path)], catch_exceptions=False)
    settings = safety_of(load_rig(path), {}, path)
    assert not settings.read_back and not settings.real_time
    with pytest.raises(InputError, match=r"residual_v"):
        safety_of(load_rig(path), {"residual_v": 500.0}, path)


def test_a_twin_is_judged_guarded_and_armed_and_left_at_rest(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('kind = "twin"\n')
    file, study, asked = load_rig(path), builtin_study(quick=True), []
    twin = TwinBench(twin_of_reading("hz"), 1)
    plain = rig_of(twin, twin_of_reading("hz"))
    with armed_rig(
        plain, file, path, study, tmp_path, lambda words: not asked.append(words)
    ) as rig:
        rig.source.write(1.0)
        rig.acquisition.read()
        assert twin.output_v > 4500.0
    assert twin.output_v == 0.0
    assert asked == ["current 1 mA, rate 2000 V/s, no guardian"]
    with pytest.raises(SafetyError, match="Arm it first"):
        rig.source.write(0.1)
    with (
        pytest.raises(InputError, match="Not armed: the answer was no"),
        armed_rig(plain, file, path, study, tmp_path, lambda words: False),
    ):
        raise AssertionError("must not be entered")


def test_a_study_that_is_too_much_is_refused_before_arming(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    (tmp_path / "twin.toml").write_text("[amplifier]\ncurrent_limit_a = 1e-3\n")
    path.write_text('kind = "twin"\ntwin = "twin.toml"\n')
    config = twin_of_reading("hz")
    plain = rig_of(TwinBench(config, 1), config)
    with (
        pytest.raises(LimitError, match=r"peak current of 2\.2"),
        armed_rig(plain, load_rig(path), path, builtin_study(), tmp_path),
    ):
        raise AssertionError("must not be entered")


@pytest.mark.parametrize(
    ("text", "words"), [("kind = 'twin'\n", "allowed is 'bench'"), ("kind = \n", "Not a TOML")]
)
def test_a_stand_by_that_cannot_act_never_says_ready(
    tmp_path: Path, text: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rig.toml").write_text(text)
    assert words in stand_by(tmp_path / "rig.toml")
    assert capsys.readouterr().out == ""
