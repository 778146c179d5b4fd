"""TWIN.toml: every parameter can be set, every fault is reported at once with its path."""

from pathlib import Path

import pytest

from haselab.base import InputError
from haselab.rig.twin.config import READINGS, TwinConfig, twin_of_reading
from haselab.rig.twin.twin_file import load_twin


def write(folder: Path, text: str) -> Path:
    path = folder / "twin.toml"
    path.write_text(text, encoding="utf-8")
    return path


def test_an_empty_file_is_the_default_bench(tmp_path: Path) -> None:
    assert load_twin(write(tmp_path, "")) == TwinConfig()


def test_a_value_changes_and_its_neighbours_stay(tmp_path: Path) -> None:
    twin = load_twin(write(tmp_path, "[shell]\nlength_m = 0.08\n"))
    assert twin.shell.length_m == 0.08
    assert twin.shell.width_m == TwinConfig().shell.width_m
    assert twin.free_length_m == pytest.approx(0.08 / 3**0.5, rel=1e-15)


@pytest.mark.parametrize("reading", list(READINGS))
def test_a_reading_brings_its_values_and_the_file_may_overrule_them(
    reading: str, tmp_path: Path
) -> None:
    whole = load_twin(write(tmp_path, f'reading = "{reading}"\n'))
    assert whole == twin_of_reading(reading)
    own = load_twin(write(tmp_path, f'reading = "{reading}"\n[load]\nadded_inertia_kg = 1.5\n'))
    assert own.load.added_inertia_kg == 1.5
    assert own.viscosity == whole.viscosity


def test_all_faults_are_reported_at_once_each_with_its_path(tmp_path: Path) -> None:
    path = write(
        tmp_path,
        "[load]\nmass_kg = -0.25\n[shell]\nlenght_m = 0.06\n"
        '[acquisition]\nbits = 24\n[amplifier]\ngain = "high"\n',
    )
    with pytest.raises(InputError, match=r"^4 errors") as fault:
        load_twin(path)
    message = str(fault.value)
    for where, what in (
        ("load.mass_kg", "greater than 0 (got -0.25)"),
        ("shell.lenght_m", "no such key; the keys are"),
        ("acquisition.bits", "less than or equal to 16 (got 24)"),
        ("amplifier.gain", "'high'"),
    ):
        assert f"{where}: " in message
        assert what in message
    assert message.endswith(str(path))
    assert "\n" not in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[no_such_section]\nx = 1\n", "no_such_section"),
        ("color = 3\n", "color"),
        ("[viscosity]\nshare = [0.1]\n", "one number per branch"),
        ("[viscosity]\nshare = [-1.0]\nrelaxation_s = [1.0]\n", "0 <= share"),
        ("[acquisition]\nskew_s = 4e-6\n", "half a sample"),
        ("[acquisition]\noutput_delay_s = 6e-3\n", "half a block"),
        ("[acquisition]\nblock_samples = 2010\n", "multiple of 40"),
        ("[shell]\nlength_m = nan\n", "shell.length_m"),
        ("[dielectric]\nrelaxation_share = 1.0\n", "less than 1"),
        ('reading = "knots"\n', "reading"),
        ("load = 3\n", "load"),
        ("[load\n", "Not a TOML file"),
    ],
)
def test_what_cannot_be_a_bench_is_refused_in_one_line(
    text: str, words: str, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=r"twin\.toml$") as fault:
        load_twin(write(tmp_path, text))
    assert words in str(fault.value)
    assert "\n" not in str(fault.value)


def test_a_file_that_is_not_there_or_no_text_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such twin file"):
        load_twin(tmp_path / "none.toml")
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="not a text in UTF-8"):
        load_twin(binary)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('kind = "muscle"\n', "No actuator 'muscle' is registered"),
        ('kind = "dea-stack"\n[actuator]\nlayer = 3.0\n', "actuator.layer is not a parameter"),
        ('kind = "dea-stack"\n[actuator]\nlayers = 0.0\n', "actuator.layers = 0 is outside"),
        ('kind = "dea-stack"\n[shell]\nlength_m = 0.05\n', "the table shell describes"),
        ('kind = "dea-stack"\nreading = "rad"\n', "the table viscosity describes"),
        ("[actuator]\nlayers = 3.0\n", "the table actuator has no effect"),
    ],
)
def test_what_is_no_parameter_of_the_kind_is_refused(text: str, words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"twin\.toml$") as fault:
        load_twin(write(tmp_path, text))
    assert words in str(fault.value)
    assert "\n" not in str(fault.value)


def test_another_kind_has_its_own_law_and_comes_back_from_a_recording(tmp_path: Path) -> None:
    text = 'kind = "dea-stack"\n[actuator]\nlayers = 40.0\nbranch_share = [0.1]\n'
    twin = load_twin(write(tmp_path, text + "branch_relaxation_s = [2.0]\n"))
    assert twin.law.kind == "dea-stack"
    assert twin.free_length_m == pytest.approx(40.0 * 0.7e-3, rel=1e-15)
    assert twin.law.losses.branch_relaxation_s == (2.0,)
    assert TwinConfig.model_validate(twin.model_dump(mode="json")) == twin
