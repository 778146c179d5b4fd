"""Check the names of experiments, which become names of files, and convert them."""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from itertools import chain, count

from haselab.base import InputError

__all__ = ["check_name", "matlab_names", "table_names"]

_LONGEST = 100
_FORBIDDEN = re.compile(r'[<>:"/\\|?*]|[^\x20-\U0010ffff]|\x7f')
_LONGEST_VARIABLE = 63  # MATLAB's namelengthmax
_KEYWORD = re.compile(
    "break|case|catch|classdef|continue|else|elseif|end|for|function|global|if|otherwise|parfor|"
    "persistent|return|spmd|switch|try|while"
)
_RESERVED = re.compile(r"(con|prn|aux|nul|com[0-9¹²³]|lpt[0-9¹²³])(\..*)?", re.IGNORECASE)


def check_name(name: str) -> None:
    r"""Refuse a name of an experiment that is not a file name on every system.

    Args:
        name: of the experiment.
    Raises:
        InputError: empty, too long, or with a path, a drive, a control character or a name that
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


def _distinct(
    names: Sequence[str],
    plain: Callable[[str, str], str],
    keys: Callable[[str], Iterable[str]],
    taken: Iterable[str],
) -> dict[str, str]:
    """Give each a name, so that no two share a key; keep names where possible.

    Args:
        names: of the experiments, each once.
        plain: returns the other tool's name for a name and an ending that makes it unique.
        keys: returns the keys that a name occupies in the other tool.
        taken: keys that must not be used.
    """
    used, found = set(taken), dict[str, str]()

    def give(name: str, new: str) -> bool:
        if name in found or not used.isdisjoint(keys(new)):
            return name in found
        found[name] = new
        used.update(keys(new))
        return True

    for name in names:
        if plain(name, "") == name:
            give(name, name)
    for name in names:
        endings = (f"-{number}" for number in count(2))
        next(ending for ending in chain([""], endings) if give(name, plain(name, ending)))
    return {name: found[name] for name in names}


def table_names(
    names: Sequence[str], endings: Sequence[str], taken: Sequence[str]
) -> dict[str, str]:
    """Convert names of experiments to names of tables, each of which is a file.

    Args:
        names: of the experiments, each once.
        endings: of the tables of an experiment.
        taken: names of other tables.
    Returns:
        Names by experiment, unique also on systems that ignore upper and lower case.
    Example:
        >>> table_names(["events", "a", "A"], ["", "-blocks"], ["events"])
        {'events': 'events-2', 'a': 'a', 'A': 'A-2'}
    """

    def folded(text: str) -> str:
        return unicodedata.normalize("NFKC", text).casefold()

    return _distinct(
        names,
        lambda name, ending: name + ending,
        lambda new: {folded(new + ending) for ending in endings},
        {folded(each) for each in taken},
    )


def matlab_names(names: Sequence[str], taken: Sequence[str]) -> dict[str, str]:
    """Convert names of experiments to names of MATLAB variables.

    Args:
        names: of the experiments, each once.
        taken: names of other variables.
    Returns:
        By experiment, all different.
    Example:
        >>> matlab_names(["step-1", "step 1", "2nd", "session"], ["session"])
        {'step-1': 'step_1', 'step 1': 'step_1_2', '2nd': 'x2nd', 'session': 'session_2'}
    """

    def plain(name: str, ending: str) -> str:
        text = "".join(c if c.isascii() and c.isalnum() else "_" for c in name)
        text = text if text[:1].isalpha() and not _KEYWORD.fullmatch(text) else f"x{text}"
        ending = ending.replace("-", "_")
        return text[: _LONGEST_VARIABLE - len(ending)] + ending

    return _distinct(names, plain, lambda new: {new}, taken)
