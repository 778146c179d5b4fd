"""Names of experiments: each becomes the name of a file somewhere."""

from __future__ import annotations

import re

from haselab.base import InputError

__all__ = ["check_name"]

_LONGEST = 100
_FORBIDDEN = re.compile(r'[<>:"/\\|?*]|[^\x20-\U0010ffff]|\x7f')
_RESERVED = re.compile(r"(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])(\..*)?", re.IGNORECASE)


def check_name(name: str) -> None:
    r"""Refuse the name of an experiment that is no file name on every system.

    Args:
        name: of the experiment.
    Raises:
        InputError: empty, too long, or it holds a path, a drive, a control character or a name that
            Windows reserves.
    Example:
        >>> check_name("triangle-1")
        >>> check_name("a/b")  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        haselab.base.errors.InputError: Experiment name 'a/b' cannot be a file name. ...
    """
    bad = (
        not name
        or len(name.encode(errors="replace")) > _LONGEST
        or not name.isprintable()
        or name != name.strip(" ")
        or name.startswith(".")
        or name.endswith(".")
        or _FORBIDDEN.search(name)
        or _RESERVED.fullmatch(name)
    )
    if bad:
        raise InputError(
            f"Experiment name {name!r} cannot be a file name. Use letters, digits, '-' and '_' "
            f"(at most {_LONGEST} bytes)."
        )
