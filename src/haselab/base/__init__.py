"""Foundations that every package uses: estimates, limits, errors, progress."""

from haselab.base.errors import (
    DeviceError,
    HaselabError,
    InputError,
    LimitError,
    ResultError,
    SafetyError,
)
from haselab.base.estimate import Estimate
from haselab.base.limits import Limits
from haselab.base.plain import to_plain
from haselab.base.progress import Progress, SilentProgress

__all__ = [
    "DeviceError",
    "Estimate",
    "HaselabError",
    "InputError",
    "LimitError",
    "Limits",
    "Progress",
    "ResultError",
    "SafetyError",
    "SilentProgress",
    "to_plain",
]
