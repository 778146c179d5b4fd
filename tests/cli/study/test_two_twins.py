"""Options that exclude each other, and files that say too little, are refused in one line."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from haselab.base import InputError, LimitError
from haselab.cli.bench.calibrate import command as calibrate
from haselab.cli.doctor import command as doctor
from haselab.cli.model.firmware import command as firmware
from haselab.cli.study.reproduce import command as reproduce
from haselab.cli.study.run import command as run
from haselab.rig.chip import build
from haselab.rig.rig_file import load_rig
from haselab.store.toml import Section, validated


@pytest.fixture
def twin(tmp_path: Path) -> Path:
    path = tmp_path / "twin.toml"
    path.write_text('reading = "hz"\n')
    return path


@pytest.mark.parametrize("reading", ["rad", "hz"])
def test_a_reading_beside_a_twin_is_refused(reading: str, twin: Path, tmp_path: Path) -> None:
    """Before, the reading had no effect and nothing was said."""
    out = tmp_path / "out"
    both = ["--reading", reading, "--twin", str(twin)]
    words = rf"--reading {reading} chooses a default twin, .* Leave one of them out"
    with pytest.raises(InputError, match=words):
        CliRunner().invoke(reproduce, [*both, "--out", str(out)], catch_exceptions=False)
    with pytest.raises(InputError, match=words):
        CliRunner().invoke(firmware, ["simulate", str(tmp_path), *both], catch_exceptions=False)
    assert not list(out.glob("*"))


LEG = """\
[actuator]
name = "leg"
kind = "planar-hasel"
[model.physical]
kind = "planar-hasel"
not_identifiable = ["mullins.width"]
[model.physical.parameters]
shell.shear_modulus_pa = 15e3
mullins.width = 0.3
"""
STUDY = """\
name = "short"
[triangle]
low_v = 0.0
high_v = 2.0
frequency_hz = 0.25
cycles = 3
skipped_cycles = 1
frame_rate_hz = 50.0
"""


@pytest.fixture
def leg(tmp_path: Path) -> Path:
    path = tmp_path / "leg.toml"
    path.write_text(LEG)
    (tmp_path / "study.toml").write_text(STUDY)
    return path


def test_options_that_do_not_fit_an_identified_actuator_are_refused(leg: Path, twin: Path) -> None:
    folder = leg.parent
    study, out = str(folder / "study.toml"), str(folder / "out")
    rigs = {"chip": '\nrun = "."\n[simulator]', "twin": '\ntwin = "leg.toml"'}
    for kind, rest in rigs.items():
        (folder / f"{kind}-rig.toml").write_text(f'kind = "{kind}"{rest}\n')
    (folder / "plain.toml").write_text('kind = "twin"\n')
    for command, arguments, words in (
        (reproduce, ["--draw", 1], r"--draw 1 draws the parameters of an identified actuator"),
        (reproduce, ["--draw", 1, "--twin", twin], r"Name its actuator file with --twin A\.toml"),
        (run, [study, "--rig", folder / "plain.toml", "--draw", 1], r"--draw 1 needs --twin A"),
        (run, [study, "--rig", folder / "plain.toml", "--twin", twin], r"is a whole twin with its"),
        (run, [study, "--rig", folder / "chip-rig.toml", "--twin", leg], r"has kind = 'chip'"),
        (run, [study, "--rig", folder / "twin-rig.toml", "--twin", leg], r"already has the ident"),
        (run, [study, "--twin", leg, "--draw", 1], r"mullins\.width cannot be drawn: it is not"),
    ):
        given = [*map(str, arguments), "--out", out]
        with pytest.raises(InputError, match=words):
            CliRunner().invoke(command, given, catch_exceptions=False)
    assert not list(Path(out).glob("*"))


@pytest.mark.long
def test_a_study_is_rehearsed_on_the_bench_of_a_rig_file(leg: Path) -> None:
    """Also with a calibration for another amplifier, which the twin does not have."""
    folder = leg.parent
    rig, out = folder / "rig.toml", folder / "out"
    (folder / "bench.toml").write_text('name = "my bench"\n[amplifier]\ni_monitor_lag_s = 1e-6\n')
    rig.write_text('kind = "twin"\ntwin = "bench.toml"\nseed = 5\n')
    other = folder / "other.toml"
    other.write_text('kind = "twin"\ntwin = "trek.toml"\n')
    (folder / "trek.toml").write_text('[amplifier]\nname = "Trek"\ni_monitor_gain_error = 0.03\n')
    given = ["--rig", other, "--capacitor", 1e-9, "--capacitor", 5e-10, "--actuator", leg]
    done = CliRunner().invoke(calibrate, [*map(str, given)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    given = [folder / "study.toml", "--rig", rig, "--twin", leg, "--actuator", leg]
    given += ["--keep-video", "none"]
    done = CliRunner().invoke(run, [*map(str, given), "--out", str(out)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert "simulating the identified actuator 'leg', with its estimates. leg.toml" in done.stderr
    assert "the calibration is for 'Trek' and is left out on the twin." in done.stderr
    assert "warning: not identifiable from its records: mullins.width." in done.stderr
    results = json.loads((out / "results.json").read_text())
    config = results["provenance"]["rig_config"]
    assert results["provenance"]["seed"] == 5
    assert config["amplifier"]["i_monitor_lag_s"] == 1e-6
    assert config["shell"]["shear_modulus_pa"] == 15e3
    assert config["origin"]["not_identifiable"] == ["mullins.width"]
    page = (out / "report.html").read_text()
    assert "<h1>SIMULATED, twin of the identified actuator &#39;leg&#39;: short</h1>" in page


def test_a_rig_file_without_a_kind_names_the_kinds(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('reading = "hz"\n')
    with pytest.raises(InputError, match=r'has no key kind \("twin" or "bench" or "chip"'):
        load_rig(path)


class _Plain(Section):
    length_m: float


def test_a_missing_number_names_no_words() -> None:
    with pytest.raises(InputError, match=r"the file has no key length_m \(in m\)\. x\.toml"):
        validated(_Plain, {}, "x.toml")


def test_a_twin_that_is_too_heavy_is_refused_with_every_advice(twin: Path, tmp_path: Path) -> None:
    twin.write_text("[load]\nmass_kg = 0.35\n")
    with pytest.raises(
        LimitError, match=r"1\) peak current is .* 2\) time of an update is infinite"
    ) as (refused):
        CliRunner().invoke(
            reproduce,
            ["--twin", str(twin), "--quick", "--out", str(tmp_path / "out")],
            catch_exceptions=False,
        )
    printed = str(refused.value)
    assert not re.search(r"\binf\b", printed)
    assert "in step trials with the paper's sensing chain" in printed
    assert "The carrier alone needs all of the amplifier's current." in printed
    assert "Lower the voltage or the hung mass of 0.35 kg." in printed


def test_the_doctor_looks_for_the_library_that_a_co_simulation_is_built_with(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for path in ("/usr/include/simavr/sim_avr.h", None):
        monkeypatch.setattr(doctor, "simavr_header", lambda found=path: found)
        assert doctor._tool("libsimavr").found == (path is not None)
    assert "simavr" not in doctor._TOOLS  # the program, which nothing of haselab starts
    header = build.simavr_header()
    assert header is None or Path(header).is_file()
