"""The reference study is feasible on both twins, a heavier wish is refused with numbers."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
import pytest
from click.testing import CliRunner

from haselab.base import InputError, LimitError, SafetyError
from haselab.cli.bench.arming import Operator, armed_rig
from haselab.cli.main import main
from haselab.cli.study.feasibility import command
from haselab.rig.bench_config import BenchConfig
from haselab.rig.chip import ChipFile
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.config import TwinConfig, twin_of_reading
from haselab.rig.twin.twin_bench import TwinBench, describe, rig_of
from haselab.safety.arming_text import arming_limits
from haselab.safety.guardian.client import guardian_command
from haselab.safety.rig_limits import safety_of
from haselab.safety.state_machine import ArmingRequest
from haselab.study import definition
from haselab.study.definition import builtin_study, load_study
from haselab.study.feasibility import (
    check_settings,
    check_study,
    check_study_on_rig,
    rating_of_twin,
)

STUDY = Path(definition.__file__).parent / "studies" / "hasel-iros2018.toml"


@pytest.mark.parametrize("reading", ["hz", "rad"])
def test_the_reference_study_is_feasible_on_the_twin(reading: str) -> None:
    config, study = twin_of_reading(reading), builtin_study()
    printed = check_study(study, describe(config), rating_of_twin(config, study))
    printed.require()
    assert len(printed.checks) >= 5 and all(check.ok for check in printed.checks)


@pytest.mark.parametrize("command", ["run", "plan feasibility"])
def test_a_bench_without_a_camera_is_refused_before_it_is_armed(
    command: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A triangle was played on it to the end, and then failed for lack of frames."""
    rig, study = tmp_path / "bench.toml", tmp_path / "study.toml"
    rig.write_text(
        'kind = "bench"\n[daq]\n[amplifier]\nname = "any"\n[generator]\n'
        'address = "TCPIP::127.0.0.1::5025::SOCKET"\n[specimen]\nshell_width_m = 0.03\n'
        "shell_thickness_m = 0.002\nmass_kg = 0.25\n"
    )
    study.write_text(
        'name = "maps"\n[triangle]\nlow_v = 0.0\nhigh_v = 1.0\nfrequency_hz = 0.25\n'
        "cycles = 3\nskipped_cycles = 1\nframe_rate_hz = 50.0\n"
    )
    out = ["--yes", "--out", str(tmp_path / "out")] if command == "run" else []
    with pytest.raises(SystemExit) as stop:
        main([*command.split(), str(study), "--rig", str(rig), *out])
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert "[triangle] need a camera to measure the length" in said and "[camera]. Add one" in said


def test_the_predicted_field_is_the_field_that_breaks_the_twin() -> None:
    # A ramp to the highest output with the twin's own weight; its breakdown set just around.
    study = builtin_study()
    printed = check_study(study, describe(TwinConfig()), rating_of_twin(TwinConfig(), study))
    field = next(c.requested for c in printed.checks if c.name == "field") * 1e6
    for factor, breaks in ((0.95, True), (1.05, False)):
        breakdown = factor * field / 1.01  # the carrier's 1 % is not in the twin's slow ramp
        config = TwinConfig.model_validate({"dielectric": {"breakdown_v_per_m": breakdown}})
        twin = TwinBench(config, 1)
        for k in range(401):  # 20 s in steps, without the protection of the bench itself
            twin._native.move(np.array([min(2.0, 0.01 * k)]), 500, twin._load_n, np.empty(500))
        assert twin._native.broken is breaks


def test_the_command_prints_every_number_and_refuses_a_thin_dielectric(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text('kind = "twin"\n')
    arguments = [str(STUDY), "--rig", str(tmp_path / "rig.toml"), "--json"]
    done = CliRunner().invoke(command, arguments, catch_exceptions=False)
    answer = json.loads(done.stdout)
    assert answer["feasible"] and all(check["ok"] for check in answer["checks"])
    (tmp_path / "twin.toml").write_text("[dielectric]\nbreakdown_v_per_m = 20e6\n")
    (tmp_path / "rig.toml").write_text('kind = "twin"\ntwin = "twin.toml"\n')
    words = r"field is \d.* MV/m in step trials with the paper's sensing chain \(limit 18 MV/m"
    with pytest.raises(LimitError, match=words):
        CliRunner().invoke(command, arguments, catch_exceptions=False)


def test_a_recorded_session_is_not_judged_and_not_read_back(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('kind = "replay"\nsession = "s.h5"\n')
    with pytest.raises(InputError, match=r"file, of kind 'replay', has no table \[rating\]"):
        CliRunner().invoke(command, [str(STUDY), "--rig", str(path)], catch_exceptions=False)
    settings = safety_of(load_rig(path), {}, path)
    assert not settings.read_back and not settings.real_time
    with pytest.raises(InputError, match=r"residual_v"):
        safety_of(load_rig(path), {"residual_v": 500.0}, path)


def test_a_twin_is_judged_guarded_and_armed_and_left_at_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('kind = "twin"\n')
    file, study, asked = load_rig(path), builtin_study(quick=True), []
    twin = TwinBench(twin_of_reading("hz"), 1)
    plain = rig_of(twin, twin_of_reading("hz"))
    monkeypatch.setattr(click, "confirm", lambda words, err: not asked.append(words))
    with armed_rig(plain, file, path, study, tmp_path, Operator()) as rig:
        rig.source.write(1.0)
        rig.acquisition.read()
        assert twin.output_v > 4500.0
    assert twin.output_v == 0.0
    assert len(asked) == 1
    assert asked[0] == (
        "HIGH VOLTAGE WILL BE APPLIED to twin: up to 10 kV at the amplifier's output. Trips above "
        "1 mA mean current; the drive rises by at most 2000 V/s (10 MV/s at the output). No "
        "guardian watches. Keep clear. Energise?"
    )
    with pytest.raises(SafetyError, match="Arm the bench before you apply a voltage"):
        rig.source.write(0.1)
    monkeypatch.setattr(click, "confirm", lambda words, err: False)
    with (
        pytest.raises(InputError, match="Not armed: the answer was no"),
        armed_rig(plain, file, path, study, tmp_path, Operator()),
    ):
        raise AssertionError("must not be entered")


def test_a_bench_that_was_made_safe_is_armed_only_after_its_reason_was_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('kind = "twin"\n')
    file, study = load_rig(path), builtin_study(quick=True)
    plain = rig_of(TwinBench(twin_of_reading("hz"), 1), twin_of_reading("hz"))
    with armed_rig(plain, file, path, study, tmp_path) as rig:
        rig.safety.trip("Smoke.")
    asked: list[str] = []
    monkeypatch.setattr(click, "confirm", lambda words, err: bool(asked.append(words)))
    for operator in (None, Operator(), Operator(yes=True)):
        with (
            pytest.raises(SafetyError, match=r"was revoked(: |\. Reason: )Smoke \(on "),
            armed_rig(plain, file, path, study, tmp_path, operator),
        ):
            raise AssertionError("must not be entered")
    assert len(asked) == 1 and "Has the cause been removed?" in asked[0]
    with armed_rig(plain, file, path, study, tmp_path, Operator(True, True)) as rig:
        rig.source.write(1.0)


def test_a_recording_needs_no_confirmation(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('kind = "replay"\nsession = "s.h5"\n')
    plain = rig_of(TwinBench(twin_of_reading("hz"), 1), twin_of_reading("hz"))
    monkeypatch.setattr(click, "confirm", lambda words, err: 1 / 0)
    with armed_rig(
        plain, load_rig(path), path, builtin_study(quick=True), tmp_path, Operator()
    ) as rig:
        assert rig.acquisition.read().size > 0  # it plays


def test_an_end_of_input_is_no_answer_and_ctrl_c_is_an_interrupt(monkeypatch) -> None:
    request = ArmingRequest(1, "bench: up to 10 kV.", "", 1)

    def ended(error: BaseException) -> Callable[[str], str]:
        def prompt(text: str) -> str:
            raise error

        return prompt

    monkeypatch.setattr(click.termui, "visible_prompt_func", ended(EOFError()))
    with pytest.raises(InputError, match=r"no answer\. Nothing was energised\..* --yes"):
        Operator().confirm(request)
    monkeypatch.setattr(click.termui, "visible_prompt_func", ended(KeyboardInterrupt()))
    with pytest.raises(click.Abort, match="Nothing was energised") as stop:
        Operator().confirm(request)
    assert stop.value.__notes__ == ["Nothing was energised."]


TRIANGLE = """\
name = "maps"
[triangle]
low_v = 0.0
high_v = 2.0
frequency_hz = 0.5
cycles = 3
skipped_cycles = 1
frame_rate_hz = 100.0
"""


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        # On each edge of 2 cycles 0.12 V at 2 V/s, so 0.12 s: 12 frames at 100 Hz, 6 at 50 Hz.
        ("frame_rate_hz = 100.0", "frame_rate_hz = 50.0",
         "The triangle gives only 6 frames on each edge within 0.06 V of the baseline of 1 V"),
        ("[triangle]", "[operating_point]\nbaseline_v = 2.1\n[triangle]",
         "only 0 frames on each edge within 0.06 V of the baseline of 2.1 V"),
        # The window is 3 % of the span, so a larger span neither gives frames nor takes them away.
        ("high_v = 2.0\nfrequency_hz = 0.5", "high_v = 10.0\nfrequency_hz = 1.0",
         "only 6 frames on each edge within 0.3 V of the baseline of 5 V"),
        ("[triangle]", "hold_s = 3\n[triangle]", "has the key hold_s outside its tables"),
        ("[triangle]", "chirp = 3\n[triangle]", "chirp: must be a table, headed [chirp]"),
        ("skipped_cycles = 1", "skipped_cycles = 3",
         "skipped_cycles = 3 must be below cycles = 3"),
        ("high_v = 2.0", "high_v = 0.0", "low_v = 0 must be below high_v = 0"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("run", [True, False])
def test_a_triangle_without_a_result_is_refused_before_anything_moves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, words: str, run: bool
) -> None:
    study, rig = tmp_path / "study.toml", tmp_path / "rig.toml"
    rig.write_text('kind = "twin"\n')
    assert TRIANGLE.count(old) == 1
    study.write_text(TRIANGLE.replace(old, new))
    verb = ["run"] if run else ["plan", "feasibility"]
    with pytest.raises(SystemExit) as stop:
        main([*verb, str(study), "--rig", str(rig), "--out", str(tmp_path / "out")])
    error = capsys.readouterr().err
    assert stop.value.code == 2 and words in error and error.count("\n") == 1
    assert str(study) in error and not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("[quick.triangle]\nframe_rate_hz = -1.0", "triangle.frame_rate_hz"),
        ("[quick.trangle]\ncycles = 4", "has a table [trangle], but no installed experiment"),
        ("[quick.triangle]\ncycle = 4", "triangle.cycle: no such key"),
        ("[quick.triangle]\nframe_rate_hz = 50.0", "The triangle gives only 6 frames"),
    ],
)
def test_the_quick_tables_are_checked_without_quick(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], table: str, words: str
) -> None:
    study, rig = tmp_path / "study.toml", tmp_path / "rig.toml"
    rig.write_text('kind = "twin"\n')
    study.write_text(f"{TRIANGLE}{table}\n")
    with pytest.raises(SystemExit) as stop:
        main(["plan", "feasibility", str(study), "--rig", str(rig)])
    error = capsys.readouterr().err
    assert stop.value.code == 2 and error.count("\n") == 1
    assert error.startswith("haselab: With the changes of [quick]: ") and words in error
    study.write_text(f"{TRIANGLE}[quick.triangle]\ncycles = 4\n")
    with pytest.raises(SystemExit) as stop:
        main(["plan", "feasibility", str(study), "--rig", str(rig)])
    assert stop.value.code == 0


@pytest.mark.parametrize(
    ("more", "is_said"),
    [("", True), ("[quick]\n", True), ("[quick.triangle]\ncycles = 4\n", False)],
)
def test_a_quick_run_of_a_study_without_a_quick_form_says_that_all_of_it_is_played(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: str, is_said: bool
) -> None:
    """Here the bench refuses the study afterwards, so that the test is short."""
    study, rig = tmp_path / "study.toml", tmp_path / "rig.toml"
    rig.write_text('kind = "twin"\n')
    study.write_text(TRIANGLE.replace("high_v = 2.0", "high_v = 9.0") + more)
    words = ["run", str(study), "--rig", str(rig), "--quick", "--out", str(tmp_path / "out")]
    with pytest.raises(SystemExit) as stop:
        main(words)
    lines = capsys.readouterr().err.splitlines()
    assert stop.value.code == 2 and len(lines) == 1 + is_said
    said = "haselab: --quick changes nothing, because the study has no table [quick]"
    assert lines[0].startswith(said) == is_said
    assert not is_said or "Add [quick.triangle] with the keys of [triangle]" in lines[0]


@pytest.mark.parametrize("high_v", [0.5, 2.0, 10.0])
def test_a_triangle_with_just_enough_frames_is_feasible(tmp_path: Path, high_v: float) -> None:
    text = TRIANGLE.replace("high_v = 2.0", f"high_v = {high_v}")
    (tmp_path / "study.toml").write_text(text.replace("100.0", "67.0"))
    check_settings(load_study(tmp_path / "study.toml"))


def test_a_study_that_plays_nothing_is_refused(tmp_path: Path) -> None:
    (tmp_path / "study.toml").write_text('name = "a"\n[control]\nkind = "open-loop"\n')
    with pytest.raises(InputError, match=r"plays nothing: it has only \[control\]\. Add an exper"):
        check_settings(load_study(tmp_path / "study.toml"))


@pytest.mark.parametrize("name", ["current_limit_a", "rate_limit_v_per_s", "follow"])
def test_a_limit_without_effect_on_a_microcontroller_is_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / "rig.toml"
    file = ChipFile.model_construct(kind="chip", port=None)
    with pytest.raises(InputError, match=rf"safety\.{name} has no effect on a microcontroller"):
        safety_of(file, {name: 0.05}, path)
    assert "mean current. The microcontroller ramps down" in arming_limits(
        rig_of(TwinBench(twin_of_reading("hz"), 1), twin_of_reading("hz")).description,
        1e-3, 2000.0, own_controller=True,
    )  # fmt: skip


@pytest.mark.parametrize("section", ["rating", "safety"])
def test_a_fault_names_the_section_of_a_limit_that_two_sections_have(
    tmp_path: Path, section: str
) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('kind = "twin"\n')
    file = load_rig(path)
    with pytest.raises(InputError, match=rf"1 error: {section}\.current_limit_a: "):
        if section == "safety":
            safety_of(file, {"current_limit_a": 0.0}, path)
        else:
            bench = BenchConfig.model_construct(kind="bench", camera=object(), rating={
                "current_limit_a": 0.0, "slew_v_per_s": 1.0, "bandwidth_hz": 1.0,
                "capacitance_f": 1.0, "thickness_m": 1.0, "breakdown_v_per_m": 1.0,
            })  # fmt: skip
            check_study_on_rig(bench, builtin_study(quick=True), path)


def test_a_study_that_is_too_much_is_refused_before_arming(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    (tmp_path / "twin.toml").write_text("[amplifier]\ncurrent_limit_a = 1e-3\n")
    path.write_text('kind = "twin"\ntwin = "twin.toml"\n')
    config = twin_of_reading("hz")
    plain = rig_of(TwinBench(config, 1), config)
    with (
        pytest.raises(
            LimitError, match=r"current is 8\.198 mA in step trials with the paper's sensing chain"
        ),
        armed_rig(plain, load_rig(path), path, builtin_study(), tmp_path),
    ):
        raise AssertionError("must not be entered")


def test_the_carrier_of_the_printed_chain_is_judged_too() -> None:
    """0.2 V are 1 kV and, at the largest capacitance, more than the amplifier's 12 mA."""
    config, study = twin_of_reading("hz"), builtin_study()
    rating = rating_of_twin(config, study)
    assert check_study(study, describe(config), rating).ok
    for trials in (1, 0):
        changed = {"paper_chain_carrier_v": 0.2, "paper_chain_trials": trials}
        loud = study.model_copy(update={"steps": study.steps.model_copy(update=changed)})
        found = check_study(loud, describe(config), rating)
        bad = {check.name: check.where for check in found.checks if not check.ok}
        named = dict.fromkeys(
            ("peak current", "time of an update"), "step trials with the paper's sensing chain"
        )
        assert bad == (named if trials else {})


@pytest.mark.parametrize(
    ("text", "words"), [("kind = 'twin'\n", "needs kind = 'bench'"), ("kind = \n", "Not a TOML")]
)
def test_a_guardian_that_cannot_act_is_never_ready(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "rig.toml").write_text(text)
    command = [*guardian_command(tmp_path / "rig.toml"), "0", str(tmp_path / "log")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 1
    assert done.stdout.startswith("failed ") and words in done.stdout


def test_the_field_is_that_of_the_study_also_beyond_the_breakdown() -> None:
    # After a breakdown the twin's voltage is 0, so the largest field would be the breakdown's for
    # every shell. The softer the shell, the thinner it is drawn.
    study, fields = builtin_study(), []
    for thickness_m in (0.6e-3, 1.0e-3, 1.2e-3, 2.0e-3):
        config = TwinConfig.model_validate({"shell": {"thickness_m": thickness_m}})
        found = check_study(study, describe(config), rating_of_twin(config, study))
        fields.append(next(c.requested for c in found.checks if c.name == "field"))
    assert fields == sorted(fields, reverse=True)
    assert fields[1] > 1.2 * 40.0


def test_the_numbers_on_the_page_about_safety_are_those_of_the_reference_study() -> None:
    page = Path(__file__).parents[3] / "docs" / "bench" / "safety.md"
    if not page.is_file():
        pytest.skip("an installed package has no docs")
    config, study = twin_of_reading("hz"), builtin_study()
    found = check_study(study, describe(config), rating_of_twin(config, study)).checks
    asked = {check.name: check.requested for check in found}
    assert (
        f"a current of {asked['peak current']:.1f} mA (limit 12 mA), "
        f"{asked['time of an update']:.2f} ms for the largest update (limit 5 ms) and a field of "
        f"{asked['field']:.1f} MV/m (limit 36 MV/m)"
    ) in " ".join(page.read_text(encoding="utf-8").split())


@pytest.mark.long
def test_the_figure_shows_the_requested_values_over_their_limits(tmp_path: Path) -> None:
    (tmp_path / "rig.toml").write_text('kind = "twin"\n')
    figure = tmp_path / "feasible.svg"
    arguments = [str(STUDY), "--rig", str(tmp_path / "rig.toml"), "--plot", str(figure)]
    CliRunner().invoke(command, arguments, catch_exceptions=False)
    text = figure.read_text()
    assert "Requested over limit" in text and "stretch" in text
