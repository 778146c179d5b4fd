"""What every driver shares: optional packages, the words for their absence, quiet clean-up."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from haselab.base import DeviceError

__all__ = ["load_driver", "quietly"]


def load_driver(module: str, what: str) -> Any:
    """A module of an optional package.

    Args:
        module: to import.
        what: needs it, for the message.
    Returns:
        The module.
    Raises:
        DeviceError: it is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        missing = error.name or module
    raise DeviceError(
        f"{what} needs the Python package {missing.partition('.')[0]!r}, which is not installed. "
        "Type: pip install 'haselab[instruments]'"
    )


def quietly(act: Callable[[], object]) -> Exception | None:
    """Do something that must not stop what comes after it; returns what went wrong.

    On the way to 0 V the next step counts more than the last one's fault; whoever has to know
    reads back what came of it.
    """
    try:
        act()
    except Exception as error:
        return error
    return None
