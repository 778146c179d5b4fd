"""The conformance suite of haselab on the emulator, and what only this supply has."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from emulator import Emulator

from haselab.testing.conformance import SupplyConformance

RIG = """
kind = "bench"
[daq]
[amplifier]
name = "any"
[generator]
address = "TCPIP::127.0.0.1::5025::SOCKET"
[supply]
kind = "mysupply"
host = "127.0.0.1"
port = {port}
serial_number = "A1234"
highest_v = 2000.0
tolerance_v = 10.0
[specimen]
shell_width_m = 0.03
shell_thickness_m = 0.002
mass_kg = 0.25
"""


@pytest.fixture
def emulator() -> Iterator[Emulator]:
    with Emulator() as emulator:
        yield emulator


class TestMySupply(SupplyConformance):
    @pytest.fixture
    def rig_file(self, tmp_path: Path, emulator: Emulator) -> Path:
        path = tmp_path / "rig.toml"
        path.write_text(RIG.format(port=emulator.port))
        return path

    @pytest.fixture
    def stuck_on(self, emulator: Emulator) -> Callable[[], None]:
        def ignore_off() -> None:
            answer = emulator.answer
            emulator.answer = lambda line: answer(line.replace("OUTP OFF", "OUTP ON"))

        return ignore_off

    def test_a_voltmeter_agrees(self, device, emulator: Emulator) -> None:
        device.set_voltage(500.0)
        assert emulator.is_on and emulator.set_v == 500.0
        device.off()
        assert not emulator.is_on and emulator.set_v == 0.0
