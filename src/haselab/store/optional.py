"""Libraries that are not installed with haselab, found when they are needed."""

from __future__ import annotations

import importlib
from types import ModuleType

from haselab.base import InputError

__all__ = ["library"]


def library(name: str) -> ModuleType:
    """Import pandas or xarray.

    Args:
        name: of the library.
    Returns:
        The module.
    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(
            f"This needs {name}, which is not installed. Install haselab[frames]."
        ) from None
