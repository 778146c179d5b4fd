"""The microcontroller's messages, frames, and compiled-in settings."""

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
