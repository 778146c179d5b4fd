"""Libraries that are not installed with haselab, found when they are needed."""

from __future__ import annotations

import importlib
from types import ModuleType

from haselab.base import InputError

__all__ = ["library"]


def library(name: str, extra: str) -> ModuleType:
    """Import a library such as pandas.

    Args:
        name: of its module.
        extra: of haselab that installs it, such as `frames`.
    Returns:
        The module.
    Raises:
        InputError: it is not installed.
    """
    try:
        return importlib.import_module(name)
    except ImportError:
        raise InputError(
            f"This needs {name.partition('.')[0]}, which is not installed. "
            f"Run: pip install 'haselab[{extra}]'"
        ) from None
