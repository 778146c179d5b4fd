"""A bench without any instrument of this package: nothing else knows which drivers there are."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from haselab.rig.bench_config import BenchConfig
from haselab.rig.instruments.registry import INSTRUMENTS
from haselab.rig.real_bench import identify
from haselab.rig.rig_file import load_rig, opened_rig
from haselab.safety.gate import Gate
from haselab.safety.guardian.make_safe import make_safe, revoke_and_make_safe
from haselab.safety.interlock import Interlock
from haselab.testing.conformance import BenchConformance, InstrumentConformance

RIG = """
kind = "bench"
[daq]
kind = "own-daq"
ahead_blocks = 0
[amplifier]
name = "any"
[generator]
kind = "own-generator"
highest_hz = 80e3
[specimen]
shell_width_m = 0.03
shell_thickness_m = 0.002
mass_kg = 0.25
"""


@pytest.fixture(scope="module")
def module(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """The package, installed into a folder of the import path."""
    folder = tmp_path_factory.mktemp("site")
    shutil.copy(Path(__file__).with_name("own_daq.py"), folder / "own_daq.py")
    metadata = folder / "own_daq-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: own-daq\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(
        f"[{INSTRUMENTS.group}]\nown-daq = own_daq:OwnDaq\nown-generator = own_daq:OwnGenerator\n"
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        INSTRUMENTS.others.cache_clear()
        import own_daq

        yield own_daq
    del sys.modules["own_daq"]
    INSTRUMENTS.others.cache_clear()


@pytest.fixture
def rig_file(tmp_path: Path, module: Any) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text(RIG)
    return path


@pytest.fixture
def file(rig_file: Path) -> BenchConfig:
    file = load_rig(rig_file)
    assert isinstance(file, BenchConfig)
    return file


class TestOwnBench(BenchConformance):
    """As with the drivers of this package."""


class TestOwnDaq(InstrumentConformance):
    section = "daq"


def test_its_instruments_identify_themselves(file: BenchConfig) -> None:
    assert identify(file) == [("daq", "own daq, number 7"), ("generator", "own generator")]


def test_it_is_shut_down_from_outside(file: BenchConfig, rig_file: Path, module: Any) -> None:
    with opened_rig(file, rig_file, gate := Gate()) as rig:
        gate.permit(gate.interlock.revision)
        rig.source.write(1.0)
        rig.generator.sine(2000.0, 0.02)
        rig.acquisition.read()
        rig.acquisition.read()
        twin = module.BENCHES[-1]
        assert twin.output_v > 4000.0 and twin.native.carrier_v > 0.0
        assert make_safe(file) == [("daq", ""), ("generator", "")]
        assert twin.output_v == pytest.approx(0.0, abs=1e-6) and twin.native.carrier_v == 0.0


def test_rig_safe_revokes_its_permission_by_the_key_of_its_driver(file: BenchConfig) -> None:
    interlock = Interlock("own daq 7")
    try:
        before = interlock.revision
        assert revoke_and_make_safe(file, "a test") == [("daq", ""), ("generator", "")]
        assert interlock.revision != before and interlock.reason.startswith("a test (on ")
    finally:
        interlock.close()
