"""The chip with a serial high-voltage supply: the loop closes over both wires."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from haselab.base import InputError
from haselab.firmware import ChipSettings
from haselab.rig.chip import (
    ChipBench,
    ChipFile,
    CoSim,
    Firmware,
    SuppliedCoSim,
    SupplyModel,
    build_firmware,
)
from haselab.rig.rig_file import load_rig
from haselab.rig.twin.twin_bench import TwinBench

GAIN = 5000.0
pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminals")


@pytest.fixture(scope="module")
def slower(settings: ChipSettings) -> ChipSettings:
    """For a module that reaches 5 kV."""
    return replace(settings, strain_high=0.0, drive_high_v=1.05, rise_v_per_s=7.0)


@pytest.fixture
def supplied(
    firmware: Firmware, cosim_program: Path, twin: TwinBench, slower: ChipSettings, tmp_path: Path
) -> Iterator[SuppliedCoSim]:
    pytest.importorskip("serial")
    del firmware  # which skips where the compiler is missing
    elf = build_firmware(slower, tmp_path).elf
    with SuppliedCoSim(cosim_program, elf, twin, SupplyModel(), GAIN) as chip:
        chip.run(0.02)
        yield chip


def test_the_supply_follows_the_chip_and_goes_to_0_v_with_it(
    supplied: SuppliedCoSim, slower: ChipSettings
) -> None:
    bench = ChipBench(supplied, slower)
    supplied.command("track 8")
    codes = []
    for _ in range(200):
        bench.follow(-0.02)
        codes.append(bench.read())
    high_v = np.array([track.high_v for track in supplied.tracks[-200:]])
    requested_v = bench.output_v * GAIN
    # The supply lags by a few commands of 10 ms, in which the chip asks for 70 V more at most each.
    assert high_v[-20:].mean() == pytest.approx(requested_v, abs=600.0)
    assert requested_v > 500.0
    assert supplied.commands > 150
    assert supplied.supply.rail_v <= 5000.0
    bench.zero()
    bench.pass_time(0.5)
    assert not supplied.outputs[-1].on
    assert supplied.supply.rail_v < 1.0
    assert supplied.tracks[-1].high_v < 5.0


def test_the_enable_pin_cuts_the_supply_at_once(
    supplied: SuppliedCoSim, slower: ChipSettings
) -> None:
    bench = ChipBench(supplied, slower)
    supplied.command("track 1")
    for _ in range(60):
        bench.follow(-0.02)
        bench.read()
    before_v = supplied.tracks[-1].high_v
    supplied.fault("breakdown")
    supplied.run(4e-3)
    assert supplied.outputs[-1].enable == 0
    assert before_v > 500.0
    assert supplied.supply.rail_v > 500.0  # the supply does not know yet
    assert abs(supplied.tracks[-1].high_v) < 50.0


def test_a_rail_that_is_no_number_is_refused(chip: CoSim) -> None:
    for line in ("rail ", "rail 1.0 x"):
        with pytest.raises(InputError, match="has no command"):
            chip.command(line)
    assert chip.command("rail 0.0 0.0") == []


def test_a_rig_file_names_the_supply_and_the_limits_of_its_module(
    tmp_path: Path, settings: ChipSettings
) -> None:
    path = tmp_path / "miniature.toml"
    path.write_text(
        'kind = "chip"\nrun = "run"\ndrive_high_v = 1.95\nrise_v_per_s = 7.0\n'
        "[simulator]\nprecondition_v = 2.0\n[simulator.supply]\nripple_v = 2.0\n",
        encoding="utf-8",
    )
    file = load_rig(path)
    assert isinstance(file, ChipFile)
    assert file.simulator is not None
    assert file.simulator.supply == SupplyModel(ripple_v=2.0)
    assert file.limited(settings) == replace(settings, drive_high_v=1.95, rise_v_per_s=7.0)
    assert ChipFile(kind="chip", run="run", simulator=file.simulator).limited(settings) == settings
