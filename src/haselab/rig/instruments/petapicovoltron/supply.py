"""Serial high-voltage supply of the Peta-Pico-Voltron family (SHVPS), firmware 8.

`haselab.rig.instruments.petapicovoltron.line` has the protocol and switches the supply off. The
supply has no watchdog: when the computer fails, it keeps its voltage, so something else must
switch it off. Source: the published Arduino code, see `haselab.rig.twin.serve.supply.firmware`.
"""

from __future__ import annotations

from haselab.base import DeviceError, InputError, LimitError
from haselab.rig.drivers import quietly
from haselab.rig.instruments.petapicovoltron.line import SupplyLine
from haselab.rig.instruments.petapicovoltron.section import PetaPicoVoltronConfig

__all__ = ["DISCHARGE_S", "PetaPicoVoltron", "identify_supply", "switch_supply_off"]

DISCHARGE_S = 3.0  # longest discharge of its converter, once it is off
_FIRMWARE = "slave 8"
_SWITCHBOARD = "slave 1"
_MODE_DC = 1  # SSwMode
_ON_STATE = ("QSwSrc", "QVMode", "QSwMode", "QVset")
_POWER_ON = ("QMem", "QPowJack", "QJack")
_MEMORY_FIELDS = 13
_SWITCHED_OFF = (
    "It is off now. Send 'Save' in a serial terminal to store that, then run the command again."
)
_MAY_BE_ON = (
    "It may be on. Keep clear, and run: haselab rig safe RIG.toml. Then run the command again."
)


def _check_identity(config: PetaPicoVoltronConfig, line: SupplyLine) -> str:
    """Check that the supply is the one of the rig file; return its name and version.

    Raises:
        DeviceError: The reply is not valid.
        InputError: It is another supply, or one that cannot reach its limit.
    """
    name, reach = line.query_all(["QName", "QVmax"])
    if line.version == _SWITCHBOARD:
        raise InputError(
            "The device at this port is a switchboard (it replies 'slave 1' to QVer), but a supply "
            f"with firmware 8 is needed. Change supply.port. {config.port}"
        )
    if line.version != _FIRMWARE:
        raise InputError(
            f"The high-voltage supply has the version {line.version!r}, but {_FIRMWARE!r} is "
            "needed: other firmware may not switch off in the same way. Load firmware 8, or change "
            f"supply.port. {config.port}"
        )
    wanted = config.serial_number
    if wanted is not None and name != wanted:
        raise InputError(
            f"The high-voltage supply's name is {name!r}, but the rig file names {wanted!r}. "
            f"Connect that one, or change supply.serial_number. {config.port}"
        )
    if not reach.isdecimal():
        raise line.no_reply(f"QVmax: {reach!r}")
    if int(reach) < config.highest_v:
        raise InputError(
            f"supply.highest_v is {config.highest_v:g} V, but this supply reaches only "
            f"{int(reach)} V. Lower supply.highest_v. {config.port}"
        )
    return f"{name}, {line.version}"


def _check_memory(config: PetaPicoVoltronConfig, line: SupplyLine, *, switched_off: bool) -> None:
    """Refuse a supply that puts out a voltage by itself at power-on.

    Raises:
        DeviceError: The reply is not valid.
        InputError: It would put out a voltage.
    """
    memory = line.query("QMem").split(",")
    try:
        set_v, source, mode, vmode, cycles = (int(memory[k]) for k in (0, 2, 3, 4, 11))
    except (ValueError, IndexError):
        raise line.no_reply(f"QMem: {','.join(memory)!r}") from None
    if len(memory) != _MEMORY_FIELDS:
        raise line.no_reply(f"QMem: {len(memory)} values instead of {_MEMORY_FIELDS}")
    voltage = set_v > 0 or vmode == 1
    if voltage and (source != 0 or mode != 0 or cycles != 0):
        reported = f"up to {set_v} V" if vmode != 1 else "the voltage of its external input"
        raise InputError(
            f"The high-voltage supply would put out {reported} at power-on: its memory contains "
            f"SwSrc {source}, SwMode {mode}, VMode {vmode}, Vset {set_v}, {cycles} "
            "cycles. "
            f"{_SWITCHED_OFF if switched_off else _MAY_BE_ON} {config.port}"
        )


def _check_jack(config: PetaPicoVoltronConfig, line: SupplyLine) -> None:
    """Refuse a supply that echoes everything but puts out no voltage.

    Raises:
        DeviceError: It has no power, or the reply is not valid.
    """
    used, plugged = line.query_all(["QPowJack", "QJack"])
    if used not in {"0", "1"} or plugged not in {"0", "1"}:
        raise line.no_reply(f"QPowJack: {used!r}, QJack: {plugged!r}")
    if used == "1" and plugged == "0":
        raise DeviceError(
            "The high-voltage supply has no power, because its power jack is unplugged. Plug it "
            f"in. {config.port}"
        )


def identify_supply(config: PetaPicoVoltronConfig) -> str:
    """Identify a supply and check that it can be used, without changing it.

    Args:
        config: section `supply` of the rig file.
    Returns:
        Name and version.
    Raises:
        DeviceError: no port, no sensible answer, no power.
        InputError: another supply than the rig file names, or one that switches on by itself.
    """
    line = SupplyLine(config)
    try:
        line.synchronise()
        reported = _check_identity(config, line)
        left_v = line.number("QVnow")
        if abs(left_v) > config.tolerance_v:
            raise DeviceError(
                f"Keep clear: the high-voltage supply is ON, its meter shows {left_v:g} V. If no "
                f"run uses it, run: haselab rig safe RIG.toml. {config.port}"
            )
        _check_memory(config, line, switched_off=False)
        _check_jack(config, line)
        return reported
    finally:
        line.close()


def switch_supply_off(config: PetaPicoVoltronConfig) -> None:
    """Switch off any supply that replies at the port, over a separate connection.

    It is switched off before it is queried, so that no other fault prevents that.

    Args:
        config: section `supply` of the rig file.
    Raises:
        DeviceError: It is not confirmed off, or is not the supply that the rig file names.
    """
    line = SupplyLine(config)
    try:
        error = quietly(line.switch_off)
        if error is not None:
            line.switch_off()
        line.wait_discharged(DISCHARGE_S)
        wanted = config.serial_number
        if wanted is not None and (name := line.query_all(["QName"])[0]) != wanted:
            raise DeviceError(
                f"The supply {name!r} was switched off, but the rig file names {wanted!r}. Switch "
                f"that one off by hand. {config.port}"
            )
    finally:
        line.close()


class PetaPicoVoltron:
    """One supply; implements `HighVoltageSupply` and `ReportsOutputState`. Opening switches it off.

    Args:
        config: section `supply` of the rig file.
    Raises:
        DeviceError: Driver or port is missing, a reply is not valid, or it is not confirmed off.
        InputError: It is not the supply that the rig file names, cannot reach its limit, or would
            switch on by itself at power-on.
    """

    def __init__(self, config: PetaPicoVoltronConfig) -> None:
        self._config = config
        self.tolerance_v = config.tolerance_v  # largest reading of its meter while it is off
        self._energised = False  # since its state was verified
        self._line = SupplyLine(config)
        try:
            self._line.synchronise()
            self._line.switch_off()
            self.identity = _check_identity(config, self._line)
            self._line.wait_discharged(DISCHARGE_S)
            _check_memory(config, self._line, switched_off=True)
        except BaseException:
            self.close()
            raise

    def check_power(self) -> None:
        """Refuse a supply that echoes everything but puts out no voltage.

        Raises:
            DeviceError: Its power jack is unplugged, or the reply is not valid.
        """
        _check_jack(self._config, self._line)

    # ---- HighVoltageSupply ---------------------------------------------------------------------

    def set_voltage(self, voltage_v: float) -> None:
        """See `haselab.rig.HighVoltageSupply`; whole volts.

        Starting from off, power, switch source and modes are verified; later changes of the
        voltage need two commands.
        """
        if not 0.0 <= voltage_v <= self._config.highest_v:
            raise LimitError(
                f"The supply voltage is {voltage_v:g} V, but it must be within [0, "
                f"{self._config.highest_v:g}] V. Lower the request, or raise supply.highest_v."
            )
        whole_v = round(voltage_v)
        try:
            first = whole_v > 0 and not self._energised
            if first:
                _check_jack(self._config, self._line)
                self._line.set("SSwSrc", 0)
                self._line.set("SVMode", 0)
            self._line.set("SVset", whole_v)
            self._line.set("SSwMode", _MODE_DC)
            if first:
                self._verify(whole_v)
        except DeviceError:
            self.off()
            raise

    def _verify(self, whole_v: int) -> None:
        """Check the settings with which an echoed voltage is put out."""
        found = self._line.query_all(_ON_STATE)
        expected = ["0", "0", str(_MODE_DC), str(whole_v)]
        if found != expected:
            raise self._line.no_reply(
                f"{', '.join(_ON_STATE)} are {', '.join(found)}, expected {', '.join(expected)}"
            )
        self._energised = True

    def read_voltage(self) -> float:
        """See `haselab.rig.HighVoltageSupply`; measured at its converter, before the switch."""
        return self._line.number("QVnow")

    def off(self) -> None:
        """See `haselab.rig.HighVoltageSupply`. Never raises, does not wait for the discharge."""
        self._energised = False
        if quietly(self._line.switch_off) is not None:  # another program may have used the port
            quietly(self._line.switch_off)

    def is_off(self) -> bool:
        """See `haselab.rig.ReportsOutputState`; according to its settings, not its meter."""
        return not self._line.not_off()

    def close(self) -> None:
        """Switch the supply off and close the port. Never raises."""
        self.off()
        self._line.close()
