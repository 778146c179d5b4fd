"""Section `generator` of RIG.toml for a Keysight 33500B."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from haselab.rig.instruments.sections import GeneratorConfig

__all__ = ["KeysightConfig"]


class KeysightConfig(GeneratorConfig):
    """Keysight 33500B over VISA."""

    kind: Literal["keysight33500"] = "keysight33500"
    address: str = Field(
        min_length=1,
        description="VISA address, ending in SOCKET or INSTR",
        examples=["TCPIP::192.168.1.5::5025::SOCKET"],
    )
    serial_number: str | None = Field(None, description="third field of *IDN?")
    channel: Literal[1, 2] = 1
    load: Literal["INF", "50"] = "INF"
    volt_per_volt: float = Field(1.0, gt=0, description="V at the amplifier's input per V set")
    timeout_s: float = Field(1.0, gt=0, le=30)
