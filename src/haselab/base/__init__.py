"""Foundations that every package uses: estimates, limits, errors, progress."""

from haselab.base.arguments import (
    check_fields,
    check_length,
    checked,
    generator,
    is_real,
    real_array,
    shown,
)
from haselab.base.closing import Closing
from haselab.base.errors import (
    DeviceError,
    HaselabError,
    InputError,
    LimitError,
    ResultError,
    SafetyError,
    described,
    text_of,
)
from haselab.base.estimate import Estimate
from haselab.base.json import Json, JsonObject, table_at
from haselab.base.limits import Limits
from haselab.base.plain import to_plain
from haselab.base.progress import Progress, SilentProgress

__all__ = [
    "Closing",
    "DeviceError",
    "Estimate",
    "HaselabError",
    "InputError",
    "Json",
    "JsonObject",
    "LimitError",
    "Limits",
    "Progress",
    "ResultError",
    "SafetyError",
    "SilentProgress",
    "check_fields",
    "check_length",
    "checked",
    "described",
    "generator",
    "is_real",
    "real_array",
    "shown",
    "table_at",
    "text_of",
    "to_plain",
]
