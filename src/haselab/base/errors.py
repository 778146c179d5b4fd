"""The error classes. A message says what is wrong, the value found and what to do."""

__all__ = ["DeviceError", "HaselabError", "InputError", "LimitError", "ResultError", "SafetyError"]


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
