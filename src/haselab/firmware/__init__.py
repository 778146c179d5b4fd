"""The microcontroller's side: messages of its wire, frames, and what is compiled into it."""

from haselab.firmware.frames import (
    FrameReader,
    decode_message,
    encode_message,
    stuff,
    unstuff,
)
from haselab.firmware.settings import (
    CARRIER_HZ,
    OUTPUT_V_PER_CODE,
    RATE_HZ,
    ChipSettings,
    ControllerStep,
    FrontEnd,
    settings_crc,
    settings_from_dict,
    settings_header,
)

__all__ = [
    "CARRIER_HZ",
    "OUTPUT_V_PER_CODE",
    "RATE_HZ",
    "ChipSettings",
    "ControllerStep",
    "FrameReader",
    "FrontEnd",
    "decode_message",
    "encode_message",
    "settings_crc",
    "settings_from_dict",
    "settings_header",
    "stuff",
    "unstuff",
]
