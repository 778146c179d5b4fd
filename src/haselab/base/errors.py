"""The error classes. A message says what is wrong, the value found and what to do."""

import re

from haselab.base.exits import no_exit

__all__ = [
    "DeviceError",
    "HaselabError",
    "InputError",
    "LimitError",
    "ResultError",
    "SafetyError",
    "described",
    "named_files",
    "text_of",
]

# Words after the last full stop that are no sentence: names of files, which end in no full stop.
_BARE_FILES = re.compile(r"(?<=[.!?]) (\S*[^\s.!?]|\S*[./]\S*[^\s.!?](?: \S*[./]\S*[^\s.!?])+)$")


class HaselabError(Exception):
    """Root of all errors that haselab raises; the command line exits with `exit_code`."""

    exit_code = 1


class InputError(HaselabError, ValueError):
    """A file, column, option or value cannot be used as given."""

    exit_code = 2


class LimitError(InputError):
    """A number is outside its limits."""


class ResultError(HaselabError, RuntimeError):
    """An analysis cannot compute a result from the given data."""

    exit_code = 3


class DeviceError(HaselabError, OSError):
    """An instrument, a link or a disk failed."""

    exit_code = 4


class SafetyError(DeviceError):
    """A protection tripped; the output was commanded to 0 V."""


def named_files(message: str) -> str:
    """Write "File:" before the names of files that stand alone at the end of a message.

    Args:
        message: one line.
    Example:
        >>> named_files("The column is constant. Name another one. data/a.csv")
        'The column is constant. Name another one. File: data/a.csv'
        >>> named_files("Not rising. a.csv b.csv"), named_files("Use a rate above 0 Hz: a.csv")
        ('Not rising. Files: a.csv b.csv', 'Use a rate above 0 Hz: a.csv')
    """
    return _BARE_FILES.sub(
        lambda found: f" File{'s' if ' ' in found[1] else ''}: {found[1]}", message
    )


def text_of(error: BaseException) -> str:
    """Return the text of an exception in one line.

    Args:
        error: of any package; its own `__str__` may fail.
    Returns:
        The text, or a remark that there is none.
    Example:
        >>> class Broken(Exception):
        ...     def __str__(self):
        ...         raise KeyError("text")
        >>> text_of(ValueError("too large")), text_of(Broken())
        ('too large', 'no text: its __str__ raised KeyError')
    """
    try:
        with no_exit():
            return " ".join(str(error).split())
    except Exception as second:
        return f"no text: its __str__ raised {type(second).__name__}"


def described(error: BaseException) -> str:
    """Return the class and the text of an exception in one line.

    Args:
        error: of any package; its own `__str__` may fail.
    Returns:
        The description.
    Example:
        >>> described(ValueError("too large")), described(TimeoutError())
        ('ValueError: too large', 'TimeoutError')
    """
    name, text = type(error).__name__, text_of(error)
    return f"{name}: {text}" if text else name
