"""A high-voltage supply with SCPI over TCP: `kind = "mysupply"` in section supply of RIG.toml."""

import contextlib
import socket
import time
from typing import Literal

from pydantic import Field

from haselab.base import DeviceError, InputError, LimitError
from haselab.rig.instruments import OpenContext, SupplyConfig, SupplyInstrument


class MySupplyConfig(SupplyConfig):
    """Section `supply`. Also has `highest_v` and `tolerance_v`, which every supply has."""

    kind: Literal["mysupply"] = "mysupply"
    host: str = Field(min_length=1, description="name or address of the supply")
    port: int = Field(5025, ge=1, le=65535)
    serial_number: str | None = Field(None, description="third field of *IDN?")
    timeout_s: float = Field(1.0, gt=0, le=30)
    discharge_s: float = Field(3.0, gt=0, le=60, description="that it may take to run down")


class Connection:
    """One TCP connection."""

    def __init__(self, config: MySupplyConfig) -> None:
        self._config = config
        try:
            self._socket = socket.create_connection((config.host, config.port), config.timeout_s)
        except OSError as error:
            raise self.fault(error) from None
        self._stream = self._socket.makefile("rwb")

    def fault(self, error: object) -> DeviceError:
        return DeviceError(
            f"The supply does not reply ({error}). Switch it on, check its cable, or change "
            f"supply.host and supply.port. {self._config.host}:{self._config.port}"
        )

    def query(self, question: str) -> str:
        try:
            self._stream.write(question.encode("ascii") + b"\n")
            self._stream.flush()
            answer = self._stream.readline()
        except (OSError, ValueError) as error:  # ValueError: the connection is closed
            raise self.fault(error) from None
        if not answer.endswith(b"\n"):
            raise self.fault("it closed the connection")
        return answer.decode("ascii", errors="replace").strip()

    def number(self, question: str) -> float:
        answer = self.query(question)
        try:
            return float(answer)
        except ValueError:
            raise self.fault(f"the reply to {question} is {answer!r}") from None

    def check_identity(self) -> str:
        identity = self.query("*IDN?")
        wanted = self._config.serial_number
        if wanted is not None and wanted not in identity.split(","):
            raise InputError(
                f"The supply identifies as {identity!r}, but supply.serial_number is {wanted}. "
                "Connect that supply, or change the rig file."
            )
        return identity

    def switch_off(self) -> None:
        """Switch off, confirmed by the instrument's own report."""
        if self.query("OUTP OFF;:VOLT 0;:OUTP?") != "0" or self.number("VOLT?") != 0.0:
            raise self.fault("the output is not off after OUTP OFF")

    def switch_off_and_discharge(self) -> None:
        """Switch off, confirmed by its meter too."""
        self.switch_off()
        end_s = time.monotonic() + self._config.discharge_s
        while (left_v := abs(self.number("MEAS:VOLT?"))) > self._config.tolerance_v:
            if time.monotonic() > end_s:
                raise self.fault(f"it shows {left_v:g} V after OUTP OFF")
            time.sleep(0.05)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._stream.close()
        self._socket.close()


class MySupplyDevice:
    """The opened supply. Its output is off after opening."""

    def __init__(self, config: MySupplyConfig) -> None:
        self._config, self.tolerance_v = config, config.tolerance_v
        self._connection = Connection(config)
        try:
            self.identity = self._connection.check_identity()
            self._connection.switch_off_and_discharge()
        except BaseException:
            self._connection.close()
            raise

    def set_voltage(self, voltage_v: float) -> None:
        if not 0.0 <= voltage_v <= self._config.highest_v:  # also refuses NaN
            raise LimitError(
                f"The supply voltage is {voltage_v:g} V, outside [0, {self._config.highest_v:g}] V."
            )
        found = self._connection.query(f"VOLT {voltage_v:.1f};:OUTP ON;:VOLT?")
        if found != f"{voltage_v:.1f}":
            self.off()
            raise self._connection.fault(f"VOLT? is {found} after VOLT {voltage_v:.1f}")

    def read_voltage(self) -> float:
        return self._connection.number("MEAS:VOLT?")

    def is_off(self) -> bool:
        return self._connection.query("OUTP?") == "0"

    def off(self) -> None:
        """Switch off. Never raises: the shutdown must continue, and then calls `is_off`."""
        with contextlib.suppress(DeviceError):
            self._connection.switch_off()

    def close(self) -> None:
        self.off()
        self._connection.close()


class MySupply(SupplyInstrument[MySupplyConfig]):
    """What `haselab` calls: the run, the guardian processes, `rig check`, `rig safe`, `doctor`."""

    kind = "mysupply"
    config = MySupplyConfig
    purpose = "SCPI high-voltage supplies"

    def open(self, config: MySupplyConfig, context: OpenContext) -> MySupplyDevice:
        return MySupplyDevice(config)

    def identify(self, config: MySupplyConfig) -> str:
        with contextlib.closing(Connection(config)) as connection:
            return connection.check_identity()

    def addresses(self, config: MySupplyConfig) -> tuple[str, ...]:
        return (f"{config.host}:{config.port}",)

    def shut_down(self, config: MySupplyConfig, within_s: float) -> None:
        with contextlib.closing(Connection(config)) as connection:
            connection.switch_off_and_discharge()
            connection.check_identity()
