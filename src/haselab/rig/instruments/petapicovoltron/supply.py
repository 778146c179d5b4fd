"""Serial high-voltage supply of the Peta-Pico-Voltron family (SHVPS), firmware 8.

`haselab.rig.instruments.petapicovoltron.line` has the protocol and switches the supply off. The
supply has no watchdog: when the computer dies it stays at its voltage, so something else has to
take it down. Source: the published Arduino code, see `haselab.rig.twin.serve.supply.firmware`.
"""

from __future__ import annotations

from haselab.base import DeviceError, InputError, LimitError
from haselab.rig.drivers import quietly
from haselab.rig.instruments.petapicovoltron.line import SupplyLine
from haselab.rig.instruments.petapicovoltron.section import PetaPicoVoltronConfig

__all__ = ["DISCHARGE_S", "PetaPicoVoltron", "identify_supply", "switch_supply_off"]

DISCHARGE_S = 3.0  # that its converter has to run down, once it is off
_FIRMWARE = "slave 8"
_SWITCHBOARD = "slave 1"
_MODE_DC = 1  # SSwMode
_ON_STATE = ("QSwSrc", "QVMode", "QSwMode", "QVset")
_POWER_ON = ("QMem", "QPowJack", "QJack")
_MEMORY_FIELDS = 13
_SWITCHED_OFF = "It is off now; send 'Save' in a serial terminal to keep it so, then start again."
_MAY_BE_ON = "It may be on: keep clear, type: haselab rig safe RIG.toml. Then start again."


def _check_identity(config: PetaPicoVoltronConfig, line: SupplyLine) -> str:
    """Name and version of a supply that is the one of the rig file.

    Raises:
        DeviceError: no sensible answer.
        InputError: another supply, or one that cannot reach its limit.
    """
    name, reach = line.query_all(["QName", "QVmax"])
    if line.version == _SWITCHBOARD:
        raise InputError(
            "The port answers 'slave 1' to QVer: a switchboard, whose relays are open until "
            f"SRelOn. Expected a supply with firmware 8. Correct supply.port. {config.port}"
        )
    if line.version != _FIRMWARE:
        raise InputError(
            f"The high-voltage supply answers {line.version!r} to QVer, expected "
            f"{_FIRMWARE!r}: other firmware may not switch off in the same way. Load firmware 8, "
            f"or correct supply.port. {config.port}"
        )
    wanted = config.serial_number
    if wanted is not None and name != wanted:
        raise InputError(
            f"Name of the high-voltage supply = {name!r}, expected {wanted!r} by the rig file. "
            f"Connect that one, or correct supply.serial_number. {config.port}"
        )
    if not reach.isdecimal():
        raise line.no_reply(f"QVmax: {reach!r}")
    if int(reach) < config.highest_v:
        raise InputError(
            f"supply.highest_v = {config.highest_v:g} V, this supply reaches {int(reach)} V. "
            f"Lower it. {config.port}"
        )
    return f"{name}, {line.version}"


def _check_memory(config: PetaPicoVoltronConfig, line: SupplyLine, *, switched_off: bool) -> None:
    """Refuse a supply that puts out a voltage by itself once it gets power.

    Raises:
        DeviceError: no sensible answer.
        InputError: it would.
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
            f"The high-voltage supply would put out {reported} as soon as it gets power: its "
            f"memory holds SwSrc {source}, SwMode {mode}, VMode {vmode}, Vset {set_v}, {cycles} "
            "cycles. "
            f"{_SWITCHED_OFF if switched_off else _MAY_BE_ON} {config.port}"
        )


def _check_jack(config: PetaPicoVoltronConfig, line: SupplyLine) -> None:
    """Refuse a supply that echoes everything and gives no voltage.

    Raises:
        DeviceError: no power, or no sensible answer.
    """
    used, plugged = line.query_all(["QPowJack", "QJack"])
    if used not in {"0", "1"} or plugged not in {"0", "1"}:
        raise line.no_reply(f"QPowJack: {used!r}, QJack: {plugged!r}")
    if used == "1" and plugged == "0":
        raise DeviceError(
            "The high-voltage supply has no power: its power jack is out, and it would echo every "
            f"voltage without giving one. Plug it in. {config.port}"
        )


def identify_supply(config: PetaPicoVoltronConfig) -> str:
    """What a supply says it is, and whether it is fit for use; it is left as it is.

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
                f"The high-voltage supply is ON: its meter shows {left_v:g} V. Keep clear; if no "
                f"run uses it, type: haselab rig safe RIG.toml. {config.port}"
            )
        _check_memory(config, line, switched_off=False)
        _check_jack(config, line)
        return reported
    finally:
        line.close()


def switch_supply_off(config: PetaPicoVoltronConfig) -> None:
    """Switch off whatever supply answers on the port, over a connection of its own.

    It is switched off before anything is asked of it, so that no fault of its own prevents that.

    Args:
        config: section `supply` of the rig file.
    Raises:
        DeviceError: not confirmed off, or another supply than the rig file names.
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
    """One supply: fulfils `HighVoltageSupply` and `ReportsOutputState`. It is off after opening.

    Args:
        config: section `supply` of the rig file.
    Raises:
        DeviceError: no driver, no port, no sensible answer, or not confirmed off.
        InputError: another supply than the rig file names, one that cannot reach its limit, or one
            that would switch on by itself at power-on.
    """

    def __init__(self, config: PetaPicoVoltronConfig) -> None:
        self._config = config
        self.tolerance_v = config.tolerance_v  # of its meter: at rest it may show as much
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
        """Refuse a supply that echoes everything and gives no voltage.

        Raises:
            DeviceError: its power jack is out, or no sensible answer.
        """
        _check_jack(self._config, self._line)

    # ---- HighVoltageSupply ---------------------------------------------------------------------

    def set_voltage(self, voltage_v: float) -> None:
        """See `haselab.rig.HighVoltageSupply`; whole volts.

        From off, power, switch source and modes are verified; a change of the voltage later on
        costs two commands.
        """
        if not 0.0 <= voltage_v <= self._config.highest_v:
            raise LimitError(
                f"Supply voltage = {voltage_v:g} V is outside [0, {self._config.highest_v:g}] V. "
                "Lower the request, or widen the limit in the rig file."
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
        """The state in which an echoed voltage is one."""
        found = self._line.query_all(_ON_STATE)
        expected = ["0", "0", str(_MODE_DC), str(whole_v)]
        if found != expected:
            raise self._line.no_reply(
                f"{', '.join(_ON_STATE)} are {', '.join(found)}, expected {', '.join(expected)}"
            )
        self._energised = True

    def read_voltage(self) -> float:
        """See `haselab.rig.HighVoltageSupply`; of its converter, ahead of the output switch."""
        return self._line.number("QVnow")

    def off(self) -> None:
        """See `haselab.rig.HighVoltageSupply`. Never raises, does not wait for the discharge."""
        self._energised = False
        if quietly(self._line.switch_off) is not None:  # somebody else may have been on the line
            quietly(self._line.switch_off)

    def is_off(self) -> bool:
        """See `haselab.rig.ReportsOutputState`: by its settings, not by its meter."""
        return not self._line.not_off()

    def close(self) -> None:
        """Off, port closed. Never raises."""
        self.off()
        self._line.close()
