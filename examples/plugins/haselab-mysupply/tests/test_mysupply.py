"""The conformance suite of haselab on the emulator, and what only this supply has."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from emulator import Emulator
from haselab_mysupply import MySupply, MySupplyConfig

from haselab.base import DeviceError
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

    def test_a_voltmeter_agrees(self, device, emulator: Emulator) -> None:
        device.set_voltage(500.0)
        assert emulator.is_on and emulator.set_v == 500.0
        device.off()
        assert not emulator.is_on and emulator.set_v == 0.0


def test_a_supply_that_stays_on_is_not_reported_as_shut_down(emulator, monkeypatch) -> None:
    config = MySupplyConfig(host="127.0.0.1", port=emulator.port, highest_v=2000.0)
    answer = emulator.answer
    monkeypatch.setattr(
        emulator, "answer", lambda line: answer(line.replace("OUTP OFF", "OUTP ON"))
    )
    with pytest.raises(DeviceError, match="not off after OUTP OFF"):
        MySupply().shut_down(config, 1.0)
