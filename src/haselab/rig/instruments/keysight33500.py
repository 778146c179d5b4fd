"""Keysight 33500B as sensing signal: PyMeasure's driver over PyVISA, every setting read back.

Whoever used the instrument before may have left burst, sweep, modulation, gate, polarity, limits
or coupling; each of them changes what comes out, and none of them the amplitude that is read back.
So it is reset first, asked for all of them, and its error queue is read.

Instruments of this family take few connections at once: the EDU33210 series two in all (user's
guide, "SCPI Socket Services"), the E4360 series four; the limit of the 33500B is inferred. So the
program holds one, and whoever switches the output off from outside uses another one for a single
line (`switch_generator_off`).

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
from haselab.rig.bench_config import GeneratorConfig
from haselab.rig.instruments.drivers import load_driver, quietly
from haselab.rig.instruments.keysight33500_state import check_rest, is_two_channel, rest_question

__all__ = ["KeysightGenerator", "identify_generator", "switch_generator_off"]

_SMALLEST_VPP, _LARGEST_VPP = 10e-3, 10.0  # that PyMeasure sends
_MODEL = "335"  # 33509B to 33522B
_OPEN_LOAD_OHM = 1e30  # the answer to a load of INF is 9.9E+37
_OFF = {"0", "OFF"}
_CLOSE = 1e-4  # relative: settings go over the wire with six digits
_RESET_S = 5.0  # that *RST may take
_ERRORS = 25  # more than its queue holds
_SOCKET_S = 0.25  # for an answer on a bare socket, at least
_AGAIN_S = 0.03  # between two trials of a connection


class _Link:
    """One VISA connection to a generator.

    Args:
        config: section `generator` of the rig file.
    Raises:
        DeviceError: no driver, no answer.
    """

    def __init__(self, config: GeneratorConfig) -> None:
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
            raise self.dead(error) from None

    def patience(self, wait_s: float) -> None:
        """Limit the time of a read.

        pyvisa-py waits for an answer with `select`, then reads a socket without a limit: where
        nothing is to be read then, as was seen under load, it would wait for ever.
        """
        connection = self.driver.adapter.connection
        connection.timeout = round(1e3 * wait_s)
        session = connection.visalib.sessions.get(connection.session)  # of pyvisa-py
        interface = getattr(session, "interface", None)
        if isinstance(interface, socket.socket):
            interface.settimeout(wait_s)

    def dead(self, error: object) -> DeviceError:
        """The error of a generator that does not answer."""
        text = str(error).partition("\n")[0] or type(error).__name__
        return DeviceError(
            f"The function generator does not answer ({text}). Switch it on, check the cable, "
            "close other programs that are connected to it, or correct generator.address. "
            f"{self._config.address}"
        )

    def check_identity(self) -> None:
        """Refuse another instrument than the rig file names.

        Raises:
            InputError: it is one.
        """
        fields = [part.strip() for part in self.identity.split(",")]
        if len(fields) < 3 or not fields[1].startswith(_MODEL):
            raise InputError(
                f"The instrument identifies as {self.identity!r}, expected a Keysight 33500B. "
                f"Correct generator.address. {self._config.address}"
            )
        wanted = self._config.serial_number
        if wanted is not None and fields[2] != wanted:
            raise InputError(
                f"Serial number of the function generator = {fields[2]}, expected {wanted} by the "
                "rig file. Connect that one, or correct generator.serial_number. "
                f"{self._config.address}"
            )

    @property
    def channels(self) -> int:
        """One or two."""
        return 2 if is_two_channel(self.identity.split(",")[1].strip()) else 1

    def ask(self, question: str) -> str:
        """The answer to one line."""
        return str(self.driver.ask(question)).strip()

    def errors(self) -> list[str]:
        """What stands in its error queue, which is empty then."""
        found: list[str] = []
        while len(found) < _ERRORS:
            told = self.ask("SYST:ERR?")
            number = told.partition(",")[0]
            if not number.lstrip("+-").isdecimal():
                raise self.dead(f"SYST:ERR? is answered by {told!r}")
            if int(number) == 0:
                return found
            found.append(told)
        return found

    def close(self) -> None:
        """End the connection; the output stays as it is. Never raises.

        PyVISA's manager is one for the process and would end all other connections too: it stays.
        """
        if self.driver is not None:
            quietly(self.driver.adapter.close)


def identify_generator(config: GeneratorConfig) -> str:
    """What a generator says it is; it is left as it is.

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


def switch_generator_off(config: GeneratorConfig, within_s: float) -> None:
    """Switch a generator off that another program may be using, with one short connection.

    A socket is used without a driver, which takes 50 ms to open. Where the connection is refused,
    as by an instrument whose connections are all in use, it is tried again.

    Args:
        config: section `generator` of the rig file.
        within_s: how long it is tried, in s.
    Raises:
        DeviceError: not confirmed off, or another instrument than the rig file names.
    """
    # *IDN? comes last: what it answers has no end but that of the line (IEEE 488.2, error -440).
    line = f"OUTP{config.channel} OFF;:OUTP{config.channel}?;*IDN?"
    kind, *place, last = config.address.split("::")
    if not (kind.upper().startswith("TCPIP") and last.upper() == "SOCKET"):
        link = _Link(config)
        try:
            _check_off(config, link.ask(line))
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
                f"The connection to the function generator failed ({fault}), so its output was "
                "not confirmed off. Check its cable, close other programs that are connected to "
                f"it, or switch its output off by hand. {config.address}"
            )
        time.sleep(_AGAIN_S)
    _check_off(config, answer)


def _over_socket(host: str, port: int, line: str, wait_s: float) -> str:
    """The answer to one line.

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


def _check_off(config: GeneratorConfig, answer: str) -> None:
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
    """One channel: fulfils `FunctionGenerator` and `TellsOff`. The output is off after opening.

    The instrument is reset, with all of its channels.

    Args:
        config: section `generator` of the rig file.
    Raises:
        DeviceError: no driver, no answer, a setting that does not read back, or an error in the
            instrument's queue.
        InputError: another instrument than the rig file names.
    """

    def __init__(self, config: GeneratorConfig) -> None:
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
        """Off; reset; the load before the amplitudes that depend on it; no offset."""
        try:
            self._set_off()
            self._link.patience(max(_RESET_S, self._config.timeout_s))
            self._link.ask("*RST;*CLS;*OPC?")
            self._link.patience(self._config.timeout_s)
            channel = self._channel
            channel.output_load = self._config.load
            channel.shape = "SIN"
            channel.amplitude_unit = "VPP"
            channel.offset = 0.0
            load_ohm = float(self._link.ask(f"OUTP{self._config.channel}:LOAD?"))
            unit = str(channel.amplitude_unit).strip().upper()
            shape = str(channel.shape).strip().upper()
            offset_v = float(channel.offset)
            rest = self._rest()
            errors = self._link.errors()
        except Exception as error:
            raise self._link.dead(error) from None
        wanted_ohm = math.inf if self._config.load == "INF" else float(self._config.load)
        told_ohm = math.inf if load_ohm > _OPEN_LOAD_OHM else load_ohm
        self._confirm("load in ohm", wanted_ohm, told_ohm)
        self._confirm("offset in V", 0.0, offset_v)
        if unit != "VPP" or shape != "SIN":
            raise DeviceError(
                f"The function generator reports {shape} in {unit} after SIN in VPP was set. "
                f"Switch it to remote control. {self._config.address}"
            )
        self._judge(rest, errors)
        if not self.is_off():
            raise DeviceError(
                "The function generator's output is on after OUTP OFF. Switch it off by hand. "
                f"{self._config.address}"
            )

    def _rest(self) -> str:
        """What it says of everything else that changes its output."""
        return self._link.ask(rest_question(self._config.channel, self._link.channels))

    def _judge(self, rest: str, errors: list[str]) -> None:
        """Refuse a signal that is not the one that was set.

        Raises:
            DeviceError: something stands otherwise, or the instrument reports errors; it is off.
        """
        fault = check_rest(rest, self._link.channels, self._config.load)
        if errors:
            fault = f"it reports {'; '.join(errors)}"
        if fault:
            self.off()
            raise DeviceError(
                f"The function generator does not put out the sine that was set: {fault}; its "
                "output is off. Do not use the front panel during a run; run the command again. "
                f"{self._config.address}"
            )

    def _confirm(self, what: str, wanted: float, told: float) -> None:
        same = wanted == told or abs(told - wanted) <= _CLOSE * abs(wanted)
        if not same:
            errors: list[str] = []
            with contextlib.suppress(Exception):
                errors = self._link.errors()
            self.off()
            reported = f" and it reports {'; '.join(errors)}" if errors else ""
            raise DeviceError(
                f"The function generator's {what} reads back as {told:g}, set was {wanted:g}"
                f"{reported}; its output is off. Look at its front panel for an error. "
                f"{self._config.address}"
            )

    # ---- FunctionGenerator ---------------------------------------------------------------------

    def sine(self, frequency_hz: float, amplitude_v: float) -> None:
        """See `haselab.rig.FunctionGenerator`; an amplitude of 0 is the output off.

        Raises:
            LimitError: beyond the rig file or the instrument; the old sine stays.
            DeviceError: no answer, a setting that does not read back, a signal that somebody has
                changed at the front panel, or an error in the queue; the output is off.
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
            # Its unit goes with it: one that was set at the panel must not come out, nor for ms.
            self._link.driver.write(f"SOUR{config.channel}:VOLT {vpp:.6f} VPP")
            told_hz, told_vpp = float(channel.frequency), float(channel.amplitude)
            rest, errors = self._rest(), self._link.errors()
        except Exception as error:
            self.off()
            raise self._link.dead(error) from None
        self._judge(rest, [])  # first: it checks the unit of told_vpp
        self._confirm("frequency in Hz", frequency_hz, told_hz)
        self._confirm("amplitude in Vpp", vpp, told_vpp)
        self._judge(rest, errors)
        self._switch(True)

    def _switch(self, on: bool) -> None:
        try:
            self._link.driver.write(f"OUTP{self._config.channel} {'ON' if on else 'OFF'}")
            state = self._is_on()
        except Exception as error:
            self.off()
            raise self._link.dead(error) from None
        if state is not on:
            self.off()
            raise DeviceError(
                f"The function generator's output is {'on' if state else 'off'}, set was "
                f"{'on' if on else 'off'}. Look at its front panel. {self._config.address}"
            )

    def _is_on(self) -> bool:
        return self._link.ask(f"OUTP{self._config.channel}?").upper() not in _OFF

    def _set_off(self) -> None:
        self._link.driver.write(f"OUTP{self._config.channel} OFF")

    def off(self) -> None:
        """See `haselab.rig.FunctionGenerator`: `OUTP OFF`, once more where it is not confirmed.

        Setting and question go in one line at first: a question sent by itself waits for the
        receipt of the setting, 40 ms over TCP.
        """
        if quietly(self._off_in_one_line) is None:
            return
        quietly(self._set_off)
        quietly(self._check_off)

    def _off_in_one_line(self) -> None:
        output = f"OUTP{self._config.channel}"
        if self._link.ask(f"{output} OFF;:{output}?").upper() not in _OFF:
            raise self._link.dead("the output is on after OUTP OFF")

    def _check_off(self) -> None:
        if self._is_on():
            raise self._link.dead("the output is on after OUTP OFF")

    def is_off(self) -> bool:
        """See `haselab.rig.TellsOff`."""
        try:
            return not self._is_on()
        except Exception as error:
            raise self._link.dead(error) from None

    def close(self) -> None:
        """Output off, connection closed. Never raises."""
        self.off()
        self._link.close()
