"""What the last user of a 33500B has left: the driver against its emulator.

`before` is the sequence that this project used until it was compared with the instrument's guide:
load, waveform, unit and offset set, frequency and amplitude read back, the error queue never read.
"""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Iterator
from typing import Any

import pytest

from haselab.base import DeviceError, InputError
from haselab.rig.instruments.keysight33500.generator import (
    KeysightGenerator,
    identify_generator,
    switch_generator_off,
)
from haselab.rig.instruments.keysight33500.section import KeysightConfig
from haselab.rig.instruments.keysight33500.state import check_settings, settings_query
from haselab.rig.twin.config import TwinConfig
from haselab.rig.twin.serve.generator.scpi import GeneratorFaults, ScpiServer
from haselab.rig.twin.serve.generator.state import Channel
from haselab.rig.twin.serve.hub import TwinHub

pytest.importorskip("pymeasure")
pytest.importorskip("pyvisa_py")

HZ, VOLT = 2000.0, 0.02
GUARD_S = 300.0


class Wire:
    """What arrives at the amplifier."""

    def __init__(self) -> None:
        self.sine = (0.0, 0.0)
        self.offset_v = 0.0
        self.highest_v = 0.0  # amplitude or offset that has come

    def carrier(self, frequency_hz: float, amplitude_v: float, offset_v: float = 0.0) -> None:
        """See `TwinHub.carrier`."""
        self.offset_v = offset_v
        self.highest_v = max(self.highest_v, amplitude_v, abs(offset_v))
        self.sine = (frequency_hz, amplitude_v) if amplitude_v else (0.0, 0.0)


class Bench:
    """An emulated generator."""

    def __init__(self, faults: GeneratorFaults) -> None:
        self.wire = Wire()
        self.server = ScpiServer(self.wire, faults=faults)  # type: ignore[arg-type]
        self.config = KeysightConfig(address=self.server.address, timeout_s=30.0)

    def query(self, line: str) -> str:
        """At its front panel, as it were."""
        return self.server.answer(line).decode().strip()

    def close(self) -> None:
        self.server.close()


@contextlib.contextmanager
def bench(*panel: str, **faults: Any) -> Iterator[Bench]:
    with contextlib.closing(Bench(GeneratorFaults(panel=panel, **faults))) as opened:
        yield opened


@contextlib.contextmanager
def opened(where: Bench) -> Iterator[KeysightGenerator]:
    with contextlib.closing(KeysightGenerator(where.config)) as generator:
        yield generator


def before(where: Bench) -> bool:
    """The old commands; whether everything that they read back was as set."""
    for line in ("OUTP1 OFF", "OUTP1:LOAD INF", "SOUR1:FUNC SIN", "SOUR1:VOLT:UNIT VPP",
                 "SOUR1:VOLT:OFFS 0", f"SOUR1:FREQ {HZ}", f"SOUR1:VOLT {2 * VOLT}",
                 "OUTP1 ON"):  # fmt: skip
        where.query(line)
    report = where.query("OUTP1:LOAD?;:SOUR1:FUNC?;:SOUR1:VOLT:UNIT?;:SOUR1:VOLT:OFFS?;:SOUR1:FREQ?"
                     ";:SOUR1:VOLT?;:OUTP1?").split(";")  # fmt: skip
    numbers = [float(report[k]) for k in (0, 3, 4, 5)]
    return (
        report[1:3] == ["SIN", "VPP"]
        and report[6] == "1"
        and numbers[0] > 1e30
        and (numbers[1:] == pytest.approx([0.0, HZ, 2 * VOLT]))
    )


LEFT = {
    "burst on a bus trigger": (("BURS:STAT ON", "TRIG:SOUR BUS"), (0.0, 0.0)),
    "gated burst": (("BURS:MODE GAT", "BURS:STAT ON"), (0.0, 0.0)),
    "one cycle every 10 ms": (("BURS:STAT ON",), (HZ, 0.05 * VOLT)),
    "gated output": (("OUTP1:MODE GAT",), (0.0, 0.0)),
    "sweep": (("SWE:STAT ON",), (550.0, VOLT)),
    "AM": (("AM:STAT ON",), (HZ, 0.5 * VOLT)),
    "FM": (("FM:STAT ON",), (HZ, 0.2459 * VOLT)),  # |J0(100 Hz / 10 Hz)|
    "PM": (("PM:STAT ON",), (HZ, 0.3042 * VOLT)),  # |J0(pi)|
    "FSK": (("FSK:STAT ON",), (HZ, 0.5 * VOLT)),
    "BPSK": (("BPSK:STAT ON",), (0.0, 0.0)),
}


@pytest.mark.parametrize("what", LEFT)
def test_what_the_last_user_left_is_seen_by_no_old_read_back_and_is_reset(what: str) -> None:
    panel, comes = LEFT[what]
    with bench(*panel) as b:
        assert before(b), "the old sequence reads back what it has set"
        assert b.wire.sine == pytest.approx(comes, rel=1e-3), "and something else comes out"
        with opened(b) as generator:
            generator.sine(HZ, VOLT)
            assert b.wire.sine == pytest.approx((HZ, VOLT))


@pytest.mark.parametrize(
    ("panel", "question"),
    [
        ("OUTP1:POL INV", "OUTP1:POL?"),
        ("SUM:STAT ON", "SUM:STAT?"),
        ("FREQ:COUP:STAT ON", "FREQ:COUP:STAT?"),
        ("VOLT:COUP ON", "VOLT:COUP:STAT?"),
        ("TRAC INV", "TRAC?"),
        ("COMB:FEED CH2", "COMB:FEED?"),
    ],
)
def test_what_is_not_seen_in_the_amplitude_is_reset_too(panel: str, question: str) -> None:
    with bench(panel) as b:
        left = b.query(question)
        assert before(b)
        assert b.query(question) == left
        with opened(b):
            assert b.query(question) in {"0", "OFF", "NORM", "NONE"}
            assert b.query(question) != left


def test_voltage_limits_keep_the_load_from_being_set_and_are_reset() -> None:
    limits = ("VOLT:LIM:HIGH 0.06", "VOLT:LIM:LOW -0.06", "VOLT:LIM:STAT ON")
    with bench(*limits) as b:
        assert not before(b)
        assert b.query("SYST:ERR?") == '-221,"Settings conflict"'
        with opened(b) as generator:
            generator.sine(HZ, 0.5)
            assert b.wire.sine == pytest.approx((HZ, 0.5))


TOUCHED = {
    "BURS:STAT ON": "burst mode is on",
    "SWE:STAT ON": "a frequency sweep is on, its frequency follows a sweep",
    "AM:STAT ON": "amplitude modulation is on",
    "FSK:STAT ON": "frequency-shift keying is on",
    "OUTP1:MODE GAT": "its output is gated",
    "OUTP1:POL INV": "its output is inverted",
    "VOLT:LIM:STAT ON": "voltage limits are on",
    "TRAC ON": "one channel tracks the other",
    "FREQ:COUP ON": "the frequencies of both channels are coupled",
    "COMB:FEED CH2": "the other channel is added",
}


@pytest.mark.parametrize("line", TOUCHED)
def test_somebody_at_the_front_panel_is_noticed_before_the_output_goes_on(line: str) -> None:
    with bench() as b, opened(b) as generator:
        generator.sine(HZ, VOLT)
        b.query(line)
        reported = rf"does not put out the sine that was set: {TOUCHED[line]}.*its output is off"
        with pytest.raises(DeviceError, match=reported):
            generator.sine(HZ, VOLT)
        assert b.wire.sine == (0.0, 0.0)


SIGNAL = {
    "VOLT:OFFS 0.3": r"an offset of 0\.3 V is added",
    "VOLT:OFFS -0.0002": r"an offset of -0\.0002 V is added",
    "VOLT:UNIT VRMS": "its amplitude is in VRMS",
    "OUTP1:LOAD 50": "its load is set to 50 ohm, expected INF",
    "OUTP1:LOAD 600": "its load is set to 600 ohm, expected INF",
    "FUNC SQU": "its waveform is SQU",
}


@pytest.mark.parametrize("line", SIGNAL)
def test_load_unit_waveform_and_offset_are_asked_for_before_the_output_goes_on(line: str) -> None:
    with bench() as b, opened(b) as generator:
        b.query(line)
        reported = rf"does not put out the sine that was set: {SIGNAL[line]}; its output is off"
        with pytest.raises(DeviceError, match=reported):
            generator.sine(HZ, VOLT)
        assert (b.wire.sine, b.wire.offset_v, b.wire.highest_v) == ((0.0, 0.0), 0.0, 0.0)


def test_a_unit_of_the_panel_is_no_higher_amplitude_for_a_moment_either() -> None:
    with bench() as b, opened(b) as generator:
        generator.sine(HZ, VOLT)
        b.query("VOLT:UNIT VRMS")
        with pytest.raises(DeviceError, match="its amplitude is in VRMS; its output is off"):
            generator.sine(HZ, VOLT)
        assert b.wire.highest_v == pytest.approx(VOLT)
        assert b.wire.sine == (0.0, 0.0)


def test_a_load_of_50_ohm_is_the_one_that_is_expected_where_the_rig_file_says_so() -> None:
    with bench() as b:
        b.config = b.config.model_copy(update={"load": "50"})
        with opened(b) as generator:
            generator.sine(HZ, VOLT)
            b.query("OUTP1:LOAD INF")
            with pytest.raises(DeviceError, match="load is set to INF ohm, expected 50; its out"):
                generator.sine(HZ, VOLT)
            assert b.wire.sine == (0.0, 0.0)


def test_an_answer_that_is_no_number_is_no_offset_of_zero() -> None:
    rest = ";NORM;NORM;0;0;CW;0;0;0;0;0;0;0;0"
    assert check_settings(f"9.9E+37;VPP;SIN;+0.0E+00{rest}", 1, "INF") == ""
    assert check_settings(f"9.9E+37;VPP;SIN;OFF{rest}", 1, "INF") == "an offset of nan V is added"
    reported = "its load is set to nan ohm, expected 50"
    assert check_settings(f"OFF;VPP;SIN;0{rest}", 1, "50") == reported


def test_an_offset_of_the_emulated_generator_drives_the_amplifier() -> None:
    with TwinHub(TwinConfig(), 1, 0.0) as hub:
        server = ScpiServer(hub)
        try:
            for line in ("OUTP1:LOAD INF", "VOLT:OFFS 0.1"):
                server.answer(line)
            hub.spend(40_000)
            assert abs(hub.output_v) < 1.0
            server.answer("OUTP1 ON")
            hub.spend(40_000)
            assert hub.output_v == pytest.approx(0.1 * hub.description.amplifier_gain, rel=0.5)
            server.answer("OUTP1 OFF")
            hub.spend(40_000)
            assert abs(hub.output_v) < 1.0
        finally:
            server.close()


# ---- the error queue ----------------------------------------------------------------------------


def test_errors_of_the_last_user_do_not_count_and_new_ones_are_reported_in_one_line() -> None:
    with bench() as b:
        for _ in range(30):
            b.query("NONSENSE")
        with opened(b) as generator:
            b.query("SOUR1:NONSENSE")
            b.query("FREQ 1e12")
            b.query(f"FREQ {HZ}")
            with pytest.raises(DeviceError, match=r"reports -113,\"Und.*\"; -222,\"Data.* is off"):
                generator.sine(HZ, VOLT)
            assert b.wire.sine == (0.0, 0.0)
            generator.sine(HZ, VOLT)
            assert b.wire.sine == pytest.approx((HZ, VOLT))


def test_the_queue_holds_twenty_and_its_last_place_says_that_more_were_lost() -> None:
    with bench() as b:
        for _ in range(30):
            b.query("NONSENSE")
        b.query("*RST")
        reported = [b.query("SYST:ERR?") for _ in range(21)]
        assert reported[:19] == ['-113,"Undefined header"'] * 19
        assert reported[19:] == ['-350,"Error queue overflow"', '+0,"No error"']


# ---- the emulator, by the guide -----------------------------------------------------------------


def test_amplitudes_are_clipped_to_10_vpp_into_50_ohm_and_20_vpp_into_an_open_circuit() -> None:
    with bench() as b:
        for load, most in (("50", 10.0), ("INF", 20.0)):
            b.query(f"OUTP1:LOAD {load}")
            b.query("VOLT 30")
            assert b.query("SYST:ERR?") == '-222,"Data out of range"'
            assert float(b.query("VOLT?")) == pytest.approx(most)


def test_an_offset_that_leaves_no_room_for_an_amplitude_is_moved_with_an_error() -> None:
    with bench() as b:
        for line in ("OUTP1:LOAD INF", "VOLT 1", "VOLT:OFFS 9", "VOLT 10"):
            b.query(line)
        assert b.query("SYST:ERR?") == '-221,"Settings conflict"'
        assert float(b.query("VOLT:OFFS?")) == pytest.approx(5.0)


def test_limits_clip_an_amplitude_with_an_error() -> None:
    with bench("VOLT:LIM:HIGH 0.1", "VOLT:LIM:LOW -0.1", "VOLT:LIM:STAT ON") as b:
        b.query("VOLT 1")
        assert b.query("SYST:ERR?") == '-221,"Settings conflict"'
        assert float(b.query("VOLT?")) == pytest.approx(0.2)


@pytest.mark.parametrize(("model", "most_hz"), [("33522B", 30e6), ("33509B", 20e6)])
def test_the_highest_frequency_is_that_of_the_model(model: str, most_hz: float) -> None:
    with bench(model=model) as b:
        b.query("FREQ 100 MHZ")
        assert b.query("SYST:ERR?") == '-222,"Data out of range"'
        assert float(b.query("FREQ?")) == most_hz


def test_only_one_of_burst_sweep_and_modulation_runs() -> None:
    with bench("BURS:STAT ON", "AM:STAT ON") as b:
        assert b.query("BURS:STAT?;:AM:STAT?") == "0;1"
        b.query("PWM:STAT ON")
        assert b.query("SYST:ERR?") == '-221,"Settings conflict"'
        assert b.query("PWM:STAT?") == "0"


def test_a_header_without_a_colon_goes_on_in_the_path_of_the_one_before() -> None:
    with bench() as b:
        b.query("SOUR1:VOLT:UNIT VRMS;OFFS 0.01")
        assert b.query("VOLT:UNIT?") == "VRMS"
        assert float(b.query("VOLT:OFFS?")) == pytest.approx(0.01)
        b.query("VOLT:UNIT VPP;VOLT 1")
        assert b.query("SYST:ERR?") == '-113,"Undefined header"'


def test_nothing_is_answered_after_an_identity() -> None:
    with bench() as b:
        assert b.query("*IDN?;*OPC?").startswith("Agilent Technologies,33522B")
        assert b.query("SYST:ERR?").startswith("-440")


@pytest.mark.parametrize(
    ("command", "question", "value"),
    [("VOLT 40 MVPP", "VOLT?", 0.04), ("FREQ 2 KHZ", "FREQ?", 2e3), ("FREQ 1 MHZ", "FREQ?", 1e6)],
)
def test_units_are_understood(command: str, question: str, value: float) -> None:
    with bench() as b:
        b.query(command)
        assert b.query("SYST:ERR?") == '+0,"No error"'
        assert float(b.query(question)) == pytest.approx(value)


def test_tracking_carries_settings_over_and_switches_coupling_off() -> None:
    with bench("FREQ:COUP ON", "TRAC ON", "SOUR2:FREQ 5000") as b:
        assert b.query("SOUR1:FREQ?") == b.query("SOUR2:FREQ?")
        assert b.query("FREQ:COUP?") == "0"


def test_an_endless_burst_is_a_sine_and_a_trigger_lets_a_burst_out() -> None:
    channel = Channel(on=True, running="BURS", burst_cycles=float("inf"))
    assert channel.output(triggers=False).amplitude_v == pytest.approx(0.1)
    channel = Channel(on=True, running="BURS", burst_mode="GAT")
    assert channel.output(triggers=True).amplitude_v == pytest.approx(0.1)


def test_an_instrument_with_one_channel_is_not_asked_for_coupling() -> None:
    with bench(model="33511B") as b, opened(b) as generator:
        generator.sine(HZ, VOLT)
        assert b.query("TRAC?") == ""
        assert b.query("SYST:ERR?") == '-113,"Undefined header"'
    assert check_settings("NORM", 1, "INF") == "1 of 17 settings were reported"
    assert "TRAC" not in settings_query(1, 1)


@pytest.mark.long
def test_a_slow_reset_is_waited_for_and_a_slow_answer_is_not() -> None:
    with bench(reset_s=1.0) as b:
        quick = b.config.model_copy(update={"timeout_s": 0.5})
        KeysightGenerator(quick).close()
    with bench(answer_s=1.0) as b:
        quick = b.config.model_copy(update={"timeout_s": 0.2})
        with pytest.raises(DeviceError, match="function generator does not reply"):
            KeysightGenerator(quick)


# ---- connections --------------------------------------------------------------------------------


def test_a_third_connection_is_refused_with_what_to_do() -> None:
    with bench() as b, opened(b):
        port = int(b.server.address.split("::")[2])
        with socket.create_connection(("127.0.0.1", port)) as held:
            held.sendall(b"*OPC?\n")
            assert held.recv(16) == b"1\n"
            with pytest.raises(DeviceError, match=r"does not reply .*close other programs"):
                KeysightGenerator(b.config)
            with pytest.raises(
                DeviceError,
                match=r"connection failed .*not confirmed off",
            ):
                switch_generator_off(b.config, 0.1)


def test_it_is_switched_off_from_outside_while_the_program_holds_its_connection() -> None:
    with bench() as b, opened(b) as generator:
        generator.sine(HZ, VOLT)
        switch_generator_off(b.config, GUARD_S)
        assert b.wire.sine == (0.0, 0.0)
        assert generator.is_off()


def test_asking_who_it_is_changes_nothing() -> None:
    with bench() as b, opened(b) as generator:
        generator.sine(HZ, VOLT)
        assert identify_generator(b.config).startswith("Agilent Technologies,33522B")
        assert b.wire.sine == pytest.approx((HZ, VOLT))


def test_another_instrument_is_switched_off_and_reported() -> None:
    with bench() as b:
        b.query("OUTP1 ON")
        other = b.config.model_copy(update={"serial_number": "MY1"})
        with pytest.raises(
            DeviceError, match=r"The instrument .* was switched off, but .*serial number MY1"
        ):
            switch_generator_off(other, GUARD_S)
        assert b.wire.sine == (0.0, 0.0)
        with pytest.raises(InputError, match="generator has the serial number MY00"):
            identify_generator(other)


def test_an_output_that_stays_on_is_reported() -> None:
    with bench() as b:
        b.server.answer = lambda line: b"1;Agilent Technologies,33522B,MY00000001,x\n"  # type: ignore[method-assign]
        with pytest.raises(DeviceError, match=r"output is not off after OUTP OFF .*by hand"):
            switch_generator_off(b.config, GUARD_S)
