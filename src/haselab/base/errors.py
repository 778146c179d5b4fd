"""One tree of errors. Each says what, got, allowed and what to do; the path comes last."""

__all__ = ["DeviceError", "HaselabError", "InputError", "LimitError", "ResultError", "SafetyError"]


class HaselabError(Exception):
    """Root of all errors raised on purpose; `exit_code` is the command line's answer."""

    exit_code = 1


class InputError(HaselabError, ValueError):
    """A file, column, option or value cannot be used as given."""

    exit_code = 2


class LimitError(InputError):
    """A number lies outside its stated limits."""


class ResultError(HaselabError, RuntimeError):
    """An analysis could not reach a result from the data it was given."""

    exit_code = 3


class DeviceError(HaselabError, OSError):
    """An instrument, a link or a disk failed."""

    exit_code = 4


class SafetyError(DeviceError):
    """A protection tripped; the output was taken to 0 V."""
