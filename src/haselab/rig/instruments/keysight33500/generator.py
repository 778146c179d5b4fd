"""Keysight 33500B for the sensing signal: PyMeasure's driver over PyVISA, with read-back.

An earlier user may have left burst, sweep, modulation, gate, polarity, limits or coupling on; each
of them changes the output, but not the amplitude that is read back. So the instrument is reset
first, all of them are queried, and its error queue is read.

Instruments of this family accept few connections at once: the EDU33210 series two in all (user's
guide, "SCPI Socket Services"), the E4360 series four; the limit of the 33500B is inferred. So the
program uses one, and a process that switches the output off uses another one for a single line
(`switch_generator_off`).

PyMeasure's `shutdown()` leaves the output on, so nothing here relies on it: `off` sets `OUTP OFF`
and `is_off` asks the instrument.
"""

from __future__ import annotations

import contextlib
import math
import socket
import time
from typing import Any

from haselab.base import DeviceError, InputError, LimitError
from haselab.rig.drivers import load_driver, quietly
from haselab.rig.instruments.keysight33500.section import KeysightConfig
from haselab.rig.instruments.keysight33500.state import (
    check_settings,
    is_two_channel,
    settings_query,
)

__all__ = ["KeysightGenerator", "identify_generator", "switch_generator_off"]

_SMALLEST_VPP, _LARGEST_VPP = 10e-3, 10.0  # that PyMeasure sends
_MODEL = "335"  # 33509B to 33522B
_OPEN_LOAD_OHM = 1e30  # the reply to a load of INF is 9.9E+37
_OFF = {"0", "OFF"}
_CLOSE = 1e-4  # relative: settings are sent with six digits
_RESET_S = 5.0  # longest time for *RST
_ERRORS = 25  # more than its queue holds
_SOCKET_S = 0.25  # shortest wait for a reply on a socket
_AGAIN_S = 0.03  # between two attempts to connect


class _Link:
    """One VISA connection to a generator.

    Args:
        config: section `generator` of the rig file.
    Raises:
        DeviceError: no driver, no answer.
    """

    def __init__(self, config: KeysightConfig) -> None:
        self._config = config
        driver = load_driver("pymeasure.instruments.agilent", "The function generator")
        load_driver("pyvisa_py", "The function generator")
        self.driver: Any = None
        try:
            self.driver = driver.Agilent33500(
                config.address,
                visa_library="@py",
                timeout=round(1e3 * config.timeout_s),
                write_termination="\n",
                read_termination="\n",
            )
            self.patience(config.timeout_s)
            self.identity = str(self.driver.id).strip()
        except Exception as error:
            self.close()
            raise self.no_reply(error) from None

    def patience(self, wait_s: float) -> None:
        """Limit the time of a read.

        pyvisa-py waits for a reply with `select`, then reads the socket without a timeout: if there
        is nothing to read then, as was seen under load, it would wait forever.
        """
        connection = self.driver.adapter.connection
        connection.timeout = round(1e3 * wait_s)
        session = connection.visalib.sessions.get(connection.session)  # of pyvisa-py
        interface = getattr(session, "interface", None)
        if isinstance(interface, socket.socket):
            interface.settimeout(wait_s)

    def no_reply(self, error: object) -> DeviceError:
        """Make the error of a generator that does not reply."""
        text = str(error).partition("\n")[0] or type(error).__name__
        return DeviceError(
            f"The function generator does not reply ({text}). Switch it on, check the cable, "
            "close other programs that are connected to it, or change generator.address. "
            f"{self._config.address}"
        )

    def check_identity(self) -> None:
        """Check that the instrument is the one that the rig file names.

        Raises:
            InputError: It is another one.
        """
        fields = [part.strip() for part in self.identity.split(",")]
        if len(fields) < 3 or not fields[1].startswith(_MODEL):
            raise InputError(
                f"The instrument identifies as {self.identity!r}, but a Keysight 33500B is needed. "
                f"Change generator.address. {self._config.address}"
            )
        wanted = self._config.serial_number
        if wanted is not None and fields[2] != wanted:
            raise InputError(
                f"The function generator has the serial number {fields[2]}, but the rig file names "
                f"{wanted}. Connect that one, or change generator.serial_number. "
                f"{self._config.address}"
            )

    @property
    def channels(self) -> int:
        """Number of channels, one or two."""
        return 2 if is_two_channel(self.identity.split(",")[1].strip()) else 1

    def query(self, question: str) -> str:
        """Send one line and return the reply."""
        return str(self.driver.ask(question)).strip()

    def errors(self) -> list[str]:
        """Read and empty its error queue."""
        found: list[str] = []
        while len(found) < _ERRORS:
            reported = self.query("SYST:ERR?")
            number = reported.partition(",")[0]
            if not number.lstrip("+-").isdecimal():
                raise self.no_reply(f"the reply to SYST:ERR? is {reported!r}")
            if int(number) == 0:
                return found
            found.append(reported)
        return found

    def close(self) -> None:
        """Close the connection without changing the output. Never raises.

        PyVISA's manager is shared by the process and would close all connections, so it stays open.
        """
        if self.driver is not None:
            quietly(self.driver.adapter.close)


def identify_generator(config: KeysightConfig) -> str:
    """Query a generator's identity without changing it.

    Args:
        config: section `generator` of the rig file.
    Raises:
        DeviceError: no driver, no answer.
        InputError: another instrument than the rig file names.
    """
    link = _Link(config)
    try:
        link.check_identity()
        return link.identity
    finally:
        link.close()


def switch_generator_off(config: KeysightConfig, within_s: float) -> None:
    """Switch off a generator that another program may be using, over one short connection.

    A socket is used without the driver, which needs 50 ms to open. A connection that is refused,
    for example because all connections are in use, is tried again.

    Args:
        config: section `generator` of the rig file.
        within_s: how long to try, in s.
    Raises:
        DeviceError: It is not confirmed off, or is not the instrument that the rig file names.
    """
    # *IDN? comes last: its reply ends only with the line (IEEE 488.2, error -440).
    line = f"OUTP{config.channel} OFF;:OUTP{config.channel}?;*IDN?"
    kind, *place, last = config.address.split("::")
    if not (kind.upper().startswith("TCPIP") and last.upper() == "SOCKET"):
        link = _Link(config)
        try:
            _check_off(config, link.query(line))
        finally:
            link.close()
        return
    end_s = time.monotonic() + within_s
    while True:
        wait_s = min(config.timeout_s, max(end_s - time.monotonic(), _SOCKET_S))
        try:
            answer = _over_socket(place[0], int(place[1]), line, wait_s)
            break
        except (OSError, ValueError, IndexError) as error:
            fault = str(error) or type(error).__name__
        if time.monotonic() >= end_s:
            raise DeviceError(
                "Switch the function generator's output off by hand: the connection failed "
                f"({fault}), so it was not confirmed off. Check its cable, and close other "
                f"programs that are connected to it. {config.address}"
            )
        time.sleep(_AGAIN_S)
    _check_off(config, answer)


def _over_socket(host: str, port: int, line: str, wait_s: float) -> str:
    """Send one line and return the reply.

    Raises:
        OSError: none.
    """
    answer = b""
    with socket.create_connection((host, port), timeout=wait_s) as link:
        link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        link.sendall(line.encode("ascii") + b"\n")
        while b"\n" not in answer:
            data = link.recv(4096)
            if not data:
                raise ConnectionError("it closed the connection")
            answer += data
    return answer.decode("ascii", errors="replace").strip()


def _check_off(config: KeysightConfig, answer: str) -> None:
    state, _, identity = answer.partition(";")
    if state.strip().upper() not in _OFF:
        raise DeviceError(
            f"The function generator's output is not off after OUTP OFF ({answer!r}). Switch it "
            f"off by hand. {config.address}"
        )
    fields = [part.strip() for part in identity.split(",")]
    wanted = config.serial_number
    if wanted is not None and wanted not in fields:
        raise DeviceError(
            f"The instrument {identity!r} was switched off, but the rig file names the serial "
            f"number {wanted}. Switch that one off by hand. {config.address}"
        )


class KeysightGenerator:
    """One channel; implements `FunctionGenerator` and `ReportsOutputState`.

    Opening resets the instrument with all of its channels and leaves the output off.

    Args:
        config: section `generator` of the rig file.
    Raises:
        DeviceError: The driver is missing, there is no reply, a setting does not read back, or the
            instrument reports an error.
        InputError: The instrument is not the one that the rig file names.
    """

    def __init__(self, config: KeysightConfig) -> None:
        self._config = config
        self._link = _Link(config)
        self.identity = self._link.identity
        try:
            self._link.check_identity()
            self._prepare()
        except BaseException:
            self.close()
            raise

    @property
    def _channel(self) -> Any:
        return self._link.driver.channels[self._config.channel]

    def _prepare(self) -> None:
        """Switch off, reset, then set the load before the amplitudes that depend on it."""
        try:
            self._set_off()
            self._link.patience(max(_RESET_S, self._config.timeout_s))
            self._link.query("*RST;*CLS;*OPC?")
            self._link.patience(self._config.timeout_s)
            channel = self._channel
            channel.output_load = self._config.load
            channel.shape = "SIN"
            channel.amplitude_unit = "VPP"
            channel.offset = 0.0
            load_ohm = float(self._link.query(f"OUTP{self._config.channel}:LOAD?"))
            unit = str(channel.amplitude_unit).strip().upper()
            shape = str(channel.shape).strip().upper()
            offset_v = float(channel.offset)
            rest = self._other_settings()
            errors = self._link.errors()
        except Exception as error:
            raise self._link.no_reply(error) from None
        wanted_ohm = math.inf if self._config.load == "INF" else float(self._config.load)
        measured_ohm = math.inf if load_ohm > _OPEN_LOAD_OHM else load_ohm
        self._confirm("load in ohm", wanted_ohm, measured_ohm)
        self._confirm("offset in V", 0.0, offset_v)
        if unit != "VPP" or shape != "SIN":
            raise DeviceError(
                f"The function generator reports {shape} in {unit} after SIN in VPP was set. "
                f"Switch it to remote control, then run the command again. {self._config.address}"
            )
        self._judge(rest, errors)
        if not self.is_off():
            raise DeviceError(
                "The function generator's output is on after OUTP OFF. Switch it off by hand. "
                f"{self._config.address}"
            )

    def _other_settings(self) -> str:
        """Query all other settings that change its output."""
        return self._link.query(settings_query(self._config.channel, self._link.channels))

    def _judge(self, rest: str, errors: list[str]) -> None:
        """Check that the signal is the one that was set; otherwise switch it off.

        Raises:
            DeviceError: A setting differs, or the instrument reports errors; the output is off.
        """
        fault = check_settings(rest, self._link.channels, self._config.load)
        if errors:
            fault = f"it reports {'; '.join(errors)}"
        if fault:
            self.off()
            raise DeviceError(
                f"The function generator does not put out the sine that was set: {fault}; its "
                "output is off. Do not use the front panel during a run; run the command again. "
                f"{self._config.address}"
            )

    def _confirm(self, what: str, wanted: float, found: float) -> None:
        same = wanted == found or abs(found - wanted) <= _CLOSE * abs(wanted)
        if not same:
            errors: list[str] = []
            with contextlib.suppress(Exception):
                errors = self._link.errors()
            self.off()
            reported = f" and it reports {'; '.join(errors)}" if errors else ""
            raise DeviceError(
                f"The function generator's {what} was set to {wanted:g} but reads back as {found:g}"
                f"{reported}; its output is off. Check its front panel for an error. "
                f"{self._config.address}"
            )

    # ---- FunctionGenerator ---------------------------------------------------------------------

    def sine(self, frequency_hz: float, amplitude_v: float) -> None:
        """See `haselab.rig.FunctionGenerator`; an amplitude of 0 switches the output off.

        Raises:
            LimitError: The sine is outside the limits of rig file or instrument, and is not
                changed.
            DeviceError: There is no reply, a setting does not read back, the signal was changed at
                the front panel, or the instrument reports an error; the output is off.
        """
        config = self._config
        vpp = 2.0 * amplitude_v / config.volt_per_volt
        inside = 0.0 < frequency_hz <= config.highest_hz and 0.0 <= amplitude_v <= config.highest_v
        if not inside or not (vpp == 0.0 or _SMALLEST_VPP <= vpp <= _LARGEST_VPP):
            low_v = 0.5 * _SMALLEST_VPP * config.volt_per_volt
            high_v = min(config.highest_v, 0.5 * _LARGEST_VPP * config.volt_per_volt)
            raise LimitError(
                f"Sine of {frequency_hz:g} Hz, {amplitude_v:g} V is outside (0, "
                f"{config.highest_hz:g}] Hz, [{low_v:g}, {high_v:g}] V. Lower the request, or "
                "widen the limit in the rig file."
            )
        if vpp == 0.0:
            self._switch(False)
            return
        try:
            channel = self._channel
            channel.frequency = frequency_hz
            # Send the unit too: one set at the front panel must never take effect.
            self._link.driver.write(f"SOUR{config.channel}:VOLT {vpp:.6f} VPP")
            measured_hz, measured_vpp = float(channel.frequency), float(channel.amplitude)
            rest, errors = self._other_settings(), self._link.errors()
        except Exception as error:
            self.off()
            raise self._link.no_reply(error) from None
        self._judge(rest, [])  # first, because it checks the unit of the amplitude
        self._confirm("frequency in Hz", frequency_hz, measured_hz)
        self._confirm("amplitude in Vpp", vpp, measured_vpp)
        self._judge(rest, errors)
        self._switch(True)

    def _switch(self, on: bool) -> None:
        try:
            self._link.driver.write(f"OUTP{self._config.channel} {'ON' if on else 'OFF'}")
            state = self._is_on()
        except Exception as error:
            self.off()
            raise self._link.no_reply(error) from None
        if state is not on:
            self.off()
            raise DeviceError(
                f"The function generator's output was switched {'on' if on else 'off'} but is "
                f"{'on' if state else 'off'}. Check its front panel. {self._config.address}"
            )

    def _is_on(self) -> bool:
        return self._link.query(f"OUTP{self._config.channel}?").upper() not in _OFF

    def _set_off(self) -> None:
        self._link.driver.write(f"OUTP{self._config.channel} OFF")

    def off(self) -> None:
        """See `haselab.rig.FunctionGenerator`: `OUTP OFF`, repeated if it is not confirmed.

        Setting and query are sent in one line first: a separate query waits for the
        acknowledgement of the setting, 40 ms over TCP.
        """
        if quietly(self._off_in_one_line) is None:
            return
        quietly(self._set_off)
        quietly(self._check_off)

    def _off_in_one_line(self) -> None:
        output = f"OUTP{self._config.channel}"
        if self._link.query(f"{output} OFF;:{output}?").upper() not in _OFF:
            raise self._link.no_reply("the output is on after OUTP OFF")

    def _check_off(self) -> None:
        if self._is_on():
            raise self._link.no_reply("the output is on after OUTP OFF")

    def is_off(self) -> bool:
        """See `haselab.rig.ReportsOutputState`."""
        try:
            return not self._is_on()
        except Exception as error:
            raise self._link.no_reply(error) from None

    def close(self) -> None:
        """Switch the output off and close the connection. Never raises."""
        self.off()
        self._link.close()
