"""Serial high-voltage supply of the Peta-Pico-Voltron family.

ASCII at 115,200 baud, 8N1; a command ends with CR, its answer with CR LF. `S...` sets and echoes
the value, `Q...` asks, anything else is answered by `Err`. Written from the protocol's description
(petapicovoltron.com, firmware 8). The supply has no watchdog: when the computer dies it stays at
its voltage, so something else has to take it down.
"""

from __future__ import annotations

import math
from typing import Any

from haselab.base import DeviceError, InputError, LimitError
from haselab.rig.bench_config import SupplyConfig
from haselab.rig.drivers import load_driver, quietly

__all__ = ["PetaPicoVoltron"]

_BAUD = 115_200
_MODE_OFF, _MODE_DC = 0, 1  # SSwMode
_REGULATED = 0  # SVMode


class PetaPicoVoltron:
    """One supply: fulfils `HighVoltageSupply` and `TellsOff`. It is off after opening.

    Args:
        config: section `supply` of the rig file.
    Raises:
        DeviceError: no driver, no port, no sensible answer.
        InputError: another supply than the rig file names, or one that cannot reach its limit.
    """

    def __init__(self, config: SupplyConfig) -> None:
        self._config = config
        self.tolerance_v = config.tolerance_v  # of its meter: at rest it may show as much
        serial = load_driver("serial", "The high-voltage supply")
        try:
            self._port: Any = serial.Serial(
                config.port, _BAUD, timeout=config.timeout_s, write_timeout=config.timeout_s
            )
        except (OSError, ValueError) as error:
            raise self._dead(str(error)) from None
        try:
            self._port.reset_input_buffer()
            self._open()
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        version, name = self._exchange("QVer"), self._exchange("QName")
        if not version.startswith("slave"):
            raise InputError(
                f"The port answers {version!r} to QVer, allowed is 'slave' and a number. "
                f"Correct supply.port. {self._config.port}"
            )
        wanted = self._config.serial_number
        if wanted is not None and name != wanted:
            raise InputError(
                f"Name of the high-voltage supply = {name!r}, allowed by the rig file is "
                f"{wanted!r}. Connect that one, or correct supply.serial_number. "
                f"{self._config.port}"
            )
        self.identity = f"{name}, {version}"
        reach_v = self._number("QVmax")
        if reach_v < self._config.highest_v:
            raise InputError(
                f"supply.highest_v = {self._config.highest_v:g} V, this supply reaches "
                f"{reach_v:g} V. Lower it. {self._config.port}"
            )
        self._set("SVset", 0)
        self._set("SSwMode", _MODE_OFF)
        self._set("SVMode", _REGULATED)

    def _dead(self, what: str) -> DeviceError:
        return DeviceError(
            f"The high-voltage supply does not answer as it should ({what}). Check cable and "
            f"power, or correct supply.port. {self._config.port}"
        )

    def _exchange(self, command: str) -> str:
        try:
            self._port.reset_input_buffer()
            self._port.write(command.encode("ascii") + b"\r")
            answer = self._port.read_until(b"\r\n", 128)
        except (OSError, TypeError) as error:  # pyserial: TypeError on a port that is gone
            raise self._dead(str(error) or type(error).__name__) from None
        if not answer.endswith(b"\r\n"):
            raise self._dead(f"{command}: {len(answer)} bytes and no end of line")
        try:
            text = str(answer[:-2].decode("ascii").strip())
        except UnicodeDecodeError:
            raise self._dead(f"{command}: garbage") from None
        if text == "Err":
            raise self._dead(f"{command}: Err")
        return text

    def _number(self, command: str) -> float:
        answer = self._exchange(command)
        try:
            value = float(answer)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise self._dead(f"{command}: {answer!r}")
        return value

    def _set(self, command: str, value: int) -> None:
        echo = self._number(f"{command} {value}")
        if echo != value:
            raise self._dead(f"{command} {value} is echoed as {echo:g}")

    # ---- HighVoltageSupply ---------------------------------------------------------------------

    def set_voltage(self, voltage_v: float) -> None:
        """See `haselab.rig.HighVoltageSupply`; whole volts."""
        if not 0.0 <= voltage_v <= self._config.highest_v:
            raise LimitError(
                f"Supply voltage = {voltage_v:g} V is outside [0, {self._config.highest_v:g}] V. "
                "Lower the request, or widen the limit in the rig file."
            )
        try:
            self._set("SVset", round(voltage_v))
            self._set("SSwMode", _MODE_DC)
        except DeviceError:
            self.off()
            raise

    def read_voltage(self) -> float:
        """See `haselab.rig.HighVoltageSupply`."""
        return self._number("QVnow")

    def off(self) -> None:
        """See `haselab.rig.HighVoltageSupply`. Never raises."""
        for _ in range(2):  # what was left on the wire may have spoilt the first try
            at_zero = quietly(lambda: self._set("SVset", 0))
            switched = quietly(lambda: self._set("SSwMode", _MODE_OFF))
            if at_zero is None and switched is None:
                return

    def is_off(self) -> bool:
        """See `haselab.rig.TellsOff`: the switch is open. What is stored runs down by itself."""
        return self._number("QSwMode") == _MODE_OFF

    def close(self) -> None:
        """Off, port closed. Never raises."""
        self.off()
        quietly(self._port.close)
