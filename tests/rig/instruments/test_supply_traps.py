"""What a Peta-Pico-Voltron echoes without doing it: the driver against its emulated firmware.

`Before` is the sequence that this project used until the firmware was read: `SVset 0`, `SSwMode 0`,
`SVMode 0`, each believed by its echo.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haselab.base import DeviceError, InputError
from haselab.rig.drivers import quietly
from haselab.rig.instruments.petapicovoltron import line as supply_line
from haselab.rig.instruments.petapicovoltron.section import PetaPicoVoltronConfig
from haselab.rig.instruments.petapicovoltron.supply import (
    PetaPicoVoltron,
    identify_supply,
    switch_supply_off,
)
from haselab.rig.twin.serve.supply.firmware import SupplyFaults, SupplyFirmware
from haselab.rig.twin.serve.supply.server import SupplyServer

pytest.importorskip("pty", reason="pseudo-terminals are POSIX's")
serial = pytest.importorskip("serial")

STEP_V = 5000.0 / 1023.0  # of the meter's ten bits


class Rail:
    """The wire behind the supply."""

    def __init__(self) -> None:
        self.rail_v = 0.0

    def rail(self, voltage_v: float) -> None:
        """See `haselab.rig.twin.serve.supply.server.Rail`."""
        self.rail_v = voltage_v


class Bench:
    """An emulated supply and what is at its output."""

    def __init__(self, faults: SupplyFaults) -> None:
        self.wire = Rail()
        self.server = SupplyServer(self.wire, faults=faults)
        self.config = PetaPicoVoltronConfig(port=self.server.port, highest_v=5000.0, timeout_s=30.0)

    def close(self) -> None:
        self.server.close()


@contextlib.contextmanager
def bench(**faults: Any) -> Iterator[Bench]:
    with contextlib.closing(Bench(SupplyFaults(**faults))) as opened:
        yield opened


@contextlib.contextmanager
def opened(where: Bench) -> Iterator[PetaPicoVoltron]:
    with contextlib.closing(PetaPicoVoltron(where.config)) as supply:
        yield supply


class Before:
    """The old driver's commands."""

    def __init__(self, where: Bench) -> None:
        self._port = serial.Serial(where.server.port, 115_200, timeout=30.0)
        self._port.reset_input_buffer()
        self.version = self.exchange("QVer")
        if self.version.startswith("slave"):
            self.off()
            self.exchange("SVMode 0")

    def exchange(self, command: str) -> str:
        self._port.reset_input_buffer()
        self._port.write(command.encode() + b"\r")
        return str(self._port.read_until(b"\r\n")[:-2].decode())

    def set_voltage(self, voltage_v: int) -> bool:
        return (self.exchange(f"SVset {voltage_v}"), self.exchange("SSwMode 1")) == (
            str(voltage_v),
            "1",
        )

    def off(self) -> bool:
        return (self.exchange("SVset 0"), self.exchange("SSwMode 0")) == ("0", "0")

    def is_off(self) -> bool:
        return self.exchange("QSwMode") == "0"

    def close(self) -> None:
        self._port.close()


@contextlib.contextmanager
def before(where: Bench) -> Iterator[Before]:
    with contextlib.closing(Before(where)) as old:
        yield old


# ---- off that is not off ------------------------------------------------------------------------


EXTERNAL = {"left_by": ("SVMode 1", "SSwSrc 1", "SSwMode 1"), "external_high": True,
            "external_v": 3000.0}  # fmt: skip


def test_with_an_external_switch_source_the_old_off_leaves_the_output_closed() -> None:
    with bench(**EXTERNAL) as b:
        assert b.wire.rail_v == 3000.0
        with before(b) as old:
            old.exchange("SVMode 1")
            assert old.off()
            assert old.is_off(), "it says that it is off"
            assert b.wire.rail_v == 3000.0, "and it is not"
        with opened(b) as supply:
            assert supply.is_off()
            assert b.wire.rail_v == 0.0
            b.server.external(False)
            b.server.external(True)
            assert b.wire.rail_v == 0.0


def test_off_with_an_external_switch_source_is_reported_and_then_done() -> None:
    with bench() as b, opened(b) as supply:
        supply.set_voltage(2000.0)
        for command in ("SSwSrc 1", "SSwMode 0"):
            b.server.answer(command)
        assert b.wire.rail_v == 2000.0
        assert not supply.is_off(), "SSwMode is 0, but it does not count"
        supply.off()
        assert supply.is_off()
        assert b.wire.rail_v == 0.0


def test_the_button_does_not_start_cycles_again_after_off() -> None:
    left = ("SVset 2000", "SCycle 5", "SSwMode 2")
    with bench(left_by=left) as b:
        for command in ("SVset 2000", "SSwMode 0"):
            b.server.answer(command)
        assert b.wire.rail_v == 0.0
        b.server.press(True)
        assert b.wire.rail_v == 2000.0, "with cycles stored the button starts them although it is 0"
    with bench(left_by=left) as b, opened(b):
        b.server.answer("SVset 2000")
        b.server.press(True)
        assert b.wire.rail_v == 0.0


def test_a_button_that_is_held_down_does_not_keep_the_output_closed() -> None:
    with bench(left_by=("SVset 900", "SSwSrc 2"), button_down=True) as b:
        assert b.wire.rail_v == 900.0
        with opened(b) as supply:
            assert supply.is_off()
            assert b.wire.rail_v == 0.0


WAVEFORM = ("SVset 3000", "SP 255", "SSwMode 3")


def test_after_the_waveform_mode_the_old_off_leaves_the_converter_at_its_voltage() -> None:
    with bench(left_by=WAVEFORM) as b, before(b) as old:
        assert old.is_off()
        assert float(old.exchange("QVnow")) == pytest.approx(3000.0, abs=STEP_V)
        assert old.exchange("QVset") == "0"
    with bench(left_by=WAVEFORM) as b, opened(b) as supply:
        assert supply.read_voltage() <= 50.0
        assert b.server.firmware.converter_v == 0.0


def test_a_converter_that_does_not_run_down_is_not_confirmed_off(monkeypatch: Any) -> None:
    monkeypatch.setattr("haselab.rig.instruments.petapicovoltron.supply.DISCHARGE_S", 0.2)
    with bench(stuck_v=700.0) as b:
        with before(b) as old:
            assert old.off()
            assert old.is_off(), "the old sequence never asked for the voltage"
        reported = r"Pull the power jack.*not confirmed off: its meter shows 699 V 0.2 s after"
        with pytest.raises(DeviceError, match=reported):
            PetaPicoVoltron(b.config)
        with pytest.raises(DeviceError, match=reported):
            switch_supply_off(b.config)


def test_opening_waits_until_the_converter_has_run_down() -> None:
    with bench(left_by=("SVset 5000", "SSwMode 1"), decay_s=0.1) as b, opened(b) as supply:
        assert supply.read_voltage() <= 50.0


def test_off_never_raises_whatever_answers() -> None:
    with bench() as b:
        supply = PetaPicoVoltron(b.config.model_copy(update={"timeout_s": 0.2}))
        b.server.answer = lambda line: "?"  # type: ignore[method-assign]
        supply.off()
        with pytest.raises(DeviceError, match="does not reply correctly"):
            supply.is_off()
        supply.close()


class LatePort:
    """A port at which nothing arrives at first, and then every reply, in order."""

    def __init__(self, firmware: SupplyFirmware, silent_writes: int) -> None:
        self._firmware, self._silent = firmware, silent_writes
        self._coming: list[bytes] = []

    def reset_input_buffer(self) -> None:
        """Nothing has arrived yet that could be discarded."""

    def write(self, data: bytes) -> None:
        replies = [self._firmware.answer(each, 0.0) for each in self._firmware.take(data)]
        self._coming += [f"{reply}\r\n".encode() for reply in replies]
        self._silent -= 1

    def read_until(self, end: bytes, most: int) -> bytes:
        return self._coming.pop(0) if self._coming and self._silent < 0 else b""

    def close(self) -> None:
        """Nothing to close."""


@pytest.mark.parametrize("silent_writes", [1, 2, 3])
def test_late_replies_to_an_earlier_request_are_not_those_of_the_next_one(
    silent_writes: int,
) -> None:
    with bench() as b, contextlib.closing(supply_line.SupplyLine(b.config)) as line:
        line._port.close()
        line._port = LatePort(SupplyFirmware("x", SupplyFaults()), silent_writes)
        while quietly(line.switch_off) is not None:
            pass
        assert line.not_off() == ""
        assert line.number("QVset") == 0.0
        assert line.query_all(["QName", "QVmax"]) == ["x", "5000"]


# ---- at power-on --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stored", "reported"),
    [
        ({"stored_set_v": 2500}, r"up to 2500 V at power-on: .*SwMode 1"),
        ({"stored_set_v": 900, "stored_source": 2}, r"up to 900 V .*SwSrc 2"),
        ({"stored_set_v": 900, "stored_mode": 3}, r"up to 900 V .*SwMode 3"),
        ({"stored_set_v": 900, "stored_mode": 0, "stored_cycles": 3}, r"up to 900 V .*3 cycles"),
        ({"stored_voltage_mode": 1}, r"the voltage of its external input .*VMode 1"),
    ],
)
def test_a_supply_that_switches_on_at_power_on_is_refused_with_what_to_do(
    stored: dict[str, int], reported: str
) -> None:
    with bench(**stored) as b:
        with before(b) as old:
            assert old.version == "slave 8", "the old sequence took it"
        with pytest.raises(InputError, match=rf"{reported}.*Send 'Save'"):
            PetaPicoVoltron(b.config)
        assert b.wire.rail_v == 0.0, "refused, and off"
        assert b.server.answer("Save") == "1"
        with opened(b):
            b.server.power_on()
            assert b.wire.rail_v == 0.0


def test_at_power_on_a_stored_voltage_is_at_the_output_before_anything_is_opened() -> None:
    with bench(stored_set_v=2500) as b:
        assert b.wire.rail_v == 2500.0
        with before(b):
            assert b.wire.rail_v == 0.0
            b.server.power_on()
            assert b.wire.rail_v == 2500.0


def test_the_factory_settings_are_accepted() -> None:
    with bench() as b:
        b.server.answer("Conf 5000")
        with opened(b):
            assert b.server.answer("QMem").startswith("0,1.0000,0,1,0,")


# ---- an echo without a voltage ------------------------------------------------------------------


def test_without_its_power_jack_a_supply_echoes_and_gives_nothing() -> None:
    with bench(jack_in=False) as b:
        with before(b) as old:
            assert old.set_voltage(1000), "the old sequence saw nothing"
            assert b.wire.rail_v == 0.0
        with opened(b) as supply:
            with pytest.raises(DeviceError, match=r"its power jack is unplugged\. Plug it in"):
                supply.set_voltage(1000.0)
            b.server.plug(True)
            supply.set_voltage(1000.0)
            assert b.wire.rail_v == 1000.0


def test_a_jack_that_is_not_used_need_not_be_plugged_in() -> None:
    with bench(jack_in=False, jack_used=False) as b, opened(b) as supply:
        supply.set_voltage(1000.0)
        assert b.wire.rail_v == 1000.0


def test_a_main_switch_that_is_off_shows_in_the_meter_alone() -> None:
    with bench(enabled=False) as b, opened(b) as supply:
        supply.set_voltage(1000.0)
        assert supply.read_voltage() == 0.0


def test_a_switchboard_with_its_relays_open_is_refused() -> None:
    with bench(version="slave 1", relays_open=True) as b:
        with before(b) as old:
            assert old.set_voltage(1000), "the old sequence took it for a supply"
            assert b.wire.rail_v == 0.0
        with pytest.raises(InputError, match=r"a switchboard .*'slave 1'"):
            PetaPicoVoltron(b.config)


def test_other_firmware_is_refused() -> None:
    with (
        bench(version="slave 7") as b,
        pytest.raises(InputError, match=r"'slave 7'.*Load firmware 8"),
    ):
        PetaPicoVoltron(b.config)


def test_a_set_point_that_is_negative_or_too_high_is_the_highest_voltage() -> None:
    """The firmware's way; the driver refuses such a request before it is sent."""
    firmware = SupplyFirmware("x", SupplyFaults())
    assert firmware.answer("SVset -1", 0.0) == "5000"
    assert firmware.answer("SVset 40000", 0.0) == "5000"
    assert firmware.answer("SVset 70000", 0.0) == "4464"  # 16 bits
    assert firmware.answer("SSwMode 7", 0.0) == "7"
    assert firmware.closed, "any mode that is not 0 closes the output"


def test_a_switch_source_that_changes_by_itself_is_noticed_before_the_output_counts() -> None:
    with bench() as b, opened(b) as supply:
        real = b.server.answer

        def master(line: str) -> str:
            reported = real(line)
            if line == "SSwMode 1":  # over I2C, in between
                real("SSwSrc 1")
            return reported

        b.server.answer = master  # type: ignore[method-assign]
        with pytest.raises(DeviceError, match=r"QSwSrc, .* are 1, 0, 1, 800, expected 0, 0, 1"):
            supply.set_voltage(800.0)
        assert b.wire.rail_v == 0.0


# ---- what others leave on the line --------------------------------------------------------------


def test_a_fragment_of_an_at_command_spoils_the_old_opening_and_not_the_new_one() -> None:
    with bench(fragment=b"AT") as b, before(b) as old:
        assert old.version == "Err"
    with bench(fragment=b"AT") as b, opened(b) as supply:
        assert supply.identity == "haselab-twin, slave 8"


def test_replies_to_another_program_break_the_old_opening_and_not_the_new_one() -> None:
    stale = b"Err\r\n0\r\n"
    with bench(stale=stale) as b, before(b) as old:
        assert old.version != "slave 8"
    with bench(stale=stale) as b, opened(b) as supply:
        assert supply.identity == "haselab-twin, slave 8"


def test_modem_commands_in_between_are_read_over() -> None:
    with bench() as b, opened(b) as supply:
        other = os.open(b.server.port, os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(other, b"AT+GCAP\rATI\r\x7e\x00\x78AT")
            assert supply.is_off()
            os.write(other, b"AT")
            supply.set_voltage(500.0)
            assert b.wire.rail_v == 500.0
            os.write(other, b"SSwMode 1\rAT")
            supply.off()
            assert supply.is_off()
        finally:
            os.close(other)


def test_a_supply_in_its_debug_mode_is_understood() -> None:
    with bench(debug=True) as b, opened(b) as supply:
        supply.set_voltage(500.0)
        assert supply.read_voltage() == pytest.approx(500.0, abs=STEP_V)
        supply.off()
        assert supply.is_off()


def test_an_empty_line_repeats_the_last_command() -> None:
    """So a lone CR, which would clean another instrument's line, may energise this one."""
    firmware = SupplyFirmware("x", SupplyFaults())
    assert list(firmware.take(b"SSwMode 1\r\r")) == ["SSwMode 1", "SSwMode 1"]


@given(fragment=st.binary(max_size=60).map(lambda data: data.replace(b"\r", b"")))
def test_the_filler_makes_of_any_fragment_a_command_that_is_none(fragment: bytes) -> None:
    firmware = SupplyFirmware("x", SupplyFaults())
    commands = list(firmware.take(fragment + supply_line._FILLER))
    assert [command[:1] for command in commands] == ["x"]
    assert firmware.answer(commands[0], 0.0) == "Err"


@given(line=st.text(alphabet="QSVMCePJacknowsetSrcMode0123456789 -.x", max_size=24))
def test_no_command_is_a_defect_of_the_firmware(line: str) -> None:
    firmware = SupplyFirmware("x", SupplyFaults())
    assert firmware.answer(line, 0.0)
    assert firmware.converter_v >= 0.0


def test_nothing_that_answers_is_one_line_of_error() -> None:
    with bench() as b:
        b.server.answer = lambda line: "OK"  # type: ignore[method-assign]
        with pytest.raises(DeviceError, match=r"not reply correctly \(QVer: .*Check its cable"):
            PetaPicoVoltron(b.config.model_copy(update={"timeout_s": 0.2}))


# ---- from outside -------------------------------------------------------------------------------


def test_asking_who_it_is_leaves_it_as_it_is() -> None:
    with bench(left_by=("SVset 700", "SSwMode 1")) as b:
        with pytest.raises(
            DeviceError, match=r"Keep clear: .* is ON, its meter shows 699 V\. .* rig safe"
        ):
            identify_supply(b.config)
        assert b.wire.rail_v == 700.0
    with bench() as b:
        assert identify_supply(b.config) == "haselab-twin, slave 8"


def test_identifying_reports_an_unplugged_power_jack() -> None:
    with bench(jack_in=False) as b, pytest.raises(DeviceError, match="power jack is unplugged"):
        identify_supply(b.config)


@pytest.mark.parametrize(
    "faults",
    [
        EXTERNAL,
        {"left_by": WAVEFORM},
        {"stored_set_v": 2500},
        {"left_by": ("SVset 900", "SSwSrc 2"), "button_down": True},
        {"fragment": b"AT", "stale": b"Err\r\n", "left_by": ("SVset 900", "SSwMode 1")},
        {"version": "slave 1", "left_by": ("SVset 900", "SSwMode 1")},
    ],
)
def test_it_is_switched_off_from_outside_whatever_is_wrong_with_it(faults: dict[str, Any]) -> None:
    with bench(**faults) as b:
        assert b.wire.rail_v > 0.0
        switch_supply_off(b.config)
        assert b.wire.rail_v == 0.0
        step_v = b.server.firmware.reach_v / 1023  # the meter has ten bits and shows whole steps
        assert b.server.converter_v <= 50.0 + step_v


def test_another_supply_is_switched_off_and_reported() -> None:
    with bench(left_by=("SVset 900", "SSwMode 1")) as b:
        config = b.config.model_copy(update={"serial_number": "rev2"})
        with pytest.raises(
            DeviceError, match=r"The supply 'haselab-twin' was switched off, but .*'rev2'"
        ):
            switch_supply_off(config)
        assert b.wire.rail_v == 0.0
