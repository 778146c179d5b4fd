"""`haselab twin new` writes the bench that was asked for, or says in one line why it cannot."""

import json
import tomllib

import pytest

from haselab.actuators import DeaStack
from haselab.cli.main import main
from haselab.rig.twin.camera import TwinCamera
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.twin_file import load_twin


def run(*arguments: object) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["twin", "new", *map(str, arguments)])
    return int(ended.value.code or 0)


def test_the_default_is_the_default_twin(tmp_path) -> None:
    path = tmp_path / "twin.toml"
    assert run("--name", "twin", "--out", path) == 0
    assert load_twin(path) == TwinConfig()


def test_values_are_set_and_every_parameter_is_in_the_file(tmp_path) -> None:
    path = tmp_path / "stack.toml"
    values = ("actuator.layers=40", "actuator.branch_share=[0.1, 0.2]", "camera.width_px=600")
    assert (
        run("--kind", "dea-stack", *(w for v in values for w in ("--set", v)), "--out", path) == 0
    )
    twin = load_twin(path)
    assert (twin.law.parameters()["actuator.layers"], twin.camera.width_px) == (40.0, 600)
    written = tomllib.loads(path.read_text())["actuator"]
    assert list(written) == [about.name for about in DeaStack.described()]
    assert written["branch_share"] == [0.1, 0.2]
    assert "layer_thickness_m = 0.0007  # m, 1e-06 to 0.01: undeformed" in path.read_text()


@pytest.mark.parametrize(
    ("kind", "changes"),
    [("peano-hasel", ("pouches=8", "pouch_length_m=0.012", "electrode_length_m=0.006")),
     ("curling-hasel", ("strip_width_m=0.03",)), ("dea-stack", ("side_m=0.02", "layers=80"))],
)  # fmt: skip
def test_the_camera_sees_the_whole_of_an_actuator_of_any_size(kind, changes, tmp_path) -> None:
    path = tmp_path / "twin.toml"
    words = [word for change in changes for word in ("--set", f"actuator.{change}")]
    assert run("--kind", kind, *words, "--out", path) == 0
    twin = load_twin(path)
    law, scale = twin.law, twin.camera.scale_m_per_px
    seen = TwinCamera(twin.camera, 0.5 * law.width_m, law.free_length_m, seed=1).lengths_m
    assert seen.low < 0.8 * law.free_length_m and 1.1 * law.free_length_m < seen.high
    assert 250.0 < law.free_length_m / scale < 350.0
    assert twin.camera.neck_coefficient == 0.0
    assert run("--kind", kind, "--set", "camera.scale_m_per_px=1e-4", "--out", path) == 2
    other = tmp_path / "other.toml"
    assert run("--kind", kind, "--set", "camera.scale_m_per_px=1e-4", "--out", other) == 0
    assert load_twin(other).camera.scale_m_per_px == 1e-4


def test_it_prints_toml_or_json(capsys) -> None:
    assert run("--set", "load.mass_kg=0.3") == 0
    assert tomllib.loads(capsys.readouterr().out)["load"]["mass_kg"] == 0.3
    assert run("--kind", "dea-stack", "--json") == 0
    assert json.loads(capsys.readouterr().out)["actuator"]["layers"] == 50.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--kind", "muscle"), "No actuator 'muscle' is registered. Use one of "),
        (("--set", "shell.length_m"), "is not SECTION.KEY=VALUE"),
        (("--set", "length_m=3"), "is not SECTION.KEY=VALUE"),
        (("--set", "shell.length_m=long"), "is not SECTION.KEY=VALUE"),
        (("--set", "name.x=1"), "name is not a section. Use --name"),
        (("--set", "shell.length_m=3"), "less than 0.2 (got 3)"),
        (("--kind", "dea-stack", "--set", "actuator.layers=0"), "outside [1, 100000]"),
    ],
)
def test_what_cannot_be_a_twin_is_refused_in_one_line(arguments, words, tmp_path, capsys) -> None:
    out = tmp_path / "twin.toml"
    assert run(*arguments, "--out", out) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1
    assert not out.exists()
