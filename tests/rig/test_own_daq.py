"""A bench without any instrument of this package: nothing else knows which drivers there are."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from haselab.cli.main import main
from haselab.rig.bench_config import BenchConfig
from haselab.rig.instruments.registry import INSTRUMENTS
from haselab.rig.real_bench import identify
from haselab.rig.rig_file import load_rig, opened_rig
from haselab.safety.gate import Gate
from haselab.safety.guardian.make_safe import make_safe, revoke_and_make_safe
from haselab.safety.interlock import Interlock
from haselab.store.video.writer import write_png
from haselab.testing.conformance import BenchConformance, DaqConformance

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


class TestOwnDaq(DaqConformance):
    """The output is also read at the twin, without the driver."""

    @pytest.fixture
    def output_v(self, module: Any) -> Callable[[], float]:
        return lambda: float(module.BENCHES[-1].output_v)


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


@pytest.mark.parametrize(
    "error", [ZeroDivisionError("division by zero"), ConnectionResetError(104, "reset")]
)
@pytest.mark.long
def test_a_driver_that_fails_under_voltage_is_named_after_0_v(
    rig_file: Path,
    tmp_path: Path,
    module: Any,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    error: Exception,
) -> None:
    monkeypatch.setattr(module, "FAULTS", [error])
    (tmp_path / "images").mkdir()
    write_png(tmp_path / "images" / "1.png", np.zeros((32, 32), np.uint8))
    camera = f'[camera]\nkind = "folder"\npath = "{tmp_path / "images"}"\nrepeat = true\n'
    rig_file.write_text(RIG + camera)
    monkeypatch.setenv("PYTHONPATH", str(Path(module.__file__).parent))  # of the guardians
    study = tmp_path / "study.toml"
    study.write_text(
        'name = "a"\n[triangle]\nlow_v = 0.0\nhigh_v = 1.0\nfrequency_hz = 1.0\ncycles = 3\n'
        "skipped_cycles = 1\nframe_rate_hz = 400.0\n"
    )
    with pytest.raises(SystemExit) as stop:
        main(["run", str(study), "--rig", str(rig_file), "--yes", "--acknowledge",
              "--out", str(tmp_path / "out")])  # fmt: skip
    said = capsys.readouterr().err
    assert stop.value.code == 4
    assert f"OwnDaqDevice.write of the package 'own_daq' failed: {type(error).__name__}" in said
    assert module.BENCHES[-1].output_v == pytest.approx(0.0, abs=1e-6)
