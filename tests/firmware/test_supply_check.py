"""The chip measures its own supply: by the simulator's converter, and what the computer says."""

from __future__ import annotations

from pathlib import Path

import pytest

from haselab.base import DeviceError
from haselab.firmware import ChipSettings
from haselab.firmware.messages import VERSION, Hello, Identity
from haselab.rig.chip import ChipBench, CoSim, Firmware
from haselab.rig.chip.supply_check import check_supply
from haselab.rig.twin.twin_bench import TwinBench


def started(program: Path, firmware: Firmware, twin: TwinBench, supply_v: float) -> CoSim:
    chip = CoSim(program, firmware.elf, twin, supply_v)
    chip.run(0.02)
    return chip


@pytest.mark.parametrize("supply_v", [4.3, 4.75, 5.0, 5.5])
def test_the_firmware_reports_its_reference_relative_to_its_supply(
    firmware, cosim_program, twin, supply_v
):
    with started(cosim_program, firmware, twin, supply_v) as chip:
        reported = chip.query(Hello(VERSION))
        assert isinstance(reported, Identity)
        # 1.1 V of the data sheet; the simulator scales to 1023 and rounds down.
        assert reported.supply == int(1100 * 1023 / round(1e3 * supply_v))


def test_a_chip_on_a_weak_supply_is_not_opened(
    firmware: Firmware, cosim_program: Path, twin: TwinBench, settings: ChipSettings
) -> None:
    with started(cosim_program, firmware, twin, 4.2) as chip:
        with pytest.raises(
            DeviceError, match=r"supply is about 4\.2. V .* must be 5 V within 5 %.*not from USB"
        ):
            ChipBench(chip, settings)
        assert not any(output.on for output in chip.outputs)
    with started(cosim_program, firmware, twin, 4.6) as chip:
        assert ChipBench(chip, settings).identity.endswith("supply 4.62 V to 9 %")
    with (
        started(cosim_program, firmware, twin, 4.6) as chip,
        pytest.raises(DeviceError, match=r"supply is about 4\.6"),
    ):
        ChipBench(chip, settings, bandgap_v=1.1)


@pytest.mark.parametrize(
    ("code", "bandgap_v", "good"),
    [
        (225, None, True),
        (225, 1.1, True),
        (238, 1.1, False),  # 4.73 V
        (237, 1.1, True),  # 4.753 V
        (214, 1.1, False),  # 5.26 V
        (215, 1.1, True),  # 5.24 V
        (238, None, True),  # another chip of the data sheet would be at 5.16 V
        (259, None, False),  # 4.74 V with the highest reference, 1.2 V
        (194, None, False),  # 5.28 V with the lowest, 1.0 V
        (245, 1.2, True),  # 5.02 V
    ],
)
def test_a_supply_is_refused_where_no_reference_of_the_chip_explains_it(code, bandgap_v, good):
    if good:
        assert "supply" in check_supply(code, 5.0, bandgap_v)
    else:
        with pytest.raises(DeviceError, match="Feed its 5V pin from a regulated supply"):
            check_supply(code, 5.0, bandgap_v)


def test_a_board_that_does_not_measure_is_taken_as_it_is():
    assert check_supply(0, 3.3) == ""
