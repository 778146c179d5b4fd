"""Options that exclude each other, and files that say too little, are refused in one line."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from click.testing import CliRunner

from haselab.base import InputError, LimitError
from haselab.cli.doctor import command as doctor
from haselab.cli.model.firmware import command as firmware
from haselab.cli.study.reproduce import command as reproduce
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


def test_a_rig_file_without_a_kind_names_the_kinds(tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text('reading = "hz"\n')
    with pytest.raises(InputError, match='has no key kind: "twin" or "bench" or "chip"'):
        load_rig(path)


class _Plain(Section):
    length_m: float


def test_a_missing_number_names_no_words() -> None:
    with pytest.raises(InputError, match=r"the file has no key length_m: in m\. x\.toml"):
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
