"""Libraries that are not installed with haselab, found when they are needed."""

from __future__ import annotations

import importlib
from types import ModuleType

from haselab.base import InputError

__all__ = ["library"]


def library(name: str, extra: str = "haselab[frames]") -> ModuleType:
    """Import a library such as pandas.

    Args:
        name: of its module.
        extra: what to install if it is missing.
    Returns:
        The module.
    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(
            f"This needs {name.partition('.')[0]}, which is not installed. Install {extra}."
        ) from None
