"""The folder of a run stands for its actuator file wherever a command reads one."""

import json
import shutil

import click
import pytest

from haselab.cli.main import cli, main
from haselab.models.plant import Plant, SlowMode

PLANT = Plant(1.0, 32.1, 0.12, slow_modes=(SlowMode(0.5, 6.0),))


def run(capsys, *arguments):
    with pytest.raises(SystemExit) as stop:
        main([str(item) for item in arguments])
    printed = capsys.readouterr()
    return stop.value.code, printed.out, printed.err


@pytest.fixture(scope="module")
def designed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("designed")
    model = folder / "model.json"
    model.write_text(json.dumps({"plant": PLANT.to_dict()}))
    arguments = ["design", str(model), "--structure", "pi", "--out", str(folder / "actuator.toml")]
    cli.main(arguments, standalone_mode=False)
    return folder / "actuator.toml"


@pytest.fixture
def folder(designed, tmp_path):
    """The folder of a run, with nothing but its actuator file."""
    shutil.copy(designed, tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    "command", [("margins",), ("design", "--json"), ("export", "--to", "json")]
)
def test_a_folder_gives_the_answer_of_the_file_in_it(command, folder, capsys):
    name, *options = command
    of_file = run(capsys, name, folder / "actuator.toml", *options)
    of_folder = run(capsys, name, folder, *options)
    assert of_file[0] == 0
    assert of_folder[:2] == of_file[:2]


def test_a_design_writes_into_the_file_of_the_folder(folder, capsys):
    before = (folder / "actuator.toml").read_text()
    assert run(capsys, "design", folder)[0] == 0
    after = (folder / "actuator.toml").read_text()
    assert 'kind = "pid"' in after and 'kind = "pid"' not in before


def test_compare_takes_the_folder(folder, capsys):
    record = folder / "record.csv"
    u = [0.0] * 50 + [0.02] * 150
    y = PLANT.simulate(u, 100.0, [k / 100.0 for k in range(200)])
    pairs = enumerate(zip(u, y, strict=True))
    rows = "".join(f"{k / 100.0},{one},{other}\n" for k, (one, other) in pairs)
    record.write_text(f"time_s,u,y\n{rows}")
    answers = [run(capsys, "compare", at, record) for at in (folder / "actuator.toml", folder)]
    assert answers[0][:2] == answers[1][:2] and "fit_percent" in answers[0][1]


def test_the_model_of_an_older_run_is_its_model_json(tmp_path, capsys):
    (tmp_path / "model.json").write_text(json.dumps({"plant": PLANT.to_dict()}))
    code, text, _ = run(capsys, "margins", tmp_path, "--kp", 0.5, "--ki", 2)
    assert code == 0 and "phase_margin_deg" in text


@pytest.mark.parametrize(
    "words",
    [("margins", "{}"), ("design", "{}"), ("compare", "{}", "{}/x.csv"),
     ("export", "{}", "--to", "json"), ("plan-experiment", "{}", "--goal", "all"),
     ("run", "s.toml", "--rig", "r.toml", "--actuator", "{}", "--out", "{}/out"),
     ("run", "s.toml", "--twin", "{}", "--out", "{}/out"),
     ("reproduce", "--twin", "{}", "--out", "{}/out"),
     ("identify", "transfer", "x.csv", "--actuator", "{}"),
     ("plan", "feasibility", "s.toml", "--actuator", "{}"),
     ("panel", "--actuator", "{}", "--no-browser")],
)  # fmt: skip
def test_a_folder_without_an_actuator_file_is_one_line_that_names_it(words, tmp_path, capsys):
    code, _, error = run(capsys, *(word.format(tmp_path) for word in words))
    assert code == 2 and error.count("\n") == 1
    assert "has no actuator.toml" in error and str(tmp_path) in error


def test_every_option_and_argument_for_an_actuator_file_takes_the_folder_of_a_run(tmp_path):
    """Those of commands that are added later, too."""
    (tmp_path / "actuator.toml").write_text("[actuator]\n")
    context = click.Context(cli, info_name="haselab")
    wrong = []

    def visit(command, path):
        if isinstance(command, click.Group):
            for name in command.list_commands(context):
                visit(command.get_command(context, name), [*path, name])
            return
        for parameter in command.params:
            if parameter.name in ("actuator", "twin") or (
                parameter.name == "model" and isinstance(parameter, click.Argument)
            ):
                found = parameter.type.convert(str(tmp_path), parameter, context)
                if found != tmp_path / "actuator.toml":
                    wrong.append(" ".join([*path, parameter.name]))

    visit(cli, ["haselab"])
    assert not wrong


@pytest.mark.parametrize(
    ("given", "missing"),
    [(("--ki", "3"), "--kp"), (("--kp", "3"), "--ki"), (("--kd", "1"), "--kp")],
)
def test_some_gains_alone_name_the_missing_one_and_what_to_give(folder, capsys, given, missing):
    code, _, error = run(capsys, "margins", folder, *given)
    assert code == 2 and error.count("\n") == 1
    assert f"Missing option '{missing}'" in error and f"Give {missing} 0" in error


def test_gains_beside_a_controller_of_the_file_are_refused(folder, capsys):
    code, _, error = run(capsys, "margins", folder, "--kp", 0, "--ki", 1, "--controller", "pi")
    assert code == 2 and "Leave out --controller or the gains" in error


@pytest.mark.parametrize("option", ["--kp", "--ki", "--kd", "--derivative-filter-s"])
def test_gains_given_to_a_design_are_led_to_margins(folder, capsys, option):
    code, _, error = run(capsys, "design", folder, option, 3)
    assert code == 2 and error.count("\n") == 1
    assert "haselab margins MODEL --kp KP --ki KI" in error
