"""Functions shared by all drivers: import of optional packages, and clean-up without errors."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from haselab.base import DeviceError
from haselab.base.exits import no_exit

__all__ = ["load_driver", "quietly"]


def load_driver(module: str, what: str) -> Any:
    """Import a module of an optional package.

    Args:
        module: to import.
        what: device that needs it, for the message.
    Returns:
        The module.
    Raises:
        DeviceError: The package is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        missing = error.name or module
    raise DeviceError(
        f"{what} needs the Python package {missing.partition('.')[0]!r}, which is not installed. "
        "Run: pip install 'haselab[instruments]'"
    )


def quietly(act: Callable[[], object]) -> Exception | None:
    """Call a function that must not stop what follows; return its error instead of raising it.

    During shutdown the next step matters more than the error of the last one; the result is read
    back afterwards.
    """
    try:
        with no_exit():
            act()
    except Exception as error:
        return error
    return None
