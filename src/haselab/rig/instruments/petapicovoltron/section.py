"""Section `supply` of RIG.toml for a Peta-Pico-Voltron."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from haselab.rig.instruments.sections import SupplyConfig

__all__ = ["PetaPicoVoltronConfig"]


class PetaPicoVoltronConfig(SupplyConfig):
    """High-voltage supply of the Peta-Pico-Voltron family on a serial port."""

    kind: Literal["petapicovoltron"] = "petapicovoltron"
    port: str = Field(min_length=1, description="serial port", examples=["/dev/ttyACM0"])
    serial_number: str | None = Field(None, description="reply to QName")
    timeout_s: float = Field(1.0, gt=0, le=30)
