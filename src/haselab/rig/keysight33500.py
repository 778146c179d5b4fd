"""Keysight 33500B as sensing signal: PyMeasure's driver over PyVISA, every setting read back.

PyMeasure's `shutdown()` leaves the output on, so nothing here relies on it: `off` sets `OUTP OFF`
and `is_off` asks the instrument.
"""

from __future__ import annotations

import math
import socket
from typing import Any

from haselab.base import DeviceError, InputError, LimitError
from haselab.rig.bench_config import GeneratorConfig
from haselab.rig.drivers import load_driver, quietly

__all__ = ["KeysightGenerator"]

_SMALLEST_VPP, _LARGEST_VPP = 10e-3, 10.0  # that PyMeasure sends
_MODEL = "335"  # 33509B to 33522B
_OPEN_LOAD_OHM = 1e30  # the answer to a load of INF is 9.9E+37
_OFF = {"0", "OFF"}
_CLOSE = 1e-4  # relative: settings go over the wire with six digits


class KeysightGenerator:
    """One channel: fulfils `FunctionGenerator` and `TellsOff`. The output is off after opening.

    Args:
        config: section `generator` of the rig file.
    Raises:
        DeviceError: no driver, no answer, or a setting that does not read back.
        InputError: another instrument than the rig file names.
    """

    def __init__(self, config: GeneratorConfig) -> None:
        self._config = config
        driver = load_driver("pymeasure.instruments.agilent", "The function generator")
        load_driver("pyvisa_py", "The function generator")
        self._link: Any = None
        try:
            self._link = driver.Agilent33500(
                config.address,
                visa_library="@py",
                timeout=round(1e3 * config.timeout_s),
                write_termination="\n",
                read_termination="\n",
            )
            self._bound_reads()
            self.identity = str(self._link.id).strip()
        except Exception as error:
            self._let_go()
            raise self._dead(error) from None
        try:
            self._check_identity()
            self._prepare()
        except BaseException:
            self.close()
            raise

    def _bound_reads(self) -> None:
        """Limit the time of a read on a socket.

        pyvisa-py waits for an answer with `select`, then reads without a limit: where nothing is
        to be read then, as was seen under load, it would wait for ever.
        """
        connection = self._link.adapter.connection
        session = connection.visalib.sessions.get(connection.session)  # of pyvisa-py
        interface = getattr(session, "interface", None)
        if isinstance(interface, socket.socket):
            interface.settimeout(self._config.timeout_s)

    def _dead(self, error: object) -> DeviceError:
        text = str(error).partition("\n")[0] or type(error).__name__
        return DeviceError(
            f"The function generator does not answer ({text}). Switch it on, check the cable, or "
            f"correct generator.address. {self._config.address}"
        )

    @property
    def _channel(self) -> Any:
        return self._link.channels[self._config.channel]

    def _check_identity(self) -> None:
        fields = [part.strip() for part in self.identity.split(",")]
        if len(fields) < 3 or not fields[1].startswith(_MODEL):
            raise InputError(
                f"The instrument says it is {self.identity!r}, allowed is a Keysight 33500B. "
                f"Correct generator.address. {self._config.address}"
            )
        wanted = self._config.serial_number
        if wanted is not None and fields[2] != wanted:
            raise InputError(
                f"Serial number of the function generator = {fields[2]}, allowed by the rig file "
                f"is {wanted}. Connect that one, or correct generator.serial_number. "
                f"{self._config.address}"
            )

    def _prepare(self) -> None:
        """Off; the units that amplitudes are told in; no offset."""
        self._set_off()
        try:
            channel = self._channel
            channel.output_load = self._config.load
            channel.shape = "SIN"
            channel.amplitude_unit = "VPP"
            channel.offset = 0.0
            load_ohm = float(self._ask(f"OUTP{self._config.channel}:LOAD?"))
            unit = str(channel.amplitude_unit).strip().upper()
            shape = str(channel.shape).strip().upper()
            offset_v = float(channel.offset)
        except Exception as error:
            raise self._dead(error) from None
        wanted_ohm = math.inf if self._config.load == "INF" else float(self._config.load)
        told_ohm = math.inf if load_ohm > _OPEN_LOAD_OHM else load_ohm
        self._confirm("load in ohm", wanted_ohm, told_ohm)
        self._confirm("offset in V", 0.0, offset_v)
        if unit != "VPP" or shape != "SIN":
            raise DeviceError(
                f"The function generator stands at {shape} in {unit}, set was SIN in VPP. "
                f"Switch it to remote control. {self._config.address}"
            )
        if not self.is_off():
            raise DeviceError(
                "The function generator's output is on after OUTP OFF. Switch it off by hand. "
                f"{self._config.address}"
            )

    def _ask(self, question: str) -> str:
        return str(self._link.ask(question)).strip()

    def _confirm(self, what: str, wanted: float, told: float) -> None:
        same = wanted == told or abs(told - wanted) <= _CLOSE * abs(wanted)
        if not same:
            self.off()
            raise DeviceError(
                f"The function generator's {what} reads back as {told:g}, set was {wanted:g}; its "
                f"output is off. Look at its front panel for an error. {self._config.address}"
            )

    # ---- FunctionGenerator ---------------------------------------------------------------------

    def sine(self, frequency_hz: float, amplitude_v: float) -> None:
        """See `haselab.rig.FunctionGenerator`; an amplitude of 0 is the output off.

        Raises:
            LimitError: beyond the rig file or the instrument; the old sine stays.
            DeviceError: no answer, or a setting that does not read back; the output is off.
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
            channel.amplitude = vpp
            told_hz, told_vpp = float(channel.frequency), float(channel.amplitude)
        except Exception as error:
            self.off()
            raise self._dead(error) from None
        self._confirm("frequency in Hz", frequency_hz, told_hz)
        self._confirm("amplitude in Vpp", vpp, told_vpp)
        self._switch(True)

    def _switch(self, on: bool) -> None:
        try:
            self._link.write(f"OUTP{self._config.channel} {'ON' if on else 'OFF'}")
            state = self._is_on()
        except Exception as error:
            self.off()
            raise self._dead(error) from None
        if state is not on:
            self.off()
            raise DeviceError(
                f"The function generator's output is {'on' if state else 'off'}, set was "
                f"{'on' if on else 'off'}. Look at its front panel. {self._config.address}"
            )

    def _is_on(self) -> bool:
        return self._ask(f"OUTP{self._config.channel}?").upper() not in _OFF

    def _set_off(self) -> None:
        self._link.write(f"OUTP{self._config.channel} OFF")

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
        if self._ask(f"{output} OFF;:{output}?").upper() not in _OFF:
            raise self._dead("the output is on after OUTP OFF")

    def _check_off(self) -> None:
        if self._is_on():
            raise self._dead("the output is on after OUTP OFF")

    def is_off(self) -> bool:
        """See `haselab.rig.TellsOff`."""
        try:
            return not self._is_on()
        except Exception as error:
            raise self._dead(error) from None

    def close(self) -> None:
        """Output off, connection closed. Never raises."""
        self.off()
        self._let_go()

    def _let_go(self) -> None:
        if self._link is not None:
            quietly(self._link.adapter.close)
            quietly(self._link.adapter.manager.close)
