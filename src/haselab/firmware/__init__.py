"""The microcontroller's messages, frames, and compiled-in settings."""

from haselab.firmware.frames import (
    FrameReader,
    decode_message,
    encode_message,
    stuff,
    unstuff,
)
from haselab.firmware.settings import (
    CAPACITANCE_NOISE,
    CARRIER_HZ,
    CURRENT_SHARE,
    HIGHEST_DRIVE_V,
    MOTION_RISE_V_PER_S,
    OUTPUT_V_PER_CODE,
    RATE_HZ,
    UPDATE_AGE_S,
    UPDATE_DELAY_S,
    ChipSettings,
    ControllerStep,
    FrontEnd,
    settings_crc,
    settings_from_dict,
    settings_header,
)

__all__ = [
    "CAPACITANCE_NOISE",
    "CARRIER_HZ",
    "CURRENT_SHARE",
    "HIGHEST_DRIVE_V",
    "MOTION_RISE_V_PER_S",
    "OUTPUT_V_PER_CODE",
    "RATE_HZ",
    "UPDATE_AGE_S",
    "UPDATE_DELAY_S",
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
