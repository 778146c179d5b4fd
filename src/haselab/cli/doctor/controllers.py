"""Check the controllers of installed packages: whether they load, and what they need."""

from __future__ import annotations

from collections.abc import Iterator

from haselab.base import InputError
from haselab.cli.doctor.machine import Finding
from haselab.controllers import controller_kind, installed_controllers

__all__ = ["controller_findings"]


def controller_findings() -> Iterator[Finding]:
    """Yield one row for each kind of controller that another package has registered."""
    for name, package in installed_controllers():
        try:
            kind = controller_kind(name)
        except InputError as error:
            what, _, advice = str(error).rpartition(". ")
            yield Finding("controller", name, False, what, advice)
            continue
        parameters = ", ".join(parameter.name for parameter in kind.parameters) or "none"
        chip = "C step" if kind.c_source is not None else "no C step"
        yield Finding("controller", name, True, f"{package}; {chip}; parameters: {parameters}")
